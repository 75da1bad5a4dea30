"""SWAG Splatting: underwater photos become 3D Gaussians in Blender. This file only registers the extension."""

from . import operators
from .swag_blender import (
    assets,
    commands,
    effect_pictures,
    engine_process,
    job,
    label_list,
    labels,
    panels,
    preferences,
    properties,
    run_list,
    translations,
    water,
)

_MODULES = (
    properties,
    run_list,
    preferences,
    engine_process,
    job,
    labels,
    operators,
    label_list,
    effect_pictures,
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
