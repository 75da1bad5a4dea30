"""Kill training runs at any moment, and check that their files are whole and that they resume bit-equal.

    python tests/hardcases/killed_runs.py --kills 100 [--seed 0]        prints counts as JSON

Linux. Each process is ended by SIGKILL at a random time, by SIGKILL before or after a random call that flushes, renames
or removes a file, by the system in the middle of a random write, or is told in the middle of one that the disk is full.
"""

import argparse
import faulthandler
import json
import os
import random
import resource
import signal
import stat
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import torch
from safetensors import safe_open

from swag_engine.base.errors import InputError
from swag_engine.base.files import LOCK, TEMPORARY, locked_folder
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import checkpoints, load_checkpoint
from swag_engine.training.schedule import Schedule
from swag_engine.training.trainer import make_trainer
from tests.scenes.tiny import make_tiny_scene

SETTINGS = TrainSettings(iterations=40, width=48, max_gaussians=400, sh_degree=1)
SCHEDULE = Schedule(checkpoint_seconds=0.01, preview_seconds=0.03)
CALLS = ("fsync", "replace", "unlink")
KINDS = ("moment", "call", "write", "full")
REFUSED = 2


def in_a_process(work: Callable[[], Any]) -> int:
    """Run `work` in a forked process; return 0, REFUSED for an InputError, 1 for another error, or -signal."""
    if pid := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    faulthandler.dump_traceback_later(60, exit=True)
    try:
        work()
        os._exit(0)
    except InputError as error:
        print(error, file=sys.stderr)
        os._exit(REFUSED)
    except BaseException:
        traceback.print_exc()
        os._exit(1)


def train(scene: Path, out: Path) -> None:
    resume = RunFolder(out).config.exists()
    with locked_folder(out):
        trainer = make_trainer(
            RunFolder(out), scene, SETTINGS, resume, lambda event: None, None, time.monotonic(), SCHEDULE
        )
        trainer.run_to_end(lambda: False, preview=True)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def ending(kind: str, chance: random.Random, seconds: float) -> Callable[[], None]:
    """Return a function that arranges the end of the process that calls it; drawn here, so that a seed repeats it."""
    fraction, size, number, after = (
        chance.random(),
        int(10 ** chance.uniform(1.5, 5.5)),
        chance.randrange(40),
        chance.random(),
    )

    def at_a_moment() -> None:
        threading.Thread(target=lambda: (time.sleep(fraction * seconds), die()), daemon=True).start()

    def at_a_call() -> None:
        calls = iter(range(number, -1, -1))

        def deadly(call: Callable[..., Any]) -> Callable[..., Any]:
            def called(*arguments: Any, **named: Any) -> Any:
                last = next(calls, 1) == 0
                if last and after < 0.5:
                    die()
                result = call(*arguments, **named)
                if last:
                    die()
                return result

            return called

        for name in CALLS:
            setattr(os, name, deadly(getattr(os, name)))

    def in_a_write() -> None:
        if stat.S_ISREG(os.fstat(2).st_mode):  # the limit is for the run's files, not for messages
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if kind == "write" else signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    return {"moment": at_a_moment, "call": at_a_call}.get(kind, in_a_write)


def check_whole(out: Path) -> None:
    """Assert that every file with its final name is whole."""
    for path in out.iterdir() if out.exists() else ():
        if path.name.startswith("."):
            assert path.name == LOCK or path.name.startswith(TEMPORARY), path
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".ply":
            assert len(read_ply(path).positions)
        elif path.suffix == ".glb":
            assert len(read_glb(path).positions)
        elif path.suffix == ".safetensors":
            with safe_open(path, framework="pt") as stored:
                assert all(len(stored.get_tensor(name).shape) >= 0 for name in stored.keys())  # noqa: SIM118
        else:
            assert path.name == "metrics.jsonl", path


def check_equal(out: Path, expected: Path) -> None:
    """Assert that a finished run is bit-equal to one that was never killed."""
    assert (out / "result.ply").read_bytes() == (expected / "result.ply").read_bytes()
    assert (out / "result.glb").read_bytes() == (expected / "result.glb").read_bytes()
    (got, _), (want, _) = load_checkpoint(out), load_checkpoint(expected)
    assert got.keys() == want.keys() and all(torch.equal(tensor, got[name]) for name, tensor in want.items())
    assert not [path.name for path in out.iterdir() if path.name.startswith(".")]
    for line in (out / "metrics.jsonl").read_text().splitlines():
        json.loads(line)


def remove_hidden_files(folder: Path) -> None:
    for path in folder.glob(".*"):
        path.unlink()


def killed_runs(folder: Path, kills: int, seed: int) -> dict[str, Any]:
    """Kill so many processes and return counts. Raises AssertionError where something was lost."""
    torch.set_num_threads(1)
    chance = random.Random(seed)
    seen: Counter[str] = Counter()
    scene = make_tiny_scene(folder / "scene", width=48, height=36, points=200)
    started = time.monotonic()
    assert in_a_process(lambda: train(scene, folder / "expected")) == 0
    seconds = time.monotonic() - started
    number, turn = 0, 0
    while sum(seen[kind] for kind in KINDS) < kills:
        turn += 1
        out = folder / f"run {number}"
        kind = KINDS[turn % len(KINDS)]
        arrange = ending(kind, chance, seconds)
        had = len(checkpoints(out))

        def work(out: Path = out, arrange: Callable[[], None] = arrange) -> None:
            arrange()
            train(scene, out)

        status = in_a_process(work)
        wanted = {"full": REFUSED, "write": -signal.SIGXFSZ}.get(kind, -signal.SIGKILL)
        assert status in (0, wanted), f"{kind}: exit status {status}"
        seen[kind] += status == wanted
        check_whole(out)
        assert len(checkpoints(out)) >= min(had, 1), "a checkpoint is gone"
        config = RunFolder(out).config
        if config.exists() and RunFolder(out).finished():
            seen["finished"] += 1
            if status == wanted:  # the last thing that the process did was to finish
                in_a_process(partial(remove_hidden_files, out))
            check_equal(out, folder / "expected")
            number += 1
    out = folder / f"run {number}"
    assert in_a_process(lambda: train(scene, out)) == 0
    check_equal(out, folder / "expected")
    return {"kills": sum(seen[kind] for kind in KINDS), **seen, "finished": seen["finished"] + 1}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["SWAG_CACHE_DIR"] = f"{temporary}/cache"
        print(json.dumps(killed_runs(Path(temporary), options.kills, options.seed), indent=2))
