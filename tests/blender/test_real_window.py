"""The real Blender with a window and the engine: import, click Train, watch, click Cancel."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.blender.real_blender import TOOLS, in_window, new_folder, viewport_picture
from tests.blender.splat_pictures import psnr
from tests.scenes.panels import write_photos
from tests.scenes.tiny import make_tiny_scene


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
    """A folder with extension and scene inside the real Blender's root."""
    folder = new_folder(real_blender, extension_zip)
    shutil.copytree(tiny_scene, folder / "scene")
    return folder


def test_train_and_cancel_with_the_pointer(real_blender, folder, shared_python):
    report = in_window(
        "real_window.py", real_blender, folder,
        size=(900, 800), SWAG_ENGINE_PYTHON=shared_python, SWAG_SCENE="/gui/test/scene",
    )  # fmt: skip
    assert report["version"].startswith("5.2")
    assert not report["imported"]["failed"]
    assert report["imported"]["found"].startswith("10 of 10 photos have a camera, 300 points")
    checked = report["checked"]
    assert checked["windows"] == 1 and not checked["failed"] and checked["message"].startswith("10 of 10 photos")
    assert report["training"]["iteration"] > 0 and report["preview"] > 0
    seconds = sorted(report["blocked_seconds"][:-1])  # without the last, in which the result is imported
    assert len(seconds) > 5 and seconds[-1] < 0.1, f"Blender's window is blocked for {seconds[-1]:.2f} s"
    assert report["iterations_while_paused"] == 0
    assert report["asked first"]
    end = report["end"]
    assert not end["failed"] and end["interrupted"] and end["continue"]
    assert end["message"].startswith("Stopped; kept") and end["points"] == end["gaussians"] > 0
    assert report["after_opening"]["job"] == "" and report["after_opening"]["engines"] == 0
    assert "another file was opened" in report["after_opening"]["message"]
    # When a training ends, its result is shown without anything else being done.
    shown, anew = (viewport_picture(folder, name, report["viewport"]) for name in ("trained", "trained, drawn anew"))
    rows, columns = np.nonzero((shown != anew).any(-1))
    where = f"rows {rows.min()} to {rows.max()}, columns {columns.min()} to {columns.max()}" if len(rows) else "nowhere"
    uploads = report["uploaded at the end of training"], report["uploaded anew"]
    assert shown.std() > 0.05 and psnr(shown, anew) > 50, f"the pictures differ in {where}; uploads: {uploads}"


def test_find_cameras_of_photos_that_are_chosen_in_the_file_browser(real_blender, folder, shared_python):
    write_photos(folder / "data" / "photos", np.linspace(-1.5, 1.5, 24))
    report = in_window(
        "find_cameras_window.py", real_blender, folder,
        size=(900, 700), SWAG_ENGINE_PYTHON=shared_python, SWAG_PHOTOS="/gui/test/data/photos",
    )  # fmt: skip
    assert report["cancelled"] == {
        "message": "Find Cameras was stopped; nothing was written.",
        "failed": False,
        "left": ["photos"],
        "objects": 0,
        "shading": "SOLID",
    }
    found = report["found"]
    assert not found["failed"] and found["folder"] == "/gui/test/data/photos_scene"
    assert found["lines"][0].startswith("6 of 6 photos have a camera") and found["message"].startswith("6 of 6")
    assert found["cameras"] == 6 and found["points"] > 100 and found["shading"] == "SOLID"
    assert all(found["in view"]) and found["size of the scene in the view"] > 0.2


def test_dialogs_undo_and_failures_in_the_window(real_blender, folder, shared_python):
    report = in_window(
        "real_window_mended.py", real_blender, folder,
        size=(900, 700), SWAG_ENGINE_PYTHON=shared_python, SWAG_SCENE="/gui/test/scene",
    )  # fmt: skip
    assert report["dialog closed"] == ""
    assert report["import failed"]["shading"] == "SOLID" and "no/such/folder" in report["import failed"]["message"]
    assert report["imported"]["shading"] == "SOLID"
    assert "Select two objects" in report["one selected"]
    assert report["scaled"]["shown"] == "2 m" and abs(report["scaled"]["metres apart"] - 2) < 1e-4
    kept = report["undone"]
    assert kept["object is back"] and kept["job"] == "Training"
    assert kept["run"] == report["run"] and kept["plan"] == report["plan"] > 0
    assert report["after escape"] == "Training"
    assert report["asked first"] and report["stopped"].startswith("Stopped; kept")
    assert report["continues"] == report["run"]
    assert report["repeated"]["seconds"] < 60 and report["repeated"]["job"] == "" and report["repeated"]["runs"] == 1
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


def test_photos_are_compared_with_splats_a_film_is_cancelled_and_nothing_of_it_stays(
    real_blender, folder, shared_python, finished_run
):
    scene = folder / "photos"
    make_tiny_scene(scene, width=640, height=480)
    shutil.copy(finished_run / "result.ply", folder)
    report = in_window(
        "films_window.py", real_blender, folder,
        SWAG_ENGINE_PYTHON=shared_python, SWAG_SCENE="/gui/test/photos", SWAG_PLY="/gui/test/result.ply",
    )  # fmt: skip
    for step, name, photo, place in (
        ("first", "wipe-1", "view_00.png", 0.5), ("third", "wipe-2", "view_02.png", 0.75),
    ):  # fmt: skip
        found = report[step]
        assert found["photo"] == photo and found["place"] == pytest.approx(place, abs=0.01)
        left, top, right, bottom = found["frame"]
        screen = cv2.imread(str(folder / f"{name}.bmp")).astype(float)
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
