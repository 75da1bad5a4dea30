"""Fuzzing of every kind of input: each file is read, or refused in one sentence.

    python tests/hardcases/fuzz.py [--inputs 1000] [--seed 0] [--kinds onnx ...]

Each kind runs in a process of its own with 6 GB of memory, so that a crash of a library is noticed too. Prints counts
as JSON; exit code 1 and the number of the input where one was neither read nor refused. Splat files have their own
tests (test_damaged_files.py), with the same changes.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np

from swag_engine.base.errors import InputError
from tests.hardcases.changed_files import THINGS, bytes_changed, values_changed

MEMORY = 6 << 30
Door = Callable[[Path], object]
Change = Callable[[bytes, np.random.Generator], bytes]


def words_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Replace words of a text by other words or numbers, or remove or repeat lines."""
    lines = data.split(b"\n")
    for _ in range(random.integers(1, 4)):
        place = int(random.integers(len(lines)))
        words = lines[place].split(b" ")
        match random.integers(4):
            case 0:
                del lines[place : place + int(random.integers(1, 3))]
            case 1:
                lines.insert(place, lines[int(random.integers(len(lines)))])
            case _:
                thing = THINGS[int(random.integers(len(THINGS)))]
                words[int(random.integers(len(words)))] = str(thing).encode()
                lines[place] = b" ".join(words)
        lines = lines or [b""]
    return b"\n".join(lines)


def colmap(folder: Path, text: bool) -> Iterator[tuple[Path, Door, tuple[Change, ...]]]:
    from swag_engine.gaussians.init import gaussians_from_points
    from swag_engine.scene.colmap import load_scene
    from swag_engine.scene.inspect import describe, inspect_scene
    from tests.scenes.dots import make_dot_scene

    scene = make_dot_scene(folder, views=3, text=text)

    def read(path: Path) -> None:
        loaded = load_scene(scene)
        describe(inspect_scene(loaded))
        gaussians_from_points(loaded.points, 1000, 0, 0, np.full(3, 0.5))

    for path in sorted((scene / "sparse" / "0").iterdir()):
        yield path, read, (words_changed, bytes_changed) if text else (bytes_changed,)


def images(folder: Path) -> Iterator[tuple[Path, Door, tuple[Change, ...]]]:
    from swag_engine.scene.images import read_image

    picture = cv2.resize(np.random.default_rng(0).integers(0, 256, (9, 12, 3), np.uint8), (60, 45))
    for name in ("a.png", "a.jpg", "a.tiff", "a.webp", "a.bmp", "deep.png"):
        path = folder / name
        values = picture.astype(np.uint16) * 257 if name.startswith("deep") else picture
        path.write_bytes(cv2.imencode(path.suffix, values)[1].tobytes())
        yield path, read_image, (bytes_changed,)


def run_folder(folder: Path) -> Iterator[tuple[Path, Door, tuple[Change, ...]]]:
    """Every file of a run that is read again, with each function that reads it."""
    from swag_engine.experiments.evaluate_run import render_run
    from swag_engine.experiments.label_run import label_run, search_run
    from swag_engine.formats.export import ExportOptions, export_run
    from swag_engine.formats.run_folder import RunFolder
    from swag_engine.planning.plan import plan_scene, read_plan
    from swag_engine.settings.settings import TrainSettings
    from swag_engine.training.checkpoint import checkpoints
    from swag_engine.training.trainer import train
    from tests.scenes.tiny import make_tiny_scene

    scene, run = make_tiny_scene(folder / "scene", views=4, width=24, height=18, points=40), folder / "run"
    settings = TrainSettings(
        iterations=4, width=24, max_gaussians=60, sh_degree=1, water_type="II", metres_per_unit=1.0
    )
    train(scene, run, settings)
    plan_scene(scene, run)
    label_run(run)
    (newest,) = checkpoints(run)

    def finish(path: Path) -> None:
        train(scene, run, settings, resume=True)

    def export(path: Path) -> None:
        export_run(run, "ply", folder / "out.ply", ExportOptions(water=0.5, labels=()))

    def render(path: Path) -> None:
        render_run(run, folder / "pictures", None)

    def settle(path: Path) -> None:
        RunFolder(run).log_until(3)

    for path, doors in (
        (run / "config.json", (finish, export)),
        (run / "metrics.json", (finish,)),
        (run / "metrics.jsonl", (settle,)),
        (run / "water.json", (export,)),
        (run / "plan.json", (read_plan,)),
        (run / "labels.json", (export, lambda path: search_run(run, "reef"))),
        (newest, (render,)),
    ):
        changes = (bytes_changed, values_changed) if path.suffix == ".json" else (bytes_changed,)
        for door in doors:
            yield path, door, changes


def requests(folder: Path) -> Iterator[tuple[Path, Door, tuple[Change, ...]]]:
    from swag_engine.app.protocol import parse_request

    request = {"request": "train", "scene": "a", "out": "b", "settings": {"width": 99, "seed": 3}, "resume": True}
    path = folder / "request.json"
    path.write_text(json.dumps(request))
    yield path, lambda path: parse_request(path.read_text(errors="replace")), (values_changed, bytes_changed)


def onnx(folder: Path) -> Iterator[tuple[Path, Door, tuple[Change, ...]]]:
    import onnx as library
    import onnx.parser

    from swag_engine.weights.onnx import Network

    graph = "net (float[1,3,H,W] image) => (float[1,3,H,W] out) { two = Constant<value = float {2}>() \n"
    graph += "a = Mul(image, two) \n out = Relu(a) }"
    path = folder / "net.onnx"
    library.save(onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> {graph}'), path)

    def read(path: Path) -> None:
        network = Network(path, "a network", [(1, 3, None, None)], [(1, 3, None, None)])
        network(np.ones((1, 3, 4, 5), np.float32))

    yield path, read, (bytes_changed,)


KINDS: dict[str, Callable[[Path], Iterator[tuple[Path, Door, tuple[Change, ...]]]]] = {
    "COLMAP, binary": lambda folder: colmap(folder, False),
    "COLMAP, text": lambda folder: colmap(folder, True),
    "images": images,
    "run folder": run_folder,
    "requests": requests,
    "onnx": onnx,
}


def fuzz(kind: str, inputs: int, seed: int) -> dict[str, int]:
    """Fuzz one kind in this process and count outcomes; each input is named on standard error before it is read.

    Raises any error of an input other than InputError.
    """
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    counts = {"read": 0, "refused": 0}
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["SWAG_CACHE_DIR"] = f"{temporary}/cache"
        files, saved = Path(temporary) / "files", Path(temporary) / "saved"
        files.mkdir()
        places = list(KINDS[kind](files))
        shutil.copytree(files, saved)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        for number in range(inputs):
            path, door, changes = places[number % len(places)]
            random = np.random.default_rng((seed, number))
            whole = path.read_bytes()
            change = changes[int(random.integers(len(changes)))]
            path.write_bytes(change(whole, random))
            print(f"input {number}: {path.name} by {change.__name__}", file=sys.stderr)
            try:
                door(path)
                counts["read"] += 1
            except InputError as error:
                assert "\n" not in str(error), f"more than one line: {error}"
                counts["refused"] += 1
            finally:
                shutil.rmtree(files)
                shutil.copytree(saved, files)
    return counts


def fuzz_all(kinds: list[str], inputs: int, seed: int) -> tuple[dict[str, dict[str, int]], list[str]]:
    """Fuzz each kind in a process of its own; return counts by kind, and the failures."""
    found, wrong = {}, []
    for kind in kinds:
        command = [sys.executable, __file__, "--inputs", str(inputs), "--seed", str(seed), "--one", kind]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=3600, check=False)
            if done.returncode:
                wrong.append(f"{kind}: exit code {done.returncode}\n{done.stderr[-3000:]}")
            else:
                found[kind] = json.loads(done.stdout.splitlines()[-1])
        except subprocess.TimeoutExpired as error:
            wrong.append(f"{kind}: does not end\n{(error.stderr or b'')[-500:]!r}")
    return found, wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1000, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--one", choices=KINDS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        try:
            print(json.dumps(fuzz(options.one, options.inputs, options.seed)))
        except BaseException:
            traceback.print_exc()
            return 1
        return 0
    found, wrong = fuzz_all(options.kinds, options.inputs, options.seed)
    print(json.dumps(found, indent=2))
    print("\n".join(wrong), file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
