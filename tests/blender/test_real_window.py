"""The real Blender with a window: import, click Train, watch, click Cancel."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.formats.ply import write_ply
from swag_engine.kernels.backends import KERNELS
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import sh_basis
from tests.scenes.panels import write_photos
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


def test_find_cameras_of_photos_that_are_chosen_in_the_file_browser(real_blender, folder, shared_python, tmp_path):
    write_photos(folder / "data" / "photos", np.linspace(-1.5, 1.5, 24))
    environment = {
        "SWAG_ENGINE_PYTHON": shared_python,
        "SWAG_ZIP": "/gui/test/extension.zip",
        "SWAG_PHOTOS": "/gui/test/data/photos",
        "SWAG_OUT": "/gui/test",
        "SWAG_CACHE_DIR": "/gui/test/cache",
        "BLENDER_USER_RESOURCES": "/gui/test/user",
    }
    script = Path(__file__).with_name("find_cameras_window.py")
    done = subprocess.run(
        ["bash", str(TOOLS / "gui"), str(real_blender), str(script), str(tmp_path / "last.png")],
        env=os.environ | environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    assert (folder / "report.json").exists(), printed
    report = json.loads((folder / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)
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
    assert found["cameras"] == 6 and found["points"] > 100 and found["shading"] == "MATERIAL"
    assert all(found["in view"]) and found["size of the scene in the view"] > 0.2


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


@pytest.fixture(scope="module", params=["OPENGL", "VULKAN"])
def viewport_pictures(request, real_blender, extension_zip, tmp_path_factory, missing):
    """Report of real_window_viewport.py and its pictures (H, W, 3) in 0..1, of the viewport's region alone."""
    if request.param == "VULKAN" and not (real_blender / "usr/share/vulkan/icd.d/lvp_icd.json").exists():
        install = f"chroot {real_blender} apt-get install mesa-vulkan-drivers"
        missing(f"There is no Vulkan in {real_blender}: run `{install}`.")
    folder = real_blender / "gui" / "viewport"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copy(extension_zip, folder / "extension.zip")
    shutil.copy(Path(__file__).with_name("window.py"), folder)
    write_ply(folder / "splats.ply", cloud())
    (folder / "water.json").write_text(json.dumps(WATER))
    environment = {
        "SWAG_ZIP": "/gui/viewport/extension.zip", "SWAG_OUT": "/gui/viewport",
        "BLENDER_USER_RESOURCES": "/gui/viewport/user",
    }  # fmt: skip
    done = subprocess.run(
        ["bash", str(TOOLS / "gui"), str(real_blender), str(Path(__file__).with_name("real_window_viewport.py")),
         str(tmp_path_factory.mktemp("viewport") / "last.png"), "--gpu-backend", request.param.lower()],
        env=os.environ | environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    assert (folder / "report.json").exists(), printed
    report = json.loads((folder / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)
    assert report["backend"] == request.param
    x, y, width, height = report["region"]
    pictures = {}
    for name in report["pictures"]:
        whole = cv2.imread(str(folder / f"{name}.png"))[..., ::-1] / 255
        pictures[name] = whole[len(whole) - y - height : len(whole) - y, x : x + width]
    return report, pictures


BACKGROUND = np.array([0.05, 0.1, 0.2])
"""Linear light of the viewport's background in real_window_viewport.py."""
WATER = {
    "beta_D": [0.09, 0.04, 0.03], "beta_B": [0.07, 0.05, 0.06],
    "veil_sh": [[-2.0, 1.0, 2.0], *np.random.default_rng(4).normal(size=(8, 3)).round(3).tolist()],
    "light": "linear", "per": "unit",
}  # fmt: skip


def cloud():
    """4000 splats of SH degree 3 in a box, of all sizes, opacities and proportions."""
    random = np.random.default_rng(2)
    count = 4000
    rotations = random.normal(size=(count, 4))
    return Splats(
        random.uniform(-3, 3, (count, 3)).astype("f4"),
        (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype("f4"),
        np.exp(random.uniform(-5, -1.2, (count, 3))).astype("f4"),
        random.uniform(0.05, 1, count).astype("f4"),
        (random.normal(size=(count, 16, 3)) * np.array([1.0, *[0.2] * 15])[:, None]).astype("f4"),
    )


def engine_picture(report, name, keep=None, water=False, degree=3, change=lambda colors: colors):
    """The engine's picture (H, W, 3) of the cloud for the matrices of a viewport's picture.

    Args:
        report: of real_window_viewport.py.
        name: of the picture.
        keep: mask (4000,) of the splats to draw; None for all.
        water: whether it is seen through WATER.
        degree: of spherical harmonics.
        change: applied to the display values (N, 3) of the splats.
    """
    splats, shown = cloud(), report["pictures"][name]
    if keep is not None:
        splats = splats.subset(keep)
    projection, to_view = np.array(shown["projection"]), np.array(shown["view"])
    width, height = report["region"][2:]
    fx, fy = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    cx, cy = (1 - projection[0, 2]) * width / 2, (1 + projection[1, 2]) * height / 2
    if projection[3, 3] == 1:  # parallel rays: seen from very far with a very long lens
        far = 1e3
        to_view[2, 3] -= far
        fx, fy = fx * far, fy * far
        centre = to_view @ np.array([0, 0, 0, 1])
        fx, fy = fx * -centre[2] / far, fy * -centre[2] / far
    to_view = np.diag([1.0, -1, -1, 1]) @ to_view
    eye = np.linalg.inv(to_view)[:3, 3]
    rays = splats.positions - eye
    ranges = np.linalg.norm(rays, axis=1, keepdims=True)
    basis = sh_basis(rays / ranges, degree)
    colors = change(np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, splats.sh[:, : basis.shape[1]]), 0))
    background = linear_to_srgb(BACKGROUND)
    if water:
        lights = open_water(rays / ranges)
        transmission, gained = np.exp(-ranges * WATER["beta_D"]), 1 - np.exp(-ranges * WATER["beta_B"])
        colors = linear_to_srgb(srgb_to_linear(colors) * transmission + lights * gained)
    kernels = KERNELS["cpu"]
    tensor = lambda values: torch.tensor(np.asarray(values), dtype=torch.float32)  # noqa: E731
    intrinsics = tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    opacities, colors = tensor(splats.opacities), tensor(colors)
    projected = kernels.project(
        tensor(splats.positions), tensor(splats.rotations), tensor(splats.scales), opacities, colors,
        tensor(to_view), intrinsics, width, height,
    )  # fmt: skip
    image, alpha = kernels.blend(projected, opacities, colors, tensor(background), width, height)
    image, alpha = image.numpy(), alpha.numpy()[..., None]
    if water:
        v, u = np.mgrid[:height, :width] + 0.5
        directions = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) @ to_view[:3, :3]
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        behind = linear_to_srgb(open_water(directions.reshape(-1, 3))).reshape(height, width, 3)
        image = image + (1 - alpha) * (behind - background)
    return np.clip(image, 0, 1)


def open_water(directions):
    """Background light (N, 3) along unit directions (N, 3)."""
    return 1 / (1 + np.exp(-sh_basis(directions, 2) @ np.array(WATER["veil_sh"])))


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


@pytest.mark.parametrize(
    "name", ["solid", "turned", "wireframe", "camera", "orthographic", "water", "instance", "separated"]
)
def test_viewport_shows_the_engines_picture(viewport_pictures, name):
    report, pictures = viewport_pictures
    shown, wanted = pictures[name], engine_picture(report, name, water=name == "water")
    inside = (slice(30, -5), slice(5, -5))  # without the rounded corners of the region
    assert np.ptp(wanted[inside]) > 0.5
    found = psnr(shown[inside], wanted[inside])
    assert found > (35 if name == "orthographic" else 38), found


def test_selection_exposure_and_degree_change_the_colors(viewport_pictures):
    report, pictures = viewport_pictures
    inside = (slice(30, -5), slice(5, -5))
    tint, amount = linear_to_srgb(np.array([1.0, 0.45, 0.0])), 0.6  # the orange of Blender's own selection
    selected = np.arange(4000)[:, None] < 1000
    wanted: dict[str, dict[str, Any]] = {
        "selected": {"change": lambda colors: np.where(selected, colors + (tint - colors) * amount, colors)},
        "exposed": {"change": lambda colors: linear_to_srgb(2 * srgb_to_linear(colors))},
        "degree_1": {"degree": 1},
    }
    plain = engine_picture(report, "selected")[inside]
    for name, how in wanted.items():
        assert psnr(pictures[name][inside], engine_picture(report, name, **how)[inside]) > 38, name
        assert psnr(pictures[name][inside], plain) < 36, name


def test_crop_boxes_clipping_and_density_leave_splats_out(viewport_pictures):
    report, pictures = viewport_pictures
    inside = (slice(30, -5), slice(5, -5))
    positions = cloud().positions
    world = positions @ np.array(report["world"])[:3, :3].T + np.array(report["world"])[:3, 3]
    kept = {"cropped": (np.abs(positions) <= (1.5, 2, 1)).all(axis=1), "clipped": world[:, 0] < 1}
    for name, keep in kept.items():
        assert 200 < keep.sum() < 3500
        assert psnr(pictures[name][inside], engine_picture(report, name, keep=keep)[inside]) > 38, name
    # Fewer splats cover less of the background.
    covered = {n: (np.abs(pictures[n][inside] - pictures[n][40, 10]) > 0.02).mean() for n in ("solid", "thinned")}
    assert 0.3 < covered["thinned"] / covered["solid"] < 0.95, covered


def test_hidden_objects_and_local_view(viewport_pictures):
    report, pictures = viewport_pictures
    even = np.arange(4000) % 2 == 0
    for name in ("half", "local_view"):
        assert psnr(pictures[name], engine_picture(report, name, keep=even)) > 38
    assert psnr(pictures["deleted"], engine_picture(report, "deleted", keep=~even)) > 38
    assert psnr(pictures["undone"], pictures["separated"]) > 45, "undo shows the deleted splats again"
    for name in ("after", "enabled"):
        assert psnr(pictures[name], pictures["separated"]) > 45, name


def test_a_mesh_hides_the_splats_behind_it(viewport_pictures):
    report, pictures = viewport_pictures
    to_view = np.array(report["pictures"]["wall"]["view"])
    depths = -(cloud().positions @ to_view[2, :3] + to_view[2, 3])
    wanted = engine_picture(report, "wall", keep=depths < report["wall_depth"])
    inside = (slice(30, -5), slice(5, -5))
    assert psnr(pictures["wall"][inside], wanted[inside]) > 38


def test_nothing_is_left_on_the_graphics_card(viewport_pictures):
    report, _ = viewport_pictures
    assert report["shading"] == "SOLID" and report["display"] == "BOUNDS"
    assert report["windows"] == 2 and report["views"] == 2
    assert report["after_disabling"] == report["after_removing"] == report["after_new_file"] == 0
    assert report["after_opening"] and not report["failed"]


def test_a_turning_view_uploads_no_splats_and_a_resting_one_draws_nothing(viewport_pictures):
    turned = viewport_pictures[0]["turned"]
    assert viewport_pictures[0]["frames_at_rest"] == 0
    # Order and depth as 4 bytes each; orders fill whole rows of 16384 texels.
    assert turned["bytes"] <= turned["frames"] * 1.5 * (4 * turned["pixels"] + 4 * 16384 + 4096), turned


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


def test_splats_are_selected_with_the_pointer_deleted_and_brought_back(real_blender, extension_zip, tmp_path):
    folder = real_blender / "gui" / "editing"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copy(extension_zip, folder / "extension.zip")
    shutil.copy(Path(__file__).with_name("window.py"), folder)
    write_ply(folder / "splats.ply", cloud())
    environment = {
        "SWAG_ZIP": "/gui/editing/extension.zip", "SWAG_OUT": "/gui/editing",
        "BLENDER_USER_RESOURCES": "/gui/editing/user",
    }  # fmt: skip
    script = Path(__file__).with_name("editing_window.py")
    done = subprocess.run(
        ["bash", str(TOOLS / "gui"), str(real_blender), str(script), str(tmp_path / "last.png")],
        env=os.environ | environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    assert (folder / "report.json").exists(), printed
    report = json.loads((folder / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)
    pixels = np.array(report["pixels"])

    def within(left, bottom, right, top, margin):
        low, high = np.array([left, bottom]) - margin, np.array([right, top]) + margin
        return set(np.flatnonzero((pixels > low).all(axis=1) & (pixels < high).all(axis=1)).tolist())

    left, bottom, right, top = report["box"]
    boxed = set(report["boxed"])
    assert within(left, bottom, right, top, -3) <= boxed <= within(left, bottom, right, top, 3) and len(boxed) > 200
    rest = set(report["without inner box"])
    inner = left + 60, bottom + 40, right - 40, top - 60
    assert rest < boxed and not rest & within(*inner, -3) and boxed - rest <= within(*inner, 3)
    assert report["after escape"] == len(rest) and report["tools in use"] == 0
    assert report["left"] == 4000 - len(rest) and report["after undo"] == 4000
    # The viewport shows the splats that are left.
    x, y, width, height = report["region"]
    whole = cv2.imread(str(folder / "deleted.png"))[..., ::-1] / 255
    shown = whole[len(whole) - y - height : len(whole) - y, x : x + width]
    wanted = engine_picture(report, "deleted", keep=~np.isin(np.arange(4000), sorted(rest)))
    inside = (slice(30, -5), slice(5, -5))
    assert psnr(shown[inside], wanted[inside]) > 38
