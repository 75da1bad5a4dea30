import hashlib
import http.server
import pickle
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.weights.onnx import Graph, Network
from swag_engine.weights.registry import NETWORKS, Weights, cache_folder, fetch, find, find_or_fetch

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
        with pytest.raises(InputError, match=f"There is no file {absent}: save a doubling network there"):
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


# Networks of several inputs and outputs -------------------------------------------------------------------------------

TWO = "net (float[1,3,H,W] image, int64[1,L] ids) => (float[1,3,H,W] twice, int64[1,L] same) "
TWO += "{ twice = Add(image, image) same = Identity(ids) }"
SHAPES = {"image": (1, 3, None, None), "ids": (1, None)}


def test_a_graph_takes_and_gives_by_name(tmp_path: Path) -> None:
    path = write_network(tmp_path / "two.onnx", TWO)
    for inputs, outputs in ((SHAPES, ["twice", "same"]), ({"pixels": None, "tokens": (1, None)}, ["a", "b"])):
        graph = Graph(path, KIND, inputs, outputs)
        image, ids = np.ones((1, 3, 4, 5), np.float32), np.arange(6, dtype=np.int32)[None]
        made = graph(**dict(zip(inputs, (image, ids), strict=True)))
        assert list(made) == outputs
        assert (made[outputs[0]] == 2).all() and np.array_equal(made[outputs[1]], ids)
        assert graph.shapes[list(inputs)[0]] == (1, 3, None, None)
    backwards = Graph(path, KIND, SHAPES, ["same", "twice"])
    assert np.array_equal(backwards(image=image, ids=ids)["same"], ids)
    one = Graph(path, KIND, {"image": SHAPES["image"]}, ["twice", "same"], ["ids", "mask"])
    assert np.array_equal(one(image=image, ids=ids, mask=ids)["same"], ids)


@pytest.mark.parametrize(
    ("inputs", "outputs", "optional"),
    [
        ({"image": (1, 3, None, None)}, ["twice", "same"], []),
        (SHAPES | {"more": (1,)}, ["twice", "same"], []),
        (SHAPES, ["twice"], ["ids"]),
        (SHAPES, ["twice", "same", "third"], []),
        ({"image": (1, 1, None, None), "ids": (1, None)}, ["twice", "same"], []),
        ({"image": (1, 3, None), "ids": (1, None)}, ["twice", "same"], []),
    ],
)
def test_another_graph_is_refused_with_what_is_needed(
    tmp_path: Path, inputs: dict, outputs: list, optional: list
) -> None:
    path = write_network(tmp_path / "two.onnx", TWO)
    with pytest.raises(InputError, match=r"two.onnx is not a doubling network: it makes twice \(.* is needed"):
        Graph(path, KIND, inputs, outputs, optional)


def test_a_graph_that_fails_or_makes_no_numbers_is_named(tmp_path: Path) -> None:
    fixed = "net (float[1,3,8,8] image) => (float[1,3,8,8] out) { out = Log(image) }"
    graph = Graph(write_network(tmp_path / "log.onnx", fixed), KIND, {"image": None}, ["out"])
    assert np.isneginf(graph(image=np.zeros((1, 3, 8, 8)))["out"]).all()  # infinities mask things out
    with pytest.raises(InputError, match="log.onnx makes what is not a number"):
        graph(image=np.full((1, 3, 8, 8), -1))
    with pytest.raises(InputError, match=r"log.onnx cannot work on an input of \(1, 3, 8, 9\)"):
        graph(image=np.zeros((1, 3, 8, 9)))


# Download -------------------------------------------------------------------------------------------------------------


class Server(http.server.ThreadingHTTPServer):
    """Serves `content`, from where it is asked to if `resumes`; stops after `most` bytes."""

    content, resumes, status = b"", True, 200
    most: int | None = None

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.ranges: list[str | None] = []
        threading.Thread(target=self.serve_forever, daemon=True).start()


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:  # noqa: N802
        asked = self.headers.get("Range")
        self.server.ranges.append(asked)
        if self.server.status != 200:
            return self.send_error(self.server.status)
        first = int(asked.removeprefix("bytes=").removesuffix("-")) if asked and self.server.resumes else 0
        if first >= len(self.server.content) and first:
            return self.send_error(416)
        rest = self.server.content[first:]
        self.send_response(206 if first else 200)
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        self.wfile.write(rest[: self.server.most])
        return None

    def log_message(self, *arguments: object) -> None:
        pass


CONTENT = np.random.default_rng(0).integers(0, 256, 3_000_000, np.uint8).tobytes()


@pytest.fixture
def server(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    served = Server()
    served.content = CONTENT
    known = Weights("1.0", "MIT", "known.onnx", len(CONTENT), hashlib.sha256(CONTENT).hexdigest(), "its page")
    known = replace(known, url=f"http://127.0.0.1:{served.server_port}/known.onnx")
    monkeypatch.setitem(NETWORKS, "known", known)
    yield served
    served.shutdown()
    served.server_close()


@pytest.mark.parametrize("sized", [True, False])
def test_a_network_is_fetched_once_with_consent(
    server: Server, empty_cache: Path, monkeypatch: pytest.MonkeyPatch, sized: bool
) -> None:
    if not sized:
        monkeypatch.setitem(NETWORKS, "known", replace(NETWORKS["known"], size=None))
    with pytest.raises(InputError, match="known 1.0 .licence MIT. is not on this machine"):
        find_or_fetch("known", None, consent=False)
    assert server.ranges == []
    fractions: list[float] = []
    path = find_or_fetch("known", None, consent=True, progress=fractions.append)
    assert path == empty_cache / "known.onnx" and path.read_bytes() == CONTENT
    assert fractions == sorted(fractions) and len(fractions) >= 3 and fractions[-1] == 1
    assert find_or_fetch("known", None, consent=True) == path and len(server.ranges) == 1
    assert [entry.name for entry in empty_cache.iterdir()] == ["known.onnx"]


def test_a_download_goes_on_where_it_stopped(server: Server, empty_cache: Path) -> None:
    server.most = 1_000_000
    with pytest.raises(InputError, match="cannot be downloaded .*: try again, which continues where it stopped"):
        fetch("known")
    assert not (empty_cache / "known.onnx").exists()
    server.most = None
    assert fetch("known").read_bytes() == CONTENT
    assert server.ranges == [None, "bytes=1000000-"]


def test_a_server_that_cannot_resume_starts_again(server: Server, empty_cache: Path) -> None:
    (empty_cache / ".known.onnx.part").write_bytes(b"x" * 500)
    server.resumes = False
    assert fetch("known").read_bytes() == CONTENT
    (empty_cache / "known.onnx").unlink()
    (empty_cache / ".known.onnx.part").write_bytes(b"x" * (len(CONTENT) + 5))  # longer than the file
    server.resumes = True
    assert fetch("known").read_bytes() == CONTENT


@pytest.mark.parametrize("wrong", [CONTENT[:-1] + bytes([CONTENT[-1] ^ 1]), CONTENT[:-1], b"<html>Sign in</html>"])
def test_what_is_not_the_network_is_removed(server: Server, empty_cache: Path, wrong: bytes) -> None:
    server.content = wrong
    with pytest.raises(InputError, match="gave is not known 1.0, or is damaged, and was removed.*its page"):
        fetch("known")
    assert list(empty_cache.iterdir()) == []


def test_a_server_that_refuses_is_quoted(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    server.status = 404
    with pytest.raises(InputError, match="known.onnx cannot be downloaded: the server answers 404"):
        fetch("known")
    monkeypatch.setitem(NETWORKS, "known", replace(NETWORKS["known"], url="http://127.0.0.1:9/known.onnx"))
    with pytest.raises(InputError, match="cannot be downloaded .*refused"):
        fetch("known")


def test_every_network_that_is_fetched_has_a_hash_and_a_secure_address(empty_cache: Path) -> None:
    for name, weights in NETWORKS.items():
        assert weights.licence and weights.page.startswith("https://"), name
        if weights.url:
            assert weights.url.startswith("https://") and weights.url.endswith(weights.file), name
            assert weights.sha256 and len(bytes.fromhex(weights.sha256)) == 32, name
    with pytest.raises(InputError, match="The network rife .* is not on this machine"):
        find_or_fetch("rife", None, consent=True)
