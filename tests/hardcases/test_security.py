"""Input is data: never executed, never a path out of its folder, never markup."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from swag_engine.base.errors import InputError
from swag_engine.experiments.evaluate_run import evaluate_run, render_run
from swag_engine.scene.colmap import load_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.tiny import make_tiny_scene

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [
    path for folder in ("swag_engine", "swag_blender", "operators") for path in sorted((ROOT / folder).rglob("*.py"))
]
RUNS_CODE = {"pickle", "cPickle", "dill", "joblib", "marshal", "shelve", "cloudpickle", "code", "codeop", "runpy"}
UNPACKS = {"tarfile", "bz2", "lzma"}
LISTENS = {"socketserver", "http.server", "xmlrpc", "socket", "asyncio"}
CALLS = {"eval", "exec", "compile", "__import__"}


def imports(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module)
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_executes_data_unpacks_archives_or_listens(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not {name for name in imports(tree) if {name, name.split(".")[0]} & (RUNS_CODE | UNPACKS | LISTENS)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        assert called not in CALLS, f"{called} in line {node.lineno}"
        assert called not in ("torch.load", "torch.save", "os.system", "os.popen", "yaml.load"), called
        named = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        assert named.get("shell", "False") == "False", f"a shell in line {node.lineno}"
        assert named.get("allow_pickle", "False") == "False", f"a pickle in line {node.lineno}"
        assert called.split(".")[-1] not in ("extract", "extractall", "unpack_archive"), f"line {node.lineno} unpacks"


def test_the_worker_ends_when_its_pipe_is_closed(tmp_path):
    """It takes requests from nowhere else: with the pipe closed at once it ends and prints nothing."""
    done = subprocess.run(
        [sys.executable, "-m", "swag_engine.app.worker"],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=60,
    )
    assert done.returncode == 0 and done.stdout == b""


@pytest.fixture(scope="module")
def hostile_run(tmp_path_factory):
    """A run of a scene whose image names are markup."""
    folder = tmp_path_factory.mktemp("hostile")
    scene = make_tiny_scene(folder / "scene <b>&", views=4, width=32, height=24, points=60)
    model = scene / "sparse" / "0" / "images.txt"
    name = "<img src=x onerror=alert(1)>.png"
    os.rename(scene / "images" / "view_00.png", scene / "images" / name)
    text = model.read_text().replace("view_00.png", name)
    model.write_text(text)
    train(scene, folder / "run", TrainSettings(iterations=3, width=32, max_gaussians=80, sh_degree=0))
    evaluate_run(folder / "run")
    return folder / "run"


def test_names_are_escaped(hostile_run):
    pages = list(hostile_run.glob("*.html"))
    assert pages
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert "<img src=x" not in text and "scene <b>" not in text, page.name
    assert any("&lt;img src=x onerror" in page.read_text(encoding="utf-8") for page in pages)
    json.loads((hostile_run / "evaluation.json").read_text())


@pytest.mark.parametrize("name", ["../../outside.png", "/outside.png", "..\\..\\outside.png", "C:\\outside.png"])
def test_image_names_do_not_lead_out_of_a_folder(tmp_path, name):
    """Renders are written under the names of images, which a model can choose."""
    scene = make_tiny_scene(tmp_path / "scene", views=4, width=32, height=24, points=60)
    model = scene / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("view_00.png", name))
    # Only the last part of a name counts when images are looked for.
    (scene / "images" / "view_00.png").rename(scene / "images" / "outside.png")
    train(scene, tmp_path / "run", TrainSettings(iterations=2, width=32, max_gaussians=80))
    (view,) = [view for view in load_scene(scene).views if view.path.name == "outside.png"]
    (file,) = render_run(tmp_path / "run", tmp_path / "a" / "b" / "pictures", view.name)
    assert file.name == "outside.png" and file.resolve().is_relative_to(tmp_path / "a" / "b" / "pictures")
    assert not (tmp_path / "a" / "outside.png").exists() and not (tmp_path / "outside.png").exists()


def test_two_names_for_one_file_are_refused(tmp_path):
    scene = make_tiny_scene(tmp_path / "scene", views=4, width=32, height=24, points=60)
    model = scene / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("view_00.png", "../view_01.png"))
    with pytest.raises(InputError, match="two photos the same name"):
        load_scene(scene)
