"""The child process that Blender drives: requests on stdin, events on stdout, one JSON object a line.

It ends when stdin closes; what runs then is cancelled first, and everything that exists is kept.
"""

import os
import queue
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from ..base import threads  # noqa: F401
from ..base.errors import InputError
from ..base.strict_json import to_json
from .protocol import (
    CancelRequest,
    ExportRequest,
    ForecastRequest,
    GoOnRequest,
    InspectRequest,
    LabelRequest,
    PauseRequest,
    PlanRequest,
    Request,
    SearchRequest,
    TrainRequest,
    parse_request,
)

if TYPE_CHECKING:
    from ..scene.colmap import Scene

PICTURE_WIDTH = 640


class Worker:
    """Reads requests from one stream and answers on another.

    Requests are read by a thread of their own, so that `cancel` and the end of the stream are seen during a run.
    """

    def __init__(self, requests: TextIO, events: TextIO) -> None:
        self.requests, self.events = requests, events
        self.waiting: queue.Queue[Request | InputError | None] = queue.Queue()
        self.stop = threading.Event()
        self.going = threading.Event()
        self.going.set()
        self.writing = threading.Lock()

    def send(self, event: dict[str, Any]) -> None:
        """One event to the other side; a reader that has gone away stops the run."""
        try:
            with self.writing:
                self.events.write(to_json(event) + "\n")
                self.events.flush()
        except (BrokenPipeError, ValueError):
            self.stop.set()

    def read(self) -> None:
        for line in self.requests:
            if not line.strip():
                continue
            try:
                request = parse_request(line)
            except InputError as error:
                self.waiting.put(error)
                continue
            if isinstance(request, PauseRequest):
                self.going.clear()
            elif isinstance(request, GoOnRequest):
                self.going.set()
            elif isinstance(request, CancelRequest):
                self.end()
            else:
                self.waiting.put(request)
        self.end()
        self.waiting.put(None)

    def end(self) -> None:
        """Let what runs stop, a paused run too."""
        self.stop.set()
        self.going.set()

    def should_stop(self) -> bool:
        """Asked by a run between two iterations: a pause holds it here, so that it goes on as if nothing had been."""
        self.going.wait()
        return self.stop.is_set()

    def run(self) -> None:
        """Answer requests, one after the other, until the stream of requests ends."""
        threading.Thread(target=self.read, daemon=True).start()
        while (request := self.waiting.get()) is not None:
            try:
                if isinstance(request, InputError):
                    raise request
                self.send(self.answer(request))
            except InputError as error:
                self.send({"event": "error", "kind": "input", "message": str(error)})
            except Exception as error:
                from ..training.pacing.memory import TOO_LITTLE, is_shortage

                if is_shortage(error):
                    self.send({"event": "error", "kind": "input", "message": TOO_LITTLE})
                else:
                    traceback.print_exc(file=sys.stderr)
                    self.send({"event": "error", "kind": "bug", "message": f"{type(error).__name__}: {error}"})
            self.stop.clear()
            self.going.set()

    def answer(self, request: Request) -> dict[str, Any]:
        """The `result` event of one request."""
        if isinstance(request, InspectRequest):
            return inspect(request.scene, request.arrays)
        if isinstance(request, PlanRequest):
            from ..evidence.observations import FIT_WIDTH
            from ..planning.plan import plan_and_keep

            settings = request.settings.sized()
            width = settings.width or FIT_WIDTH  # a time budget finds its own
            plan, _ = plan_and_keep(request.scene, request.out, settings.effects, width)
            return {"event": "result", "request": "plan", "plan": plan.to_json()}
        if isinstance(request, TrainRequest):
            from ..experiments.train_and_report import train_and_report

            return train_and_report(
                request.scene, request.out, request.settings, request.resume, self.send, self.should_stop, preview=True
            )
        if isinstance(request, ForecastRequest):
            from ..experiments.forecast import forecast_scene

            forecast = forecast_scene(request.scene, request.settings, self.stoppable("The forecast was stopped."))
            return {"event": "result", "request": "forecast", "scene": str(request.scene)} | forecast
        if isinstance(request, LabelRequest):
            return self.label(request)
        if isinstance(request, SearchRequest):
            from ..experiments.label_run import search_run, write_similarity

            similarity, names = search_run(request.run, request.words)
            write_similarity(request.path, similarity)
            return {"event": "result", "request": "search", "path": str(request.path), "labels": names}
        assert isinstance(request, ExportRequest)
        from ..formats.export import export_run

        export_run(request.run, request.format, request.out)
        return {"event": "result", "request": "export", "out": str(request.out)}

    def label(self, request: LabelRequest) -> dict[str, Any]:
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

    def stoppable(self, sentence: str) -> Callable[[str, float], None]:
        """A function that sends the progress of something that is no training (stage, fraction 0..1), and raises
        InputError(sentence) once a stop is asked for."""

        def progress(stage: str, fraction: float) -> None:
            if self.stop.is_set():
                raise InputError(sentence)
            done = {"iteration": round(100 * fraction), "iterations": 100}
            self.send({"event": "progress", "stage": stage, "text": stage} | done)

        return progress


def inspect(scene_folder: Path, arrays: Path) -> dict[str, Any]:
    """Describe a scene; write points_xyz.npy (P, 3) float32 and points_rgb.npy (P, 3) uint8 to the folder `arrays`."""
    import numpy as np

    from ..base.files import atomic_path
    from ..scene.colmap import load_scene
    from ..scene.inspect import inspect_scene

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
            "image": str(picture),
        }
        for view, picture in zip(scene.views, pinhole_pictures(scene), strict=True)
    ]
    summary = inspect_scene(scene)
    return {
        "event": "result",
        "request": "inspect",
        "scene": str(scene.folder),
        "images": scene.image_count,
        "registered": len(scene.views),
        "points": {name: str(path) for name, path in paths.items()} | {"count": len(scene.points.positions)},
        "up": scene.up.tolist(),
        "cameras": cameras,
        "summary": summary,
        "warnings": list(scene.warnings),
    }


def pinhole_pictures(scene: "Scene") -> list[Path]:
    """A picture for each view to show behind its pinhole camera: the photograph itself where its lens is one, else an
    undistorted copy in the user's cache, small because it is only looked at."""
    import cv2

    from ..base.files import atomic_path
    from ..scene.images import cache_folder, load_images

    folder = cache_folder(scene, "pictures")
    distorted = [view for view in scene.views if not view.lens.is_pinhole]
    pictures = {view.camera.name: view.path for view in scene.views}
    for image in load_images(scene, distorted, PICTURE_WIDTH):
        path = (folder / image.camera.name).with_suffix(".jpg")
        with atomic_path(path) as temporary:
            temporary.write_bytes(cv2.imencode(".jpg", image.pixels[..., ::-1])[1].tobytes())
        pictures[image.camera.name] = path
    return [pictures[view.camera.name] for view in scene.views]


def main() -> None:
    # Libraries that print to stdout would break the protocol: events keep a copy of it, the rest goes to stderr.
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    sys.stdin.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    Worker(sys.stdin, events).run()


if __name__ == "__main__":
    main()
