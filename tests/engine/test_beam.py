"""Beam of a lamp: its gain, what is decided of generated scenes, and what a training learns of it."""

import json
from dataclasses import replace

import pytest
import torch

from swag_engine.effects.beam import MOST_LOG_GAIN, POWERS, Beam
from swag_engine.effects.registry import REGISTRY
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evidence.scene_evidence import SceneEvidence
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.settings.effect_names import EFFECTS, parse_effects
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.effect_scenes import small_scene

EFFECT = REGISTRY["beam"]


def beam(size=0.3):
    random = torch.Generator().manual_seed(0)
    return Beam(size * torch.randn(len(POWERS), generator=random, dtype=torch.float64))


# -- the gain ----------------------------------------------------------------------------------------------------------


def test_the_log_gain_is_a_polynomial_of_the_place_over_half_of_the_diagonal():
    height, width, model = 7, 11, beam()
    log_gain = model.log_gain("any", height, width)
    half = (height**2 + width**2) ** 0.5 / 2
    for row in range(height):
        for column in range(width):
            x, y = (column + 0.5 - width / 2) / half, (row + 0.5 - height / 2) / half
            # Written out, so that the order of the coefficients is the one that the kernels have.
            terms = [x, y, x**2, x * y, y**2, x**3, x**2 * y, x * y**2, y**3]
            terms += [x**4, x**3 * y, x**2 * y**2, x * y**3, y**4]
            expected = sum(float(c) * term for c, term in zip(model.coefficients, terms, strict=True))
            assert float(log_gain[row, column, 0]) == pytest.approx(expected, abs=1e-12)


def test_gradients_of_the_gain():
    def function(coefficients):
        return Beam(coefficients).log_gain("any", 4, 5)

    assert torch.autograd.gradcheck(function, [beam().coefficients.requires_grad_()])


@pytest.mark.parametrize("size", [-1e6, 1e6])
def test_the_gain_stays_bounded(size):
    coefficients = torch.full((len(POWERS),), size, requires_grad=True)
    log_gain = Beam(coefficients).log_gain("any", 90, 160)
    assert float(log_gain.detach().abs().max()) <= MOST_LOG_GAIN
    (gradient,) = torch.autograd.grad(log_gain.square().sum(), coefficients)
    assert gradient.isfinite().all()


# -- what is kept ------------------------------------------------------------------------------------------------------


def test_a_checkpoint_holds_it():
    effects = SceneEffects({"beam": beam()})
    state = json.loads(json.dumps(effects.state()))
    read = SceneEffects.from_checkpoint(effects.parameters(), state).models["beam"]
    assert isinstance(read, Beam)
    assert torch.equal(read.coefficients, effects.parameters()["beam.coefficients"])


def test_without_a_lamp_there_is_no_beam():
    assert parse_effects("lamp=off") == {"lamp": False, "beam": False}
    assert parse_effects("beam=on") == {"lamp": True, "beam": True}


# -- decisions ---------------------------------------------------------------------------------------------------------


def decided(folder, **amounts):
    scene = load_scene(small_scene(folder, "around", 41, **amounts))
    return EFFECT.decide(SceneEvidence(scene, load_images(scene, scene.views)), {})


@pytest.mark.parametrize("light", [{"beam": 1.0}, {"beam": 1.0, "exposure": 0.1}, {"vignetting": 0.45}])
def test_a_beam_or_a_lens_that_falls_off_is_found_beside_a_lamp(tmp_path, light):
    decision = decided(tmp_path / "scene", lamp=1.0, **light)
    assert decision.state == "on", decision
    assert decision.evidence["falloff"] > 0.25


@pytest.mark.parametrize("light", [{"lamp": 1.0}, {"lamp": 1.0, "exposure": 0.1}, {"vignetting": 0.3}])
def test_it_is_off_under_an_even_lamp_and_without_one(tmp_path, light):
    decision = decided(tmp_path / "scene", **light)
    assert decision.state == "off", decision


# -- training ----------------------------------------------------------------------------------------------------------


def test_held_out_views_are_nearer_to_their_photos_with_it(tmp_path):
    scene = small_scene(tmp_path / "scene", "survey", 43, lamp=1.0, beam=1.0)
    off = ",".join(f"{name}=off" for name in EFFECTS if name not in ("lamp", "beam"))
    settings = TrainSettings(iterations=300, width=96, max_gaussians=2000, sh_degree=1)
    psnr = {}
    for state in ("off", "on"):
        chosen = replace(settings, effects=f"{off},lamp=on,beam={state}")
        psnr[state] = train(scene, tmp_path / state, chosen)["metrics"]["test_psnr"]
    assert psnr["on"] > psnr["off"] + 0.5, psnr
