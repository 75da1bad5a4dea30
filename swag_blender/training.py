"""A training as the Blender scene sees it: its request, the splats of its previews, its result."""

import contextlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from ..swag_engine.base.text import time_text
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.splats.splats import Splats
from . import kept_through_undo, splats, water
from .blender_types import present
from .job import chosen_scene
from .nodes import splat_preview
from .properties import swag_of
from .runs import free_run_folder, remember_training, show_splats, shown_splats

_reader = ThreadPoolExecutor(1)


class Training:
    """One training of the images that the Blender scene has chosen.

    Args:
        context: its scene gets the splats, and gives the settings.
        resume: continue the run in the run folder instead of starting a new one.

    Raises:
        InputError: no images are chosen, or the folder that the run's folder lies in does not exist.
    """

    def __init__(self, context: bpy.types.Context, resume: bool) -> None:
        scene = present(context.scene)
        swag = swag_of(scene)
        self._images = chosen_scene(swag)
        if not resume:
            swag.run_folder = str(free_run_folder(require_parent(Path(swag.run_path))))
        self._scene, self._run = scene.name, swag.run_path
        kept_through_undo.keep(scene)
        self._preview: tuple[Future[Splats], dict[str, Any]] | None = None
        self._cloud = 0
        self.request: dict[str, Any] = {
            "request": "train",
            "scene": self._images,
            "out": self._run,
            # A run continues with the settings it was started with.
            "settings": {} if resume else swag.shown_settings(),
            "resume": resume,
        }

    def read_preview(self, event: dict[str, Any]) -> None:
        """Start to read the splats of a `preview` event; does nothing while others are read.

        A thread reads them: reading takes longer than all other work on a preview, and would block the window.
        """
        if self._preview is None:
            self._preview = _reader.submit(read_ply, Path(event["path"])), event

    def show_preview(self, context: bpy.types.Context) -> None:
        """Show the splats of the preview in the scene once they are read.

        The user may undo or delete a preview: no other is shown then, because its own step of undo would come between
        the user and what they want to undo. Redo shows the previews again, and the result is shown in any case.
        """
        if self._preview is None or not self._preview[0].done():
            return
        (reading, event), self._preview = self._preview, None
        # A window that was busy reads late: the run has ended and its preview file is gone.
        with contextlib.suppress(InputError):
            scene = bpy.data.scenes.get(self._scene)
            if scene and not self._is_undone(scene):
                obj = show_splats(scene, reading.result(), self._run, self._images)
                if "background" in event:
                    obj[splat_preview.BACKGROUND_KEY] = event["background"]
                water.remember_water(obj, event.get("water"), 0.0)
                self._remember_step(obj)

    def show_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Show the result of a `result` event in the scene and select it; returns what to tell the user.

        Raises:
            InputError: the scene was removed, or the result cannot be read.
        """
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise InputError(f"The scene {self._scene} was removed; the trained splats are in {event['ply']}.")
        metrics = event["metrics"]
        obj = show_splats(scene, read_ply(Path(event["ply"])), self._run, self._images)
        remember_training(obj, RunFolder(Path(self._run)), metrics)
        if context.mode == "OBJECT" and present(context.view_layer).objects.get(obj.name):
            splats.select_only(context, [obj])
        swag_of(scene).show_metrics(event)
        quality = f", {metrics['test_psnr']:.1f} dB on held-out photos" if metrics.get("test_psnr") else ""
        how = "Stopped; kept" if event["interrupted"] else "Trained"
        return f"{how} {metrics['gaussians']} Gaussians in {time_text(metrics['seconds'])}{quality}."

    def _is_undone(self, scene: bpy.types.Scene) -> bool:
        """Whether the user undid or deleted the last preview."""
        obj = shown_splats(scene, self._run)
        return bool(self._cloud) and (obj is None or present(obj.data).session_uid != self._cloud)

    def _remember_step(self, obj: bpy.types.Object) -> None:
        """Make a step of undo where the preview has made data: Blender crashes on undo of steps that do not have it."""
        cloud = present(obj.data).session_uid
        if cloud != self._cloud:
            bpy.ops.ed.undo_push(message="Show Training")
        self._cloud = cloud
