"""Materials of the map of a survey's blocks: one color each, without light."""

from typing import Any

import bpy

from ..blender_types import present
from . import build

Color = tuple[float, float, float]


def material(name: str, color: Color, alpha: float) -> bpy.types.Material:
    """The material of a name that emits a color; made once per file.

    Args:
        name: of the material.
        color: linear light.
        alpha: 0 (clear) to 1.
    """
    if (known := bpy.data.materials.get(name)) is not None:
        return known
    made: Any = bpy.data.materials.new(name)
    made.use_nodes = True
    made.diffuse_color = (*color, alpha)  # for Solid shading
    made.surface_render_method = "BLENDED"
    tree = present(made.node_tree)
    tree.nodes.clear()
    emission = build.add(tree, "ShaderNodeEmission", Color=(*color, 1.0))
    clear = build.add(tree, "ShaderNodeBsdfTransparent")
    mixed: Any = build.add(tree, "ShaderNodeMixShader")
    mixed.inputs[0].default_value = alpha
    for output, socket in zip((clear.outputs["BSDF"], emission.outputs["Emission"]), mixed.inputs[1:], strict=True):
        tree.links.new(output, socket)
    build.add(tree, "ShaderNodeOutputMaterial", Surface=build.Field(mixed.outputs["Shader"]))
    build.arranged(tree)
    return made
