"""A survey whose blocks take a second, for tests of what runs them: no images, no Gaussians, the survey's files.

    python tests/scenes/stand_in_survey.py SURVEY --block NAME --json      what `survey block` would do

Each iteration hashes the state, so that a block that lost or repeated one has another result. orders.json in the folder
has what happens to a block at each of its starts: "kill" at half of the iterations that are left, "refuse" with exit
code 2, "slow" it down to a second for each, "endless" until it is asked to end, or "crash" with a traceback;
"refuse on PROCESS" is for the node of a Ray cluster whose raylet has that number.
"""

import hashlib
import json
import os
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from swag_engine.base.claim import claimed
from swag_engine.base.files import FolderInUse

PAUSE, SLOW = 0.03, 1.0
ITERATIONS = 20


def make_survey(
    folder: Path,
    blocks: int = 4,
    memory: int = 1000,
    orders: dict[str, list[str]] = {},  # noqa: B006
    seams: tuple[str, ...] = (),
) -> Path:
    """Write a survey and what is to happen to its blocks; return its folder."""
    from swag_engine.formats.survey_folder import Block, Ground, Survey, SurveyFolder
    from swag_engine.kernels.machine import engine_version
    from swag_engine.settings.settings import TrainSettings

    files, settings = SurveyFolder(folder), TrainSettings(iterations=ITERATIONS, width=64, max_gaussians=100)
    names = tuple(f"B-{number:03d}" for number in range(1, blocks + 1))
    for name in (*names, *seams):
        box, sides = (0.0, 0.0, 1.0, 1.0), names[:2] if name in seams else ()
        files.write_block(Block(name, box, box, ("a.png",), (), (), 0, ITERATIONS, 100, 10, memory, sides))
    ground = Ground((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    version = engine_version() or ""
    bounds = (0.0, 0.0, 1.0, 1.0)
    files.write(Survey(folder, version, settings, settings, ("a.png",), (), (), ground, bounds, 1, names, seams))
    (folder / "orders.json").write_text(json.dumps(orders))
    return folder


def expected(name: str) -> str:
    """Return the hash of a block that nothing happened to."""
    state = name
    for iteration in range(ITERATIONS):
        state = step(state, iteration)
    return state


def step(state: str, iteration: int) -> str:
    """Return the state after an iteration."""
    return hashlib.sha256(f"{state} {iteration}".encode()).hexdigest()


def starts(folder: Path, name: str) -> list[str]:
    """Return a line for each start of a block: its process, the number of its threads, its node."""
    file = job_folder(folder, name) / "starts.txt"
    return file.read_text().splitlines() if file.exists() else []


def results(folder: Path) -> dict[str, str | None]:
    """Return the hash of each block, None for those that are not done."""
    names = json.loads((folder / "survey.json").read_text())["blocks"]
    files = {name: job_folder(folder, name) / "done.json" for name in names}
    return {
        name: json.loads(file.read_text())["result_sha256"] if file.exists() else None for name, file in files.items()
    }


def job_folder(folder: Path, name: str) -> Path:
    if name == "coarse":
        return folder / "coarse"
    return folder / ("seams" if name.startswith("S-") else "blocks") / name


def write(file: Path, document: object) -> None:
    file.parent.mkdir(exist_ok=True)
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    temporary.write_text(json.dumps(document))
    temporary.replace(file)


def main(folder: Path, name: str) -> int:
    job = job_folder(folder, name)
    try:
        with claimed(job):
            return 0 if (job / "done.json").exists() else train(folder, job, name)
    except FolderInUse:
        return 0


def train(folder: Path, job: Path, name: str) -> int:
    with open(job / "starts.txt", "a") as file:
        file.write(f"{os.getpid()} {os.environ['OMP_NUM_THREADS']} {os.environ.get('RAY_RAYLET_PID')}\n")
    orders = json.loads((folder / "orders.json").read_text()).get(name, [])
    order, _, node = (orders + [""] * 100)[len(starts(folder, name)) - 1].partition(" on ")
    if node not in ("", os.environ.get("RAY_RAYLET_PID")):
        order = ""
    if order == "refuse":
        write(job / "failed.json", {"version": 1, "block": name, "problem": "No photo a.png.", "attempts": 1})
        print(json.dumps({"error": f"{folder}/a.png cannot be read: it is not there."}))
        return 2
    if order == "crash":
        raise ValueError("a bug")
    asked_to_end: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: asked_to_end.append(number))
    run = job if name == "coarse" else job / "run"
    write(run / "config.json", {})
    checkpoint = run / "checkpoint-0000001.safetensors"
    begun, state = json.loads(checkpoint.read_text()) if checkpoint.exists() else (0, name)
    for iteration in range(begun, ITERATIONS):
        time.sleep(SLOW if order == "slow" else PAUSE)
        while order == "endless" and iteration > 2 and not asked_to_end:
            time.sleep(PAUSE)
        if order == "kill" and iteration >= (begun + ITERATIONS) // 2:
            os.kill(os.getpid(), signal.SIGKILL)
        state = step(state, iteration)
        write(checkpoint, (iteration + 1, state))
        with open(run / "metrics.jsonl", "a") as log:
            log.write(json.dumps({"iteration": iteration + 1, "psnr": 20.0 + iteration, "seconds": 0.1 * iteration}))
            log.write("\n")
        if asked_to_end:
            return 143
    figures = {"result_sha256": state, "seconds": 2.0, "iterations": ITERATIONS, "test_psnr": 30.0}
    write(job / "done.json", {"version": 1, "block": name} | figures)
    (job / "failed.json").unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[3]))
