"""Faults of the jobs of a survey: what becomes of the result. benchmarks/survey.py calls it."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from swag_engine.formats.run_folder import read_json
from swag_engine.formats.survey_folder import COARSE, SurveyFolder
from swag_engine.formats.survey_state import progress_of
from swag_engine.settings.settings import TrainSettings
from swag_engine.survey.executors.local import LocalExecutor
from swag_engine.survey.job import hash_of
from swag_engine.survey.merge import merge_survey
from swag_engine.survey.plan import plan_survey
from swag_engine.survey.run import run_survey
from swag_engine.training.checkpoint import checkpoints

IMAGES = 64
"""Images of the survey."""
WIDTH = 64
"""Width of the images, pixels."""
SETTINGS = TrainSettings(iterations=600, width=WIDTH, max_gaussians=8000, backend="cpu")
BLOCK_IMAGES = 16
KILLED = 1 / 3
"""Fraction of the jobs that are killed."""
FULL_DISK = 200_000
"""Bytes from which the system writes no more to a file, in place of a full disk."""


def faults(folder: Path) -> dict[str, Any]:
    """Train a survey twice, once undisturbed and once with faults, and compare the results.

    Returns:
        Numbers of jobs and of each fault, the sentences that said what was wrong, and whether all results and tiles are
        equal to the bit.
    """
    scene = folder / "scene"
    if not (scene / "truth.json").exists():
        shutil.rmtree(scene, ignore_errors=True)
        script = "import sys; from pathlib import Path; from tests.scenes.survey_scenes import tiny_survey; "
        script += "tiny_survey(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))"
        subprocess.run([sys.executable, "-c", script, scene, str(IMAGES), str(WIDTH)], cwd=ROOT, check=True)
    calm, disturbed = SurveyFolder(folder / "calm"), SurveyFolder(folder / "disturbed")
    for survey in (calm, disturbed):
        shutil.rmtree(survey.path, ignore_errors=True)
        plan_survey(scene, survey.path, SETTINGS, BLOCK_IMAGES)
    _finish(calm)
    names, blocks = calm.read().jobs, calm.read().blocks
    draw = random.Random(0)

    # The coarse model first, as no block begins without it; then blocks, as seams begin when these are done.
    chosen = draw.sample(blocks, max(3, round(KILLED * len(names))) - 1)
    iterations = {}
    for name in (COARSE, *chosen):
        iterations[name] = _ended(disturbed, name, draw.uniform(0.2, 0.9), signal.SIGKILL)
        if name == COARSE:
            _finish(disturbed, only=COARSE)
    damaged, full, twice = [name for name in blocks if name not in chosen][:3]
    _ended(disturbed, damaged, 0.5, signal.SIGINT)  # which leaves a checkpoint
    (newest,) = checkpoints(disturbed.run(damaged).path)
    newest.write_bytes(newest.read_bytes()[: newest.stat().st_size // 2])
    sentence = _with_full_disk(disturbed, full)
    both = [_start(disturbed, twice) for _ in range(2)]
    codes = [process.wait() for process in both]
    _finish(disturbed)
    equal = {name: hash_of(calm.run(name).ply) == hash_of(disturbed.run(name).ply) for name in names}
    tiles = [sorted(path.name for path in (survey.merged).rglob("*.ply")) for survey in (calm, disturbed)]
    return {
        "images": IMAGES,
        "jobs": len(names),
        "killed": len(chosen) + 1,
        "killed_at_iteration": iterations,
        "damaged_checkpoint": damaged,
        "full_disk": {"block": full, "problem": sentence},
        "two_processes": {"block": twice, "exit_codes": codes},
        "equal_results": sum(equal.values()),
        "equal_tiles": tiles[0] == tiles[1],
    }


def _finish(survey: SurveyFolder, only: str = "") -> None:
    """Train what is left of a survey and merge it; or only one job."""
    if only:
        assert _start(survey, only).wait() == 0
        return
    answer = run_survey(survey.path, LocalExecutor(SETTINGS.backend))
    if answer["exit_code"]:
        raise SystemExit("\n".join(answer["sentences"]))
    merge_survey(survey.path)


def _start(survey: SurveyFolder, name: str, **options: Any) -> subprocess.Popen[bytes]:
    """Start a job as executors do."""
    words = ["-m", "swag_engine", "survey", "block", str(survey.path), "--block", name, "--json"]
    return subprocess.Popen(
        [sys.executable, *words], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **options
    )


def _ended(survey: SurveyFolder, name: str, fraction: float, number: int) -> int:
    """End a job by a signal after a fraction of its iterations, and return the iteration of its last report."""
    process = _start(survey, name)
    settings = survey.read().coarse_settings if name == COARSE else survey.read_block(name)
    while process.poll() is None and progress_of(survey, name, 0).iteration < fraction * settings.iterations:
        time.sleep(0.02)
    process.send_signal(number)
    process.wait()
    return progress_of(survey, name, 0).iteration


def _with_full_disk(survey: SurveyFolder, name: str) -> str:
    """Run a job whose files cannot grow beyond a limit, and return what failed.json says."""
    import resource

    process = _start(
        survey, name, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (FULL_DISK, FULL_DISK)),
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    process.wait()
    failed = survey.failed(name)
    return str(read_json(failed, "").get("problem")) if failed.exists() else ""
