"""Sizes of presets: what the photos resolve, the surface they show, and what the machine does in two minutes."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.formats.run_folder import RunFolder
from swag_engine.kernels import hardware, webgpu_device
from swag_engine.kernels.backends import CPU, KERNELS
from swag_engine.kernels.hardware import hardware_of
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.resolved_width import resolved_width
from swag_engine.settings.presets import CARD_PRESETS, FEWEST, PRESETS, Size, Surface
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.pacing import preset_size
from swag_engine.training.pacing.memory import USABLE_FRACTION, needed
from swag_engine.training.pacing.preset_size import (
    DRAFT_SECONDS,
    MOST_ON_PROCESSOR,
    ON_CARD,
    ON_PROCESSOR,
    fit_preset,
    limit_gaussians,
    sizes_of_presets,
    suitable_gaussians,
)
from swag_engine.training.pacing.speed import Extent, Speed, predicted_seconds
from swag_engine.training.trainer import train
from tests.engine.webgpu_devices import Adapter, adapters_are, software_device
from tests.scenes.tiny import make_tiny_scene

ROOT = Path(__file__).resolve().parents[2]
SURVEY = Extent(training=90, held_out=10, points=9000, overlap=8, width=1280, height=960)
FAST, SLOW = Speed(1, 2e-4, 2e-5, 0.01), Speed(20, 4e-3, 4e-4, 0.2)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The scene of discs: as it is, with blurred photos, and with noise on these."""
    folder, random, made = tmp_path_factory.mktemp("scenes"), np.random.default_rng(0), {}
    for kind in ("sharp", "soft", "noisy"):
        made[kind] = load_scene(make_tiny_scene(folder / kind))
        for view in made[kind].views if kind != "sharp" else ():
            blurred = cv2.GaussianBlur(cv2.imread(str(view.path)).astype(np.float32), (0, 0), 3)
            photo = blurred + random.normal(0, 4 if kind == "noisy" else 0, blurred.shape)
            cv2.imwrite(str(view.path), photo.round().clip(0, 255).astype(np.uint8))
    return made


def test_only_what_photos_resolve_counts_and_noise_is_no_detail(scenes):
    full = scenes["sharp"].views[0].camera.width
    assert resolved_width(scenes["sharp"], 2000) == full
    assert resolved_width(scenes["soft"], 2000) < full
    assert resolved_width(scenes["noisy"], 2000) < full
    assert resolved_width(scenes["sharp"], full // 2) == full // 2


def test_gaussians_follow_the_surface_that_photos_show():
    few = suitable_gaussians(SURVEY, 640, 10)
    assert few == pytest.approx(640 * 480 * 100 / 8 / 10)
    assert suitable_gaussians(replace(SURVEY, overlap=16), 640, 10) == pytest.approx(few / 2, abs=1)
    assert suitable_gaussians(replace(SURVEY, training=190), 640, 10) == pytest.approx(2 * few, abs=1)
    assert suitable_gaussians(replace(SURVEY, training=1, held_out=0), 64, 10) == FEWEST


def test_better_presets_have_more_gaussians_for_the_same_surface(scenes, monkeypatch):
    monkeypatch.setattr(Extent, "of", lambda scene: replace(SURVEY, training=10, held_out=2))
    sizes = [fit_preset(scenes["sharp"], TrainSettings(preset=name, width=480), FAST) for name in PRESETS]
    gaussians = [settings.max_gaussians for settings in sizes]
    assert FEWEST < gaussians[0] < gaussians[1] < gaussians[2] < PRESETS["high"].max_gaussians


def test_no_preset_has_more_gaussians_on_a_processor_than_gain_anything(scenes, monkeypatch):
    monkeypatch.setattr(Extent, "of", lambda scene: replace(SURVEY, training=5000))
    sizes = [fit_preset(scenes["sharp"], TrainSettings(preset=name, width=480), FAST) for name in PRESETS]
    gaussians = [settings.max_gaussians for settings in sizes]
    assert gaussians == [3 * PRESETS["draft"].max_gaussians, MOST_ON_PROCESSOR, MOST_ON_PROCESSOR]
    guide = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")
    for name, settings in zip(PRESETS, sizes, strict=True):
        size = PRESETS[name]
        row = f"| `{name}` | {size.iterations} | {size.width} | {settings.max_gaussians:,} |".replace(",", " ")
        assert row in guide


def test_presets_train_longer_the_more_photos_there_are(scenes, monkeypatch):
    def iterations(photos, preset="high"):
        monkeypatch.setattr(Extent, "of", lambda scene: replace(SURVEY, training=photos))
        return fit_preset(scenes["sharp"], TrainSettings(preset=preset), FAST).iterations

    assert (
        iterations(1)
        == ON_PROCESSOR["high"].least
        < iterations(20)
        < iterations(20 * 3 // 2)
        < PRESETS["high"].iterations
    )
    assert iterations(300) == PRESETS["high"].iterations
    for photos in (1, 20):
        draft, standard, high = (iterations(photos, preset) for preset in PRESETS)
        assert draft < standard < high


def test_a_draft_ends_in_two_minutes_on_a_slow_machine(scenes, monkeypatch):
    monkeypatch.setattr(Extent, "of", lambda scene: SURVEY)
    monkeypatch.setattr(preset_size, "resolved_width", lambda scene, most: min(most, SURVEY.width))
    fast, slow = (fit_preset(scenes["sharp"], TrainSettings(preset="draft"), speed) for speed in (FAST, SLOW))
    assert (fast.iterations, fast.width) == (PRESETS["draft"].iterations, PRESETS["draft"].width)
    assert all(a < b for a, b in zip(slow.size.numbers().values(), fast.size.numbers().values(), strict=True))
    assert 0.7 * DRAFT_SECONDS < predicted_seconds(SLOW, SURVEY, slow.size, 0.5) <= 1.05 * DRAFT_SECONDS
    high = fit_preset(scenes["sharp"], TrainSettings(preset="high"), SLOW)
    assert high.iterations == PRESETS["high"].iterations  # a result to keep may take its time


@pytest.mark.parametrize(
    "kind, api, memory",
    [("DiscreteGPU", "Vulkan", 24e9), ("IntegratedGPU", "Metal", 16e9), ("IntegratedGPU", "D3D12", 16e9),
     ("DiscreteGPU", "Metal", 2**28), ("CPU", "Vulkan", None)],
    ids=["AMD", "Apple", "Intel", "AMD in a Mac", "software"],
)  # fmt: skip
def test_a_card_of_any_make_takes_photos_at_full_size(scenes, monkeypatch, kind, api, memory):
    """In a computer of 32 GB; a processor has no memory of a card."""
    monkeypatch.delenv(webgpu_device.ALLOW_SOFTWARE, raising=False)
    monkeypatch.setattr(webgpu_device, "_vulkan_memory", lambda *card: 24 * 10**9 if api == "Vulkan" else None)
    monkeypatch.setattr(Extent, "of", lambda scene: replace(SURVEY, training=2000, width=6000, height=4000))
    monkeypatch.setattr(preset_size, "resolved_width", lambda scene, most: min(most, 6000))
    for module in (webgpu_device, hardware):
        monkeypatch.setattr(module, "total_memory", lambda: 32 * 10**9)
    monkeypatch.setattr(hardware, "free_memory", lambda: 30 * 10**9)
    monkeypatch.setattr(hardware, "may_have_card", lambda: True)
    monkeypatch.setattr(KERNELS["cuda"], "unavailable_reason", lambda: "no NVIDIA card.")
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU, webgpu_device.request))
    adapters_are(monkeypatch, Adapter("a card", kind, api=api))
    found, high = hardware_of(TrainSettings()), TrainSettings(preset="high")
    sizes, processor = fit_preset(scenes["sharp"], high).size.numbers(), hardware_of(replace(high, recipe="seasplat"))
    assert (processor.backend, processor.card, processor.free_memory()) == ("cpu", False, 30e9)
    if memory:
        assert asdict(found) == {"backend": "wgpu", "card": True, "name": "a card", "memory": memory}
        assert found.free_memory() == memory and sizes == CARD_PRESETS["high"].numbers() | {"width": 6000}
    else:
        assert found == processor and sizes == PRESETS["high"].numbers() | {"max_gaussians": MOST_ON_PROCESSOR}


def test_software_that_counts_as_a_card_has_its_presets(monkeypatch, missing):
    device, scene = software_device(missing), load_scene(ROOT / "tests" / "scenes" / "reef_wreck")
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU, lambda: device))
    extent, width = Extent.of(scene), resolved_width(scene, 960)

    def draft(flag, backend="wgpu"):
        monkeypatch.setenv(webgpu_device.ALLOW_SOFTWARE, flag)
        return fit_preset(scene, TrainSettings(preset="draft", backend=backend), FAST, width).size

    most = suitable_gaussians(extent, width, ON_CARD["draft"].pixels_each)
    assert draft("1") == Size(ON_CARD["draft"].visits * extent.training, width, most)
    assert draft("0") == draft("1", "cpu") and draft("0").width == PRESETS["draft"].width < width


def test_what_the_user_chose_stays(scenes):
    chosen = TrainSettings(preset="draft", iterations=7, width=31, max_gaussians=123)
    assert fit_preset(scenes["sharp"], chosen) is chosen
    partly = fit_preset(scenes["sharp"], TrainSettings(preset="standard", width=31))
    assert partly.width == 31 and partly.max_gaussians == FEWEST
    assert partly.iterations == ON_PROCESSOR["standard"].least  # there are few photos
    assert fit_preset(scenes["sharp"], TrainSettings(preset="high", iterations=8000)).iterations == 8000


def test_no_more_gaussians_are_trained_than_the_photos_have_pixels(scenes, tmp_path):
    scene = scenes["sharp"]
    extent = Extent.of(scene)
    pixels = round(extent.pixels(160) * len(scene.views) / extent.overlap)
    assert pixels > FEWEST
    within = TrainSettings(iterations=5, width=160, max_gaussians=pixels, recipe="3dgs")
    assert limit_gaussians(scene, within) == (within, "")
    more = replace(within, max_gaussians=10 * pixels)
    limited, note = limit_gaussians(scene, more)
    assert limited == within and f"At most {pixels} Gaussians instead of {10 * pixels}" in note
    metrics = train(scene.folder, tmp_path / "run", more)["metrics"]
    assert note in metrics["notes"] and RunFolder(tmp_path / "run").read_config()[1].max_gaussians == pixels
    config = json.loads(RunFolder(tmp_path / "run").config.read_text())
    assert config["settings"]["backend"] == "auto" and config["hardware"] == asdict(hardware_of(more))


def test_sizes_of_presets_are_those_of_runs_and_read_the_photos_once(scenes, tmp_path, monkeypatch):
    scene, read = scenes["soft"], []
    monkeypatch.setattr(preset_size, "resolved_width", lambda *asked: read.append(asked) or resolved_width(*asked))
    found = sizes_of_presets(scene, TrainSettings(iterations=7, preset="high"), FAST)
    assert len(read) == 1
    for name in PRESETS:
        settings = fit_preset(scene, TrainSettings(preset=name), FAST)
        assert found["presets"][name] == limit_gaussians(scene, settings)[0].size.numbers() | {"lowered": False}
    surface = Surface(**found["surface"])
    for width in (16, 50, 90, 160, 5000):
        most = TrainSettings(iterations=1, width=width, max_gaussians=10**7)
        assert surface.gaussians(width) == limit_gaussians(scene, most)[0].max_gaussians


def test_sizes_of_presets_are_lowered_to_the_free_memory(scenes, monkeypatch):
    settings = fit_preset(scenes["sharp"], TrainSettings(preset="high", width=480), FAST)
    enough = needed(Extent.of(scenes["sharp"]), settings.width, settings.max_gaussians) / USABLE_FRACTION
    monkeypatch.setattr(preset_size, "resolved_width", lambda scene, most: 480)
    monkeypatch.setattr(hardware, "free_memory", lambda: int(0.99 * enough))
    presets = sizes_of_presets(scenes["sharp"], TrainSettings(), FAST)["presets"]
    assert [size["lowered"] for size in presets.values()] == [False, False, True]
    assert FEWEST <= presets["high"]["max_gaussians"] < settings.max_gaussians
