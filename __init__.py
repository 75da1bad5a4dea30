"""SWAG Splatting: underwater photos become 3D Gaussians in Blender. This file only registers the extension."""

from . import operators
from .swag_blender import (
    assets,
    commands,
    engine_process,
    job,
    kept_through_undo,
    label_list,
    labels,
    panels,
    preferences,
    properties,
    translations,
    water,
)

_MODULES = (
    properties,
    preferences,
    engine_process,
    job,
    kept_through_undo,
    labels,
    operators,
    label_list,
    panels,
    water,
    assets,
    commands,
    translations,
)


def register() -> None:
    """Register everything with Blender."""
    for module in _MODULES:
        module.register()


def unregister() -> None:
    """Undo `register`."""
    for module in reversed(_MODULES):
        module.unregister()
