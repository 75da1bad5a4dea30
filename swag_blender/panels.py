"""The panels of the sidebar tab SWAG, in the order of work: Photos, Train, Result, Labels, Export.

Further panels are in files of their own; bl_order is 30 for Edit, 35 for Film and 55 for Maps. Train and
Result have a closed panel until their stage is reached; the panel that replaces it then is open.
"""

import bpy

from ..swag_engine.formats.registry import FORMATS
from ..swag_engine.settings.presets import SIZES
from ..swag_engine.settings.recipes import RECIPES
from . import (
    EXTENSION,
    camera_import,
    effect_pictures,
    engine_process,
    find_cameras,
    label_list,
    run_list,
    scale,
    splats,
)
from .blender_types import present, set_button
from .properties import IN_TIME, OWN_WATER, status_of, swag_of
from .sidebar import SwagPanel, draw_job, draw_outcome, draw_wrapped


class SWAG_PT_scene(SwagPanel):
    """Panel that takes the photos or the video."""

    bl_label = "Photos"
    bl_order = 0

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        if problem := engine_process.engine_problem():
            draw_wrapped(layout, problem, present(context.region).width, icon="ERROR")
            button = layout.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES")
            set_button(button, module=EXTENSION)
        find_cameras.draw_photos(layout, context)
        find_cameras.draw_shown(layout, context)


class SWAG_PT_other_cameras(SwagPanel):
    """Panel that imports models and cameras of other programs."""

    bl_label = "Cameras of Another Program"
    bl_parent_id = "SWAG_PT_scene"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag = present(self.layout), swag_of(context.scene)
        column = layout.column(align=True)
        column.label(text="COLMAP Model with Photos")
        column.prop(swag, "scene_folder", text="")
        row = column.row(align=True)
        row.operator("swag.inspect_scene", text="Check", icon="VIEWZOOM")
        button = row.operator("swag.import_scene", text="Import", icon="IMPORT")
        set_button(button, directory=swag.scene_path)
        layout.label(text="Other Cameras")
        camera_import.draw_import_cameras(layout, context)


class SWAG_PT_train_later(SwagPanel):
    """Panel in place of SWAG_PT_train until photos are chosen."""

    bl_label = "Train"
    bl_order = 10
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether no photos are chosen."""
        return not SWAG_PT_train.poll(context)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        draw_wrapped(
            present(self.layout), "Choose photos or a video first.", present(context.region).width, icon="INFO"
        )


class SWAG_PT_train(SwagPanel):
    """Panel that trains, continues and forecasts."""

    bl_label = "Train"
    bl_order = 10

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether photos are chosen, or a training runs."""
        return bool(swag_of(context.scene).scene_folder) or status_of(context).find("Training") is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag = present(self.layout), swag_of(context.scene)
        width = present(context.region).width
        if draw_job(layout, context, "Training", "Forecast"):
            return
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(align=True)
        column.prop(swag, "preset")
        if swag.preset == IN_TIME:
            column.prop(swag, "minutes")
            draw_wrapped(
                layout, "This machine is measured when training starts: the numbers follow from it.", width, icon="INFO"
            )
        else:
            for name in SIZES:
                column.prop(swag, name)
            if swag.is_lowered:
                draw_wrapped(
                    layout, "Little memory is free: these numbers are lowered. Close other programs and press Check.",
                    width, icon="ERROR",
                )  # fmt: skip
            if not swag.known_size:
                draw_wrapped(
                    layout, "Typical numbers: the photos set them when training starts. Check shows them.", width,
                    icon="INFO",
                )  # fmt: skip
        row = layout.row(align=True)
        row.scale_y = 1.4
        set_button(row.operator("swag.train", text="Train", icon="PLAY"), resume=False)
        can_continue = swag.can_continue
        if can_continue:
            set_button(row.operator("swag.train", text="Continue", icon="FRAME_NEXT"), resume=True)
        layout.operator("swag.forecast", icon="TIME")
        for name, seconds, psnr, memory in swag.forecast_lines():
            split = layout.split(factor=0.3)
            split.label(text=name)
            column = split.column(align=True)
            column.scale_y = 0.8
            column.label(text=seconds)
            column.label(text=f"{psnr}, {memory}")
        draw_outcome(layout, context, "Training")
        draw_outcome(layout, context, "Forecast", only_failed=True)
        if can_continue:
            draw_wrapped(layout, f"{swag.stopped_at} Press Continue to finish it.", width, icon="RECOVER_LAST")


class SWAG_PT_effects(SwagPanel):
    """Panel that plans the effects, shows the plan, and lets the user overrule it."""

    bl_label = "Effects"
    bl_parent_id = "SWAG_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether no training runs."""
        return status_of(context).find("Training") is None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag = present(self.layout), swag_of(context.scene)
        plan, width = swag.plan, present(context.region).width
        if draw_job(layout, context, "Plan"):
            return
        row = layout.row(align=True)
        row.operator("swag.plan", text="Plan Again" if plan.lines else "Plan", icon="VIEWZOOM")
        row.operator("swag.reset_effects", text="", icon="LOOP_BACK")
        draw_outcome(layout, context, "Plan", only_failed=True)
        if not plan.lines:
            draw_wrapped(
                layout, "Plan determines from the photos which effects training should model.", width, icon="INFO"
            )
            return
        if swag.plan_is_stale:
            draw_wrapped(layout, "This plan was made for other photos: plan again.", width, icon="ERROR")
        if not RECIPES[swag.recipe].planned:
            draw_wrapped(layout, "This method has its own effects: the plan is not followed.", width, icon="INFO")
        elif plan.water_note:
            draw_wrapped(layout, plan.water_note, width, icon="INFO")
        layout.template_list("SWAG_UL_effects", "", plan, "lines", plan, "active", rows=len(plan.lines))
        effect_pictures.draw_effect(layout, swag, plan.lines[plan.active], width)


class SWAG_PT_train_more(SwagPanel):
    """Panel of the settings that few users change."""

    bl_label = "Advanced"
    bl_parent_id = "SWAG_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether no training runs."""
        return status_of(context).find("Training") is None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, swag = present(self.layout), swag_of(context.scene)
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(swag, "recipe")
        column = layout.column(align=True)
        column.prop(swag, "sh_degree")
        column.prop(swag, "stop_when_flat")
        column = layout.column(align=True)
        column.prop(swag, "water_type")
        if swag.water_type == OWN_WATER:
            column.prop(swag, "attenuation")
        column.prop(swag, "metres_per_unit")
        if swag.water_type != "auto" and not swag.metres_per_unit and not scale.is_measured(context):
            draw_wrapped(
                layout,
                "This water is per metre: set the scale in the panel Scale, or Metres per Unit.",
                present(context.region).width,
                icon="ERROR",
            )
        column = layout.column(align=True)
        column.prop(swag, "run_folder")
        column.prop(swag, "backend")
        column.prop(swag, "seed")


class SWAG_PT_no_result(SwagPanel):
    """Panel in place of SWAG_PT_result until there are splats."""

    bl_label = "Result"
    bl_order = 20
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene has no splats."""
        return not SWAG_PT_result.poll(context)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        draw_wrapped(layout, "Train first, or open a run or a splat file.", present(context.region).width, icon="INFO")
        _draw_open(layout)


class SWAG_PT_result(SwagPanel):
    """Panel of the runs; below it are those of the water, the colors, the figures, the display and of opening files."""

    bl_label = "Result"
    bl_order = 20

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene has splats."""
        return any(splats.is_splats(obj) for obj in present(context.scene).objects)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        run_list.draw_runs(present(self.layout), context)


class SWAG_PT_quality(SwagPanel):
    """Panel of the quality of the shown run, in words and in figures."""

    bl_label = "How Good Is It?"
    bl_parent_id = "SWAG_PT_result"
    bl_order = 10
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a run."""
        return run_list.shown_run(context) is not None

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        """Draw the word for the quality; Blender calls this."""
        shown = present(run_list.shown_run(context))
        if quality := run_list.quality_of_run(run_list.folder_of(shown)):
            present(self.layout).label(text=quality[0].word)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        run_list.draw_quality(present(self.layout), context)


class SWAG_PT_open(SwagPanel):
    """Panel that opens further runs and splat files."""

    bl_label = "Open Another"
    bl_parent_id = "SWAG_PT_result"
    bl_order = 30
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        _draw_open(present(self.layout))


def _draw_open(layout: bpy.types.UILayout) -> None:
    """Draw the buttons that open runs and splat files."""
    row = layout.row(align=True)
    row.operator("swag.open_run", icon="FILE_FOLDER")
    row.operator("swag.import_splats", text="Open Splat File", icon="FILE")
    layout.operator("swag.open_survey", icon="OUTLINER_OB_POINTCLOUD")


class SWAG_PT_labels(SwagPanel):
    """Panel of the labels of the active splat object."""

    bl_label = "Labels"
    bl_order = 50
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        obj = context.active_object
        if obj is None or not splats.is_splats(obj):
            draw_wrapped(layout, "Select an object with splats first.", present(context.region).width, icon="INFO")
        else:
            label_list.draw_labels(layout, obj)


class SWAG_PT_label(SwagPanel):
    """Panel that labels the run of the active splat object."""

    bl_label = "Make Labels"
    bl_parent_id = "SWAG_PT_labels"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats."""
        return splats.is_splats(context.active_object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        layout.use_property_split = True
        layout.use_property_decorate = False
        if draw_job(layout, context, "Labelling"):
            return
        label_list.draw_labelling(layout, present(context.active_object))
        draw_outcome(layout, context, "Labelling")


class SWAG_PT_export(SwagPanel):
    """Panel that saves splats for other programs."""

    bl_label = "Export"
    bl_order = 60
    bl_options = {"DEFAULT_CLOSED"}

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
    SWAG_PT_other_cameras,
    SWAG_PT_train_later,
    SWAG_PT_train,
    SWAG_PT_effects,
    SWAG_PT_train_more,
    SWAG_PT_no_result,
    SWAG_PT_result,
    SWAG_PT_quality,
    SWAG_PT_open,
    SWAG_PT_labels,
    SWAG_PT_label,
    SWAG_PT_export,
)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
