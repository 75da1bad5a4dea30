"""Blender's properties from the engine's settings."""

from typing import Any

from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..swag_engine.settings.field import Setting
from . import WORDS


def setting_property(default: Any, described: Setting) -> Any:
    """Make the property of one setting of the engine.

    Args:
        default: Default value; its type chooses the kind of property. Several texts become one with commas.
        described: Label, help, range and choices.

    Returns:
        What Blender takes as a property's annotation.
    """
    words: dict[str, Any] = {"name": described.label, "description": described.description, "default": default}
    words["translation_context"] = WORDS
    if isinstance(default, tuple):
        words["description"] += " (separated by commas)"
        return StringProperty(**words | {"default": ", ".join(default)})
    if described.choices:
        return EnumProperty(items=[(choice, choice, text) for choice, text in described.choices.items()], **words)
    if isinstance(default, bool):
        return BoolProperty(**words)
    if isinstance(default, str):
        return StringProperty(subtype="DIR_PATH" if described.is_folder else "NONE", **words)
    words["min"] = 0 if described.zero else described.least
    words["max"] = described.most
    if isinstance(default, int):
        return IntProperty(subtype="PIXEL" if described.unit == "px" else "NONE", **words)
    if (described.least, described.most) == (0, 1):
        return FloatProperty(subtype="FACTOR", **words)
    return FloatProperty(precision=4, **words)


def texts_of(value: str) -> tuple[str, ...]:
    """Return the texts of the property of a setting with several texts."""
    return tuple(text.strip() for text in value.split(",") if text.strip())
