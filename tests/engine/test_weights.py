import hashlib
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
import torch

from swag_engine.errors import InputError
from swag_engine.weights.onnx import Network
from swag_engine.weights.registry import NETWORKS, Weights, cache_folder, find

KIND = "a doubling network"
DOUBLE = "net (float[1,3,H,W] image) => (float[1,3,H,W] out) { out = Add(image, image) }"


def write_network(path: Path, graph: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> {graph}'), path)
    return path


def open_doubling(path: Path) -> Network:
    return Network(path, KIND, [(1, 3, None, None)], [(1, 3, None, None)])


def test_a_network_runs_on_torchs_threads(tmp_path: Path) -> None:
    network = open_doubling(write_network(tmp_path / "schöne Netze.onnx", DOUBLE))
    image = np.random.default_rng(0).random((1, 3, 5, 7), np.float32)
    assert np.array_equal(network(image), 2 * image)
    assert network.inputs == [(1, 3, None, None)]
    assert network.session.get_session_options().intra_op_num_threads == torch.get_num_threads()
    assert network.session.get_providers() == ["CPUExecutionProvider"]


@pytest.mark.parametrize("shape", ["", "1", "1,1,1,1"])
def test_one_number_is_given_in_the_rank_that_the_file_asks_for(tmp_path: Path, shape: str) -> None:
    # torch exports "t" as float[], float[1] or float[1,1,1,1], as the network's author happened to write it.
    value = f"float[{shape}]" if shape else "float[]"
    path = write_network(
        tmp_path / "net.onnx", f"net (float[1,3,H,W] a, {value} t) => (float[1,3,H,W] out) {{ out = Mul(a, t) }}"
    )
    network = Network(path, KIND, [(1, 3, None, None), ()], [(1, 3, None, None)])
    assert np.all(network(np.ones((1, 3, 2, 2), np.float32), np.array(0.25, np.float32)) == 0.25)


@pytest.mark.parametrize(
    "graph",
    [
        "net (float[1,1,H,W] image) => (float[1,1,H,W] out) { out = Add(image, image) }",
        "net (float[1,1,H,W] image) => (float[1,3,H,W] out) { out = Concat<axis=1>(image, image, image) }",
        "net (float[3,H,W] image) => (float[3,H,W] out) { out = Add(image, image) }",
        "net (float16[1,3,H,W] image) => (float16[1,3,H,W] out) { out = Add(image, image) }",
        "net (float[1,3,H,W] image, float[1,3,H,W] b) => (float[1,3,H,W] out) { out = Add(image, b) }",
        "net (float[1,3,H,W] image) => (float[1,1,H,W] out) { out = ReduceMean<axes=[1]>(image) }",
        "net (float[1,3,H,W] image) => (int64[4] out) { out = Shape(image) }",
    ],
)
def test_another_kind_of_network_is_refused_with_what_is_needed(tmp_path: Path, graph: str) -> None:
    path = write_network(tmp_path / "other.onnx", graph)
    with pytest.raises(InputError, match=r"is not a doubling network: it makes out \(.*is needed") as refused:
        open_doubling(path)
    assert str(path) in str(refused.value) and "(1, 3, any, any)" in str(refused.value)


def test_a_file_that_is_no_network_is_named(tmp_path: Path) -> None:
    whole = write_network(tmp_path / "whole.onnx", DOUBLE).read_bytes()
    contents = {"cut.onnx": whole[:60], "empty.onnx": b"", "page.onnx": b"<!DOCTYPE html><html>Not found</html>"}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="cannot be opened as an ONNX file") as refused:
            open_doubling(tmp_path / name)
        assert str(tmp_path / name) in str(refused.value) and "\n" not in str(refused.value)
    for absent in (tmp_path / "absent.onnx", tmp_path):
        with pytest.raises(InputError, match=f"There is no file {absent}: put a doubling network there"):
            open_doubling(absent)


def test_a_pickle_is_never_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "ran",))

    (tmp_path / "trap.onnx").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InputError):
        open_doubling(tmp_path / "trap.onnx")
    assert not (tmp_path / "ran").exists()


def test_what_goes_wrong_while_a_network_runs_is_told(tmp_path: Path) -> None:
    fixed = "net (float[1,3,8,8] image) => (float[1,3,8,8] out) { out = Add(image, image) }"
    with pytest.raises(InputError, match=r"fixed.onnx cannot work on an input of \(1, 3, 8, 9\)"):
        open_doubling(write_network(tmp_path / "fixed.onnx", fixed))(np.zeros((1, 3, 8, 9), np.float32))
    flat = "net (float[1,3,H,W] image) => (float out) { out = Flatten(image) }"
    with pytest.raises(InputError, match=r"flat.onnx is not a doubling network: its output is \(1, 192\)"):
        open_doubling(write_network(tmp_path / "flat.onnx", flat))(np.zeros((1, 3, 8, 8), np.float32))
    log = "net (float[1,3,H,W] image) => (float[1,3,H,W] out) { out = Log(image) }"
    with pytest.raises(InputError, match="log.onnx makes numbers that are not finite"):
        open_doubling(write_network(tmp_path / "log.onnx", log))(np.zeros((1, 3, 8, 8), np.float32))


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path / "cache"))
    cache_folder().mkdir(parents=True)
    return cache_folder()


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_a_missing_network_says_where_to_get_it_and_where_to_put_it(
    name: str, tmp_path: Path, empty_cache: Path
) -> None:
    weights = NETWORKS[name]
    for folder, place in ((tmp_path, tmp_path), (None, empty_cache)):
        with pytest.raises(InputError) as refused:
            find(name, folder)
        for part in (name, weights.licence, weights.page, str(place / weights.file)):
            assert part in str(refused.value)


def test_the_users_file_comes_before_the_cached_one(tmp_path: Path, empty_cache: Path) -> None:
    file = NETWORKS["rife"].file
    (empty_cache / file).touch()
    assert find("rife", None) == find("rife", tmp_path) == empty_cache / file
    (tmp_path / file).touch()
    assert find("rife", tmp_path) == tmp_path / file
    with pytest.raises(InputError, match="There is no network 'raft': choose one of .*rife"):
        find("raft", tmp_path)


def test_a_file_with_another_size_or_hash_is_refused(
    tmp_path: Path, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = b"weights of a network"
    known = Weights("1.0", "MIT", "known.onnx", len(content), hashlib.sha256(content).hexdigest(), "its page")
    monkeypatch.setitem(NETWORKS, "known", known)
    (tmp_path / "known.onnx").write_bytes(content)
    assert find("known", tmp_path) == tmp_path / "known.onnx"
    for damaged in (content[:-1], content[:-1] + b"!"):
        (tmp_path / "known.onnx").write_bytes(damaged)
        with pytest.raises(InputError, match="known.onnx is not the file of known 1.0, or is damaged.*its page"):
            find("known", tmp_path)
    monkeypatch.setitem(NETWORKS, "known", replace(known, size=None, sha256=None))
    assert find("known", tmp_path) == tmp_path / "known.onnx"
