"""Compositor nodes that develop a render of splats: the formula of swag_engine/splats/development.py.

They act on whole pictures, as `render` and the viewport do. Splats have colors far above and below those of their
picture, so that the curve of development, unlike its gains, cannot be applied to each.
"""

from typing import Any, cast

import bpy

from ...swag_engine.splats.development import ColorView
from ..blender_types import present
from .build import Field, add, add_socket, arranged, combined, new_tree
from .formulas import Development, by_channel, to_display, to_light
from .water_shader import drive

NAME = "SWAG Development"
GROUP_KEY = "swag_development_group"
"""Property of a scene: the node group of its development."""
WATER = "Water"
_ROWS = ("Red", "Green", "Blue")
_GAINS, _CONTRAST, _KNEE, _OWN_CONTRAST = "Own Gains", "Contrast", "Knee", "Own Contrast"
_LEAST_ALPHA = 1e-6
"""Least alpha that is divided by."""


def set_up(scene: bpy.types.Scene, view: ColorView, has_water: bool, display_values: bool) -> None:
    """Put the development between the render of a scene and what its compositor makes of it.

    Args:
        scene: the scene.
        view: how its colors are developed.
        has_water: whether the slider `scene.swag.water` fades the development of restored colors.
        display_values: whether renders hold sRGB values and not linear light.
    """
    remove(scene)
    scene[GROUP_KEY] = group = _new_group(f"{NAME} {scene.name}", display_values)
    if has_water:
        drive(group, f'nodes["{WATER}"].outputs[0].default_value', scene)
    tree = _compositor(scene)
    node: Any = tree.nodes.new("CompositorNodeGroup")
    node.name = node.label = NAME
    node.node_tree = group
    _insert(tree, node)
    update(scene, view)


def update(scene: bpy.types.Scene, view: ColorView) -> None:
    """Give another development to the nodes; does nothing for a scene without them."""
    group = scene.get(GROUP_KEY)
    if group is None:
        return
    nodes: Any = group.nodes
    for name, row in zip(_ROWS, view.restored.gains.tolist(), strict=True):
        _set_vector(nodes[name], row)
    _set_vector(nodes[_GAINS], view.adjusted.gains.diagonal().tolist())
    for name, value in (
        (_CONTRAST, view.restored.contrast),
        (_KNEE, view.restored.knee),
        (_OWN_CONTRAST, view.adjusted.contrast),
    ):
        nodes[name].outputs[0].default_value = value


def is_set_up(scene: bpy.types.Scene) -> bool:
    """Whether renders of a scene are developed."""
    return scene.get(GROUP_KEY) is not None


def remove(scene: bpy.types.Scene) -> None:
    """Undo `set_up`; does nothing for a scene without the nodes."""
    group = scene.get(GROUP_KEY)
    if group is None:
        return
    tree = _compositor(scene)
    if (node := tree.nodes.get(NAME)) is not None:
        for link in list(present(node.outputs[0].links)):
            if node.inputs[0].is_linked:
                tree.links.new(present(present(node.inputs[0].links)[0].from_socket), present(link.to_socket))
        tree.nodes.remove(node)
    del scene[GROUP_KEY]
    bpy.data.node_groups.remove(group)


def _compositor(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The compositor nodes of a scene; without any, new ones that show the render, computed by the processor.

    Blender 5.2 and later use the graphics card by default: without a window that needs libEGL, and where this is
    missing, Blender aborts at the first render.
    """
    own: Any = scene
    scene.render.use_compositing = True
    if hasattr(scene, "compositing_node_group"):  # Blender 5.0 and later
        if own.compositing_node_group is None:
            own.render.compositor_device = "CPU"
            own.compositing_node_group = tree = new_tree(scene.name, "CompositorNodeTree")
            add_socket(tree, "Image", "Color", "OUTPUT")
            layers: Any = tree.nodes.new("CompositorNodeRLayers")
            layers.scene = scene
            tree.links.new(layers.outputs["Image"], tree.nodes.new("NodeGroupOutput").inputs["Image"])
        return own.compositing_node_group
    own.use_nodes = True
    return own.node_tree


def _insert(tree: bpy.types.NodeTree, node: bpy.types.Node) -> None:
    """Put a node behind the render of a compositor's tree."""
    layers = next((n for n in tree.nodes if n.bl_idname == "CompositorNodeRLayers"), None)
    if layers is None:
        return
    image = layers.outputs["Image"]
    targets = [present(link.to_socket) for link in present(image.links)]
    tree.links.new(image, node.inputs[0])
    for target in targets:
        tree.links.new(node.outputs[0], target)
    node.location = layers.location.x + 300, layers.location.y


def _new_group(name: str, display_values: bool) -> bpy.types.NodeTree:
    tree = new_tree(name, "CompositorNodeTree")
    add_socket(tree, "Image", "Color")
    add_socket(tree, "Image", "Color", "OUTPUT")

    def figure(name: str, kind: str = "ShaderNodeValue") -> Field:
        node = tree.nodes.new(kind)
        node.name = node.label = name
        return Field(node.outputs[0])

    rows, gains = [figure(name, "ShaderNodeCombineXYZ") for name in _ROWS], figure(_GAINS, "ShaderNodeCombineXYZ")
    contrast, knee, own_contrast = map(figure, (_CONTRAST, _KNEE, _OWN_CONTRAST))
    water = figure(WATER)

    image = Field(tree.nodes.new("NodeGroupInput").outputs["Image"])
    parts = [Field(socket) for socket in add(tree, "CompositorNodeSeparateColor", Image=image).outputs]
    alpha = parts[3]
    straight = combined(tree, parts[:3]).scaled(alpha.math("MAXIMUM", _LEAST_ALPHA).math("POWER", -1.0))
    light = by_channel(tree, to_light, straight) if display_values else straight
    light = Development(water, rows, contrast, gains, own_contrast, knee).apply(tree, light)
    developed = (by_channel(tree, to_display, light) if display_values else light).scaled(alpha)
    red, green, blue = developed.xyz()
    result = add(tree, "CompositorNodeCombineColor", Red=red, Green=green, Blue=blue, Alpha=alpha)
    tree.links.new(result.outputs[0], tree.nodes.new("NodeGroupOutput").inputs["Image"])
    arranged(tree)
    return tree


def _set_vector(node: Any, values: list[float]) -> None:
    for socket, value in zip(node.inputs, values, strict=True):
        cast(Any, socket).default_value = value
