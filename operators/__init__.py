"""What a user can do: one module for each verb.

A module lists its classes in CLASSES. It may have unregister(), and draw_import(layout) or draw_export(layout) for its
line in these menus of Blender.
"""

from typing import Any

import bpy

from ..swag_blender.blender_types import present
from . import (
    add_crop_box,
    add_turntable,
    camera_path,
    cancel,
    check_engine,
    clean_up,
    compare_photos,
    copy_survey_command,
    delete_outside_crop,
    delete_splats,
    export_splats,
    find_cameras,
    find_color_chart,
    find_floaters,
    finish_clean_up,
    forecast,
    hide_splats,
    import_cameras,
    import_scene,
    import_splats,
    inspect_scene,
    install_engine,
    isolate_label,
    keep_mask,
    label_run,
    load_tiles,
    look_up_engine,
    make_areas,
    make_change,
    make_heights,
    make_orthomosaic,
    make_profile,
    mark_color_chart,
    measure,
    merge_splats,
    merge_survey,
    node_assets,
    open_camera_page,
    open_photos,
    open_report,
    open_run,
    open_survey,
    pause,
    pick_profile,
    pick_scale,
    plan,
    plan_survey,
    prepare_render,
    read_labels,
    read_point,
    remove_engine,
    render_film,
    reset_colors,
    reset_effects,
    restore_photos,
    reveal_splats,
    scale_from_targets,
    score_selection,
    search_labels,
    select_all_splats,
    select_box,
    select_brush,
    select_by,
    select_circle,
    select_flood,
    select_label,
    select_lasso,
    select_run,
    select_sphere,
    separate_splats,
    set_scale,
    show_blocks,
    show_effect,
    show_labels,
    show_log,
    train,
    water_objects,
)

_GROUPS = (
    (open_photos, find_cameras, import_cameras, inspect_scene, import_scene, open_camera_page),
    (plan, reset_effects, show_effect),
    (forecast, train, cancel, pause, show_log),
    (open_run, import_splats, open_report, select_run),
    (plan_survey, copy_survey_command, show_blocks, merge_survey, open_survey, load_tiles),
    (label_run, read_labels, show_labels, isolate_label, select_label, search_labels, keep_mask),
    (select_box, select_circle, select_lasso, select_brush, select_sphere, select_flood),
    (select_all_splats, select_by, find_floaters, score_selection, clean_up, finish_clean_up),
    (delete_splats, hide_splats, reveal_splats, add_crop_box, delete_outside_crop, measure, read_point),
    (separate_splats, merge_splats),
    (prepare_render, water_objects, reset_colors, find_color_chart, mark_color_chart, restore_photos),
    (add_turntable, camera_path, compare_photos, render_film),
    (scale_from_targets, set_scale, pick_scale),
    (make_orthomosaic, make_heights, make_areas, pick_profile, make_profile, make_change),
    (export_splats,),
    (node_assets, look_up_engine, install_engine, check_engine, remove_engine),
)
"""The modules in the order of the menu, where a line separates the groups."""
_MODULES = tuple(module for group in _GROUPS for module in group)
_NOT_IN_MENU = (isolate_label, select_label, keep_mask, select_run, show_effect)
"""They act on one line of a list, where their buttons are."""


class SWAG_MT_splatting(bpy.types.Menu):
    """Menu of all operators, so that F3 finds them and they can get shortcuts"""

    bl_label = "SWAG Splatting"

    def draw(self, context: bpy.types.Context | None) -> None:
        """Draw the menu; Blender calls this."""
        layout = present(self.layout)
        layout.operator_context = "INVOKE_DEFAULT"
        for group in _GROUPS:
            for module in group:
                for cls in module.CLASSES:
                    if issubclass(cls, bpy.types.Operator) and module not in _NOT_IN_MENU:
                        layout.operator(cls.bl_idname)
            layout.separator()


def _object_menu(menu: Any, context: bpy.types.Context) -> None:
    menu.layout.menu(SWAG_MT_splatting.__name__)


def _import_menu(menu: Any, context: bpy.types.Context) -> None:
    for module in _MODULES:
        if hasattr(module, "draw_import"):
            module.draw_import(menu.layout)


def _export_menu(menu: Any, context: bpy.types.Context) -> None:
    for module in _MODULES:
        if hasattr(module, "draw_export"):
            module.draw_export(menu.layout)


_menus: Any = {  # as Any: the stubs declare another signature of append
    bpy.types.VIEW3D_MT_object: _object_menu,
    bpy.types.TOPBAR_MT_file_import: _import_menu,
    bpy.types.TOPBAR_MT_file_export: _export_menu,
}


def register() -> None:
    """Register all operators and their lines in Blender's menus."""
    for module in _MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    bpy.utils.register_class(SWAG_MT_splatting)
    for parent, draw in _menus.items():
        parent.append(draw)


def unregister() -> None:
    """Undo `register`."""
    for parent, draw in _menus.items():
        parent.remove(draw)
    bpy.utils.unregister_class(SWAG_MT_splatting)
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
