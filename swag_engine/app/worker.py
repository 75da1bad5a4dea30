"""The child process that Blender drives: requests on stdin, events on stdout, one JSON object a line.

It ends when stdin closes, or on SIGTERM; what runs then is cancelled first, and everything that exists is kept.
"""

import os
import queue
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from ..base import threads  # noqa: F401
from ..base.errors import InputError, name_buttons
from ..base.strict_json import to_json
from ..settings.settings import TrainSettings
from .answers import missing_package
from .interrupts import interrupts
from .map_requests import make_map
from .protocol import (
    CancelRequest,
    ChartRequest,
    ExportRequest,
    FilmRequest,
    ForecastRequest,
    GoOnRequest,
    ImportCamerasRequest,
    InspectRequest,
    LabelRequest,
    MapRequest,
    MergeSurveyRequest,
    PauseRequest,
    PlanRequest,
    PlanSurveyRequest,
    ReportRequest,
    Request,
    RestoreRequest,
    ScaleRequest,
    ScoreEditRequest,
    SearchRequest,
    SfmRequest,
    TrainRequest,
    parse_request,
)

if TYPE_CHECKING:
    from ..scene.colmap import Scene

DEFAULTS = TrainSettings()
"""Settings of a run that nobody has changed."""
DISPLAY_WIDTH = 640
"""Width in pixels of undistorted copies, which are shown behind cameras and not trained on."""
PAUSE_POLL_SECONDS = 0.2
"""Seconds between two looks for a signal while a run is paused."""


class Worker:
    """Reads requests from one stream and answers on another.

    Requests are read by a thread of their own, so that `cancel` and the end of the stream are seen during a run.

    Args:
        requests: Stream of requests, one JSON object a line.
        events: Stream that events are written to.
    """

    def __init__(self, requests: TextIO, events: TextIO) -> None:
        self.requests, self.events = requests, events
        self.waiting: queue.SimpleQueue[Request | InputError | None] = queue.SimpleQueue()
        self.stop, self.now = threading.Event(), threading.Event()
        self.going = threading.Event()
        self.going.set()
        self.writing = threading.Lock()
        self.counting = threading.Lock()
        self.unanswered = 0

    def send(self, event: dict[str, Any]) -> None:
        """Write one event; a reader that has gone away stops the run."""
        try:
            with self.writing:
                self.events.write(to_json(event) + "\n")
                self.events.flush()
        except (BrokenPipeError, ValueError):
            self.stop.set()

    def read(self) -> None:
        """Read requests until the stream ends, and carry out those that concern the run at hand."""
        for line in self.requests:
            if not line.strip():
                continue
            try:
                request: Request | InputError = parse_request(line)
            except InputError as error:
                request = error
            # With nothing to cancel or to pause, these must not reach what is asked for next.
            with self.counting:
                if isinstance(request, PauseRequest):
                    if self.unanswered:
                        self.going.clear()
                elif isinstance(request, GoOnRequest):
                    self.going.set()
                elif isinstance(request, CancelRequest):
                    if self.unanswered:
                        self.end()
                        if request.now:
                            self.now.set()
                else:
                    self.unanswered += 1
                    self.waiting.put(request)
        self.end()
        self.waiting.put(None)

    def end(self) -> None:
        """Ask the run at hand to stop, a paused one too."""
        self.stop.set()
        self.going.set()

    def should_stop(self) -> bool:
        """Return whether the run is to stop. Asked between two iterations; while the run is paused it waits here."""
        while not self.going.wait(PAUSE_POLL_SECONDS):
            if interrupts.should_stop():
                break
        return interrupts.should_stop() or self.stop.is_set()

    def should_stop_now(self) -> bool:
        """Return whether the evaluation that a training ends with is to stop, too."""
        return interrupts.should_stop_now() or self.now.is_set()

    def run(self) -> None:
        """Answer requests, one after the other, until the stream of requests ends or a signal comes.

        Raises:
            KeyboardInterrupt: On a signal while nothing runs that can stop by itself.
        """
        threading.Thread(target=self.read, daemon=True).start()
        while not interrupts.should_stop() and (request := self.waiting.get()) is not None:
            event = self.outcome(request)
            with self.counting:
                self.unanswered -= 1
                self.stop.clear()
                self.now.clear()
                self.going.set()
            self.send(event)

    def outcome(self, request: Request | InputError) -> dict[str, Any]:
        """Carry out one request.

        Args:
            request: The request, or what is wrong with the line that was read.

        Returns:
            The `result` event, or an `error` event of kind "input" (the user can change it) or "bug".
        """
        try:
            if isinstance(request, InputError):
                raise request
            return self.answer(request)
        except InputError as error:
            return {"event": "error", "kind": "input", "message": str(error)}
        except Exception as error:  # the worker lives on after a bug
            if sentence := missing_package(error) or shortage(error):
                return {"event": "error", "kind": "input", "message": sentence}
            traceback.print_exc(file=sys.stderr)
            return {"event": "error", "kind": "bug", "message": f"{type(error).__name__}: {error}"}

    def answer(self, request: Request) -> dict[str, Any]:
        """Return the `result` event of one request.

        Raises:
            InputError: As the request's function does.
        """
        if isinstance(request, InspectRequest):
            return inspect(request.scene, request.arrays, request.settings)
        if isinstance(request, SfmRequest):
            with interrupts.deferred():
                return self.find_cameras(request)
        if isinstance(request, ScaleRequest):
            from ..georeference.measure import Measurements, scale_scene

            with interrupts.deferred():
                progress = self.stoppable("The measurement was stopped; nothing was written.")
                known = Measurements(targets=request.targets, size=request.size)
                return {"event": "result", "request": "scale"} | scale_scene(request.scene, known, progress)
        if isinstance(request, ImportCamerasRequest):
            with interrupts.deferred():
                return self.import_cameras(request)
        if isinstance(request, PlanRequest):
            from ..evidence.observations import FIT_WIDTH
            from ..planning.plan import plan_and_keep

            settings = request.settings.sized()
            width = settings.width or FIT_WIDTH  # a time budget finds its own
            plan, _ = plan_and_keep(request.scene, request.out, settings.effects, width)
            return {"event": "result", "request": "plan", "plan": plan.to_json()}
        if isinstance(request, TrainRequest):
            from ..experiments.train_and_report import train_and_report

            with interrupts.deferred():
                return train_and_report(
                    request.scene, request.out, request.settings, request.resume, self.send, self.should_stop,
                    preview=True, should_stop_now=self.should_stop_now,
                )  # fmt: skip
        if isinstance(request, ForecastRequest):
            from ..experiments.forecast import forecast_scene

            with interrupts.deferred():
                progress = self.stoppable("The forecast was stopped.")
                forecast = forecast_scene(request.scene, request.settings, progress)
            return {"event": "result", "request": "forecast", "scene": str(request.scene)} | forecast
        if isinstance(request, LabelRequest):
            with interrupts.deferred():
                return self.label(request)
        if isinstance(request, FilmRequest):
            with interrupts.deferred():
                return self.film(request)
        if isinstance(request, SearchRequest):
            from ..experiments.label_run import search_run, write_similarity

            similarity, labels = search_run(request.run, request.words)
            write_similarity(request.path, similarity)
            return {"event": "result", "request": "search", "path": str(request.path), "labels": labels}
        if isinstance(request, ScoreEditRequest):
            from ..experiments.score_edit import score_edit

            with interrupts.deferred():
                progress = self.stoppable("The comparison was stopped.")
                scores = score_edit(request.run, request.masks, progress)
            return {"event": "result", "request": "score_edit"} | scores
        if isinstance(request, ChartRequest):
            from ..experiments.color_chart import measure_chart

            with interrupts.deferred():
                progress = self.stoppable("The search for a color chart was stopped; nothing was written.")
                document = measure_chart(request.run, progress=progress, marked=request.marked)
            return {"event": "result", "request": "chart", "run": str(request.run)} | document
        if isinstance(request, RestoreRequest):
            from ..experiments.restore_photos import restore_photos

            with interrupts.deferred():
                progress = self.stoppable("The restoration was stopped; the photos that were done are there.")
                files = restore_photos(
                    request.run, request.out, develop=request.colors, haze=request.haze, progress=progress
                )
            return {"event": "result", "request": "restore", "out": str(request.out), "photos": len(files)}
        if isinstance(request, MapRequest):
            with interrupts.deferred():
                progress = self.stoppable("The map was stopped before it was done.")
                return {"event": "result"} | make_map(request, progress)
        if isinstance(request, PlanSurveyRequest):
            from ..survey.plan import plan_survey

            with interrupts.deferred():
                progress = self.stoppable("The planning of the survey was stopped; nothing was written.")
                planned = plan_survey(request.scene, request.out, request.settings, request.block_images, progress)
            return {"event": "result", "request": "plan_survey", "survey": str(request.out)} | planned
        if isinstance(request, MergeSurveyRequest):
            from ..survey.merge import merge_survey

            with interrupts.deferred():
                progress = self.stoppable("The merge was stopped before it was done.")
                merged = merge_survey(request.survey, progress, request.partial)
            return {"event": "result", "request": "merge_survey", "survey": str(request.survey)} | merged
        if isinstance(request, ReportRequest):
            from ..experiments.report import write_report

            return {"event": "result", "request": "report", "report": str(write_report(request.run))}
        assert isinstance(request, ExportRequest)
        from ..formats.export import export_run

        export_run(request.run, request.format, request.out)
        return {"event": "result", "request": "export", "out": str(request.out)}

    def find_cameras(self, request: SfmRequest) -> dict[str, Any]:
        """Return the `result` event of an `sfm` request: that of `inspect` for the new scene, with all warnings.

        Raises:
            InputError: As `reconstruct` does, and when the request is cancelled.
        """
        from ..sfm.reconstruct import reconstruct

        progress = self.stoppable("Find Cameras was stopped; nothing was written.")
        made = reconstruct(request.photos, request.out, progress)
        found = inspect(request.out, request.arrays, request.settings)
        return found | {
            "request": "sfm",
            "notes": made["notes"],
            "warnings": list(dict.fromkeys(made["warnings"] + found["warnings"])),
        }

    def import_cameras(self, request: ImportCamerasRequest) -> dict[str, Any]:
        """Return the `result` event of an `import_cameras` request: that of `inspect`, with all warnings.

        Raises:
            InputError: As the engine's `import_cameras` does, and when the request is cancelled.
        """
        from ..camera_files.import_cameras import import_cameras

        progress = self.stoppable("Import Cameras was stopped; nothing was written.")
        made = import_cameras(request.file, request.out, request.photos, request.points, progress)
        found = inspect(request.out, request.arrays, request.settings)
        return found | {"request": "import_cameras", "warnings": made["warnings"] + found["warnings"]}

    def label(self, request: LabelRequest) -> dict[str, Any]:
        """Return the `result` event of a `label` request.

        Raises:
            InputError: As `label_run` does, and when the request is cancelled.
        """
        from ..experiments.label_run import label_run

        document = label_run(
            request.run,
            request.words.split(",") if request.words else (),
            request.masks,
            "saliency" if request.saliency else None,
            download=request.download,
            progress=self.stoppable("Labelling was stopped; the run is as it was."),
        )
        return {"event": "result", "request": "label", "run": str(request.run)} | document

    def film(self, request: FilmRequest) -> dict[str, Any]:
        """Return the `result` event of a `film` request; a cancelled sequence keeps the frames it has.

        Raises:
            InputError: As `film_model` and `render_film` do.
        """
        from ..experiments.film import FilmOptions, describe, film_model, render_film
        from ..formats.camera_path import read_camera_path

        frames = read_camera_path(request.cameras)
        options = FilmOptions(request.alpha, request.depth, request.overwrite, request.fps, request.unit)
        model = film_model(request.splats, request.run, request.water, request.background)

        def progress(done: int, total: int) -> None:
            text = f"Frame {done} of {total}"
            self.send({"event": "progress", "stage": "film", "text": text, "iteration": done, "iterations": total})

        result = render_film(
            model, request.out, frames, options,
            colors=request.colors, progress=progress, should_stop=self.should_stop,
        )  # fmt: skip
        return {"event": "result", "request": "film", "text": describe(result)} | result

    def stoppable(self, sentence: str) -> Callable[[str, float], None]:
        """Make a progress function for work that is not a training.

        Args:
            sentence: What to say when the work is cancelled.

        Returns:
            A function of (stage, fraction 0..1) that sends a `progress` event, or raises InputError with the sentence
            once the work is to stop.
        """

        def progress(stage: str, fraction: float) -> None:
            if interrupts.should_stop() or self.stop.is_set():
                raise InputError(sentence)
            done = {"iteration": round(100 * fraction), "iterations": 100}
            self.send({"event": "progress", "stage": stage, "text": stage} | done)

        return progress


def shortage(error: Exception) -> str:
    """Return what to do where the memory did not suffice, "" for other errors."""
    from ..training.pacing.memory import TOO_LITTLE, is_shortage

    return TOO_LITTLE if is_shortage(error) else ""


def inspect(scene_folder: Path, arrays: Path, settings: TrainSettings = DEFAULTS) -> dict[str, Any]:
    """Describe a scene, and write its points to points_xyz.npy (P, 3) float32 and points_rgb.npy (P, 3) uint8.

    Args:
        scene_folder: Folder of the scene.
        arrays: Folder for the two files.
        settings: Settings of the next run.

    Returns:
        The `result` event.

    Raises:
        InputError: As `load_scene` does, and when a file cannot be written.
    """
    import numpy as np

    from ..base.files import atomic_path
    from ..scene.colmap import load_scene
    from ..scene.inspect import inspect_scene
    from ..training.pacing.preset_size import sizes_of_presets

    scene = load_scene(scene_folder)
    paths = {"positions": arrays / "points_xyz.npy", "colors": arrays / "points_rgb.npy"}
    for path, values in zip(
        paths.values(), (scene.points.positions.astype(np.float32), scene.points.colors), strict=True
    ):
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.save(file, values)
    cameras = [
        {
            "name": view.camera.name,
            "width": view.camera.width,
            "height": view.camera.height,
            "fx": view.camera.fx,
            "fy": view.camera.fy,
            "cx": view.camera.cx,
            "cy": view.camera.cy,
            "world_to_camera": view.camera.world_to_camera.tolist(),
            "image": str(path),
        }
        for view, path in zip(scene.views, pinhole_images(scene), strict=True)
    ]
    summary = inspect_scene(scene)
    sizes: dict[str, Any] = {}
    with suppress(InputError):  # a photo that cannot be read, or too little memory: training says it
        sizes = sizes_of_presets(scene, settings)
    return {
        "event": "result",
        "request": "inspect",
        "scene": str(scene.folder),
        "images": scene.image_count,
        "registered": len(scene.views),
        "points": {name: str(path) for name, path in paths.items()} | {"count": len(scene.points.positions)},
        "up": scene.up.tolist(),
        "scale": summary["scale"],
        "cameras": cameras,
        "summary": summary,
        "sizes": sizes,
        "warnings": summary["warnings"],
    }


def pinhole_images(scene: "Scene") -> list[Path]:
    """Return for each view an image file that fits its pinhole camera.

    Args:
        scene: The scene.

    Returns:
        The image of a pinhole lens itself, else an undistorted copy in the user's cache, DISPLAY_WIDTH pixels wide.

    Raises:
        InputError: When an image cannot be read, or the cache cannot be written to.
    """
    import cv2

    from ..base.files import atomic_path
    from ..scene.images import cache_folder, load_images

    folder = cache_folder(scene, "pictures")
    distorted = [view for view in scene.views if not view.lens.is_pinhole]
    paths = {view.camera.name: view.path for view in scene.views}
    for image in load_images(scene, distorted, DISPLAY_WIDTH):
        path = folder / f"{image.camera.name}.jpg"
        with atomic_path(path) as temporary:
            temporary.write_bytes(cv2.imencode(".jpg", image.pixels[..., ::-1])[1].tobytes())
        paths[image.camera.name] = path
    return [paths[view.camera.name] for view in scene.views]


def main() -> None:
    """Answer the requests on stdin; the exit code is 0, or that of the signal that ended the process."""
    # Libraries that print to stdout would break the protocol: events keep a copy of it, the rest goes to stderr.
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    sys.stdin.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    interrupts.install()
    name_buttons()
    with suppress(KeyboardInterrupt):
        Worker(sys.stdin, events).run()
    if interrupts.should_stop():
        # Python's own end would wait for the lock of stdin, which the thread that reads it holds.
        sys.stderr.flush()
        os._exit(interrupts.exit_code)


if __name__ == "__main__":
    main()
