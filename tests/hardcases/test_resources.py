"""Too little memory: fewer Gaussians, smaller images, and a note; never a crash."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

from swag_engine.app.cli import main
from swag_engine.base.computer_memory import free_memory, total_memory
from swag_engine.base.errors import InputError
from swag_engine.formats.ply import read_ply
from swag_engine.kernels import cuda_driver, hardware
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cuda import CudaKernels
from swag_engine.kernels.protocol import TooManyPairs
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import TrainingImage
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import trainer as loop
from swag_engine.training.pacing.memory import (
    FEWEST,
    NARROWEST,
    USABLE_FRACTION,
    fit_memory,
    is_shortage,
    needed,
)
from swag_engine.training.pacing.speed import Extent
from swag_engine.training.targets import Target
from tests.scenes.runs import train_with
from tests.scenes.tiny import make_tiny_scene

SETTINGS = TrainSettings(iterations=60, width=64, max_gaussians=500, sh_degree=1)
EXTENT = Extent(training=90, held_out=10, points=9000, overlap=5, width=1000, height=800)


@pytest.mark.parametrize("free", [4e9, 1e9, 2e8, 1e8])
def test_a_run_is_reduced_to_what_fits(free):
    asked = replace(SETTINGS, max_gaussians=300_000, width=640)
    settings, note = fit_memory(EXTENT, asked, int(free))
    assert needed(EXTENT, settings.width, settings.max_gaussians) <= USABLE_FRACTION * free
    assert settings == asked if free == 4e9 else settings.max_gaussians < asked.max_gaussians
    assert bool(note) == (settings != asked)
    assert settings.width == 640 or settings.max_gaussians == FEWEST  # Gaussians are reduced before images
    assert not note or f"trained with {settings.max_gaussians} and {settings.width}" in note


def test_a_run_that_cannot_fit_is_refused():
    assert fit_memory(EXTENT, SETTINGS, None) == (SETTINGS, "")
    with pytest.raises(InputError, match="at the least and 0.01 GB are free"):
        fit_memory(EXTENT, replace(SETTINGS, width=NARROWEST * 3), 10_000_000)


def test_free_memory_is_known():
    assert 1e7 < free_memory() < total_memory()


def test_a_run_notes_that_it_was_reduced(tmp_path, monkeypatch):
    scene = make_tiny_scene(tmp_path / "scene", width=160, height=128)
    enough = needed(Extent.of(load_scene(scene)), 160, FEWEST + 1000) / USABLE_FRACTION
    monkeypatch.setattr(hardware, "free_memory", lambda: int(enough))
    asked = replace(SETTINGS, width=160, max_gaussians=8000, iterations=10)
    metrics = loop.train(scene, tmp_path / "run", asked)["metrics"]
    (note,) = [note for note in metrics["notes"] if note.startswith("Memory: 8000 Gaussians")]
    assert loop.RunFolder(tmp_path / "run").read_config()[1].max_gaussians == int(note.split()[-3])


SHORTAGES = {
    "torch, CUDA": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
    "driver": cuda_driver.CudaError("cuLaunchKernel failed with error 2, out of memory"),
    "torch, CPU": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"),
    "Python": MemoryError(),
    "tiles": TooManyPairs("The Gaussians meet too many tiles."),
}


@pytest.mark.parametrize("kind", SHORTAGES)
def test_a_run_that_runs_out_of_memory_continues_smaller(tmp_path, kind):
    def limit(trainer):
        step = trainer.step

        def limited(state, target, config):
            if target.camera.width > 100 if kind == "tiles" else len(state.cloud) > 400:
                raise SHORTAGES[kind]
            return step(state, target, config)

        trainer.step = limited

    scene = make_tiny_scene(tmp_path / "scene", width=160, height=128)
    metrics = train_with(scene, tmp_path / "run", replace(SETTINGS, width=160, iterations=120), limit)["metrics"]
    (note,) = [note for note in metrics["notes"] if note.startswith("Memory ran out")]
    assert metrics["iteration"] == 120 and metrics["test_psnr"] > metrics["control_psnr"] + 1
    assert metrics["gaussians"] <= 400 or kind == "tiles"
    assert ("images reduced to 1/2 of their size" in note) == (kind == "tiles")


@pytest.fixture
def card(request, monkeypatch, tmp_path):
    """Make a card of CPU fibres, which refuses launches that are too large; tensors stay on the CPU."""
    if sys.platform != "linux":
        pytest.skip("the fibres are for Linux")
    from tests.engine.cuda_fibres import Fibres, Libcuda, pretend_card

    monkeypatch.setattr(cuda_driver, "ptx_path", lambda: tmp_path / "kernels.ptx")
    (tmp_path / "kernels.ptx").write_text("")
    monkeypatch.setitem(KERNELS, "cuda", CudaKernels())
    fibres = Fibres(request.config.cache.mkdir("cuda_fibres"))
    return lambda too_large: pretend_card(monkeypatch, Libcuda(fibres, too_large))


ON_CARD = replace(SETTINGS, recipe="3dgs", backend="cuda", width=48, iterations=20)
CARDS = {
    "for 256 Gaussians": (lambda kernel, blocks: kernel == "project_forward" and blocks > 1, "at most 210 Gaussians."),
    "for 15 tiles": (lambda kernel, blocks: kernel == "blend_forward_3" and blocks > 15, "images reduced to 1/2 of"),
}


@pytest.mark.parametrize("kind", CARDS)
def test_a_run_on_a_card_that_is_too_small_continues_smaller(tmp_path, card, kind):
    """The driver refuses launches; held-out images of full size are then scored on the CPU."""
    too_large, words = CARDS[kind]
    card(too_large)
    scene = make_tiny_scene(tmp_path / "scene", width=96, height=80)
    metrics = loop.train(scene, tmp_path / "run", replace(ON_CARD, width=96))["metrics"]
    assert metrics["iteration"] == ON_CARD.iterations and np.isfinite(metrics["test_psnr"])
    (note,) = [note for note in metrics["notes"] if note.startswith("Memory ran out")]
    assert words in note and "held-out" not in note


@pytest.mark.parametrize("launch", [0, 1, 5, 60, 200])
def test_one_launch_without_memory_does_not_end_a_run(tiny_scene, tmp_path, card, launch):
    launches = iter(range(10**9))
    card(lambda kernel, blocks: next(launches) == launch)
    metrics = loop.train(tiny_scene, tmp_path / "run", ON_CARD)["metrics"]
    assert next(launches) > 200 and metrics["iteration"] == ON_CARD.iterations
    assert [note for note in metrics["notes"] if note.startswith("Memory ran out 1 times")]
    assert np.isfinite(read_ply(tmp_path / "run" / "result.ply").positions).all()


class Shortage(TorchFunctionMode):
    """Raises an error of too little memory at the n-th call of torch that can need memory."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number, self.calls = number, 0

    def __torch_function__(self, function, types, arguments=(), named=None):
        # Torch calls this at the end of a block without gradients, which an error here would leave for good.
        self.calls += function is not torch._C._set_grad_enabled
        if self.calls == self.number and function is not torch._C._set_grad_enabled:
            raise SHORTAGES["torch, CUDA"]
        return function(*arguments, **(named or {}))


@pytest.mark.filterwarnings("ignore:TypedStorage")  # torch's own
def test_a_shortage_anywhere_in_a_command_is_handled(tiny_scene, tmp_path, capsys):
    """The command ends with a result, or with one sentence and a run that can be resumed."""

    def run(name, number, *more):
        words = ["train", str(tiny_scene), "--out", str(tmp_path / name), "--iterations", "10", "--width", "48"]
        with Shortage(number) as shortage:
            code = main([*words, "--backend", "cpu", "--json", *more])
        printed = json.loads(capsys.readouterr().out)
        return code, printed, shortage.calls

    code, _, calls = run("whole", 0)
    assert code == 0
    codes = []
    for number in map(int, np.linspace(1, calls - 1, 8)):
        code, printed, _ = run(f"run {number}", number)
        codes.append(code)
        if code:
            assert code == 2 and "more memory than there is" in printed["error"]
            code, _, _ = run(f"run {number}", 0, *["--resume"] * (tmp_path / f"run {number}" / "config.json").exists())
        assert code == 0 and np.isfinite(read_ply(tmp_path / f"run {number}" / "result.ply").positions).all()
    assert 2 < codes.count(0) < 8


def test_a_run_that_fits_at_no_size_is_refused(tiny_scene, tmp_path):
    def never(trainer):
        def step(state, target, config):
            raise MemoryError

        trainer.step = step

    with pytest.raises(InputError, match="needs more memory than there is"):
        train_with(tiny_scene, tmp_path / "run", SETTINGS, never)


def test_held_out_images_that_never_fit_are_not_scored(tiny_scene, tmp_path, monkeypatch):
    def never(*arguments):
        raise MemoryError

    monkeypatch.setattr(loop, "score_views", never)
    metrics = loop.train(tiny_scene, tmp_path / "run", SETTINGS)["metrics"]
    assert np.isnan(metrics["test_psnr"]) and "Memory did not suffice to score all" in metrics["notes"][-1]


@pytest.mark.parametrize("factor, width", [(2, 160), (4, 80), (8, 80)])
def test_a_larger_shrink_factor_never_gives_a_larger_image(factor, width):
    image = TrainingImage(Camera("a", 320, 180, 200, 200, 160, 90, np.eye(4)), np.zeros((180, 320, 3), np.uint8),
                          np.ones((180, 320), bool))  # fmt: skip
    assert Target.shrunk(image, factor, torch.device("cpu")).camera.width == width


def test_other_errors_are_no_shortage(tiny_scene, tmp_path):
    assert not is_shortage(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))

    def broken(trainer):
        def step(state, target, config):
            raise RuntimeError("a bug")

        trainer.step = step

    with pytest.raises(RuntimeError, match="a bug"):
        train_with(tiny_scene, tmp_path / "run", SETTINGS, broken)
