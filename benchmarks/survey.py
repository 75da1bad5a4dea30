"""Measure surveys in blocks: quality against one run, cost by size, planning of a large one, and faults.

Run: `python benchmarks/survey.py FOLDER [--parts quality scale plan cost faults]`, with nothing else on the machine
Results: benchmarks/results/survey.json; pictures docs/images/survey_seam.webp and survey_scale.webp

Scenes, runs and surveys are kept in FOLDER. A part can be stopped and started again: rows of the results are not made
again. Jobs of `quality` that were not finished start anew, surveys of `scale` too, so that times are of whole ones.

quality   A survey of 4 and of 9 blocks against one run of the whole scene with as many Gaussians and as many iterations
          an image, on a reef under water and a street in air of 300 photos (tests/scenes/survey_scenes.py).
scale     Processor time and memory of surveys of 150, 300 and 600 photos; two workers against one, each on one core.
plan      Time and memory of planning a model of 5000 images and 5 million points.
cost      Processor time of larger surveys, from the straight line through those of `scale`.
faults    Jobs that are killed, a damaged checkpoint, two processes for a block, a full disk: the result against that of
          jobs which nobody disturbed.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, machine, save_chart, write_results
from benchmarks.survey_faults import faults
from benchmarks.survey_quality import compare_survey, draw_seam
from swag_engine.formats.run_folder import read_json, write_json
from swag_engine.formats.survey_folder import COARSE, SurveyFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.survey.executors.local import LocalExecutor
from swag_engine.survey.merge import merge_survey
from swag_engine.survey.plan import FEWEST_BLOCK_IMAGES, plan_survey
from swag_engine.survey.run import run_survey

WIDTH = 320
"""Width of the images, pixels."""
IMAGES = 300
"""Images of the scenes of `quality`."""
ITERATIONS = 9000
"""Iterations of the run of a whole scene of 300 images, 39 a training image."""
GAUSSIANS = 100_000
"""Gaussians of a scene of 300 images."""
CUTS = (4, 9)
"""Numbers of blocks in `quality`."""
SIZES = (150, 300, 600)
"""Numbers of images in `scale`."""
WORKERS_IMAGES = 300
"""Images of the survey that one worker and two workers train."""
SCALE_BLOCK = 100
"""Images of a block in `scale`, at most."""
SCALE_ITERATIONS = 1000
"""Iterations of the average block in `scale`."""
LARGE = {"images": 5000, "points": 5_000_000}
"""Size of the model in `plan`."""
ON_PAPER = (5000, 50_000)
"""Numbers of images in `cost`."""


class Results:
    """The rows of benchmarks/results/survey.json by part, written after each row."""

    def __init__(self) -> None:
        path = RESULTS / "survey.json"
        self.document: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def rows(self, part: str) -> list[dict[str, Any]]:
        """Return the rows of a part."""
        return self.document.setdefault(part, [])

    def has(self, part: str, **key: Any) -> bool:
        """Return whether a part has a row of these values."""
        return any(all(row.get(name) == value for name, value in key.items()) for row in self.rows(part))

    def add(self, part: str, row: dict[str, Any], *key: str) -> None:
        """Add a row in place of that with the same values of `key`."""
        others = [each for each in self.rows(part) if any(each.get(name) != row[name] for name in key)]
        self.document[part] = [*others, row]
        self.document["machine"] = machine()
        write_results("survey", self.document)
        print(part, {name: value for name, value in row.items() if not isinstance(value, (list, dict))}, flush=True)


# Scenes and runs


def scene_of(folder: Path, kind: str, images: int, **numbers: int) -> Path:
    """Return a generated scene; it is made in a process of its own where it is missing or not whole."""
    scene = folder / "scenes" / f"{kind}-{images}"
    mark = scene / "whole"
    if not mark.exists():
        shutil.rmtree(scene, ignore_errors=True)
        words = [part for name, number in numbers.items() for part in (f"--{name}", str(number))]
        command = [ROOT / "tests" / "scenes" / "survey_scenes.py", "--out", scene, "--kind", kind, "--images", images]
        subprocess.run([sys.executable, *map(str, command), *words], check=True)
        mark.touch()
    return scene


def measured(words: Sequence[Any], threads: int | None = None) -> dict[str, float]:
    """Run Python with these words and return its time, processor time (seconds) and largest memory (bytes)."""
    environment = os.environ | ({"OMP_NUM_THREADS": str(threads)} if threads else {})
    started = time.monotonic()
    process = subprocess.Popen([sys.executable, *map(str, words)], cwd=ROOT, stdout=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    return {
        "seconds": round(time.monotonic() - started, 2),
        "processor_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_memory": usage.ru_maxrss * 1024,
    }


def single_run(scene: Path, out: Path, settings: TrainSettings) -> dict[str, float]:
    """Train the whole scene in one run, unless it is done, and return what it took."""
    usage = out / "usage.json"
    if not usage.exists():
        shutil.rmtree(out, ignore_errors=True)
        words: list[Any] = ["-m", "swag_engine", "train", scene, "--out", out]
        for name in ("iterations", "width", "max_gaussians", "seed", "backend"):
            words += [f"--{name.replace('_', '-')}", getattr(settings, name)]
        write_json(usage, measured(words))
    return read_json(usage, "")


def block_images_for(scene: Path, settings: TrainSettings, blocks: int, most: int) -> int:
    """Return the limit of images of a block with which a survey is cut into that number of blocks, or nearly."""
    low, high, found = FEWEST_BLOCK_IMAGES, most, {}
    while low < high and blocks not in found.values():
        limit = (low + high) // 2
        with tempfile.TemporaryDirectory() as folder:
            found[limit] = len(plan_survey(scene, Path(folder), settings, limit)["blocks"])
        low, high = (limit + 1, high) if found[limit] > blocks else (low, limit)
    return min(found, key=lambda limit: abs(found[limit] - blocks))


def planned(scene: Path, out: Path, settings: TrainSettings, block_images: int) -> SurveyFolder:
    """Plan a survey unless it is planned, and return its folder."""
    survey = SurveyFolder(out)
    if not survey.survey.exists():
        shutil.rmtree(out, ignore_errors=True)
        plan_survey(scene, out, settings, block_images)
    return survey


def trained(survey: SurveyFolder, workers: int | None = None) -> tuple[float, float]:
    """Train the jobs of a survey that are not done, from their beginning.

    Args:
        survey: The survey.
        workers: Jobs at once, each on one core; None for one at a time on all cores.

    Returns:
        The seconds that it took, and the processor time of all processes of the jobs, seconds.
    """
    for name in survey.read().jobs:
        if not survey.done(name).exists():
            clear_job(survey, name)
    before, used = os.environ.get("OMP_NUM_THREADS"), _used_by_children()
    if workers:
        os.environ["OMP_NUM_THREADS"] = str(workers)  # the cores that the executor divides
    try:
        executor = LocalExecutor(survey.read().settings.backend, workers or 1)
        answer = run_survey(survey.path, executor)
    finally:
        if workers:
            os.environ.pop("OMP_NUM_THREADS")
            os.environ.update({"OMP_NUM_THREADS": before} if before else {})
    if answer["exit_code"]:
        raise SystemExit("\n".join(answer["sentences"]) or f"The jobs of {survey.path} did not end.")
    return float(answer["seconds"]), round(_used_by_children() - used, 2)


def _used_by_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def clear_job(survey: SurveyFolder, name: str) -> None:
    """Remove what a job has made; its description and its part of the scene stay."""
    kept = {survey.block_file(name), survey.scene_part(name), survey.all_views}
    for path in survey.job(name).iterdir():
        if path not in kept:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def jobs_of(survey: SurveyFolder) -> list[dict[str, Any]]:
    """Return images, seconds, processor time and memory of each job, the coarse model first."""
    names = ("images", "seconds", "processor_seconds", "peak_memory", "iterations", "gaussians")
    return [
        {"name": name} | {key: done.get(key) for key in names}
        for name in survey.read().jobs
        for done in [read_json(survey.done(name), f"{name} is not done.")]
    ]


# Parts


def quality(folder: Path, results: Results, seeds: Sequence[int], iterations: int, gaussians: int) -> None:
    """Compare surveys of 4 and of 9 blocks with one run."""
    for seed in seeds:
        for kind in ("reef", "street"):
            scene = scene_of(folder, kind, IMAGES)
            settings = TrainSettings(
                iterations=iterations, width=WIDTH, max_gaussians=gaussians, seed=seed, backend="cpu"
            )
            single = folder / "single" / f"{kind}-{seed}"
            for cut in CUTS:
                if results.has("quality", scene=kind, seed=seed, cut=cut):
                    continue
                usage = single_run(scene, single, settings)
                limit = block_images_for(scene, settings, cut, IMAGES)
                survey = planned_equally(scene, folder / "surveys" / f"{kind}-{cut}-{seed}", settings, limit)
                trained(survey)
                merge_survey(survey.path)
                jobs = jobs_of(survey)
                row = {
                    "scene": kind, "seed": seed, "cut": cut, "blocks": len(survey.read().blocks), "block_images": limit,
                    "iterations": [job["iterations"] for job in jobs], "single_iterations": iterations,
                    "single_seconds": usage["processor_seconds"], "single_memory": usage["peak_memory"],
                    "survey_seconds": sum(job["processor_seconds"] for job in jobs),
                    "survey_memory": max(job["peak_memory"] for job in jobs),
                }  # fmt: skip
                results.add("quality", row | compare_survey(single, survey.path), "scene", "seed", "cut")
                if kind == "reef" and seed == seeds[0] and cut == max(CUTS):
                    draw_seam(single, survey.path)


def planned_equally(scene: Path, out: Path, settings: TrainSettings, block_images: int) -> SurveyFolder:
    """Plan a survey whose blocks make as many iterations for each of their training images as a run of the scene."""
    with tempfile.TemporaryDirectory() as folder:
        trial = plan_survey(scene, Path(folder), settings, block_images)
        views = SurveyFolder(Path(folder)).read()
        validation = {
            name for block in views.blocks for name in SurveyFolder(Path(folder)).read_block(block).validation
        }
    training = trial["totals"]["images"] - trial["totals"]["test"] - len(validation)
    average = sum(block["training"] for block in trial["blocks"]) / len(trial["blocks"])
    equal = replace(settings, iterations=round(settings.iterations * average / training))
    return planned(scene, out, equal, block_images)


def scale(folder: Path, results: Results) -> None:
    """Measure surveys of three sizes, and two workers."""
    for images in SIZES:
        if results.has("scale", images=images):
            continue
        scene, out = scene_of(folder, "reef", images), folder / "scale" / f"{images}"
        shutil.rmtree(out, ignore_errors=True)  # what was begun is measured as a whole
        survey = planned(scene, out, _settings_for(images), SCALE_BLOCK)
        seconds, used = trained(survey, workers=1)
        merged = measured(["-m", "swag_engine", "survey", "merge", survey.path])
        jobs = jobs_of(survey)
        row = {
            "images": images, "blocks": len(survey.read().blocks), "block_images": SCALE_BLOCK, "seconds": seconds,
            "processor_seconds": round(used + merged["processor_seconds"], 2),
            "merge": merged, "jobs": jobs,
        }  # fmt: skip
        results.add("scale", row, "images")
    if not results.has("workers", images=WORKERS_IMAGES):
        workers(folder, results)
    rows = sorted(results.rows("scale"), key=lambda row: row["images"])
    if len(rows) >= 3:
        results.document["line"] = straight_line(rows)
        write_results("survey", results.document)
        draw_scale(rows, results.document["line"])


def _settings_for(images: int) -> TrainSettings:
    """Settings of a survey of the density of that of 300 images."""
    gaussians = round(GAUSSIANS * images / IMAGES)
    return TrainSettings(iterations=SCALE_ITERATIONS, width=WIDTH, max_gaussians=gaussians, backend="cpu")


def workers(folder: Path, results: Results) -> None:
    """Train the blocks and seams of a survey with one worker and with two, each on one core."""
    first = SurveyFolder(folder / "scale" / f"{WORKERS_IMAGES}")
    seconds, used = {}, {}
    for count in (1, 2):
        copy = SurveyFolder(folder / "scale" / f"{WORKERS_IMAGES}-{count}-workers")
        shutil.rmtree(copy.path, ignore_errors=True)
        shutil.copytree(first.path, copy.path)
        for name in copy.read().parts:
            clear_job(copy, name)
        seconds[count], used[count] = trained(copy, workers=count)
    stages = [
        [job["processor_seconds"] for job in jobs_of(first) if job["name"] in names]
        for names in (first.read().blocks, first.read().seams)
    ]
    row = {
        "images": WORKERS_IMAGES, "blocks": len(first.read().blocks),
        "seconds_one": seconds[1], "seconds_two": seconds[2],
        "processor_seconds_one": used[1], "processor_seconds_two": used[2], "speed_up": seconds[1] / seconds[2],
        # As no job is divided, and seams wait for blocks: the time of all over that of the busier of two workers.
        "most_speed_up": sum(map(sum, stages)) / sum(makespan(stage, 2) for stage in stages),
    }  # fmt: skip
    results.add("workers", row, "images")


def makespan(seconds: Sequence[float], count: int) -> float:
    """Time after which workers have done jobs of these times, the longest first."""
    busy = [0.0] * count
    for each in sorted(seconds, reverse=True):
        busy[busy.index(min(busy))] += each
    return round(max(busy), 2)


def straight_line(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Fit processor seconds over images, and name the largest deviation as a fraction."""
    images, seconds = (np.array([row[name] for row in rows], float) for name in ("images", "processor_seconds"))
    slope, offset = np.polyfit(images, seconds, 1)
    deviation = np.abs((offset + slope * images) / seconds - 1).max()
    return {"seconds_per_image": float(slope), "seconds": float(offset), "deviation": float(deviation)}


def draw_scale(rows: Sequence[dict[str, Any]], line: dict[str, float]) -> None:
    """Plot processor time and memory over images."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (time_axes, memory_axes) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    images = np.array([row["images"] for row in rows])
    time_axes.plot(images, [row["processor_seconds"] / 60 for row in rows], "o", color="#1f5a96")
    ends = np.array([0, 1.05 * images.max()])
    time_axes.plot(ends, (line["seconds"] + line["seconds_per_image"] * ends) / 60, "-", color="#1f5a96", lw=1)
    time_axes.set(xlabel="photos", ylabel="processor time of all jobs, min", xlim=(0, None), ylim=(0, None))
    for row in rows:
        memory = [job["peak_memory"] / 1e9 for job in row["jobs"]]
        memory_axes.plot([row["images"]] * (len(memory) - 1), memory[1:], "o", color="#1f5a96", alpha=0.5)
        memory_axes.plot(row["images"], memory[0], "^", color="#c9572b")
    memory_axes.plot([], [], "o", color="#1f5a96", label="blocks")
    memory_axes.plot([], [], "^", color="#c9572b", label="coarse model")
    most = max(job["peak_memory"] for row in rows for job in row["jobs"]) / 1e9
    memory_axes.set(xlabel="photos", ylabel="largest memory of a job, GB", xlim=(0, None), ylim=(0, 1.15 * most))
    memory_axes.legend(frameon=False, loc="lower right")
    save_chart("survey_scale", figure, 110)
    plt.close(figure)


def plan(folder: Path, results: Results) -> None:
    """Measure the planning of a large survey."""
    if results.has("plan", **LARGE):
        return
    scene = scene_of(folder, "model", LARGE["images"], points=LARGE["points"])
    out = folder / "surveys" / "large"
    shutil.rmtree(out, ignore_errors=True)
    usage = measured(["-m", "swag_engine", "survey", "plan", scene, "--out", out, "--backend", "cpu"])
    survey = SurveyFolder(out)
    blocks = [survey.read_block(name) for name in survey.read().blocks]
    images = [len(block.images) for block in blocks]
    row = {**LARGE, "blocks": len(blocks), "block_images_least": min(images), "block_images_most": max(images)}
    results.add("plan", row | usage, "images", "points")


def cost(results: Results) -> None:
    """Extend the straight line of `scale` to larger surveys."""
    line, rows = results.document.get("line"), results.rows("scale")
    if not line:
        raise SystemExit("The part cost needs the figures of the part scale: measure that first.")
    largest = max(rows, key=lambda row: row["images"])
    parts = [job for job in largest["jobs"] if job["name"] != COARSE]
    for images in ON_PAPER:
        row = {
            "images": images,
            "blocks": round(largest["blocks"] * images / largest["images"]),
            "processor_hours": (line["seconds"] + line["seconds_per_image"] * images) / 3600,
            "coarse_hours": largest["jobs"][0]["processor_seconds"] / 3600,
            # With its share of the seams.
            "block_minutes": sum(job["processor_seconds"] for job in parts) / largest["blocks"] / 60,
            "peak_memory": max(job["peak_memory"] for job in largest["jobs"]),
        }
        results.add("cost", row, "images")


def main() -> None:
    """Measure the parts that are asked for."""
    parser = ArgumentParser(description=__doc__)
    names = ("quality", "scale", "plan", "cost", "faults")
    parser.add_argument("folder", type=Path, help="where scenes and runs are kept")
    parser.add_argument("--parts", nargs="+", choices=names, default=names)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds of the part quality")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="of the single runs of the part quality")
    parser.add_argument("--gaussians", type=int, default=GAUSSIANS, help="of the scenes of the part quality")
    options = parser.parse_args()
    folder, results = options.folder.absolute(), Results()
    parts: dict[str, Callable[[], None]] = {
        "quality": lambda: quality(folder, results, options.seeds, options.iterations, options.gaussians),
        "scale": lambda: scale(folder, results),
        "plan": lambda: plan(folder, results),
        "cost": lambda: cost(results),
        "faults": lambda: results.add("faults", faults(folder / "faults"), "images"),
    }
    for name in options.parts:
        parts[name]()


if __name__ == "__main__":
    main()
