"""The panel Survey: plan, watch, merge and open a survey, and choose which of its tiles are loaded."""

from typing import Any

import bpy

from ..swag_engine.formats.survey_folder import COARSE
from . import survey, survey_map, survey_watch
from .blender_types import present, set_button
from .properties import swag_of
from .sidebar import SwagPanel, draw_job, draw_outcome, draw_wrapped

JOBS = ("Survey Plan", "Survey Merge")
"""Names of the jobs whose progress the panel shows."""


class SWAG_PT_survey(SwagPanel):
    """Panel that plans, watches, merges and opens a survey."""

    bl_label = "Survey"
    bl_order = 15
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, scene = present(self.layout), present(context.scene)
        width = present(context.region).width
        if draw_job(layout, context, *JOBS):
            return
        settings, folder = survey.survey_of(scene), survey.chosen_survey(scene)
        layout.prop(settings, "folder", text="")
        if folder is None:
            _draw_plan(layout, context)
        else:
            survey_watch.follow()
            _draw_jobs(layout, context, str(folder.path))
        draw_outcome(layout, context, *JOBS)
        button = layout.operator("swag.open_survey", icon="FILE_FOLDER")
        set_button(button, directory=str(folder.path) if folder is not None else "")
        if folder is None and not swag_of(scene).scene_folder:
            draw_wrapped(
                layout, "Choose the folder of a survey, or in Photos the photos of a new one.", width, icon="INFO"
            )


def _draw_plan(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the choices of a new survey and the button that plans it."""
    scene = present(context.scene)
    column = layout.column(align=True)
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(swag_of(scene), "preset")
    column.prop(survey.survey_of(scene), "block_images")
    layout.operator("swag.plan_survey", icon="MESH_GRID")


def _draw_jobs(layout: bpy.types.UILayout, context: bpy.types.Context, path: str) -> None:
    """Draw the jobs of a survey, the command that trains them, and the button that merges them."""
    width, shown = present(context.region).width, survey_watch.jobs_of(context)
    if shown.folder != path:
        draw_wrapped(layout, "Reading the survey.", width, icon="INFO")
        return
    if shown.problem:
        draw_wrapped(layout, shown.problem, width, icon="ERROR")
        return
    row = layout.row(align=True)
    for state, look in survey_map.STATES.items():
        if count := shown.count(state):
            row.label(text=f"{count}", icon=look.icon)
    layout.template_list("SWAG_UL_survey_jobs", "", shown, "jobs", shown, "active", rows=5)
    chosen = list(shown.jobs[shown.active : shown.active + 1])
    if failed := next((job for job in (*chosen, *shown.jobs) if job.problem), None):
        draw_wrapped(layout, failed.problem, width, icon="ERROR")
    layout.operator("swag.show_blocks", icon="MESH_GRID")
    if shown.count("done") < len(shown.jobs) - 1:
        box = layout.box()
        draw_wrapped(box, "Train in a terminal, on as many machines as see this folder:", width)
        draw_wrapped(box, survey.run_command(path, blender=False), width)
        column = box.column(align=True)
        button = column.operator("swag.copy_survey_command", text="Copy", icon="COPYDOWN")
        set_button(button, blender=False)
        button = column.operator("swag.copy_survey_command", text="Copy for This Blender", icon="BLENDER")
        set_button(button, blender=True)
    partial = 0 < shown.count("done") < len(shown.jobs) - 1
    button = layout.operator(
        "swag.merge_survey", text="Merge Finished Blocks" if partial else "Merge Survey", icon="AUTOMERGE_ON"
    )
    set_button(button, partial=partial)


class SWAG_PT_survey_tiles(SwagPanel):
    """Panel that chooses which tiles of the active survey are loaded."""

    bl_label = "Detail"
    bl_parent_id = "SWAG_PT_survey"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object is the splats of a survey."""
        return survey.holds_tiles(context.active_object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, obj = present(self.layout), present(context.active_object)
        settings = survey.survey_of(context.scene)
        draw_wrapped(layout, survey.describe(obj), present(context.region).width)
        column = layout.column(align=True)
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "budget")
        column.prop(settings, "box")
        column = layout.column(align=True)
        column.operator("swag.load_view", icon="HIDE_OFF")
        column.operator("swag.load_box", icon="CUBE")
        column.operator("swag.load_overview", icon="WORLD")


class SWAG_UL_survey_jobs(bpy.types.UIList):
    """List of the jobs of a survey: state, name, progress and PSNR."""

    def draw_item(
        self,
        context: bpy.types.Context | None,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int | None,
        active_data: Any,
        active_property: str | None,
        index: int | None,
        flt_flag: int | None,
    ) -> None:
        """Draw one job; Blender calls this."""
        look = survey_map.STATES[item.state]
        columns = layout.split(factor=0.5)
        if item.name == COARSE:
            columns.label(text="Coarse Model", icon=look.icon)
        else:
            columns.label(text=item.name, icon=look.icon, translate=False)
        columns = columns.split(factor=0.55)
        if item.state in ("running", "begun") and item.fraction:
            columns.label(text=f"{item.fraction:.0%}")
        else:
            columns.label(text=look.title)
        figure = columns.row()
        figure.alignment = "RIGHT"
        figure.label(text=f"{item.psnr:.1f} dB" if item.psnr else "-")


_CLASSES = (SWAG_UL_survey_jobs, SWAG_PT_survey, SWAG_PT_survey_tiles)
register, unregister = bpy.utils.register_classes_factory(_CLASSES)
