"""The panels of the sidebar tab SWAG: one for each stage of the work."""

import bpy

from ..swag_engine.base.text import time_text
from ..swag_engine.formats.registry import FORMATS
from . import EXTENSION, engine_process, label_list, splats
from .blender_types import present, set_button
from .properties import SETTINGS, status_of, swag_of
from .sidebar import SwagPanel, draw_job, draw_outcome, draw_wrapped

MAIN_SETTINGS = ("recipe", "preset", "time_budget")
"""Settings that are always visible; the others are in the closed panel below them."""


class SWAG_PT_scene(SwagPanel):
    """Panel that chooses, checks and imports the photos."""

    bl_label = "Scene"
    bl_order = 0

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag, status = present(self.layout), swag_of(context.scene), status_of(context)
        width = present(context.region).width
        column = layout.column()
        column.label(text="Photos with COLMAP Model")
        column.prop(swag, "scene_folder", text="")
        row = column.row(align=True)
        row.enabled = bool(swag.scene_folder)
        row.operator("swag.inspect_scene", text="Check", icon="VIEWZOOM")
        button = row.operator("swag.import_scene", text="Import", icon="IMPORT")
        set_button(button, directory=swag.scene_path)
        if not swag.scene_folder:
            draw_wrapped(layout, "Choose the folder with the photos first.", width, icon="INFO")
        elif status.job in ("Import", "Check"):
            draw_job(layout, context)
        elif status.failed and status.last_job in ("Import", "Check"):
            draw_outcome(layout, context)
        else:
            for line in swag.found.splitlines():
                draw_wrapped(layout, line, width)


class SWAG_PT_effects(SwagPanel):
    """Panel that plans the effects and shows the plan."""

    bl_label = "Effects"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag, status = present(self.layout), swag_of(context.scene), status_of(context)
        plan, width = swag.plan, present(context.region).width
        if status.job == "Plan":
            draw_job(layout, context)
            return
        row = layout.row(align=True)
        row.enabled = bool(swag.scene_folder)
        row.operator("swag.plan", text="Plan Again" if plan.lines else "Plan", icon="VIEWZOOM")
        row.operator("swag.reset_effects", text="", icon="LOOP_BACK")
        if status.failed and status.last_job == "Plan":
            draw_outcome(layout, context)
        if not plan.lines:
            draw_wrapped(
                layout, "Plan determines from the photos which effects training should model.", width, icon="INFO"
            )
            return
        if plan.stale:
            draw_wrapped(layout, "This plan was made for other photos: plan again.", width, icon="ERROR")
        layout.template_list("SWAG_UL_effects", "", plan, "lines", plan, "active", rows=len(plan.lines))
        line = plan.lines[plan.active]
        layout.prop(line, "choice", expand=True)
        draw_wrapped(layout.box(), line.reason, width - 20)


class SWAG_PT_train(SwagPanel):
    """Panel that trains, continues and forecasts."""

    bl_label = "Train"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag, status = present(self.layout), swag_of(context.scene), status_of(context)
        width = present(context.region).width
        if status.job in ("Training", "Forecast"):
            draw_job(layout, context)
            return
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(align=True)
        for name in MAIN_SETTINGS:
            column.prop(swag, name)
        try:
            engine_process.engine_python()
            problem = "" if swag.scene_folder else "Choose the photos in the panel Scene first."
        except engine_process.EngineError as error:
            problem = str(error)
        row = layout.row(align=True)
        row.scale_y = 1.4
        row.enabled = not problem
        set_button(row.operator("swag.train", text="Train", icon="PLAY"), resume=False)
        can_continue = swag.can_continue
        if can_continue:
            set_button(row.operator("swag.train", text="Continue", icon="FRAME_NEXT"), resume=True)
        row = layout.row()
        row.enabled = not problem
        row.operator("swag.forecast", icon="TIME")
        for name, seconds, psnr, memory in swag.forecast_lines():
            split = layout.split(factor=0.3)
            split.label(text=name)
            column = split.column(align=True)
            column.scale_y = 0.8
            column.label(text=seconds)
            column.label(text=f"{psnr}, {memory}")
        if problem:
            draw_wrapped(layout, problem, width, icon="INFO")
            if swag.scene_folder:
                button = layout.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES")
                set_button(button, module=EXTENSION)
        elif status.last_job == "Training" or status.failed and status.last_job == "Forecast":
            draw_outcome(layout, context)
        if can_continue:
            draw_wrapped(layout, f"{swag.stopped_at} Press Continue to finish it.", width, icon="RECOVER_LAST")


class SWAG_PT_train_more(SwagPanel):
    """Panel of the settings that few users change."""

    bl_label = "More"
    bl_parent_id = "SWAG_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether no training runs."""
        return status_of(context).job != "Training"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag = present(self.layout), swag_of(context.scene)
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(align=True)
        for name in (*(name for name in SETTINGS if name not in MAIN_SETTINGS), "run_folder"):
            column.prop(swag, name)


class SWAG_PT_result(SwagPanel):
    """Panel of the figures of the last run, of rendering and of opening files."""

    bl_label = "Result"
    bl_order = 3

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag = present(self.layout), swag_of(context.scene)
        if not swag.result_ply:
            draw_wrapped(layout, "Train first, or open a splat file below.", present(context.region).width, icon="INFO")
        else:
            column = layout.column(align=True)
            for label, value in (
                ("Gaussians", f"{swag.result_gaussians}"),
                ("Held-out PSNR", f"{swag.result_psnr:.2f} dB" if swag.result_psnr else "no held-out photos"),
                ("Held-out SSIM", f"{swag.result_ssim:.3f}" if swag.result_ssim else ""),
                ("Time", time_text(swag.result_seconds) + (" (stopped)" if swag.result_interrupted else "")),
            ):
                if value:
                    row = column.split(factor=0.45)
                    row.label(text=label)
                    row.label(text=value)
            if swag.result_water:
                draw_wrapped(layout, swag.result_water, present(context.region).width, icon="MOD_OCEAN")
        layout.operator("swag.prepare_render", icon="RESTRICT_RENDER_OFF")
        layout.operator("swag.import_splats", text="Open Splat File", icon="FILE_FOLDER")


class SWAG_PT_labels(SwagPanel):
    """Panel of the labels of the active splat object."""

    bl_label = "Labels"
    bl_parent_id = "SWAG_PT_result"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats."""
        return splats.is_splats(context.active_object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        label_list.draw_labels(present(self.layout), present(context.active_object))


class SWAG_PT_label(SwagPanel):
    """Panel that labels the run of the active splat object."""

    bl_label = "Make Labels"
    bl_parent_id = "SWAG_PT_labels"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, status = present(self.layout), status_of(context)
        layout.use_property_split = True
        layout.use_property_decorate = False
        if status.job == "Labelling":
            draw_job(layout, context)
            return
        label_list.draw_labelling(layout, present(context.active_object))
        if status.last_job == "Labelling":
            draw_wrapped(
                layout, status.message, present(context.region).width, icon="ERROR" if status.failed else "CHECKMARK"
            )


class SWAG_PT_export(SwagPanel):
    """Panel that saves splats for other programs."""

    bl_label = "Export"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        column = layout.column(align=True)
        chosen = any(splats.is_splats(obj) for obj in context.selected_objects)
        column.enabled = chosen
        for format in FORMATS.values():
            button = column.operator("swag.export_splats", text=format.title, icon="EXPORT")
            set_button(button, filepath=f"splats{format.suffix}")
        if not chosen:
            draw_wrapped(layout, "Select an object with splats first.", present(context.region).width, icon="INFO")


_CLASSES = (
    SWAG_PT_scene,
    SWAG_PT_effects,
    SWAG_PT_train,
    SWAG_PT_train_more,
    SWAG_PT_result,
    SWAG_PT_labels,
    SWAG_PT_label,
    SWAG_PT_export,
)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
