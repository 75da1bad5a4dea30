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


@pytest.fixture(scope="module")
def real_blender(missing):
    """The folder of the real Blender, a root folder of its own with a window system."""
    if not (REAL / "usr/bin/blender").exists():
        missing(f"There is no Blender with a window in {REAL}: run `{TOOLS}/setup {REAL}` (3 minutes, 2 GB).")
    return REAL


@pytest.fixture(scope="module")
def shared_python(real_blender):
    """This Python's path inside the real Blender's folder."""
    prefix = Path(sys.prefix).resolve()
    # Hard links are made quickly. They are removed afterwards, or they would keep a deleted environment on the disk.
    links = f"{real_blender}{prefix}"
    shutil.rmtree(links, ignore_errors=True)
    subprocess.run(["bash", str(TOOLS / "share-venv"), str(real_blender), sys.prefix], check=True)
    yield str(prefix / "bin" / "python")
    shutil.rmtree(links)


@pytest.fixture
def folder(real_blender, extension_zip, tiny_scene):
    """A folder with zip and scene inside the real Blender's root, where its path is /gui/test."""
    folder = real_blender / "gui" / "test"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(tiny_scene, folder / "scene")
    shutil.copy(extension_zip, folder / "extension.zip")
    shutil.copy(Path(__file__).with_name("window.py"), folder)
    return folder


def in_window(script, real_blender, folder, python, tmp_path):
    """Run a script in the real Blender; returns its report and the folder of its pictures."""
    environment = {
        "SWAG_ENGINE_PYTHON": python,
        "SWAG_ZIP": "/gui/test/extension.zip",
        "SWAG_SCENE": "/gui/test/scene",
        "SWAG_OUT": "/gui/test",
        "SWAG_CACHE_DIR": "/gui/test/cache",
        "BLENDER_USER_RESOURCES": "/gui/test/user",
    }
    script = Path(__file__).with_name(script)
    done = subprocess.run(
        ["bash", str(TOOLS / "gui"), str(real_blender), str(script), str(tmp_path / "last.png")],
        env=os.environ | environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for picture in folder.glob("*.png"):
        shutil.copy(picture, pictures)
    assert (folder / "report.json").exists(), printed
    report = json.loads((folder / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)
    return report, pictures


def test_train_and_cancel_with_the_pointer(real_blender, folder, shared_python, tmp_path):
    report, pictures = in_window("real_window.py", real_blender, folder, shared_python, tmp_path)
    assert report["version"].startswith("5.2")
    assert not report["imported"]["failed"]
    assert report["imported"]["found"].startswith("10 of 10 photos have a camera, 300 points")
    assert report["training"]["iteration"] > 0 and report["preview"] > 0
    seconds = sorted(report["blocked_seconds"][:-1])  # without the last, in which the result is imported
    assert len(seconds) > 5 and seconds[-1] < 0.1, f"Blender's window is blocked for {seconds[-1]:.2f} s"
    assert report["iterations_while_paused"] == 0
    assert report["asked first"] and report["stopping"]
    end = report["end"]
    assert not end["failed"] and end["interrupted"] and end["continue"]
    assert end["message"].startswith("Stopped; kept") and end["points"] == end["gaussians"] > 0
    assert report["after_opening"]["job"] == "" and report["after_opening"]["engines"] == 0
    assert "another file was opened" in report["after_opening"]["message"]
    assert len(list(pictures.glob("*.png"))) == 4


def test_dialogs_undo_and_failures_in_the_window(real_blender, folder, shared_python, tmp_path):
    report, _ = in_window("real_window_mended.py", real_blender, folder, shared_python, tmp_path)
    assert report["dialog closed"] == ""
    assert report["import failed"]["shading"] == "SOLID" and "no/such/folder" in report["import failed"]["message"]
    assert report["imported"]["shading"] == "MATERIAL"
    assert "Select two objects" in report["one selected"]
    assert report["scaled"]["shown"] == "2 m" and abs(report["scaled"]["metres apart"] - 2) < 1e-4
    kept = report["undone"]
    assert kept["object is back"] and kept["job"] == "Training"
    assert kept["run"] == report["run"] and kept["plan"] == report["plan"] > 0
    assert report["after escape"] == "Training"
    assert report["asked first"] and report["stopped"].startswith("Stopped; kept")
    assert report["continues"] == report["run"]
    assert report["repeated"]["seconds"] < 5 and report["repeated"]["job"] == "" and report["repeated"]["runs"] == 1
    assert not {"train", "plan", "import_scene"} & set(report["repeatable"])
    assert "choose another folder" in report["not writable"]
    assert "(signal 15)" in report["terminated"] and "press Continue" in report["terminated"]
    assert "lacks the package" in report["missing"] and "Install Engine" in report["missing"]


def test_command_line_of_the_real_blender(real_blender, folder, shared_python):
    """`blender --background --command swag` gives the engine's messages, JSON and exit codes."""
    environment = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "SWAG_ENGINE_PYTHON": shared_python,
        "SWAG_CACHE_DIR": "/gui/test/cache", "BLENDER_USER_RESOURCES": "/gui/test/user",
    }  # fmt: skip

    def blender(*arguments):
        return subprocess.run(
            ["chroot", str(real_blender), "blender", "--background", *arguments],
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
    assert "iterations/s" in trained.stdout and "Test views: PSNR" in trained.stdout
    assert (folder / "run/result.ply").exists()
