"""What viewports of the real Blender draw, against the engine's picture, and editing with the pointer."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.formats.ply import write_ply
from swag_engine.kernels.backends import KERNELS
from swag_engine.splats.development import Development, white_balance
from swag_engine.splats.haze import with_haze
from swag_engine.splats.splats import LEAST_VARIANCE, Splats
from swag_engine.splats.transform import sh_basis
from tests.blender.real_blender import in_window, new_folder, viewport_picture
from tests.blender.splat_pictures import psnr


@pytest.fixture(scope="module", params=["OPENGL", "VULKAN"])
def viewport_pictures(request, real_blender, extension_zip, missing):
    """Report of real_window_viewport.py and its pictures (H, W, 3) in 0..1, of the viewport's region alone."""
    if request.param == "VULKAN" and not (real_blender / "usr/share/vulkan/icd.d/lvp_icd.json").exists():
        install = f"chroot {real_blender} apt-get install mesa-vulkan-drivers"
        missing(f"There is no Vulkan in {real_blender}: run `{install}`.")
    folder = new_folder(real_blender, extension_zip, "viewport")
    write_ply(folder / "splats.ply", cloud())
    (folder / "water.json").write_text(json.dumps(WATER))
    (folder / "attenuation.json").write_text(json.dumps(ATTENUATION))
    (folder / "development.json").write_text(json.dumps(DEVELOPMENT.to_json()))
    report = in_window(
        "real_window_viewport.py", real_blender, folder, "--gpu-backend", request.param.lower(), size=(600, 450)
    )
    assert report["backend"] == request.param
    return report, {name: viewport_picture(folder, name, report["region"]) for name in report["pictures"]}


BACKGROUND = np.array([0.05, 0.1, 0.2])
"""Linear light of the viewport's background in real_window_viewport.py."""
COLOR = (0.3, 0.5, 0.6)
"""sRGB color behind the splats that the run has there."""
WATER = {
    "beta_D": [0.09, 0.04, 0.03], "beta_B": [0.07, 0.05, 0.06],
    "background_sh": [[-2.0, 1.0, 2.0], *np.random.default_rng(4).normal(size=(8, 3)).round(3).tolist()],
    "light": "linear", "per": "unit",
}  # fmt: skip
ATTENUATION = WATER | {"background_sh": [[-100.0] * 3, *[[0.0] * 3] * 8]}
"""Water that adds no light."""

DEVELOPMENT = Development(0.6, (1.2, 1.0, 0.8), 1.1, ((1.1, -0.1, 0.0), (0.0, 1.0, 0.0), (0.0, -0.1, 1.1)), knee=0.7)


def cloud():
    """4000 splats of SH degree 3 in a box, of all sizes, opacities and proportions; some are haze."""
    random = np.random.default_rng(2)
    count = 4000
    rotations = random.normal(size=(count, 4))
    haze = np.where(np.arange(count) % 8, 0, 0.9).astype("f4")
    return Splats(
        random.uniform(-3, 3, (count, 3)).astype("f4"),
        (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype("f4"),
        np.exp(random.uniform(-5, -1.2, (count, 3))).astype("f4"),
        random.uniform(0.05, 1, count).astype("f4") * (1 - haze),
        (random.normal(size=(count, 16, 3)) * np.array([1.0, *[0.2] * 15])[:, None]).astype("f4"),
        {"haze": haze},
    )


def engine_picture(
    report, name, keep=None, water=None, amount=1.0, color=None, degree=3, change=lambda colors: colors, develop=None,
    pixel_size=0.0, haze=0.0,
):  # fmt: skip
    """The engine's picture (H, W, 3) of the cloud for the matrices of a viewport's picture.

    Args:
        report: of real_window_viewport.py.
        name: of the picture.
        keep: mask (4000,) of the splats to draw; None for all.
        water: that it is seen through, as in water.json; None for none. Its open water is behind the splats.
        amount: fraction of the water.
        color: sRGB color behind the splats in place of open water and of the viewport's own background.
        degree: of spherical harmonics.
        change: applied to the display values (N, 3) of the splats.
        develop: Development of the picture, without the viewport's own background.
        pixel_size: 1 / focal length of the training images, pixels.
        haze: fraction of the haze that is shown, without water.
    """
    splats, shown = with_haze(cloud(), amount if water else haze), report["pictures"][name]
    if keep is not None:
        splats = splats.subset(keep)
    projection, to_view = np.array(shown["projection"]), np.array(shown["view"])
    width, height = report["region"][2:]
    fx, fy = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    cx, cy = (1 - projection[0, 2]) * width / 2, (1 + projection[1, 2]) * height / 2
    parallel = projection[3, 3] == 1
    to_view = np.diag([1.0, -1, -1, 1]) @ to_view
    eye = np.linalg.inv(to_view)[:3, 3]
    rays = np.tile(to_view[2, :3], (len(splats), 1)) if parallel else splats.positions - eye
    if parallel:  # all splats lie before the camera
        to_view[2, 3] += 1e3
    ranges = np.linalg.norm(rays, axis=1, keepdims=True)
    basis = sh_basis(rays / ranges, degree)
    colors = change(np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, splats.sh[:, : basis.shape[1]]), 0))
    background = linear_to_srgb(BACKGROUND) if color is None else np.array(color)
    if water:
        lights = amount * open_water(rays / ranges, water)
        path = ranges * amount
        transmission, gained = np.exp(-path * water["beta_D"]), 1 - np.exp(-path * water["beta_B"])
        colors = linear_to_srgb(srgb_to_linear(colors) * transmission + lights * gained)
    kernels = KERNELS["cpu"]
    tensor = lambda values: torch.tensor(np.asarray(values), dtype=torch.float32)  # noqa: E731
    intrinsics = tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    opacities, colors = tensor(splats.opacities), tensor(colors)
    projected = kernels.project(
        tensor(splats.positions), tensor(splats.rotations), tensor(splats.scales), opacities, colors,
        tensor(to_view), intrinsics, width, height, kind="orthographic" if parallel else "perspective",
    )  # fmt: skip
    if pixel_size:
        finest = fy / projected.depths * tensor(splats.scales.min(axis=1)) / LEAST_VARIANCE**0.5
        blur = (0.3 * finest.clamp(min=1).clamp(max=fy * pixel_size) ** 2).clamp(min=0.1)
        projected = replace(projected, conics=widened(projected.conics, blur - 0.3))
    image, alpha = kernels.blend(projected, opacities, colors, tensor(background), width, height)
    image, alpha = image.numpy(), alpha.numpy()[..., None]
    if water and color is None:
        v, u = np.mgrid[:height, :width] + 0.5
        directions = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) @ to_view[:3, :3]
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        behind = linear_to_srgb(amount * open_water(directions.reshape(-1, 3), water)).reshape(height, width, 3)
        image = image + (1 - alpha) * (behind - background)
    if develop is not None:
        through = (1 - alpha) * (background if color is None else 0)
        alpha = alpha if color is None else np.ones_like(alpha)
        image = through + alpha * develop.apply((image - through).clip(0) / np.maximum(alpha, 1e-4))
    return np.clip(image, 0, 1)


def widened(conics, variances):
    """Conics (N, 3) of projected Gaussians with (N,) added to their variances, pixels squared."""
    a, b, c = conics.double().unbind(1)
    xx, xy, yy = (value / (a * c - b * b) for value in (c, -b, a))
    xx, yy = xx + variances, yy + variances
    return torch.stack([yy, -xy, xx], 1).div((xx * yy - xy * xy)[:, None]).float()


def open_water(directions, water):
    """Background light (N, 3) of a water along unit directions (N, 3)."""
    return 1 / (1 + np.exp(-sh_basis(directions, 2) @ np.array(water["background_sh"])))


@pytest.mark.parametrize(
    "name", ["solid", "turned", "wireframe", "camera", "orthographic", "water", "haze", "instance", "separated"]
)
def test_viewport_shows_the_engines_picture(viewport_pictures, name):
    report, pictures = viewport_pictures
    shown = pictures[name]
    wanted = engine_picture(report, name, water=WATER if name == "water" else None, haze=0.5 * (name == "haze"))
    inside = (slice(30, -5), slice(5, -5))  # without the rounded corners of the region
    assert np.ptp(wanted[inside]) > 0.5
    found = psnr(shown[inside], wanted[inside])
    assert found > 38, found


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("water_0", {"water": WATER, "amount": 0.0}),
        ("water_.001", {"water": WATER, "amount": 0.001}),
        ("attenuation_0", {"water": ATTENUATION, "amount": 0.0, "color": COLOR}),
        ("attenuation_.001", {"water": ATTENUATION, "amount": 0.001, "color": COLOR}),
        ("attenuation_1", {"water": ATTENUATION, "color": COLOR}),
        ("color_developed", {"color": COLOR, "develop": DEVELOPMENT}),
        ("color_off", {}),
    ],
)
def test_viewport_has_the_background_of_the_run(viewport_pictures, name, how):
    """Open water or the color of the run, at every amount of water, with and without development."""
    report, pictures = viewport_pictures
    inside = (slice(30, -5), slice(5, -5))
    wanted = engine_picture(report, name, **how)[inside]
    assert psnr(pictures[name][inside], wanted) > 38
    corner = pictures[name][inside][5, 5]
    assert np.abs(corner - wanted[5, 5]).max() < 0.02, corner


def test_selection_development_and_degree_change_the_colors(viewport_pictures):
    report, pictures = viewport_pictures
    inside = (slice(30, -5), slice(5, -5))
    tint, amount = linear_to_srgb(np.array([1.0, 0.45, 0.0])), 0.6  # the orange of Blender's own selection
    selected = np.arange(4000)[:, None] < 1000
    wanted: dict[str, dict[str, Any]] = {
        "selected": {"change": lambda colors: np.where(selected, colors + (tint - colors) * amount, colors)},
        "adjusted": {"develop": Development(1.0, white_balance(0.25, 0.0), 1.2)},
        "developed": {"develop": DEVELOPMENT},
        "degree_1": {"degree": 1},
    }
    plain = engine_picture(report, "selected")[inside]
    for name, how in wanted.items():
        assert psnr(pictures[name][inside], engine_picture(report, name, **how)[inside]) > 38, name
        assert psnr(pictures[name][inside], plain) < 36, name


@pytest.mark.parametrize(("name", "focal"), [("trained_wider", 2000), ("trained_narrower", 100)])
def test_splats_are_blurred_as_in_the_images_of_their_training(viewport_pictures, name, focal):
    report, pictures = viewport_pictures
    inside = (slice(30, -5), slice(5, -5))
    wanted, plain = (engine_picture(report, name, pixel_size=size)[inside] for size in (1 / focal, 0.0))
    as_wanted = psnr(pictures[name][inside], wanted)
    assert as_wanted > 40
    assert as_wanted > psnr(pictures[name][inside], plain) + 2


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


def test_splats_are_selected_with_the_pointer_deleted_and_brought_back(real_blender, extension_zip):
    folder = new_folder(real_blender, extension_zip, "editing")
    write_ply(folder / "splats.ply", cloud())
    report = in_window("editing_window.py", real_blender, folder)
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
    # The same with the tools of the toolbar, whose first press is the one that Blender gives them.
    tools = {name: set(found) for name, found in report["tools"].items()}
    assert tools["box"] == boxed and tools["box ctrl"] == rest
    middle = np.array([(left + right) / 2 + 30, (bottom + top) / 2 - 5])
    away = np.linalg.norm(pixels - middle, axis=1)
    assert set(np.flatnonzero(away < 97)) <= tools["circle"] <= set(np.flatnonzero(away < 103))
    across = np.abs(pixels - middle) < (80, 22)
    assert set(np.flatnonzero(across.all(axis=1))) <= tools["brush"] and len(tools["brush"]) < len(tools["circle"])
    assert tools["sphere"] and tools["flood"] and report["undone"] and report["handlers"] == 0
    assert report["left"] == 4000 - len(rest) and report["after undo"] == 4000
    # The viewport shows the splats that are left.
    shown = viewport_picture(folder, "deleted", report["region"])
    wanted = engine_picture(report, "deleted", keep=~np.isin(np.arange(4000), sorted(rest)))
    inside = (slice(30, -5), slice(5, -5))
    assert psnr(shown[inside], wanted[inside]) > 38
