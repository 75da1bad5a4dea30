"""The material of coloured points: the sparse cloud, and splats shown as points."""

import bpy

from . import build

NAME = "SWAG Points"
COLOR = "swag:color"  # linear light


def material() -> bpy.types.Material:
    """Emission of the point attribute `swag:color`; made once per file."""
    if (known := bpy.data.materials.get(NAME)) is not None:
        return known
    made = bpy.data.materials.new(NAME)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    color = build.add(tree, "ShaderNodeAttribute", {"attribute_type": "GEOMETRY", "attribute_name": COLOR})
    emission = build.add(tree, "ShaderNodeEmission", Color=build.Field(color.outputs["Color"]))
    build.add(tree, "ShaderNodeOutputMaterial", Surface=build.Field(emission.outputs["Emission"]))
    build.arranged(tree)
    return made
