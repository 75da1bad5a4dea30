"""The real Blender with a window: import, click Train, watch, click Cancel."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2].parent / "shared" / "real-blender"
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
REAL = CACHE / "swag_splatting" / "real-blender"

pytestmark = [
    pytest.mark.skipif(not TOOLS.exists(), reason=f"{TOOLS} is absent: no real Blender can be set up"),
    pytest.mark.skipif(
        not (REAL / "usr/bin/blender").exists(), reason=f"no real Blender in {REAL}: run {TOOLS}/setup {REAL}"
    ),
]


@pytest.fixture(scope="module")
def shared_python():
    """This Python as the real Blender's folder sees it."""
    prefix = Path(sys.prefix).resolve()
    # Hard links: cheap to make again. Left there, they would keep gigabytes of an environment that has been deleted.
    links = f"{REAL}{prefix}"
    shutil.rmtree(links, ignore_errors=True)
    subprocess.run(["bash", str(TOOLS / "share-venv"), str(REAL), sys.prefix], check=True)
    yield str(prefix / "bin" / "python")
    shutil.rmtree(links)


@pytest.fixture
def place(extension_zip, tiny_scene):
    """A folder inside the real Blender's root with zip and scene; its paths there begin with /gui/test."""
    folder = REAL / "gui" / "test"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(tiny_scene, folder / "scene")
    shutil.copy(extension_zip, folder / "extension.zip")
    shutil.copy(Path(__file__).with_name("window.py"), folder)
    return folder


def test_train_and_cancel_with_the_pointer(place, shared_python, tmp_path):
    environment = {
        "SWAG_ENGINE_PYTHON": shared_python,
        "SWAG_ZIP": "/gui/test/extension.zip",
        "SWAG_SCENE": "/gui/test/scene",
        "SWAG_OUT": "/gui/test",
        "SWAG_CACHE_DIR": "/gui/test/cache",
        "BLENDER_USER_RESOURCES": "/gui/test/user",
    }
    script = Path(__file__).with_name("real_window.py")
    done = subprocess.run(
        ["bash", str(TOOLS / "gui"), str(REAL), str(script), str(tmp_path / "last.png")],
        env=os.environ | environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for picture in place.glob("*.png"):
        shutil.copy(picture, pictures)
    assert (place / "report.json").exists(), printed
    report = json.loads((place / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)
    assert report["version"].startswith("5.2")
    assert not report["imported"]["failed"]
    assert report["imported"]["found"].startswith("10 of 10 photos have a camera, 300 points")
    assert report["training"]["iteration"] > 0 and report["preview"] > 0
    held = sorted(report["held_seconds"][:-1])  # all but the last, which takes in the result
    assert len(held) > 5 and held[-1] < 0.1, f"Blender's window is held up for {held[-1]:.2f} s"
    assert report["went_on_by"] == 0
    assert report["stopping"]
    end = report["end"]
    assert not end["failed"] and end["interrupted"] and end["continue"]
    assert end["message"].startswith("Stopped; kept") and end["points"] == end["gaussians"] > 0
    assert not report["escaped"]["failed"] and report["escaped"]["message"].startswith("Stopped; kept")
    assert report["loaded"]["job"] == "" and report["loaded"]["engines"] == 0
    assert "another file was opened" in report["loaded"]["message"]
    assert len(list(pictures.glob("*.png"))) == 4


def test_command_line_of_the_real_blender(place, shared_python):
    """`blender --background --command swag` gives the engine's words, JSON and exit codes."""
    environment = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "SWAG_ENGINE_PYTHON": shared_python,
        "SWAG_CACHE_DIR": "/gui/test/cache", "BLENDER_USER_RESOURCES": "/gui/test/user",
    }  # fmt: skip

    def blender(*arguments):
        return subprocess.run(
            ["chroot", str(REAL), "blender", "--background", *arguments],
            env=environment, capture_output=True, text=True, timeout=600,
        )  # fmt: skip

    install = blender(
        "--command", "extension", "install-file", "-r", "user_default", "--enable", "/gui/test/extension.zip"
    )
    assert install.returncode == 0, install.stdout + install.stderr
    found = blender("--command", "swag", "inspect", "/gui/test/scene", "--json")
    assert found.returncode == 0, found.stdout + found.stderr
    assert json.loads(found.stdout[found.stdout.index("{") : found.stdout.rindex("}") + 1])["registered"] == 10
    wrong = blender("--command", "swag", "inspect", "/gui/no/such/folder")
    assert wrong.returncode == 2 and "/gui/no/such/folder" in wrong.stdout and "Traceback" not in wrong.stdout
    trained = blender(
        *("--command", "swag", "train", "/gui/test/scene", "--out", "/gui/test/run", "--iterations", "80"),
        *("--width", "64", "--sh-degree", "0"),
    )
    assert trained.returncode == 0, trained.stdout + trained.stderr
    assert "iterations/s" in trained.stdout and "Held-out views: PSNR" in trained.stdout
    assert (REAL / "gui/test/run/result.ply").exists()
