"""How a splat object is shown in viewports: as splats or points, how many, and its crop box."""

from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty
from bpy.types import PropertyGroup

from .blender_types import present, with_properties
from .nodes import splat_colors, splat_preview

_STYLES = [
    ("SPLATS", "Splats", "The splats as trained, with view-dependent colors"),
    ("POINTS", "Points", "A colored point for each splat, which any graphics card draws fast"),
]
if splat_preview.HAS_NATIVE:
    text = "Blender's own drawing: with noise, and dark in Solid shading"
    _STYLES.append(("NATIVE", "Blender's Splats", text))


@with_properties
class SwagDisplay(PropertyGroup):
    """`object.swag_display`: how viewports show the splats of an object."""

    style: Annotated[
        str,
        EnumProperty(
            name="Display As",
            description="What viewports show, except in Rendered shading",
            items=_STYLES,
            update=lambda self, context: change(self.id_data),
        ),
    ]
    exact: Annotated[
        bool,
        BoolProperty(
            name="Exact Shapes",
            description="Render the extension's own shapes: without noise, as trained if set up so, and slower",
            get=lambda self: not splat_preview.is_native(self.id_data),
            set=lambda self, on: use_shapes(self.id_data, on),
        ),
    ]
    density: Annotated[
        float,
        FloatProperty(
            name="Density",
            description="Percentage of the splats that viewports show; renders show all",
            default=100.0,
            min=0.0,
            max=100.0,
            subtype="PERCENTAGE",
            update=lambda self, context: change(self.id_data),
        ),
    ]
    sh_degree: Annotated[
        int,
        IntProperty(
            name="SH Degree",
            description="Highest degree of spherical harmonics in viewports and renders; 0 makes colors the same from "
            "every view",
            default=3,
            min=0,
            max=3,
            update=lambda self, context: change(self.id_data),
        ),
    ]
    background: Annotated[
        bool,
        BoolProperty(
            name="Background",
            description="Viewports show what is behind the splats in films: open water, or the background color of the "
            "run. Off: the viewport's own background",
            default=True,
            update=lambda self, context: self.id_data.update_tag(),
        ),
    ]
    crop: Annotated[
        bpy.types.Object | None,
        PointerProperty(
            type=bpy.types.Object,
            name="Crop Box",
            description="Object whose box limits the splats that are shown, rendered and exported",
            poll=lambda self, obj: can_crop(self.id_data, obj),
            update=lambda self, context: update_crop(self.id_data),
        ),
    ]


def display_of(obj: bpy.types.Object) -> SwagDisplay:
    """How viewports show a splat object."""
    return cast(Any, obj).swag_display


def apply(obj: bpy.types.Object) -> None:
    """Show a splat object as its settings say; for a new object, and after a change."""
    display = display_of(obj)
    drawn_here = display.style == "SPLATS"
    # Viewports draw nothing but a box of an object that is displayed as bounds; renders are not affected.
    obj.display_type = "BOUNDS" if drawn_here else "TEXTURED"
    splat_preview.set_input(obj, splat_preview.POINTS_IN_VIEWPORT, display.style == "POINTS")
    if not drawn_here:
        splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, display.style == "NATIVE")
    splat_preview.set_input(obj, splat_colors.DENSITY, display.density)
    splat_preview.set_input(obj, splat_colors.SH_DEGREE, display.sh_degree)
    obj.update_tag()


def change(obj: bpy.types.Object) -> None:
    """Show a splat object as its settings say, also one that Blender imported, which has no nodes."""
    splat_preview.ensure_modifier(obj)
    apply(obj)


def can_crop(obj: bpy.types.Object, box: bpy.types.Object) -> bool:
    """Whether `box` can crop the splats of `obj`: an empty or a mesh, and not the parent of the splats."""
    return box != obj and box.type in {"EMPTY", "MESH"} and box != obj.parent


def update_crop(obj: bpy.types.Object) -> None:
    """Give the crop box to the preview nodes, which draw the splats in renders."""
    box = display_of(obj).crop
    if box is not None:
        splat_preview.ensure_modifier(obj)
    splat_preview.set_input(obj, splat_colors.CROP_BOX, box)
    path = splat_preview.input_path(obj, splat_colors.CROP_HALF_EDGE)
    if path:
        obj.driver_remove(path)
        splat_preview.set_input(obj, splat_colors.CROP_HALF_EDGE, 1.0)
        if box is not None and box.type == "EMPTY":
            driver = present(cast(bpy.types.FCurve, obj.driver_add(path)).driver)
            driver.type = "SUM"
            variable = driver.variables.new()
            variable.targets[0].id = box
            variable.targets[0].data_path = "empty_display_size"
    splat_preview.follow_objects(obj)


def use_shapes(obj: bpy.types.Object, shapes: bool) -> None:
    """Have renders draw a splat object by own shapes, or natively."""
    splat_preview.ensure_modifier(obj)
    splat_preview.use_shapes(obj, shapes)
    apply(obj)


def copy_settings(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Show one splat object as another is shown."""
    for name in SwagDisplay.__annotations__:
        setattr(display_of(target), name, getattr(display_of(source), name))


def register() -> None:
    """Register the properties with objects."""
    bpy.utils.register_class(SwagDisplay)
    cast(Any, bpy.types.Object).swag_display = PointerProperty(type=SwagDisplay)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Object).swag_display
    bpy.utils.unregister_class(SwagDisplay)
