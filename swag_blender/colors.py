"""How the colors of splats are developed in Blender: stored with each object, sliders for the scene, their panel."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, cast

import bpy
from bpy.props import EnumProperty, FloatProperty, PointerProperty
from bpy.types import PropertyGroup

from ..swag_engine.splats.development import NO_DEVELOPMENT, ColorView, Development, white_balance
from . import splats
from .blender_types import present, with_properties
from .nodes import development_nodes, splat_colors, splat_preview
from .properties import swag_of
from .sidebar import SwagPanel
from .water import KEY as WATER_KEY

KEY = "swag_development"
"""Property of a splat object: the developments of its run or file by name, as JSON."""
SLIDERS = ("exposure", "temperature", "tint", "contrast")
"""Properties of the user's own adjustments."""


def _update(colors: Any, context: bpy.types.Context) -> None:
    """Show a change in viewports and in a render that is set up."""
    show(colors.id_data)
    colors.id_data.update_tag()


def _slider(name: str, description: str, most: float, soft_most: float) -> Any:
    """Property of a number on both sides of 0, which changes nothing."""
    return FloatProperty(
        name=name, description=description, min=-most, max=most, soft_min=-soft_most, soft_max=soft_most, update=_update
    )


@with_properties
class SwagColors(PropertyGroup):
    """`scene.swag_colors`: development of the colors of all splats of a scene."""

    develop: Annotated[
        str,
        EnumProperty(
            name="Development",
            description="Exposure and white point of restored colors; they fade as the slider Water adds water",
            items=[
                ("auto", "Automatic", "Exposure and white point that training found in near, bright, neutral parts"),
                ("chart", "Color Chart", "From a color chart in the photos"),
                ("none", "None", "Colors as restored, which may be dark or clipped"),
            ],
            update=_update,
        ),
    ]
    exposure: Annotated[float, _slider("Exposure", "Further exposure of the splats, in stops", 20.0, 5.0)]
    temperature: Annotated[
        float, _slider("Temperature", "White balance between blue (below 0) and orange (above 0)", 2.0, 1.0)
    ]
    tint: Annotated[float, _slider("Tint", "White balance between green (below 0) and magenta (above 0)", 2.0, 1.0)]
    contrast: Annotated[
        float,
        FloatProperty(
            name="Contrast",
            description="Contrast about middle grey; 1 changes nothing",
            default=1.0,
            min=0.1,
            max=10.0,
            soft_min=0.5,
            soft_max=2.0,
            update=_update,
        ),
    ]

    @property
    def adjusted(self) -> Development:
        """What the sliders do."""
        values = Development(self.exposure, white_balance(self.temperature, self.tint), self.contrast)
        neutral = not (self.exposure or self.temperature or self.tint) and self.contrast == 1
        return NO_DEVELOPMENT if neutral else values

    def reset(self) -> None:
        """Go back to the automatic development."""
        for name in ("develop", *SLIDERS):
            self.property_unset(name)
        _update(self, bpy.context)


def colors_of(scene: bpy.types.Scene | None) -> SwagColors:
    """Color settings of a scene."""
    return cast(Any, scene).swag_colors


def remember_developments(obj: bpy.types.Object, known: Mapping[str, Any]) -> None:
    """Store the developments of a run or a file with its splat object.

    Args:
        obj: the object.
        known: the values of each by its name in `SwagColors.develop`.

    Raises:
        InputError: a development is damaged.
    """
    for values in known.values():
        Development.from_json(values)
    if known:
        obj[KEY] = json.dumps(known)
    else:
        obj.pop(KEY, None)
    for scene in obj.users_scene:
        show(scene)


def has_development(obj: bpy.types.Object, name: str) -> bool:
    """Whether the run of a splat object has the development of that name."""
    return name in json.loads(obj.get(KEY, "{}"))


def color_view(scene: bpy.types.Scene, obj: bpy.types.Object | None) -> ColorView:
    """How the colors of a splat object are shown in a scene; without an object, what the sliders do."""
    colors = colors_of(scene)
    values = json.loads(obj.get(KEY, "{}")).get(colors.develop) if obj is not None else None
    return ColorView(NO_DEVELOPMENT if values is None else Development.from_json(values), colors.adjusted)


def find(scene: bpy.types.Scene, active: bpy.types.Object | None) -> bpy.types.Object | None:
    """The splat object whose development a picture has: the active one, else the first, of those from a run."""
    return splats.find_with(scene, active, KEY)


def picture_development(scene: bpy.types.Scene, active: bpy.types.Object | None) -> Development:
    """The development of a picture of the scene's splats, with the amount of water that is shown."""
    obj = find(scene, active)
    return color_view(scene, obj).at(shown_water(scene, obj))


def shown_water(scene: bpy.types.Scene, obj: bpy.types.Object | None) -> float:
    """The amount of water that a splat object shows, 0 for one without water."""
    return swag_of(scene).water if obj is not None and obj.get(WATER_KEY) is not None else 0.0


def set_up_render(scene: bpy.types.Scene, display_values: bool) -> None:
    """Have renders of the scene developed by compositor nodes, where its colors have a development.

    Args:
        scene: a scene with splats.
        display_values: whether renders hold sRGB values and not linear light.
    """
    obj = find(scene, None)
    view = color_view(scene, obj)
    if view == ColorView():
        development_nodes.remove(scene)
    else:
        has_water = obj is not None and obj.get(WATER_KEY) is not None
        development_nodes.set_up(scene, view, has_water, display_values)
    show(scene)


def show(scene: bpy.types.Scene) -> None:
    """Give the present development to what Blender draws.

    Where a render is set up, the compositor develops its pictures. Elsewhere the nodes of splats that viewports draw as
    renders do develop each splat.
    """
    development_nodes.update(scene, color_view(scene, find(scene, None)))
    by_nodes = not development_nodes.is_set_up(scene)
    for obj in scene.objects:
        if splats.is_splats(obj):
            _give_nodes(obj, color_view(scene, obj), by_nodes)


def _give_nodes(obj: bpy.types.Object, view: ColorView, develop: bool) -> None:
    for name, row in zip(splat_colors.RESTORED_ROWS, view.restored.gains.tolist(), strict=True):
        splat_preview.set_input(obj, name, row)
    for name, value in (
        (splat_colors.RESTORED_CONTRAST, view.restored.contrast),
        (splat_colors.GAINS, view.adjusted.gains.diagonal().tolist()),
        (splat_colors.CONTRAST, view.adjusted.contrast),
        (splat_colors.DEVELOP, develop and view != ColorView()),
    ):
        splat_preview.set_input(obj, name, value)


class SWAG_PT_colors(SwagPanel):
    """Panel of the development of colors."""

    bl_label = "Color"
    bl_parent_id = "SWAG_PT_result"

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        """Draw the button that resets; Blender calls this."""
        present(self.layout).operator("swag.reset_colors", text="", icon="LOOP_BACK", emboss=False)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, scene = present(self.layout), present(context.scene)
        layout.use_property_split = True
        layout.use_property_decorate = False
        colors = colors_of(scene)
        layout.prop(colors, "develop")
        obj = find(scene, context.active_object)
        if colors.develop == "chart" and (obj is None or not has_development(obj, "chart")):
            layout.label(text="The photos have no color chart.", icon="INFO")
        column = layout.column(align=True)
        for name in SLIDERS:
            column.prop(colors, name)


_CLASSES = (SwagColors, SWAG_PT_colors)


def register() -> None:
    """Register the settings with scenes, and the panel."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    cast(Any, bpy.types.Scene).swag_colors = PointerProperty(type=SwagColors)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_colors
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
