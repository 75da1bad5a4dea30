"""What is behind the splats of a run, in viewports, renders and films alike. The rule is in docs/water.md.

Where the water of the run adds light, that is its background light times the amount of water that is shown: black
without water. Otherwise it is the background color of the run, at any amount of water. Behind splats that are from no
run there is what Blender has there.
"""

from collections.abc import Iterable
from typing import Any

import bpy

from . import splats, water
from .nodes import world
from .nodes.splat_preview import BACKGROUND_KEY
from .water_values import Triple


def find(objects: Iterable[bpy.types.Object], active: bpy.types.Object | None) -> bpy.types.Object | None:
    """The splat object whose background is that of a picture; None where none has a background.

    Args:
        objects: the splat objects of the picture. Those with water come before those with a color alone.
        active: the active object, which comes first among its kind.
    """
    known = [obj for obj in objects if obj.get(water.KEY) is not None or obj.get(BACKGROUND_KEY) is not None]
    return min(known, key=lambda obj: (obj.get(water.KEY) is None, obj != active), default=None)


def has_open_water(obj: bpy.types.Object) -> bool:
    """Whether the background light of its water is behind a splat object."""
    values = water.water_of(obj)
    return values is not None and values.has_background_light


def color_behind(obj: bpy.types.Object) -> Triple | None:
    """The sRGB color behind a splat object at any amount of water; None where open water or nothing known is there."""
    color = obj.get(BACKGROUND_KEY)
    if color is None or has_open_water(obj):
        return None
    red, green, blue = (min(max(float(value), 0.0), 1.0) for value in color)
    return red, green, blue


def set_world(scene: bpy.types.Scene, display_values: bool) -> None:
    """Make the scene's world what is behind its splats, where that is known.

    Args:
        scene: the scene.
        display_values: whether renders hold sRGB values and not linear light.
    """
    obj = _source(scene)
    if obj is None:
        return
    color = color_behind(obj)
    if color is not None:
        world.show_color(scene, color, display_values)
    elif has_open_water(obj):
        world.show_open_water(scene, water.node_group(obj), display_values)


def is_known(scene: bpy.types.Scene) -> bool:
    """Whether it is known what is behind the splats of a scene."""
    return _source(scene) is not None


def has_users_world(scene: bpy.types.Scene) -> bool:
    """Whether the world of a scene is the user's own, which is kept unless they say otherwise."""
    return world.is_users(scene.world, [color for obj in scene.objects if (color := color_behind(obj)) is not None])


def update_worlds() -> None:
    """Give worlds that `set_world` made what is behind the splats now: a run may have changed."""
    for scene in bpy.data.scenes:
        display_values = world.holds_display_values(scene.world)
        if display_values is not None:
            set_world(scene, display_values)


def _source(scene: bpy.types.Scene) -> bpy.types.Object | None:
    return find((obj for obj in scene.objects if splats.is_splats(obj) and not obj.hide_render), None)


@bpy.app.handlers.persistent
def _after_load(*_: Any) -> None:
    """Mend worlds of files of earlier versions, which show open water where the background color should be."""
    update_worlds()


def register() -> None:
    """Mend files that are opened from now on."""
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    """Undo `register`."""
    bpy.app.handlers.load_post.remove(_after_load)
