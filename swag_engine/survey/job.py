"""The jobs of a survey: coarse model, blocks, seams. A job can be started again at any time, on any machine."""

import hashlib
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.claim import claimed
from ..base.errors import InputError, reading
from ..base.files import FolderInUse, locked_folder, regular
from ..base.html_page import number
from ..base.text import printable, time_text
from ..formats.ply import read_ply
from ..formats.run_folder import RunFolder, read_json, write_json
from ..formats.survey_folder import COARSE, VERSION, Survey, SurveyFolder, inside
from ..gaussians.cloud import GaussianCloud
from ..gaussians.init import gaussians_from_points
from ..kernels.machine import engine_version
from ..scene.colmap import Points, Scene
from ..scene.scene_part import read_part
from ..settings.settings import TrainSettings
from ..training.checkpoint import checkpoints, load_checkpoint
from ..training.inputs import Event
from ..training.schedule import CONTINUED, STANDARD, Schedule
from ..training.trainer import InitialCloud, make_trainer
from ..training.whole import Whole
from .whole_model import around, around_seam, keep_whole, load_whole


def run_job(
    folder: Path,
    name: str,
    on_event: Callable[[Event], None] = lambda event: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Train a block, a seam, or the coarse model, of a survey, as far as that is not done.

    Args:
        folder: Folder of the survey.
        name: Name of the block or seam, or COARSE.
        on_event: Gets the events of the run.
        should_stop: Asked between two iterations; the job then ends with everything kept.

    Returns:
        `state`: done, running (another process has it; `note` says which) or begun (it was stopped); for done the
        figures of done.json.

    Raises:
        InputError: For anything that keeps the job from being done; failed.json then says it, too.
    """
    survey_folder = SurveyFolder(folder)
    survey = survey_folder.read()
    if name not in survey.jobs:
        raise InputError(f"The survey {folder} has no block {name}; its first is {survey.blocks[0]}.")
    try:
        with claimed(survey_folder.job(name)) as claim:
            if done := _done(survey_folder, name):
                return {"state": "done"} | done
            try:
                check_engine(survey)
                return _train(survey_folder, survey, name, on_event, lambda: claim.lost or should_stop())
            except InputError as error:
                _note_failure(survey_folder, name, str(error))
                raise
    except FolderInUse as used:
        return {"state": "running", "note": str(used)}


def _done(folder: SurveyFolder, name: str) -> dict[str, Any] | None:
    """Return done.json where the result is the one that it names; else prepare that the result is written again."""
    if not folder.done(name).exists():
        return None
    try:
        done = folder.read_done(name)
        if done.get("result_sha256") == hash_of(folder.run(name).ply):
            return done
    except InputError:
        pass
    folder.run(name).metrics.unlink(missing_ok=True)  # the run then ends again, from its last checkpoint
    folder.done(name).unlink()
    return None


def _train(
    folder: SurveyFolder, survey: Survey, name: str, on_event: Callable[[Event], None], should_stop: Callable[[], bool]
) -> dict[str, Any]:
    started, processor = time.monotonic(), time.process_time()
    part = read_part(folder.scene_part(name), survey.scene)
    run = folder.run(name)
    # Seams start from the checkpoints of blocks.
    whole = run.metrics.exists() and run.finished() and _can_be_read(run)
    if whole:
        metrics = read_json(run.metrics, "")
        with reading(run.metrics, "remove it to continue the run"):
            [metrics[name] for name in ("interrupted", "iteration", "gaussians", "test_psnr", "psnr", "notes")]
    else:
        run.metrics.unlink(missing_ok=True)
        inputs = _inputs(folder, survey, name, part)
        metrics = _trained(run, survey.scene, part, inputs, on_event, should_stop)
    if metrics["interrupted"]:
        return {"state": "begun", "iteration": metrics["iteration"]}
    if name == COARSE:
        keep_whole(folder)
    splats = read_ply(run.ply)
    in_core = len(splats)
    if name in survey.blocks:
        in_core = int(folder.read_block(name).in_core(survey.ground.on_ground(splats.positions)).sum())
    document = {
        "version": VERSION,
        "block": name,
        "engine": engine_version(),
        "result_sha256": hash_of(run.ply),
        "gaussians": metrics["gaussians"],
        "gaussians_in_core": in_core,
        "iterations": metrics["iteration"],
        "images": len(part.views),
        "test_psnr": metrics["test_psnr"],
        "validation_psnr": metrics["psnr"],
        "seconds": round(time.monotonic() - started, 2),
        "processor_seconds": round(time.process_time() - processor, 2),
        "peak_memory": _peak_memory(),
        "notes": metrics["notes"],
    }
    write_json(folder.done(name), document)
    folder.failed(name).unlink(missing_ok=True)
    return {"state": "done"} | document


def _trained(
    run: RunFolder,
    scene: Path,
    part: Scene,
    inputs: "_Inputs",
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
) -> dict[str, Any]:
    """Train a new run, or one that was begun, and return its figures."""
    # The coarse run lies in the folder of its job, which is locked already.
    with nullcontext() if run.path.name == COARSE else locked_folder(run.path):
        resume = run.config.exists()
        if resume and checkpoints(run.path) and not _can_be_read(run):
            for path in checkpoints(run.path):
                path.unlink()
        trainer = make_trainer(
            run, scene, inputs.settings, resume, on_event, None, time.monotonic(),
            inputs.schedule, inputs.initial_cloud, part, inputs.whole,
        )  # fmt: skip
        return trainer.run_to_end(should_stop, preview=False)["metrics"]


def _can_be_read(run: RunFolder) -> bool:
    """Return whether a checkpoint of a run can be read; without one the run starts again, and ends the same."""
    try:
        return load_checkpoint(run.path) is not None
    except InputError:
        return False


@dataclass(frozen=True)
class _Inputs:
    """What a job is trained with beside its part of the scene.

    Attributes:
        settings: Settings of the run.
        whole: What it takes over from the rest of the survey.
        schedule: When things happen in the run.
        initial_cloud: Makes the Gaussians that it starts from, unless `whole` has them.
    """

    settings: TrainSettings
    whole: Whole | None = None
    schedule: Schedule = STANDARD
    initial_cloud: InitialCloud = gaussians_from_points


def _inputs(folder: SurveyFolder, survey: Survey, name: str, part: Scene) -> _Inputs:
    """Return what a job is trained with; a block starts from the points in its extended box."""
    if name == COARSE:
        return _Inputs(survey.coarse_settings)
    block, whole = folder.read_block(name), load_whole(folder)
    settings = replace(survey.settings, iterations=block.iterations, max_gaussians=block.max_gaussians, seed=block.seed)
    cameras = [view.camera for view in part.views]
    if block.sides:
        whole = around_seam(whole, folder, survey.ground, block, cameras)
        assert whole.start
        return _Inputs(replace(settings, max_gaussians=max(1, len(whole.start))), whole, CONTINUED)

    def initial_cloud(points: Points, most: int, sh_degree: int, seed: int, background: np.ndarray) -> GaussianCloud:
        near = inside(block.extended, survey.ground.on_ground(points.positions))
        of_block = Points(
            *(values[near] for values in (points.positions, points.colors, points.errors, points.track_lengths))
        )
        return gaussians_from_points(of_block, most, sh_degree, seed, background)

    return _Inputs(settings, around(whole, survey.ground, block, cameras), STANDARD, initial_cloud)


def check_engine(survey: Survey) -> None:
    """Refuse a survey that another version of the engine has planned: its blocks would not fit together.

    Raises:
        InputError: If the versions differ.
    """
    version = engine_version()
    if survey.engine != version:
        raise InputError(
            f"The survey was planned with version {survey.engine} of SWAG Splatting, and this machine has {version}: "
            "blocks of one survey need one version. Install it here, or plan the survey again."
        )


def describe(document: dict[str, Any]) -> str:
    """Format what `run_job` returned as the line that `survey block` prints."""
    if document["state"] == "running":
        return f"Nothing to do: {document['note']}"
    if document["state"] == "begun":
        return f"Stopped after {document['iteration']} iterations; started again, it continues."
    return (
        f"{document['block']} is done: {document['gaussians_in_core']:,} splats in its core, test PSNR "
        f"{number(document['test_psnr'], 2, ' dB')}, {time_text(document['seconds'])}."
    )


def _note_failure(folder: SurveyFolder, name: str, problem: str) -> None:
    """Write failed.json, as far as the disk allows."""
    try:
        attempts = read_json(folder.failed(name), "").get("attempts", 0) if folder.failed(name).exists() else 0
        attempts = attempts if isinstance(attempts, int) else 0
        write_json(
            folder.failed(name), {"version": VERSION, "block": name, "problem": problem, "attempts": attempts + 1}
        )
    except InputError:
        print(printable(f"{folder.failed(name)} could not be written."), file=sys.stderr)


def hash_of(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        with open(path, "rb", opener=regular) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error


def _peak_memory() -> int:
    """Return the largest memory of this process so far, bytes; 0 where the system does not say."""
    if sys.platform == "win32":
        return 0
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
