"""Hostile and damaged splat files are read or refused in one sentence, with little memory and nothing written."""

import gzip
import json
import os
import re
import shutil
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.experiments.evaluate_run import evaluate_run, render_run
from swag_engine.experiments.report import write_report
from swag_engine.experiments.restore_photos import restore_photos
from swag_engine.formats.export import export_run
from swag_engine.formats.gltf import read_glb, write_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.spz import read_spz, write_spz
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.scene.cameras import Camera
from swag_engine.settings.settings import TrainSettings
from swag_engine.survey.export import export_survey
from swag_engine.survey.job import run_job
from swag_engine.survey.merge import describe as describe_merge
from swag_engine.survey.merge import merge_survey
from swag_engine.survey.plan import plan_survey
from swag_engine.survey.render import render_survey
from swag_engine.survey.report import describe as describe_report
from swag_engine.survey.report import report_survey
from tests.hardcases.changed_files import NUMBERS, bytes_changed, some_splats, values_changed
from tests.scenes.survey_scenes import tiny_survey

INPUTS = 1000
"""Changed files of each kind; there are seven kinds."""
SECONDS = float(os.environ.get("SWAG_DAMAGED_SECONDS", 3))
"""Time that files of a run or a survey are changed for each command."""
WORDS = [b"nan", b"-inf", b"1e999", b"", b"x", b"\xff", b"uchar", b"double", b"list uchar int", b"\n", b"vertex", b"sh"]


def binary_ply(path: Path) -> bytes:
    write_ply(path, some_splats())
    return path.read_bytes()


def text_ply(path: Path) -> bytes:
    header, _, body = binary_ply(path).partition(b"end_header\n")
    columns = header.count(b"property")
    rows = np.frombuffer(body, "<f4").reshape(-1, columns)
    lines = [" ".join(f"{value:.6g}" for value in row) for row in rows.tolist()]
    text = header.replace(b"binary_little_endian", b"ascii").replace(b"property int", b"property float")
    return text + b"end_header\n" + "\n".join(lines).encode() + b"\n"


def packed_ply(path: Path) -> bytes:
    random = np.random.default_rng(2)
    bounds = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
    ends = [f"{end}_{name}" for end in ("min", "max") for name in bounds]
    packed = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    header = ["ply", "format binary_little_endian 1.0", "element chunk 2", *(f"property float {e}" for e in ends)]
    header += ["element vertex 300", *(f"property uint {name}" for name in packed)]
    header += ["element sh 300", *(f"property uchar f_rest_{i}" for i in range(9)), "end_header", ""]
    chunks = np.sort(random.normal(size=(2, 2, 9)), axis=1).astype("<f4")
    return "\n".join(header).encode() + chunks.tobytes() + random.bytes(300 * 16 + 300 * 9)


def glb(path: Path) -> bytes:
    camera = Camera("a", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
    write_glb(path, some_splats(), cameras=[camera])
    return path.read_bytes()


def spz(path: Path) -> bytes:
    write_spz(path, some_splats())
    return path.read_bytes()


def old_spz(path: Path) -> bytes:
    """Version 3, with random attributes."""
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 40, 1, 12, 0, 0)
    return gzip.compress(head + np.random.default_rng(3).bytes(40 * (9 + 1 + 3 + 3 + 4 + 9)), mtime=0)


def contents_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Apply bytes_changed to what is in a gzip file."""
    return gzip.compress(bytes_changed(gzip.decompress(data), random), mtime=0)


def header_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Change a number or a word in the header of a PLY, or remove, repeat or move a line."""
    header, end, body = data.partition(b"end_header\n")
    lines = header.splitlines()
    for _ in range(random.integers(1, 3)):
        place = int(random.integers(len(lines)))
        words = lines[place].split(b" ")
        match random.integers(5):
            case 0:
                words[int(random.integers(len(words)))] = str(random.choice(np.array(NUMBERS, object))).encode()
            case 1:
                words[int(random.integers(len(words)))] = WORDS[int(random.integers(len(WORDS)))]
            case 2:
                words = lines[int(random.integers(len(lines)))].split(b" ")
            case 3:
                words = []
            case 4:
                lines.insert(place, lines[int(random.integers(len(lines)))])
                words = lines[place].split(b" ")
        lines[place] = b" ".join(words)
    return b"\n".join(lines) + b"\n" + end + body


def words_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Replace numbers in the rows of a text PLY by other words."""
    header, end, body = data.partition(b"end_header\n")
    words = re.split(rb"(\s)", body)
    for _ in range(random.integers(1, 4)):
        words[int(random.integers(len(words)))] = WORDS[int(random.integers(len(WORDS)))]
    return header + end + b"".join(words)


def glb_json_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Apply values_changed to the JSON of a GLB and adjust the lengths of its chunks."""
    (length,) = struct.unpack("<I", data[12:16])
    text = values_changed(data[20 : 20 + length], random)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "make, change, read",
    [
        (binary_ply, (bytes_changed, header_changed), read_ply),
        (text_ply, (words_changed, header_changed, bytes_changed), read_ply),
        (packed_ply, (bytes_changed, header_changed), read_ply),
        (glb, (glb_json_changed,), read_glb),
        (glb, (bytes_changed,), read_glb),
        (spz, (bytes_changed,), read_spz),
        (old_spz, (bytes_changed, contents_changed), read_spz),
    ],
    ids=["binary PLY", "text PLY", "compressed PLY", "GLB's JSON", "GLB's bytes", "SPZ", "SPZ of version 3"],
)
def test_changed_files(tmp_path: Path, make: Callable, change: tuple[Callable, ...], read: Callable) -> None:
    """Each file has its number as its seed; a failure prints the number."""
    path = tmp_path / "changed file"
    data = make(path)
    path.write_bytes(data)
    assert 6 <= len(read(path)) <= 300
    outcomes = {"refused": 0, "read": 0}
    tracemalloc.start()
    for number in range(INPUTS):
        random = np.random.default_rng(number)
        changed = change[number % len(change)](data, random)
        path.write_bytes(changed)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        started = time.process_time()
        try:
            splats = read(path)
        except InputError as error:
            outcomes["refused"] += 1
            assert str(path) in str(error) and "\n" not in str(error) and str(error).endswith("."), (number, str(error))
        except Exception as error:
            raise AssertionError(f"file {number}: {type(error).__name__}: {error}") from error
        else:
            outcomes["read"] += 1
            assert np.isfinite(splats.positions).all() and np.isfinite(splats.sh).all(), number
            assert np.allclose(np.linalg.norm(splats.rotations, axis=1), 1, atol=1e-5), number
        used = tracemalloc.get_traced_memory()[1] - before
        assert used < 40 * len(changed) + 2**21, (number, used, len(changed))
        assert time.process_time() - started < 30, number  # a length that is believed would take minutes
    tracemalloc.stop()
    print(outcomes)
    assert min(outcomes.values()) > INPUTS / 50
    assert [entry.name for entry in tmp_path.iterdir()] == ["changed file"]


def refused_cheaply(path: Path, read: Callable) -> str:
    """Assert that `read` refuses the file in one sentence without allocating what its header declares; return it."""
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        read(path)
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert used < 4 * path.stat().st_size + 2**21, used
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("zeros", [10, 17, 30, 5000])
@pytest.mark.parametrize("make", [binary_ply, text_ply, packed_ply])
def test_a_ply_that_declares_more_than_it_holds(tmp_path: Path, make: Callable, zeros: int) -> None:
    path = tmp_path / "promise.ply"
    path.write_bytes(re.sub(rb"element vertex \d+", b"element vertex 1" + b"0" * zeros, make(path)))
    assert re.search("cut off|damaged", refused_cheaply(path, read_ply))


def test_a_ply_header_without_end(tmp_path: Path) -> None:
    path = tmp_path / "endless.ply"
    line = b"property float a%07d\n"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\n" + b"".join(line % i for i in range(300_000)))
    assert "header" in refused_cheaply(path, read_ply)
    path.write_bytes(b"ply\n" + b"comment" * 2_000_000)
    assert "header" in refused_cheaply(path, read_ply)


ENDLESS = {
    "deep lists": b"[" * 10**7,
    "deep objects": b'{"a":' * 10**6,
    "many lists": b"[" + b"[]," * 8 * 10**6 + b"[]]",
    "a long number": b"1" * 10**7,
}


@pytest.mark.parametrize("text", ENDLESS.values(), ids=ENDLESS.keys())
def test_glb_json_that_is_deep_or_endless(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "deep.glb"
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    assert "damaged" in refused_cheaply(path, read_glb)


def test_a_glb_whose_attributes_share_their_bytes(tmp_path: Path) -> None:
    """A small file cannot become large in memory by using the same bytes many times."""
    path = tmp_path / "shared.glb"
    data = glb(path)
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    size = 3_000_000
    kind = {"componentType": 5120, "count": size // 4, "bufferView": 0}
    document["bufferViews"] = [{"buffer": 0, "byteLength": size}]
    document["accessors"] = [kind | {"type": name, "normalized": True} for name in ("SCALAR", "VEC3", "VEC4")]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    for name in attributes:
        attributes[name] = 2 if "ROTATION" in name else 0 if "OPACITY" in name or name[0] == "_" else 1
    for i in range(16):
        attributes[f"KHR_gaussian_splatting:SH_DEGREE_{int(i**0.5)}_COEF_{i - int(i**0.5) ** 2}"] = 1
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + size, len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", size, 0x004E4942) + bytes(size))
    assert "damaged" in refused_cheaply(path, read_glb)


@pytest.mark.parametrize(
    "uri", ["../../etc/passwd", "file:///etc/passwd", "/dev/zero", "http://127.0.0.1:9/x", "%2e%2e/x"]
)
def test_gltf_uris_are_never_opened(tmp_path: Path, uri: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tricky.glb"
    data = glb(path)
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    document["buffers"][0]["uri"] = uri
    document["images"] = [{"uri": uri}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)
    opened, real_open = [], open
    monkeypatch.setattr("builtins.open", lambda file, *a, **k: opened.append(file) or real_open(file, *a, **k))
    assert "other files" in refused_cheaply(path, read_glb) and opened == [path]


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    """A run with all its files."""
    folder = shutil.copytree(finished_run, tmp_path_factory.mktemp("damaged") / "run")
    evaluate_run(folder)
    write_report(folder)
    return folder


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """A merged survey of one block."""
    folder = tmp_path_factory.mktemp("damaged") / "survey"
    settings = TrainSettings(iterations=20, width=48, max_gaussians=200, sh_degree=0)
    plan_survey(tiny_survey(folder.parent / "scene"), folder, settings, block_images=100)
    for name in SurveyFolder(folder).read().jobs:
        run_job(folder, name)
    merge_survey(folder)
    report_survey(folder)
    return folder


RUN_DOORS: dict[str, Callable[[Path, Path], object]] = {
    "report": lambda run, out: write_report(run),
    "render": lambda run, out: render_run(run, out, None),
    "export": lambda run, out: export_run(run, "ply", out / "a.ply"),
    "restore": lambda run, out: restore_photos(run, out, width=16),
}
SURVEY_DOORS: dict[str, Callable[[Path, Path], object]] = {
    "block": lambda survey, out: run_job(survey, SurveyFolder(survey).read().blocks[0]),
    "merge": lambda survey, out: describe_merge(merge_survey(survey)),
    "report": lambda survey, out: describe_report(report_survey(survey)),
    "render": lambda survey, out: render_survey(survey, out),
    "export": lambda survey, out: export_survey(survey, "ply", out / "a.ply"),
}


@pytest.mark.parametrize("door", RUN_DOORS)
def test_damaged_files_of_a_run(run: Path, tmp_path: Path, door: str) -> None:
    through_door(run, tmp_path, RUN_DOORS[door], SECONDS)


@pytest.mark.parametrize("door", SURVEY_DOORS)
def test_damaged_files_of_a_survey(survey: Path, tmp_path: Path, door: str) -> None:
    through_door(survey, tmp_path, SURVEY_DOORS[door], SECONDS)


def through_door(source: Path, tmp_path: Path, door: Callable[[Path, Path], object], seconds: float) -> None:
    """Change one JSON file after the other: a command does its work or refuses it in one sentence."""
    folder = shutil.copytree(source, tmp_path / "a")
    files = sorted(path for path in folder.rglob("*.json") if path.name != "claim.json")
    until, number, refused = time.monotonic() + seconds, 0, 0
    while time.monotonic() < until:
        path, random = files[number % len(files)], np.random.default_rng(number)
        data = (source / path.relative_to(folder)).read_bytes()
        path.write_bytes((values_changed, bytes_changed)[number // len(files) % 4 == 3](data, random))
        try:
            door(folder, tmp_path / "out")
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).endswith("."), (number, path.name, str(error))
        except Exception as error:
            raise AssertionError(f"{number}: {path.name}: {type(error).__name__}: {error}") from error
        number += 1
        shutil.rmtree(folder)
        shutil.copytree(source, folder)
    assert refused
