"""The real Blender with a window: import, click Train, watch, click Cancel."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.scenes.tiny import make_tiny_scene

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


def test_train_and_cancel_with_the_pointer(real_blender, folder, shared_python, tmp_path):
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
    assert report["version"].startswith("5.2")
    assert not report["imported"]["failed"]
    assert report["imported"]["found"].startswith("10 of 10 photos have a camera, 300 points")
    assert report["training"]["iteration"] > 0 and report["preview"] > 0
    seconds = sorted(report["blocked_seconds"][:-1])  # without the last, in which the result is imported
    assert len(seconds) > 5 and seconds[-1] < 0.1, f"Blender's window is blocked for {seconds[-1]:.2f} s"
    assert report["iterations_while_paused"] == 0
    assert report["stopping"]
    end = report["end"]
    assert not end["failed"] and end["interrupted"] and end["continue"]
    assert end["message"].startswith("Stopped; kept") and end["points"] == end["gaussians"] > 0
    assert not report["escaped"]["failed"] and report["escaped"]["message"].startswith("Stopped; kept")
    assert report["after_opening"]["job"] == "" and report["after_opening"]["engines"] == 0
    assert "another file was opened" in report["after_opening"]["message"]
    assert len(list(pictures.glob("*.png"))) == 4


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


def test_photos_are_compared_with_splats_a_film_is_cancelled_and_nothing_of_it_stays(
    real_blender, folder, shared_python, finished_run, tmp_path
):
    scene = folder / "photos"
    make_tiny_scene(scene, width=640, height=480)
    shutil.copy(finished_run / "result.ply", folder)
    environment = {
        "SWAG_ENGINE_PYTHON": shared_python,
        "SWAG_ZIP": "/gui/test/extension.zip",
        "SWAG_SCENE": "/gui/test/photos",
        "SWAG_PLY": "/gui/test/result.ply",
        "SWAG_OUT": "/gui/test",
        "SWAG_CACHE_DIR": "/gui/test/cache",
        "BLENDER_USER_RESOURCES": "/gui/test/user",
    }
    script = Path(__file__).with_name("films_window.py")
    done = subprocess.run(
        ["bash", str(TOOLS / "gui"), str(real_blender), str(script), str(tmp_path / "last.png")],
        env=os.environ | environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    for picture in folder.glob("*.png"):
        shutil.copy(picture, tmp_path)
    assert (folder / "report.json").exists(), printed
    report = json.loads((folder / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)

    for step, name, photo, place in (
        ("first", "wipe-1", "view_00.png", 0.5), ("third", "wipe-2", "view_02.png", 0.75),
    ):  # fmt: skip
        found = report[step]
        assert found["photo"] == photo and found["place"] == pytest.approx(place, abs=0.01)
        left, top, right, bottom = found["frame"]
        screen = cv2.imread(str(tmp_path / f"{name}.png")).astype(float)
        own = cv2.imread(str(scene / "images" / photo)).astype(float)
        # Discs of the photo that are away from line and text, at their place and in their display values.
        errors: dict[str, list[float]] = {"photo": [], "splats": []}
        for x in np.linspace(0.05, 0.95, 60):
            for y in np.linspace(0.05, 0.85, 40):
                u, v = int(x * 640), int(y * 480)
                patch = own[v - 4 : v + 5, u - 4 : u + 5].reshape(-1, 3)
                if np.ptp(patch, axis=0).max() > 2 or abs(x - place) < 0.03 or abs(y - 0.5) < 0.03:
                    continue
                seen = screen[round(top + y * (bottom - top)), round(left + x * (right - left))]
                errors["photo" if x < place else "splats"].append(np.abs(seen - patch[40]).max())
        assert len(errors["photo"]) > 50 and np.median(errors["photo"]) <= 2, np.median(errors["photo"])
        assert np.mean(np.array(errors["photo"]) <= 3) > 0.95
        assert np.median(errors["splats"]) > 5, "the photo ends at the line"
    assert not report["running"] and not report["running after disable"]
    assert report["after"] == report["before"] == report["at the end"]
    film = report["film"]
    assert film["message"].startswith("Stopped after") and "of 2000 frames" in film["message"], film
    assert not film["failed"] and film["frame"] == 1
    written = sum(path.suffix == ".png" for path in (folder / "film").iterdir())
    assert 0 < written < 2000 and f"after {written} of" in film["message"]
    assert "llvmpipe" in report["warning"] and "640 x 480 pixels with 32 samples take about 8 min" in report["warning"]
