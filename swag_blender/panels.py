"""The sidebar tab SWAG: a panel for each stage of the work."""

import textwrap

import bpy

from . import EXTENSION, engine_process, labels, splats
from .properties import SETTINGS, sparkline, time_text
from .splat_formats import FORMATS

MAIN_SETTINGS = ("recipe", "preset", "time_budget")
"""Settings that are always visible; the others are in the closed panel below them."""


class SwagPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SWAG"


class SWAG_PT_scene(SwagPanel, bpy.types.Panel):
    bl_label = "Scene"
    bl_order = 0

    def draw(self, context: bpy.types.Context) -> None:
        layout, swag, status = self.layout, context.scene.swag, context.window_manager.swag
        width = context.region.width
        column = layout.column()
        column.label(text="Photographs with COLMAP model")
        column.prop(swag, "scene_folder", text="")
        row = column.row(align=True)
        row.enabled = bool(swag.scene_folder)
        row.operator("swag.inspect_scene", text="Check", icon="VIEWZOOM")
        row.operator("swag.import_scene", text="Import", icon="IMPORT").directory = swag.scene_path
        if not swag.scene_folder:
            draw_wrapped(layout, "Choose the folder first.", width, icon="INFO")
        elif status.job in ("Import", "Check"):
            draw_job(layout, context)
        elif status.failed and status.last_job in ("Import", "Check"):
            draw_outcome(layout, context)
        else:
            for line in swag.found.splitlines():
                draw_wrapped(layout, line, width)


class SWAG_PT_effects(SwagPanel, bpy.types.Panel):
    bl_label = "Effects"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        layout, plan, status = self.layout, context.scene.swag.plan, context.window_manager.swag
        width = context.region.width
        if status.job == "Plan":
            draw_job(layout, context)
            return
        row = layout.row(align=True)
        row.enabled = bool(context.scene.swag.scene_folder)
        row.operator("swag.plan", text="Plan Again" if plan.lines else "Plan", icon="VIEWZOOM")
        row.operator("swag.reset_effects", text="", icon="LOOP_BACK")
        if status.failed and status.last_job == "Plan":
            draw_outcome(layout, context)
        if not plan.lines:
            draw_wrapped(layout, "The photographs tell which effects training should simulate.", width, icon="INFO")
            return
        if plan.stale:
            draw_wrapped(layout, "This plan is of other photographs: plan again.", width, icon="ERROR")
        layout.template_list("SWAG_UL_effects", "", plan, "lines", plan, "active", rows=len(plan.lines))
        line = plan.lines[plan.active]
        layout.prop(line, "choice", expand=True)
        draw_wrapped(layout.box(), line.reason, width - 20)


class SWAG_PT_train(SwagPanel, bpy.types.Panel):
    bl_label = "Train"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        layout, swag, status = self.layout, context.scene.swag, context.window_manager.swag
        width = context.region.width
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
            problem = "" if swag.scene_folder else "Choose the photographs in the panel Scene first."
        except engine_process.EngineError as error:
            problem = str(error)
        row = layout.row(align=True)
        row.scale_y = 1.4
        row.enabled = not problem
        row.operator("swag.train", text="Train", icon="PLAY").resume = False
        can_continue = swag.can_continue
        if can_continue:
            row.operator("swag.train", text="Continue", icon="FRAME_NEXT").resume = True
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
                layout.operator(
                    "preferences.addon_show", text="Open Preferences", icon="PREFERENCES"
                ).module = EXTENSION
        elif status.last_job == "Training" or status.failed and status.last_job == "Forecast":
            draw_outcome(layout, context)
        if can_continue:
            draw_wrapped(layout, f"{swag.stopped_at} Continue goes on with it.", width, icon="RECOVER_LAST")


class SWAG_PT_train_more(SwagPanel, bpy.types.Panel):
    bl_label = "More"
    bl_parent_id = "SWAG_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.window_manager.swag.job != "Training"

    def draw(self, context: bpy.types.Context) -> None:
        layout, swag = self.layout, context.scene.swag
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(align=True)
        for name in (*(name for name in SETTINGS if name not in MAIN_SETTINGS), "run_folder"):
            column.prop(swag, name)


class SWAG_PT_result(SwagPanel, bpy.types.Panel):
    bl_label = "Result"
    bl_order = 3

    def draw(self, context: bpy.types.Context) -> None:
        layout, swag = self.layout, context.scene.swag
        if not swag.result_ply:
            draw_wrapped(layout, "Train first, or open a splat file below.", context.region.width, icon="INFO")
        else:
            column = layout.column(align=True)
            for label, value in (
                ("Gaussians", f"{swag.result_gaussians}"),
                ("Held-out PSNR", f"{swag.result_psnr:.2f} dB" if swag.result_psnr else "no such photographs"),
                ("Held-out SSIM", f"{swag.result_ssim:.3f}" if swag.result_ssim else ""),
                ("Time", time_text(swag.result_seconds) + (" (stopped)" if swag.result_interrupted else "")),
            ):
                if value:
                    row = column.split(factor=0.45)
                    row.label(text=label)
                    row.label(text=value)
            if swag.result_water:
                draw_wrapped(layout, swag.result_water, context.region.width, icon="MOD_OCEAN")
        layout.operator("swag.prepare_render", icon="RESTRICT_RENDER_OFF")
        layout.operator("swag.import_splats", text="Open Splat File", icon="FILE_FOLDER")


class SWAG_PT_labels(SwagPanel, bpy.types.Panel):
    bl_label = "Labels"
    bl_parent_id = "SWAG_PT_result"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return splats.is_splats(context.active_object)

    def draw(self, context: bpy.types.Context) -> None:
        labels.draw_labels(self.layout, context.active_object)


class SWAG_PT_label(SwagPanel, bpy.types.Panel):
    bl_label = "Make Labels"
    bl_parent_id = "SWAG_PT_labels"

    def draw(self, context: bpy.types.Context) -> None:
        layout, status = self.layout, context.window_manager.swag
        layout.use_property_split = True
        layout.use_property_decorate = False
        if status.job == "Labelling":
            draw_job(layout, context)
            return
        labels.draw_labelling(layout, context.active_object)
        if status.last_job == "Labelling":
            draw_wrapped(layout, status.message, context.region.width, icon="ERROR" if status.failed else "CHECKMARK")


class SWAG_PT_export(SwagPanel, bpy.types.Panel):
    bl_label = "Export"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        column = layout.column(align=True)
        chosen = any(splats.is_splats(obj) for obj in context.selected_objects)
        column.enabled = chosen
        for format in FORMATS.values():
            button = column.operator("swag.export_splats", text=format.title, icon="EXPORT")
            button.filepath = f"splats{format.suffix}"
        if not chosen:
            draw_wrapped(layout, "Select an object with splats first.", context.region.width, icon="INFO")


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The job that runs: progress, Pause and Cancel, figures, the curve of its quality."""
    status = context.window_manager.swag
    text = "Stopping" if status.stopping else "Paused" if status.paused else status.text
    layout.progress(factor=status.factor, text=text)
    row = layout.row(align=True)
    if status.job == "Training":
        row.operator(
            "swag.pause", text="Go On" if status.paused else "Pause", icon="PLAY" if status.paused else "PAUSE"
        )
    row.operator("swag.cancel", text="Cancel", icon="CANCEL")
    figures = status.figures()
    if figures:
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
        for figure in figures:
            grid.label(text=figure)
    curve = [float(psnr) for psnr in status.curve.split()]
    if len(curve) > 1:
        layout.label(text=f"{curve[0]:.1f} {sparkline(curve)} {curve[-1]:.1f} dB")


def draw_outcome(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """How the last job ended; after an error with the way to its log."""
    status = context.window_manager.swag
    draw_wrapped(layout, status.message, context.region.width, icon="ERROR" if status.failed else "CHECKMARK")
    if status.failed:
        layout.operator("swag.show_log", icon="TEXT")


def draw_wrapped(layout: bpy.types.UILayout, text: str, width: int, icon: str = "NONE") -> None:
    """A sentence over as many lines as a region of `width` pixels needs."""
    text = bpy.app.translations.pgettext_iface(text)
    # Blender's interface font has about 6.4 pixels a character; margins and an icon take their share.
    pixels = width / bpy.context.preferences.system.ui_scale - (30 if icon == "NONE" else 54)
    characters = max(20, int(pixels / 6.4))
    column = layout.column(align=True)
    column.scale_y = 0.8
    for number, line in enumerate(textwrap.wrap(text, characters)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


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
