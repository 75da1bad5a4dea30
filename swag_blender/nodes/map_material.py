"""The material of a plane that shows the picture of a map."""

from typing import Any

import bpy

from ..blender_types import present
from . import build


def material(image: bpy.types.Image) -> bpy.types.Material:
    """Make a material that emits the colors of an image, and is transparent where the image is."""
    made = bpy.data.materials.new(image.name)
    made.use_nodes = True
    tree = present(made.node_tree)
    tree.nodes.clear()
    picture: Any = build.add(tree, "ShaderNodeTexImage", {"image": image, "extension": "CLIP"})
    emission = build.add(tree, "ShaderNodeEmission", Color=build.Field(picture.outputs["Color"]))
    clear = build.add(tree, "ShaderNodeBsdfTransparent")
    mixed: Any = build.add(tree, "ShaderNodeMixShader")
    for output, socket in zip(
        (picture.outputs["Alpha"], clear.outputs["BSDF"], emission.outputs["Emission"]), mixed.inputs, strict=True
    ):
        tree.links.new(output, socket)
    build.add(tree, "ShaderNodeOutputMaterial", Surface=build.Field(mixed.outputs["Shader"]))
    build.arranged(tree)
    return made
