"""The world of a scene as what is behind splats: a color, or the background light of their water."""

from collections.abc import Iterable, Sequence
from typing import Any, cast

import bpy
import numpy as np
from mathutils import Color

from ..blender_types import present
from . import water_shader

NAME = "SWAG Background"
"""Name of the world that takes the place of one of the user's."""
COLOR_KEY = "swag_background"
"""Property of a world: the color that it was given here, and 1 for sRGB values or 0 for linear light."""
DEFAULT_GREYS = (0.05, 0.050876)
"""Colors of Blender's own new worlds: of a script, and of its startup file."""
SAMPLE_MAP_COLUMNS = 64
"""Columns of the map by which Cycles samples the background light."""
_ROUNDING = 1e-5


def show_color(scene: bpy.types.Scene, color: Sequence[float], display_values: bool) -> None:
    """Show an sRGB color (3,) behind all that is in a scene, as sRGB values or as linear light."""
    node = _replaceable(scene, [color])
    color = in_render(color, display_values)
    socket: Any = node.inputs["Color"]
    for link in socket.links:
        cast(bpy.types.NodeTree, node.id_data).links.remove(link)
    socket.default_value = (*color, 1.0)
    cast(Any, scene.world)[COLOR_KEY] = [*color, float(display_values)]


def show_open_water(scene: bpy.types.Scene, group: bpy.types.NodeTree, display_values: bool) -> None:
    """Show the open water of a node group behind all that is in a scene, as sRGB values or as linear light."""
    node = _replaceable(scene, [])
    tree = cast(bpy.types.NodeTree, node.id_data)
    water: Any = tree.nodes.get(water_shader.NAME) or tree.nodes.new("ShaderNodeGroup")
    water.name = water.label = water_shader.NAME
    water.node_tree = group
    water.location = node.location.x - 260, node.location.y
    output = water.outputs[water_shader.DISPLAY_VALUES if display_values else water_shader.LIGHT]
    tree.links.new(output, node.inputs["Color"])
    # Cycles evaluates the nodes once for each pixel of its map of the world, which takes minutes at its own size. The
    # background light changes slowly with direction.
    settings: Any = getattr(scene.world, "cycles", None)
    if settings is not None:  # Blender without Cycles
        settings.sampling_method, settings.sample_map_resolution = "MANUAL", SAMPLE_MAP_COLUMNS


def is_users(world: bpy.types.World | None, colors: Iterable[Sequence[float]]) -> bool:
    """Whether a user has made or changed a world: it is neither Blender's default nor what this file makes.

    Args:
        world: of a scene; None for none.
        colors: sRGB colors (3,) that earlier versions may have given it, without noting that.
    """
    if world is None:
        return False
    if world.library is not None:
        return True
    greys = [[grey] * 3 for grey in DEFAULT_GREYS]
    if not world.use_nodes:
        return world.node_tree is not None or not _is_one_of(world.color[:], greys)
    if holds_display_values(world) is not None:
        return False
    node = _background_node(world)
    if node is None or node.inputs["Color"].is_linked:
        return True
    own = [in_render(color, display_values) for color in colors for display_values in (False, True)]
    return not _is_one_of(cast(Any, node.inputs["Color"]).default_value[:3], greys + own)


def holds_display_values(world: bpy.types.World | None) -> bool | None:
    """Whether a world that was made here, and not changed since, holds sRGB values; None for all other worlds."""
    node = None if world is None or world.library is not None else _background_node(world)
    if world is None or node is None:
        return None
    socket: Any = node.inputs["Color"]
    if not socket.is_linked:
        *color, display_values = world.get(COLOR_KEY, [-1.0] * 4)
        return bool(display_values) if _is_one_of(socket.default_value[:3], [color]) else None
    source = socket.links[0].from_socket
    group = getattr(source.node, "node_tree", None)
    is_water = group is not None and group.name.startswith(water_shader.NAME)
    return {water_shader.LIGHT: False, water_shader.DISPLAY_VALUES: True}.get(source.name) if is_water else None


def in_render(color: Sequence[float], display_values: bool) -> list[float]:
    """An sRGB color (3,) as renders hold it: as sRGB values, or as linear light."""
    return [*color] if display_values else [*Color(color).from_srgb_to_scene_linear()[:]]


def _replaceable(scene: bpy.types.Scene, colors: Iterable[Sequence[float]]) -> bpy.types.Node:
    """The Background node of a world that may be changed, which the scene gets in place of a user's world."""
    world = scene.world
    if world is None or is_users(world, colors):
        if world is not None and world.library is None:
            world.use_fake_user = True  # it stays in the file
        world = scene.world = bpy.data.worlds.new(NAME)
    world.use_nodes = True
    return present(_background_node(world))


def _background_node(world: bpy.types.World) -> bpy.types.Node | None:
    """The Background node that alone is the surface of a world, at strength 1; None for other worlds."""
    output = present(world.node_tree).get_output_node("ALL") if world.use_nodes else None
    if output is None or output.inputs["Volume"].is_linked or not output.inputs["Surface"].is_linked:
        return None
    node = present(present(output.inputs["Surface"].links)[0].from_node)
    if node.bl_idname != "ShaderNodeBackground":
        return None
    strength: Any = node.inputs["Strength"]
    return None if strength.is_linked or strength.default_value != 1 else node


def _is_one_of(color: Sequence[float], known: Iterable[Sequence[float]]) -> bool:
    return any(np.allclose(color, one, rtol=0, atol=_ROUNDING) for one in known)
