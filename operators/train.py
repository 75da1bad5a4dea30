"""Train the scene's photographs; the splats appear while they are trained."""

import contextlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty

from ..swag_blender import scene_import, water
from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job
from ..swag_blender.properties import time_text
from ..swag_blender.runs import free_run_folder, remember_training, show_splats
from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.splats.splats import Splats

_reader = ThreadPoolExecutor(1)


class SWAG_OT_train(Job, bpy.types.Operator):
    """Turn the photographs into 3D Gaussians; Escape stops and keeps what exists"""

    bl_idname = "swag.train"
    bl_label = "Train"
    bl_options = {"REGISTER", "UNDO"}
    job = "Training"

    resume: BoolProperty(
        name="Continue", description="Go on with the run in the run folder where it stopped", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        if properties.resume:
            return "Go on with the run where it stopped, with the settings it was started with"
        return cls.__doc__

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background:
            return self.run_waiting(context)
        scene_import.show_colors(context.screen)
        return self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        swag = context.scene.swag
        if not swag.scene_folder:
            raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
        if not self.resume:
            swag.run_folder = str(free_run_folder(Path(swag.run_path)))
        self._preview: tuple[Future[Splats], dict[str, Any] | None] | None = None
        self._scene, self._run, self._photographs = context.scene.name, swag.run_path, swag.scene_path
        engine = Engine()
        engine.send(
            {
                "request": "train",
                "scene": self._photographs,
                "out": self._run,
                # A run goes on with the settings it was started with.
                "settings": {} if self.resume else swag.train_settings(),
                "resume": self.resume,
            }
        )
        return engine

    def on_event(self, context: bpy.types.Context, event: dict[str, Any]) -> None:
        # Read beside the window, which would wait for longer than all the rest takes; none waits where none is seen.
        if event["event"] == "preview" and not self._preview and not bpy.app.background:
            self._preview = _reader.submit(read_ply, Path(event["path"])), event.get("water")

    def on_timer(self, context: bpy.types.Context) -> None:
        if self._preview is None or not self._preview[0].done():
            return
        (reading, values), self._preview = self._preview, None
        # A window that was busy comes late: the run has ended and its preview is gone.
        with contextlib.suppress(InputError):
            if scene := bpy.data.scenes.get(self._scene):
                obj = show_splats(scene, reading.result(), self._run, self._photographs)
                water.remember_water(obj, values, 0.0)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise EngineError(f"The scene {self._scene} is gone; the trained splats are in {event['ply']}.")
        obj = show_splats(scene, read_ply(Path(event["ply"])), self._run, self._photographs)
        remember_training(obj, RunFolder(Path(self._run)), event["metrics"])
        if context.mode == "OBJECT" and context.view_layer.objects.get(obj.name):
            # What the user exports, moves or isolates next.
            for other in context.selected_objects:
                other.select_set(False)
            obj.select_set(True)
            context.view_layer.objects.active = obj
        scene.swag.show_metrics(event)
        metrics = event["metrics"]
        measured = f", {metrics['test_psnr']:.1f} dB on held-out photographs" if metrics.get("test_psnr") else ""
        how = "Stopped; kept" if event["interrupted"] else "Trained"
        return f"{how} {metrics['gaussians']} Gaussians in {time_text(metrics['seconds'])}{measured}."


CLASSES = (SWAG_OT_train,)
