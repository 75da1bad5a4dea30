"""Random search (hypothesis) over input files and settings of runs: a result, or one sentence.

What it finds becomes a test in test_found.py. With SWAG_EXAMPLES=N it tries N examples of each, different ones each
time.
"""

import json
import os
import struct
import warnings
from dataclasses import fields

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swag_engine.app.protocol import parse_request
from swag_engine.base.errors import InputError
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.formats.water import bake_water
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.planning.plan import read_plan
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import read_image
from swag_engine.scene.inspect import describe, inspect_scene
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.recipes import RECIPES, SWITCHES
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train
from tests.hardcases.changed_files import some_splats

EXAMPLES = int(os.environ.get("SWAG_EXAMPLES", 0))


def searched(examples: int):
    """Return the settings of a search that tries so many examples by default."""
    return settings(
        max_examples=EXAMPLES or examples,
        derandomize=not EXAMPLES,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def read_or_refused(read, *arguments):
    """Return what `read` returns, None where it refuses the input in one sentence."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read(*arguments)
    except InputError as error:
        assert str(error) and "\n" not in str(error), error


# -- input files ------------------------------------------------------------------------------------------------------

VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
DOCUMENTS = st.recursive(
    VALUES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=9,
)


def objects(*names: str) -> st.SearchStrategy:
    """JSON objects with some of these names and any values."""
    return st.dictionaries(st.sampled_from(names), DOCUMENTS)


SETTINGS = [field.name for field in fields(TrainSettings)]
REQUESTS = ("request", "scene", "out", "arrays", "settings", "resume", "run", "format", "words", "path")
KINDS = st.sampled_from(["inspect", "train", "plan", "forecast", "export", "label", "search", "cancel"])
TRIPLES = st.lists(st.floats(), min_size=3, max_size=3) | DOCUMENTS
SEEN_FROM = Camera("a", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
EFFECT = objects("state", "evidence", "reason", "cost_ms", "start", "overruled")
JSON = {
    "request": (
        st.builds(lambda kind, rest: rest | {"request": kind}, KINDS, objects(*REQUESTS))
        | st.fixed_dictionaries({"request": KINDS, "scene": VALUES, "out": VALUES, "settings": objects(*SETTINGS)}),
        lambda path: parse_request(path.read_text(encoding="utf-8")),
    ),
    "config.json": (
        st.fixed_dictionaries({"scene": VALUES, "settings": objects(*SETTINGS), "up": DOCUMENTS}),
        lambda path: RunFolder(path.parent).read_config(),
    ),
    "metrics.json": (
        objects("interrupted", "iteration", "test_psnr"),
        lambda path: (RunFolder(path.parent).finished(), RunFolder(path.parent).iterations()),
    ),
    "metrics.jsonl": (objects("iteration", "test_psnr"), lambda path: RunFolder(path.parent).log_until(3)),
    "water.json": (
        st.fixed_dictionaries(
            {
                "beta_D": TRIPLES,
                "beta_B": TRIPLES,
                "light": st.sampled_from(["linear", "srgb", "x"]),
                "per": st.just("unit"),
            },
            optional={"background_sh": DOCUMENTS, "B_inf": TRIPLES, "ranges": DOCUMENTS, "transmission": DOCUMENTS},
        ),
        lambda path: bake_water(some_splats(), RunFolder(path.parent).read_water(), [SEEN_FROM]),
    ),
    "plan.json": (
        st.fixed_dictionaries({"effects": st.fixed_dictionaries(dict.fromkeys(EFFECTS, EFFECT)), "water": DOCUMENTS}),
        read_plan,
    ),
}


@pytest.mark.parametrize("kind", JSON)
def test_any_json(kind, tmp_path):
    made, read = JSON[kind]
    path = tmp_path / kind

    @searched(40)
    @given(document=made | DOCUMENTS)
    def search(document):
        path.write_text(json.dumps(document), encoding="utf-8")
        read_or_refused(read, path)

    search()


@pytest.mark.parametrize("kind", JSON)
@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 100_000, "", "{", '"\\ud800"', "9" * 5000],
    ids=["deep list", "deep object", "nothing", "half", "half a character", "long number"],
)
def test_json_that_is_no_document(kind, text, tmp_path):
    path = tmp_path / kind
    path.write_text(text, encoding="utf-8")
    if kind == "metrics.jsonl":  # damaged lines are dropped
        JSON[kind][1](path)
        assert path.read_text() == ""
    else:
        with pytest.raises(InputError, match=r"^[^\n]+$"):
            JSON[kind][1](path)


NUMBERS = st.one_of(st.floats(), st.integers(-3, 300), st.integers(), st.floats(-9, 9)).map(str)
NAMES = st.sampled_from(["view_0.png", "../a.png", "a b.png", "", "ü.png", "/etc/passwd"])
CAMERAS = st.tuples(st.sampled_from(["1", "2"]), st.sampled_from(["PINHOLE", "SIMPLE_RADIAL", "FISHEYE", "OPENCV"]),
                    st.lists(NUMBERS, max_size=11).map(" ".join)).map(" ".join)  # fmt: skip
POSE = st.lists(NUMBERS, min_size=7, max_size=7).map(" ".join)
HEADS = st.tuples(st.sampled_from(["1", "2"]), POSE, st.just("1"), NAMES).map(" ".join)
IMAGES = st.tuples(HEADS, st.lists(NUMBERS, max_size=6).map(" ".join)).map("\n".join)
POINTS = st.lists(NUMBERS, max_size=12).map(" ".join) | st.builds(
    lambda position: f"1 {' '.join(position)} 1 2 3 .5", st.lists(NUMBERS, min_size=3, max_size=3)
)


def test_any_text_model(tmp_path):
    model, pictures = tmp_path / "sparse" / "0", tmp_path / "images"
    model.mkdir(parents=True)
    pictures.mkdir()
    cv2.imwrite(str(pictures / "view_0.png"), np.zeros((3, 4, 3), np.uint8))
    pinhole = "1 PINHOLE 4 3 5 5 2 1.5"

    @searched(60)
    @given(
        cameras=st.just([pinhole]) | st.lists(CAMERAS, max_size=2),
        images=st.lists(IMAGES, max_size=3),
        points=st.lists(POINTS, max_size=4),
    )
    def search(cameras, images, points):
        for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
            (model / f"{name}.txt").write_text("\n".join([*lines, ""]), encoding="utf-8")

        def read():
            loaded = load_scene(tmp_path)
            describe(inspect_scene(loaded))
            return gaussians_from_points(loaded.points, 100, 0, 0, np.full(3, 0.5))

        if cloud := read_or_refused(read):
            assert all(tensor.isfinite().all() for tensor in cloud.parameters().values())

    search()


BYTES = (np.uint8,)
TYPES = {"png": (np.uint8, np.uint16), "tiff": (np.uint8, np.uint16, np.float32), "jpg": BYTES, "bmp": BYTES}


def test_any_photograph(tmp_path):
    @searched(40)
    @given(
        size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
        channels=st.sampled_from([1, 3, 4]),
        kind=st.sampled_from([(suffix, dtype) for suffix, dtypes in TYPES.items() for dtype in dtypes]),
        cut=st.none() | st.integers(0, 200),
        tail=st.binary(max_size=9),
    )
    def search(size, channels, kind, cut, tail):
        suffix, dtype = kind
        pixels = np.random.default_rng(0).integers(0, 255, (*size, channels)).astype(dtype)
        path = tmp_path / f"a.{suffix}"
        path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes()[:cut] + tail)
        if found := read_or_refused(read_image, path):
            assert found[0].shape == (*size, 3) and found[0].dtype == np.uint8

    search()


PROPERTIES = [
    "x",
    "y",
    "z",
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
    *(f"f_dc_{i}" for i in range(3)),
]
PLY_TYPES = st.sampled_from(["float", "double", "int", "uchar", "half", "list uchar int"])


def test_any_ply(tmp_path):
    path = tmp_path / "a.ply"
    extra = st.sampled_from(["x", "f_rest_0", "f_rest_8", "label", "nx", "packed_position", "ü"])

    @searched(60)
    @given(
        form=st.sampled_from(["binary_little_endian 1.0", "binary_big_endian 1.0", "ascii 1.0", "other"]),
        count=st.integers(-1, 5) | st.integers(),
        kinds=st.lists(st.just("float") | PLY_TYPES, min_size=14, max_size=14),
        extras=st.lists(st.tuples(PLY_TYPES, extra), max_size=4),
        body=st.binary(max_size=400) | st.lists(NUMBERS, max_size=70).map(lambda words: " ".join(words).encode()),
    )
    def search(form, count, kinds, extras, body):
        pairs = [*zip(kinds, PROPERTIES, strict=True), *extras]
        head = ["ply", f"format {form}", f"element vertex {count}", *(f"property {k} {n}" for k, n in pairs)]
        path.write_bytes("\n".join([*head, "end_header", ""]).encode() + body)
        read_or_refused(read_ply, path)

    search()


ACCESSOR = objects("bufferView", "byteOffset", "componentType", "count", "type", "normalized", "sparse")
PRIMITIVE = objects("mode", "attributes", "extensions")


def test_any_glb(tmp_path):
    path = tmp_path / "a.glb"
    lists = {"accessors": ACCESSOR, "bufferViews": objects("buffer", "byteOffset", "byteLength", "byteStride"),
             "buffers": objects("byteLength", "uri"), "nodes": objects("mesh", "matrix", "translation", "children"),
             "meshes": st.fixed_dictionaries({"primitives": st.lists(PRIMITIVE, max_size=2)})}  # fmt: skip

    @searched(60)
    @given(
        document=st.fixed_dictionaries({name: st.lists(one, max_size=2) for name, one in lists.items()}) | DOCUMENTS,
        body=st.binary(max_size=60),
    )
    def search(document, body):
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), 0x4E4F534A)
        path.write_bytes(head + text + struct.pack("<II", len(body), 0x004E4942) + body)
        read_or_refused(read_glb, path)

    search()


# -- settings of runs -------------------------------------------------------------------------------------------------

STATES = st.dictionaries(st.sampled_from(sorted([*EFFECTS, *SWITCHES])), st.sampled_from(["on", "off"]), max_size=6)
ASKED = st.fixed_dictionaries(
    {
        "recipe": st.sampled_from(sorted(RECIPES)),
        "effects": STATES.map(lambda states: ",".join(f"{name}={state}" for name, state in states.items())),
        "water_type": st.sampled_from(["auto", "auto", "I", "9C", "3,2,1", "0,0,0", "1000,1,0.001"]),
        "metres_per_unit": st.sampled_from([0.0, 1.0, 1e-6, 1e6]),
        "iterations": st.integers(1, 30),
        "width": st.integers(8, 60),
        "max_gaussians": st.integers(1, 200),
        "sh_degree": st.integers(0, 3),
        "stop_when_flat": st.booleans(),
        "seed": st.integers(0, 2**31 - 1),
        "backend": st.just("cpu"),
    }
)


def test_any_run(tiny_scene, tmp_path_factory):
    """Runs of any settings, stopped somewhere and resumed, have a finite result."""

    @searched(3)
    @given(asked=ASKED, stop=st.integers(0, 30))
    def search(asked, stop):
        run = tmp_path_factory.mktemp("any") / "run"
        chosen = read_or_refused(lambda: TrainSettings(**asked))
        if chosen is None:
            return
        stops = iter([False] * stop)
        first = read_or_refused(lambda: train(tiny_scene, run, chosen, should_stop=lambda: next(stops, True)))
        if first is None:
            return
        if first["interrupted"]:
            assert train(tiny_scene, run, chosen, resume=True)["metrics"]["iteration"] >= 1
        tensors, _ = load_checkpoint(run)
        assert all(torch.isfinite(tensor).all() for tensor in tensors.values())
        splats = read_ply(run / "result.ply")
        assert len(splats.positions) and all(np.isfinite(v).all() for v in (splats.positions, splats.sh, splats.scales))

    search()
