"""`object.swag_display`: how a splat object is shown."""

from typing import Annotated, Any, cast

import bpy
from bpy.props import PointerProperty
from bpy.types import PropertyGroup

from . import crop_box
from .blender_types import with_properties


@with_properties
class SwagDisplay(PropertyGroup):
    """`object.swag_display`: how the splats of an object are shown."""

    crop: Annotated[
        bpy.types.Object | None,
        PointerProperty(
            type=bpy.types.Object,
            name="Crop Box",
            description="Object whose box limits the splats that are shown, rendered and exported",
            poll=lambda self, obj: crop_box.can_crop(self.id_data, obj),
            update=lambda self, context: crop_box.update_preview(self.id_data),
        ),
    ]


def register() -> None:
    """Register the property group and give every object its display settings."""
    bpy.utils.register_class(SwagDisplay)
    cast(Any, bpy.types.Object).swag_display = PointerProperty(type=SwagDisplay)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Object).swag_display
    bpy.utils.unregister_class(SwagDisplay)
