"""SWAG Splatting: underwater photos become 3D Gaussians in Blender. This file only registers the extension."""

from . import operators
from .swag_blender import (
    assets,
    background,
    clean_up,
    color_chart,
    colors,
    commands,
    display,
    display_panel,
    edit_panel,
    effect_pictures,
    engine_process,
    file_versions,
    film,
    film_panel,
    job,
    jobs_panel,
    kept_through_undo,
    label_list,
    labels,
    maps,
    maps_panel,
    moved_points,
    panels,
    preferences,
    properties,
    restored_photos,
    run_list,
    scale_panel,
    selection_tools,
    survey,
    survey_panel,
    survey_watch,
    translations,
    viewport,
    viewport_tool,
    water,
)
from .swag_engine.base.errors import name_buttons

_MODULES = (
    properties,
    run_list,
    survey,
    survey_watch,
    preferences,
    engine_process,
    job,
    display,
    kept_through_undo,
    moved_points,
    labels,
    film,
    maps,
    operators,
    label_list,
    effect_pictures,
    jobs_panel,
    panels,
    scale_panel,
    survey_panel,
    edit_panel,
    viewport_tool,
    selection_tools,
    film_panel,
    maps_panel,
    clean_up,
    water,
    background,
    colors,
    restored_photos,
    color_chart,
    display_panel,
    viewport,
    file_versions,
    assets,
    commands,
    translations,
)


def register() -> None:
    """Register everything with Blender."""
    name_buttons()
    for module in _MODULES:
        module.register()


def unregister() -> None:
    """Undo `register`."""
    for module in reversed(_MODULES):
        module.unregister()
