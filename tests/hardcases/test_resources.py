"""Too little memory: fewer Gaussians, smaller pictures, and a sentence about it; never a crash."""

from dataclasses import replace

import pytest
import torch
from tiny import make_tiny_scene

from swag_engine.errors import InputError
from swag_engine.rasterize import cuda_driver, projection
from swag_engine.training import loop
from swag_engine.training.config import TrainSettings
from swag_engine.training.memory import FEWEST, NARROWEST, SHARE, fit_memory, free_memory, is_shortage, needed
from swag_engine.training.speed import Extent

SETTINGS = TrainSettings(iterations=60, width=64, max_gaussians=500, sh_degree=1)
EXTENT = Extent(training=90, held_out=10, points=9000, width=1000, height=800)


@pytest.mark.parametrize("free", [4e9, 1e9, 2e8, 1e8])
def test_a_run_is_cut_down_to_what_fits(free):
    asked = replace(SETTINGS, max_gaussians=300_000, width=640)
    settings, note = fit_memory(EXTENT, asked, int(free))
    assert needed(EXTENT, settings.width, settings.max_gaussians) <= SHARE * free
    assert settings == asked if free == 4e9 else settings.max_gaussians < asked.max_gaussians
    assert bool(note) == (settings != asked)
    assert settings.width == 640 or settings.max_gaussians == FEWEST  # Gaussians are given up before pixels
    assert not note or f"trained with {settings.max_gaussians} and {settings.width}" in note


def test_what_can_never_fit_is_one_sentence():
    assert fit_memory(EXTENT, SETTINGS, None) == (SETTINGS, "")
    with pytest.raises(InputError, match="at the least and 0.01 GB are free"):
        fit_memory(EXTENT, replace(SETTINGS, width=NARROWEST * 3), 10_000_000)


def test_the_system_tells_what_is_free():
    assert free_memory(torch.device("cpu")) > 1e7


def test_a_run_says_that_it_was_cut_down(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "free_memory", lambda device: int((6_000 * 1280 + 10 * 64 * 48 * 24) / SHARE))
    asked = replace(SETTINGS, max_gaussians=50_000, iterations=10)
    metrics = loop.train(tiny_scene, tmp_path / "run", asked)["metrics"]
    assert [note for note in metrics["notes"] if note.startswith("Memory: 50000 Gaussians")]


SHORTAGES = {
    "torch, CUDA": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
    "driver": cuda_driver.CudaError("cuLaunchKernel failed with error 2, out of memory"),
    "torch, CPU": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"),
    "Python": MemoryError(),
    "tiles": projection.TooManyPairs("The Gaussians meet too many tiles."),
}


@pytest.mark.parametrize("kind", SHORTAGES)
def test_a_run_that_meets_the_end_of_memory_goes_on_smaller(tmp_path, monkeypatch, kind):
    render = loop.render

    def limited(cloud, camera, *arguments, **named):
        if camera.width > 100 if kind == "tiles" else len(cloud) > 400:
            raise SHORTAGES[kind]
        return render(cloud, camera, *arguments, **named)

    monkeypatch.setattr(loop, "render", limited)
    scene = make_tiny_scene(tmp_path / "scene", width=160, height=128)
    metrics = loop.train(scene, tmp_path / "run", replace(SETTINGS, width=160, iterations=120))["metrics"]
    (note,) = [note for note in metrics["notes"] if note.startswith("Memory ran out")]
    assert metrics["iteration"] == 120 and metrics["test_psnr"] > metrics["control_psnr"] + 1
    assert metrics["gaussians"] <= 400 or kind == "tiles"
    assert ("photographs at 1/2 of their size" in note) == (kind == "tiles")


def test_a_run_that_never_fits_ends_with_a_sentence(tiny_scene, tmp_path, monkeypatch):
    def never(*arguments, **named):
        raise MemoryError

    monkeypatch.setattr(loop, "render", never)
    with pytest.raises(InputError, match="needs more memory than there is"):
        loop.train(tiny_scene, tmp_path / "run", SETTINGS)


def test_other_errors_are_no_shortage(tiny_scene, tmp_path, monkeypatch):
    assert not is_shortage(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))

    def broken(*arguments, **named):
        raise RuntimeError("a bug")

    monkeypatch.setattr(loop, "render", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        loop.train(tiny_scene, tmp_path / "run", SETTINGS)
