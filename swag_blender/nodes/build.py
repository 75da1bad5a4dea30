"""Node trees written as formulas: sockets that add and multiply, shared by geometry and shader trees."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

Operand = "Field | float | Sequence[float]"


class Field:
    """An output socket with arithmetic; each operation adds one node to the tree that the socket belongs to.

    Numbers act on number sockets, numbers or triples on vector sockets; vector * number scales.
    """

    def __init__(self, socket: bpy.types.NodeSocket):
        self.socket = socket

    @property
    def is_vector(self) -> bool:
        return self.socket.type in {"VECTOR", "RGBA"}

    def math(self, operation: str, *others: Operand) -> Field:
        """One Math node: operation of the field and the others."""
        return self._node("ShaderNodeMath", operation, "Value", self, *others)

    def vector(self, operation: str, *others: Operand, output: str = "Vector") -> Field:
        """One Vector Math node: operation of the field and the others."""
        return self._node("ShaderNodeVectorMath", operation, output, self, *others)

    def _node(self, kind: str, operation: str, output: str, *operands: Operand) -> Field:
        tree = self.socket.id_data
        node = tree.nodes.new(kind)
        node.operation = operation
        for socket, operand in zip(node.inputs, operands, strict=False):
            connect(tree, operand, socket)
        return Field(node.outputs[output])

    def scaled(self, factor: Operand) -> Field:
        """vector * number"""
        tree = self.socket.id_data
        node = tree.nodes.new("ShaderNodeVectorMath")
        node.operation = "SCALE"
        connect(tree, self, node.inputs["Vector"])
        connect(tree, factor, node.inputs["Scale"])
        return Field(node.outputs["Vector"])

    def dot(self, other: Operand) -> Field:
        """Dot product of two vectors."""
        return self.vector("DOT_PRODUCT", other, output="Value")

    def xyz(self) -> tuple[Field, Field, Field]:
        """The three components of a vector."""
        tree = self.socket.id_data
        node = tree.nodes.new("ShaderNodeSeparateXYZ")
        connect(tree, self, node.inputs["Vector"])
        return tuple(Field(socket) for socket in node.outputs)

    def _arithmetic(self, operation: str, other: Operand) -> Field:
        return self.vector(operation, other) if self.is_vector else self.math(operation, other)

    def __add__(self, other: Operand) -> Field:
        return self._arithmetic("ADD", other)

    def __sub__(self, other: Operand) -> Field:
        return self._arithmetic("SUBTRACT", other)

    def __mul__(self, other: Operand) -> Field:
        if self.is_vector and not isinstance(other, Sequence) and not (isinstance(other, Field) and other.is_vector):
            return self.scaled(other)
        return self._arithmetic("MULTIPLY", other)

    __rmul__ = __mul__


def connect(tree: bpy.types.NodeTree, value: Operand, socket: bpy.types.NodeSocket) -> None:
    """Feed an input socket: a link from a field, or a constant."""
    if isinstance(value, Field):
        tree.links.new(value.socket, socket)
    else:
        socket.default_value = value


def add(tree: bpy.types.NodeTree, kind: str, settings: dict | None = None, **inputs: Operand) -> bpy.types.Node:
    """A new node with `settings` (its properties) and its inputs fed by name (`_` in a keyword stands for a space)."""
    node = tree.nodes.new(kind)
    for name, value in (settings or {}).items():
        setattr(node, name, value)
    for name, value in inputs.items():
        socket = next(s for s in node.inputs if s.name == name.replace("_", " ") and s.enabled)
        connect(tree, value, socket)
    return node


def combined(tree: bpy.types.NodeTree, parts: Sequence[Operand]) -> Field:
    """A vector of three numbers."""
    node = tree.nodes.new("ShaderNodeCombineXYZ")
    for part, socket in zip(parts, node.inputs, strict=True):
        connect(tree, part, socket)
    return Field(node.outputs["Vector"])


def arranged(tree: bpy.types.NodeTree) -> None:
    """Lay the nodes out in columns by their distance from the inputs, so that a person can read the tree."""
    column: dict[str, int] = {}
    incoming: dict[str, list[str]] = {node.name: [] for node in tree.nodes}
    for link in tree.links:
        incoming[link.to_node.name].append(link.from_node.name)
    pending = list(incoming)
    while pending:
        for name in [n for n in pending if all(source in column for source in incoming[n])]:
            column[name] = 1 + max((column[source] for source in incoming[name]), default=-1)
            pending.remove(name)
    rows: dict[int, int] = {}
    places: list[float] = []
    for node in tree.nodes:
        x = column[node.name]
        places += (220 * x, -180 * rows.get(x, 0))
        rows[x] = rows.get(x, 0) + 1
    # At once: each node that is moved alone makes Blender look through the whole tree.
    tree.nodes.foreach_set("location", places)
