"""The material of colored points: the sparse cloud, and splats drawn as points."""

import bpy

from ..blender_types import present
from . import build

NAME = "SWAG Points"
COLOR = "swag:color"
"""Point attribute of the color, linear light."""


def material() -> bpy.types.Material:
    """The material that emits the attribute COLOR; made once per file."""
    if (known := bpy.data.materials.get(NAME)) is not None:
        return known
    made = bpy.data.materials.new(NAME)
    made.use_nodes = True
    tree = present(made.node_tree)
    tree.nodes.clear()
    color = build.add(tree, "ShaderNodeAttribute", {"attribute_type": "GEOMETRY", "attribute_name": COLOR})
    emission = build.add(tree, "ShaderNodeEmission", Color=build.Field(color.outputs["Color"]))
    build.add(tree, "ShaderNodeOutputMaterial", Surface=build.Field(emission.outputs["Emission"]))
    build.arranged(tree)
    return made
