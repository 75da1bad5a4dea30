"""Node trees written as formulas: sockets with arithmetic, for geometry, shader and compositor trees.

fake-bpy-module has no types for what nodes of one kind have alone, so nodes and sockets are Any here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypeAlias, cast

import bpy

from ..blender_types import present

Operand: TypeAlias = "Field | float | Sequence[float] | str | bpy.types.Material"
"""Value of an input socket: the output of another node, or a constant."""


class Field:
    """An output socket with arithmetic; each operation adds one node to the tree that the socket belongs to.

    Numbers act on number sockets, numbers or triples on vector sockets; vector * number scales.
    """

    def __init__(self, socket: bpy.types.NodeSocket) -> None:
        self.socket = socket

    @property
    def tree(self) -> bpy.types.NodeTree:
        """The tree that the socket belongs to."""
        return cast(bpy.types.NodeTree, self.socket.id_data)

    @property
    def is_vector(self) -> bool:
        """Whether the socket holds a vector or a color."""
        return self.socket.type in {"VECTOR", "RGBA"}

    def math(self, operation: str, *others: Operand) -> Field:
        """One Math node: operation of the field and the others."""
        return self._node("ShaderNodeMath", operation, "Value", self, *others)

    def vector(self, operation: str, *others: Operand, output: str = "Vector") -> Field:
        """One Vector Math node: operation of the field and the others."""
        return self._node("ShaderNodeVectorMath", operation, output, self, *others)

    def _node(self, kind: str, operation: str, output: str, *operands: Operand) -> Field:
        node: Any = self.tree.nodes.new(kind)
        node.operation = operation
        for socket, operand in zip(node.inputs, operands, strict=False):
            connect(self.tree, operand, socket)
        return Field(node.outputs[output])

    def scaled(self, factor: Operand) -> Field:
        """Product of a vector and a number."""
        node: Any = self.tree.nodes.new("ShaderNodeVectorMath")
        node.operation = "SCALE"
        connect(self.tree, self, node.inputs["Vector"])
        connect(self.tree, factor, node.inputs["Scale"])
        return Field(node.outputs["Vector"])

    def dot(self, other: Operand) -> Field:
        """Dot product of two vectors."""
        return self.vector("DOT_PRODUCT", other, output="Value")

    def xyz(self) -> tuple[Field, Field, Field]:
        """The three components of a vector."""
        node = self.tree.nodes.new("ShaderNodeSeparateXYZ")
        connect(self.tree, self, node.inputs["Vector"])
        x, y, z = (Field(socket) for socket in node.outputs)
        return x, y, z

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


def new_tree(
    name: str, kind: Literal["GeometryNodeTree", "ShaderNodeTree", "CompositorNodeTree"]
) -> bpy.types.NodeTree:
    """Make an empty node group."""
    return present(bpy.data.node_groups.new(name, kind))


def add_socket(
    tree: bpy.types.NodeTree,
    name: str,
    kind: str,
    in_out: Literal["INPUT", "OUTPUT"] = "INPUT",
    parent: bpy.types.NodeTreeInterfacePanel | None = None,
) -> Any:
    """Add an input or output to a node group; `kind` as in NodeSocketFloat."""
    new_socket = cast(Any, present(tree.interface).new_socket)
    return new_socket(name, in_out=in_out, socket_type=f"NodeSocket{kind}", parent=parent)


def add_input(
    tree: bpy.types.NodeTree,
    name: str,
    kind: str,
    description: str,
    default: float | Sequence[float],
    low: float | None = None,
    high: float | None = None,
    parent: bpy.types.NodeTreeInterfacePanel | None = None,
) -> Any:
    """Add an input with a default value, and for numbers their range, to a node group."""
    socket = add_socket(tree, name, kind, parent=parent)
    socket.default_value, socket.description = default, description
    if low is not None:
        socket.min_value, socket.max_value = low, high
    return socket


def by_name(sockets: bpy.types.NodeOutputs) -> dict[str, Field]:
    """The outputs of a node by their names."""
    return {socket.name: Field(socket) for socket in sockets if socket.name}


def connect(tree: bpy.types.NodeTree, value: Operand, socket: bpy.types.NodeSocket) -> None:
    """Set an input socket: a link from a field, or a constant."""
    if isinstance(value, Field):
        tree.links.new(value.socket, socket)
    else:
        cast(Any, socket).default_value = value


def add(
    tree: bpy.types.NodeTree | None, kind: str, settings: dict[str, Any] | None = None, **inputs: Operand
) -> bpy.types.Node:
    """Make a node.

    Args:
        tree: where the node is made; never None, although a material's tree has that type.
        kind: type name of the node.
        settings: properties of the node by name.
        **inputs: values of its input sockets by name, with `_` for a space.
    """
    assert tree is not None
    node = tree.nodes.new(kind)
    for name, value in (settings or {}).items():
        setattr(node, name, value)
    for name, value in inputs.items():
        socket = next(s for s in node.inputs if s.name == name.replace("_", " ") and s.enabled)
        connect(tree, value, socket)
    return node


def combined(tree: bpy.types.NodeTree, parts: Sequence[Operand]) -> Field:
    """Vector of three numbers."""
    node = tree.nodes.new("ShaderNodeCombineXYZ")
    for part, socket in zip(parts, node.inputs, strict=True):
        connect(tree, part, socket)
    return Field(node.outputs["Vector"])


def switch(tree: bpy.types.NodeTree, condition: Field, off: Field, on: Field, kind: str = "GEOMETRY") -> Field:
    """One of two fields of geometry nodes; only that one is computed if `condition` is the same for all points."""
    node = add(tree, "GeometryNodeSwitch", {"input_type": kind}, Switch=condition, **{"False": off, "True": on})
    return Field(node.outputs["Output"])


def stored(tree: bpy.types.NodeTree, geometry: Field, name: str, kind: str, value: Field) -> Field:
    """The geometry with a field stored as a point attribute."""
    node = add(
        tree,
        "GeometryNodeStoreNamedAttribute",
        {"data_type": kind, "domain": "POINT"},
        Geometry=geometry,
        Name=name,
        Value=value,
    )
    return Field(node.outputs["Geometry"])


def attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> Field:
    """A point attribute as a field."""
    node = add(tree, "GeometryNodeInputNamedAttribute", {"data_type": kind}, Name=name)
    return Field(node.outputs["Attribute"])


def alpha(tree: bpy.types.NodeTree, color: Field) -> Field:
    """The alpha of a color in geometry nodes."""
    return Field(add(tree, "FunctionNodeSeparateColor", Color=color).outputs["Alpha"])


def arranged(tree: bpy.types.NodeTree) -> None:
    """Place the nodes in columns by their distance from the inputs, so that the tree is readable."""
    column: dict[str, int] = {}
    incoming: dict[str, list[str]] = {node.name: [] for node in tree.nodes}
    for link in tree.links:
        incoming[present(link.to_node).name].append(present(link.from_node).name)
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
    # In one call: moving a node alone makes Blender search the whole tree.
    tree.nodes.foreach_set("location", places)
