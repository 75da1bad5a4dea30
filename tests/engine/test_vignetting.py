"""Vignetting: its gain, what is decided of generated scenes, and what a training learns of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from swag_engine.effects.effect import InitialContext
from swag_engine.effects.image_gain import apply_log_gains
from swag_engine.effects.registry import REGISTRY
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.effects.vignetting import LEAST_GAIN, MOST_GAIN, Vignetting
from swag_engine.evidence.scene_evidence import SceneEvidence
from swag_engine.kernels.reference.transfer import to_light
from swag_engine.planning.plan import Plan, PlannedEffect
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train
from swag_engine.training.trials import undetermined_effects
from tests.scenes.effect_scenes import small_scene

EFFECT = REGISTRY["vignetting"]
COEFFICIENTS = (-0.3, -0.1, 0.05)


def vignetting(*coefficients, **settings):
    return Vignetting(torch.tensor(coefficients, dtype=torch.float64), **settings)


def random(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


# -- the gain ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("centre", [(0.5, 0.5), (0.4, 0.6)])
def test_the_gain_is_a_polynomial_of_the_squared_distance_from_the_principal_point(centre):
    height, width = 7, 11
    gain = vignetting(*COEFFICIENTS, centre=centre).log_gain("any", height, width).exp()
    for row in range(height):
        for column in range(width):
            x, y = column + 0.5 - centre[0] * width, row + 0.5 - centre[1] * height
            r2 = (x * x + y * y) / ((width**2 + height**2) / 4)
            expected = 1 - 0.3 * r2 - 0.1 * r2**2 + 0.05 * r2**3
            assert float(gain[row, column, 0]) == pytest.approx(expected, rel=1e-12)


def test_the_gain_is_1_at_the_centre_and_the_same_at_every_size():
    model = vignetting(*COEFFICIENTS)
    assert float(model.log_gain("any", 45, 81)[22, 40]) == 0
    corner = [float(model.log_gain("any", 45 * n, 81 * n).exp()[0, 0, 0]) for n in (1, 20)]
    assert corner[0] == pytest.approx(0.65, abs=0.02) and corner[1] == pytest.approx(0.65, abs=0.001)


def test_gradients_of_the_gain():
    def function(picture, coefficients):
        return apply_log_gains(picture, [Vignetting(coefficients).log_gain("any", 4, 5)])

    inputs = (random(4, 5, 3), torch.tensor(COEFFICIENTS, dtype=torch.float64))
    assert torch.autograd.gradcheck(function, [value.requires_grad_() for value in inputs])


@pytest.mark.parametrize("size", [-1e6, -1.0, 1.0, 1e6])
def test_the_gain_stays_positive_and_bounded_and_can_return(size):
    coefficients = torch.full((3,), size, requires_grad=True)
    log_gain = Vignetting(coefficients).log_gain("any", 90, 160)
    gain = log_gain.detach().exp()
    assert float(gain.min()) >= LEAST_GAIN * 0.999 and float(gain.max()) <= MOST_GAIN * 1.001
    (gradient,) = torch.autograd.grad(log_gain.square().sum(), coefficients)
    assert gradient.isfinite().all()
    if abs(size) <= 1:
        assert (gradient.sign() == np.sign(size)).all()  # descent leads back towards no vignetting


def test_held_out_images_get_it_and_restored_ones_do_not():
    model = vignetting(*COEFFICIENTS)
    effects = SceneEffects({"vignetting": model})
    picture = random(9, 16, 3)
    shown = effects.apply_to_image(picture, "no training image")
    expected = to_light(picture) * model.log_gain("", 9, 16).exp()
    torch.testing.assert_close(to_light(shown), expected)
    assert torch.equal(effects.apply_to_image(picture, "no training image", amount=0.0), picture)


# -- what is kept ------------------------------------------------------------------------------------------------------


def test_a_checkpoint_holds_it():
    effects = SceneEffects({"vignetting": vignetting(*COEFFICIENTS, centre=(0.4, 0.6))})
    state = json.loads(json.dumps(effects.state()))
    read = SceneEffects.from_checkpoint(effects.parameters(), state).models["vignetting"]
    assert isinstance(read, Vignetting)
    assert torch.equal(read.coefficients, effects.parameters()["vignetting.coefficients"])
    assert read.centre == (0.4, 0.6)


@pytest.mark.parametrize("effect", ["vignetting", "beam"])
def test_a_plan_from_before_it_existed_opens_with_it_off(effect):
    line = PlannedEffect("on", {}, "", 0.0)
    document = Plan({name: line for name in EFFECTS}, None, "").to_json()
    del document["effects"][effect]
    plan = Plan.from_json(document)
    assert not plan.on(effect) and plan.on("exposure") and plan.on("lamp")


# -- decisions ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def decided(tmp_path_factory):
    """Decide about generated scenes, each made once."""
    made = {}

    def of(pattern, **amounts):
        key = (pattern, *amounts.items())
        if key not in made:
            folder = small_scene(tmp_path_factory.mktemp(pattern) / "scene", pattern, 41, **amounts)
            scene = load_scene(folder)
            evidence = SceneEvidence(scene, load_images(scene, scene.views))
            made[key] = evidence, EFFECT.decide(evidence, {})
        return made[key]

    return of


def test_a_lens_that_falls_off_is_found_with_its_gain(decided):
    evidence, decision = decided("around", vignetting=0.3)
    assert decision.state == "on"
    assert decision.evidence["falloff"] == pytest.approx(0.3, abs=0.06)
    start = EFFECT.fitted(evidence)
    context = InitialContext(start, [], 160, 90, 1.0)
    model = EFFECT.initial(context)
    assert isinstance(model, Vignetting)
    gain = model.log_gain("any", 90, 160)[..., 0].exp().numpy()
    y, x = (np.mgrid[:90, :160] + 0.5 - np.array([45, 80])[:, None, None]) / np.hypot(45, 80)
    np.testing.assert_allclose(gain, 1 - 0.3 * (x * x + y * y), atol=0.06)
    assert start["centre"] == pytest.approx([0.5, 0.5], abs=1e-3)


@pytest.mark.parametrize("amounts", [{}, {"vignetting": 0.02, "exposure": 0.12}])
def test_it_is_off_where_the_lens_does_not_fall_off(decided, amounts):
    _, decision = decided("around", **amounts)
    assert decision.state == "off", decision


@pytest.mark.parametrize("amounts", [{"lamp": 1.0}, {"lamp": 1.0, "vignetting": 0.3}])
def test_beside_a_lamp_it_is_neither_on_nor_tried(decided, amounts):
    evidence, decision = decided("around", **amounts)
    assert REGISTRY["lamp"].decide(evidence, {}).state == "on"
    assert decision.state == "unknown" and "beam of the lamp" in decision.reason
    line = PlannedEffect(decision.state, decision.evidence, decision.reason, 0.0)
    off = PlannedEffect("off", {}, "", 0.0)
    assert undetermined_effects(Plan(dict.fromkeys(EFFECTS, off) | {"vignetting": line}, None, "")) == []


@pytest.mark.parametrize("amounts", [{"vignetting": 0.3}, {"lamp": 1.0}])
def test_a_survey_at_constant_height_cannot_show_it(decided, amounts):
    _, decision = decided("survey", **amounts)
    assert decision.state == "unknown" and "vary together" in decision.reason


# -- training ----------------------------------------------------------------------------------------------------------


def test_held_out_views_are_nearer_to_their_photos_with_it(tmp_path):
    scene = small_scene(tmp_path / "scene", "survey", 43, vignetting=0.4)
    off = ",".join(f"{name}=off" for name in EFFECTS if name != "vignetting")
    settings = TrainSettings(iterations=300, width=96, max_gaussians=2000, sh_degree=1)
    psnr = {}
    for state in ("off", "on"):
        chosen = replace(settings, effects=f"{off},vignetting={state}")
        psnr[state] = train(scene, tmp_path / state, chosen)["metrics"]["test_psnr"]
    assert psnr["on"] > psnr["off"] + 0.5, psnr
    tensors, state = load_checkpoint(tmp_path / "on")
    assert 1 + float(tensors["vignetting.coefficients"].sum()) == pytest.approx(0.6, abs=0.1)
    assert state["vignetting"] == pytest.approx([0.5, 0.5])
