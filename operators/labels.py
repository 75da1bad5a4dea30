"""What a user does with the labels of splats: make, list, show, select, search, keep as masks, separate, merge."""

import os
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, IntProperty, StringProperty

from ..swag_blender import labels, splats
from ..swag_blender.engine_process import Engine, EngineError, run_request
from ..swag_blender.job import Job
from ..swag_blender.runs import RUN_KEY
from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.run_folder import RunFolder


class _OnSplats:
    """Mixin of operators on the active splat object: errors become one sentence, and undo takes all back."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Select an object with splats first")
        return splats.is_splats(context.active_object)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            message = self.work(context, context.active_object)
        except (InputError, EngineError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if message:
            self.report({"INFO"}, message)
        return {"FINISHED"}


class SWAG_OT_label_run(Job, bpy.types.Operator):
    """Give every splat of the run a label: by your masks, by words, or by what stands out; Escape stops"""

    bl_idname = "swag.label_run"
    bl_label = "Label"
    bl_options = {"REGISTER", "UNDO"}
    job = "Labelling"

    source: labels.SOURCE
    words: labels.WORDS
    masks: labels.MASKS
    download: labels.DOWNLOAD

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and _OnSplats.poll.__func__(cls, context)

    def start(self, context: bpy.types.Context) -> Engine:
        obj = context.active_object
        self._object, self._run = obj.name, bpy.path.abspath(obj.get(RUN_KEY, "")) or context.scene.swag.run_path
        if not self._run:
            raise InputError(
                f"The splats of {obj.name} are from no run on this machine: train, or choose the run folder."
            )
        request: dict[str, Any] = {"request": "label", "run": self._run, "saliency": self.source == "SALIENCY"}
        if self.source == "WORDS":
            if not self.words.strip():
                raise InputError("There is nothing to look for: write words such as coral, wreck, open water.")
            if self.download and not bpy.app.online_access:
                raise InputError("Networks cannot be fetched: allow online access in Preferences > System first.")
            request |= {"words": self.words, "download": self.download}
        elif self.source == "MASKS":
            if not self.masks:
                raise InputError("There is no folder of masks: choose it, or label by something else.")
            request["masks"] = os.path.abspath(bpy.path.abspath(self.masks))
        engine = Engine()
        engine.send(request)
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        obj = bpy.data.objects.get(self._object)
        if obj is None:
            raise InputError(f"{self._object} is gone; the labels are in {self._run}.")
        labels.take_labels(obj, read_ply(RunFolder(Path(self._run)).ply), self._run)
        names = [entry["name"] for entry in event["labels"]]
        return " ".join([f"{len(names)} labels: {', '.join(names[:8])}.", *event["notes"]])


class SWAG_OT_read_labels(_OnSplats, bpy.types.Operator):
    """List the labels of the splats, with the names of the run they are from"""

    bl_idname = "swag.read_labels"
    bl_label = "Read Labels"

    directory: StringProperty(
        name="Run", description="Folder of the run; left empty: that of the splats", subtype="DIR_PATH"
    )

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        folder = bpy.path.abspath(self.directory or obj.get(RUN_KEY, "")) or context.scene.swag.run_path
        return f"{labels.read_labels(obj, folder)} labels."


class SWAG_OT_show_labels(_OnSplats, bpy.types.Operator):
    """Show all labels"""

    bl_idname = "swag.show_labels"
    bl_label = "Show All"

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        for entry in obj.swag_labels.entries:
            entry["visible"] = True
        labels.show(obj)
        return ""


class SWAG_OT_isolate_label(_OnSplats, bpy.types.Operator):
    """Show this label alone; all again on a second click"""

    bl_idname = "swag.isolate_label"
    bl_label = "Isolate"

    number: IntProperty(name="Label")

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        labels.isolate(obj, self.number)
        return ""


class SWAG_OT_select_label(_OnSplats, bpy.types.Operator):
    """Select the splats of this label; with Shift beside what is selected"""

    bl_idname = "swag.select_label"
    bl_label = "Select Label"

    number: IntProperty(name="Label")
    extend: BoolProperty(name="Extend")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.extend = event.shift
        return self.execute(context)

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        return f"{labels.select_label(obj, self.number, self.extend)} splats selected."


class SWAG_OT_search_labels(_OnSplats, bpy.types.Operator):
    """Find splats by words: writes swag:similarity and selects what is above the threshold"""

    bl_idname = "swag.search_labels"
    bl_label = "Search Splats"

    words: StringProperty(name="Search", description="What to look for; left empty: what stands in the panel")

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        words = (self.words or obj.swag_labels.words).strip()
        if not words:
            raise InputError("There is nothing to search for: write what to look for, such as coral.")
        numbers = labels.called(obj, words)
        found = labels.similarity_to_labels(obj, numbers) if numbers else self.by_meaning(obj, words)
        obj.swag_labels.words = words
        return f"{labels.set_similarity(obj, found)} splats selected."

    @staticmethod
    def by_meaning(obj: bpy.types.Object, words: str) -> np.ndarray:
        """What the engine's text network says, for words that no label is called."""
        if not obj.swag_labels.folder:
            names = ", ".join(entry.name for entry in obj.swag_labels.entries if entry.number)
            raise InputError(f"No label is called {words}: the labels are {names or 'not read yet'}.")
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "similarity.npy")
            run_request({"request": "search", "run": obj.swag_labels.folder, "words": words, "path": path})
            return np.load(path)


class SWAG_OT_keep_mask(_OnSplats, bpy.types.Operator):
    """Keep the selection as an attribute mask:NAME, for geometry nodes"""

    bl_idname = "swag.keep_mask"
    bl_label = "Keep as Mask"

    name: StringProperty(name="Name", description="Of the mask; left empty: what was searched")

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        return f"Kept as {labels.keep_mask(obj, self.name or obj.swag_labels.words)}."


class SWAG_OT_separate_splats(_OnSplats, bpy.types.Operator):
    """Move the selected splats to an object of their own"""

    bl_idname = "swag.separate_splats"
    bl_label = "Separate Splats"

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        made = labels.separate(obj)
        for one in context.selected_objects:
            one.select_set(False)
        made.select_set(True)
        context.view_layer.objects.active = made
        return f"{len(made.data.points)} splats in {made.name}."


class SWAG_OT_merge_splats(_OnSplats, bpy.types.Operator):
    """Bring the splats of the other selected objects into the active one"""

    bl_idname = "swag.merge_splats"
    bl_label = "Merge Splats"

    def work(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        others = [one for one in context.selected_objects if splats.is_splats(one) and one != obj]
        if not others:
            raise InputError("Only one object with splats is selected: select those to merge, the one to keep last.")
        return f"{labels.merge(obj, others)} splats in {obj.name}."


CLASSES = (
    *labels.CLASSES,
    SWAG_OT_label_run,
    SWAG_OT_read_labels,
    SWAG_OT_show_labels,
    SWAG_OT_isolate_label,
    SWAG_OT_select_label,
    SWAG_OT_search_labels,
    SWAG_OT_keep_mask,
    SWAG_OT_separate_splats,
    SWAG_OT_merge_splats,
)

register, unregister = labels.register, labels.unregister
