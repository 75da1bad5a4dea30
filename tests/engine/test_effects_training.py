"""Effects in a run: off, on and learned, tried, and resumed."""

import json
import shutil
import sys
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from swag_engine.app.worker import pinhole_images
from swag_engine.effects.caustics import Illumination
from swag_engine.effects.exposure import Exposure
from swag_engine.effects.lamp import lit
from swag_engine.effects.moving_objects import moving_mask
from swag_engine.effects.registry import REGISTRY
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.effects.vignetting import Vignetting
from swag_engine.evaluation.metrics import render_image
from swag_engine.experiments import evaluate_run, restore_photos
from swag_engine.experiments.evaluate_run import load_newest, render_run
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.reference.transfer import to_display, to_light
from swag_engine.planning.plan import Plan, PlannedEffect, plan_scene
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.lenses import Lens
from swag_engine.scene.split import split_views
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import trials
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.optimizer import Optimizer
from swag_engine.training.trainer import train
from swag_engine.water.light import apply_gain
from swag_engine.water.medium import Medium, open_water, through_water
from tests.scenes.runs import train_with
from tests.scenes.tiny import make_tiny_scene

SETTINGS = TrainSettings(iterations=40, width=64, max_gaussians=400, sh_degree=1)
OFF = "water=off,lamp=off,exposure=off,vignetting=off,caustics=off,moving_objects=off"
CODE = {
    "attenuation": through_water,
    "backscatter": open_water,
    "lamp": lit,
    "exposure": Exposure.log_gain,
    "vignetting": Vignetting.log_gain,
    "caustics": Illumination.log_gain,
    "moving_objects": moving_mask,
}
"""A function of each effect that runs in every image, or search, that the effect acts on."""


@contextmanager
def counted_calls():
    """Count the calls of each effect's function in this thread."""
    counts, effects = dict.fromkeys(CODE, 0), {function.__code__: effect for effect, function in CODE.items()}

    def count(frame, event, argument):
        if event == "call" and frame.f_code in effects:
            counts[effects[frame.f_code]] += 1

    sys.setprofile(count)
    try:
        yield counts
    finally:
        sys.setprofile(None)


def test_the_code_of_an_effect_that_is_off_does_not_run(tiny_scene, tmp_path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene", copy_function=shutil.copy2)
    plan_scene(scene, scene)  # its measuring of costs calls every effect
    with counted_calls() as calls:
        result = train(scene, tmp_path / "off", replace(SETTINGS, effects=OFF))
    assert not any(calls.values()), calls
    assert not set(result["metrics"]["effects"]) & set(EFFECTS)
    for effect in CODE:
        chosen = replace(SETTINGS, iterations=10, effects=f"{OFF},{effect}=on".replace("water=off,", ""))
        if effect not in ("attenuation", "backscatter"):
            chosen = replace(chosen, effects=f"{OFF},{effect}=on")
        with counted_calls() as calls:
            train(scene, tmp_path / effect, chosen)
        assert calls[effect] > 0, effect
        others = set(CODE) - {effect, "attenuation", "backscatter"}
        assert not any(calls[other] for other in others), (effect, calls)
    plan = json.loads((tmp_path / "lamp" / "plan.json").read_text())["effects"]
    assert plan["lamp"]["state"] == "on" and plan["lamp"]["overruled"] and plan["caustics"]["state"] == "off"


def test_everything_on_is_learned_and_resumes_bit_equal(tiny_scene, tmp_path):
    chosen = replace(SETTINGS, effects="water=on,separate_backscatter=on," + OFF.split(",", 1)[1].replace("off", "on"))
    train(tiny_scene, tmp_path / "whole", chosen)
    asked = iter(range(10**9))
    train(tiny_scene, tmp_path / "parts", chosen, should_stop=lambda: next(asked) >= 25)
    train(tiny_scene, tmp_path / "parts", chosen, resume=True)
    expected, got = (load_checkpoint(tmp_path / name)[0] for name in ("whole", "parts"))
    assert expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)
    learned = {"lamp.log_tau", "exposure.raw", "vignetting.coefficients", "caustics.log_light", "medium.background_sh"}
    assert learned <= expected.keys() and expected["vignetting.coefficients"].abs().min() > 0
    assert expected["exposure.raw"].std() > 0 and expected["caustics.log_light"].std() > 0
    assert float(expected["lamp.log_tau"]) != 0


def test_photos_that_differ_in_suffix_alone_have_their_own_files(tiny_scene, tmp_path, monkeypatch):
    train(tiny_scene, tmp_path, replace(SETTINGS, iterations=2, effects=OFF))
    scene = load_scene(tiny_scene)
    files = {"same.png": "same.png.png", "same.JPG": "same.JPG.png", "a/same.png": "a/same.png", "b.jpg": "b.png"}
    views = [replace(view, camera=replace(view.camera, name=n)) for n, view in zip(files, scene.views, strict=False)]
    for module in (evaluate_run, restore_photos):
        monkeypatch.setattr(module, "load_scene", lambda folder: replace(scene, views=tuple(views)))
    for name, file in files.items():
        assert render_run(tmp_path, tmp_path, name, 0.0, "none") == [tmp_path / file]
        assert restore_photos.restore_photos(tmp_path, tmp_path, name, width=16) == [tmp_path / file]
    distorted = [replace(view, lens=Lens("SIMPLE_RADIAL", 64, 48, (60.0, 32, 24, 0.1))) for view in views]
    assert len(set(pinhole_images(replace(scene, views=tuple(distorted))))) == len(views)


def test_restored_images_have_no_effects(tiny_scene, tmp_path):
    run, name = tmp_path / "run", "view_02.png"
    effects = "water=off,moving_objects=off,lamp=on,exposure=on,caustics=on"
    train(tiny_scene, run, replace(SETTINGS, iterations=10, effects=effects))
    cloud, effects, _ = load_newest(run)
    (camera,) = [view.camera for view in load_scene(tiny_scene).views if view.name == name]
    (restored,) = render_run(run, tmp_path / "restored", name, 0.0, "none")
    plain = render_image(cloud, camera, SETTINGS.sh_degree)
    one_step = 1.01 / 255  # of 8 bits
    pixels = torch.from_numpy(cv2.imread(str(restored))[..., ::-1] / np.float32(255))
    torch.testing.assert_close(pixels, plain, atol=one_step, rtol=0)
    for key in ("lamp", "exposure", "caustics"):
        (values,) = effects.models[key].parameters().values()
        values -= 4 * torch.rand(values.shape, generator=torch.Generator().manual_seed(0))
        alone = SceneEffects({key: effects.models[key]})
        with_effect = render_image(cloud, camera, SETTINGS.sh_degree, effects=alone)
        assert (with_effect - plain).abs().max() > 5 * one_step, key
        without = render_image(cloud, camera, SETTINGS.sh_degree, effects=alone, amount=0)
        torch.testing.assert_close(without, plain, atol=one_step, rtol=0)


# Exposure that varies -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unevenly_exposed(tmp_path_factory):
    """The wall of discs with log gains that drift from image to image, with a standard deviation of 0.35; and these."""
    scene = make_tiny_scene(tmp_path_factory.mktemp("uneven") / "scene", views=16)
    paths = sorted((scene / "images").iterdir())
    gains = 0.5 * np.sin(np.linspace(0, 2 * np.pi, len(paths)))
    for path, gain in zip(paths, gains, strict=True):
        light = to_light(torch.from_numpy(cv2.imread(str(path)) / 255)) * np.exp(gain)
        cv2.imwrite(str(path), (to_display(light).clamp(0, 1) * 255).round().byte().numpy())
    return scene, {path.name: gain for path, gain in zip(paths, gains, strict=True)}


def test_exposures_are_learned(unevenly_exposed, tmp_path):
    scene, truth = unevenly_exposed
    settings = replace(SETTINGS, iterations=200, effects=f"{OFF},exposure=on")
    train(scene, tmp_path / "run", settings)
    tensors, state = load_checkpoint(tmp_path / "run")
    learned = tensors["exposure.raw"][:, 0].numpy()
    true = np.array([truth[name] for name in state["exposure"]["names"]])
    assert np.corrcoef(learned, true)[0, 1] > 0.8
    assert (
        "view_00.png" not in state["exposure"]["names"] and "view_08.png" not in state["exposure"]["names"]
    )  # held out


SHAPES = (3,), (4,), (3,), (), (1, 3), (0, 3)
"""Shapes of the tensors of a Gaussian."""


def test_gains_of_many_images_are_not_moved_away_from_the_truth_by_the_momentum_of_single_steps():
    """Each of V images is visited once in V steps, with a gradient of random sign: its gain must stay where it is."""
    moved = {}
    for images in (20, 320):
        exposure = Exposure.starting({f"{k:03d}": 0.0 for k in range(images)})
        effects = SceneEffects({"exposure": exposure})
        cloud = GaussianCloud(*[torch.zeros(1, *n) for n in SHAPES], torch.zeros(3))  # type: ignore[call-arg]
        optimizer = Optimizer(cloud, effects, "torch")
        random = np.random.default_rng(1)
        for step in range(6 * images):
            exposure.raw.grad = torch.zeros_like(exposure.raw)
            exposure.raw.grad[step % images] = float(random.choice([-1, 1]))
            optimizer.step(effects.learning_rates())
        moved[images] = float(exposure.raw.detach().abs().mean())
    assert moved[320] < 1.2 * moved[20] < 0.1


def test_a_held_out_gain_is_predicted_from_neighbours():
    film = Exposure.starting({f"{k:02d}": 0.1 * k for k in range(10) if k != 5})
    known = film.log_gains[:, 0]
    assert float(film.log_gain("05")) == pytest.approx(float(known[4] + known[5]) / 2, rel=0.1)
    chance = Exposure.starting({f"{k:02d}": 0.3 * (-1) ** k for k in range(10)})
    assert float(chance.log_gain("045")) == 0  # neighbours do not predict one another
    assert float(Exposure.starting({"a": 0.1, "c": 0.3}).log_gain("b")) == 0


# Trials ---------------------------------------------------------------------------------------------------------------


def try_effect(name, **start):
    """Return a change of a trainer that leaves an effect to a trial from these values, whatever the plan decides."""

    def change(trainer):
        effects = trainer.selection.plan.effects
        effects[name] = replace(effects[name], start=start)
        trainer.selection.to_try = [name]
        trainer.selection.switch(trainer.state, {name: False})

    return change


def test_an_effect_that_gains_is_kept_after_its_trial(unevenly_exposed, tmp_path):
    scene, gains = unevenly_exposed
    settings = replace(SETTINGS, iterations=200, effects=OFF.replace("exposure=off,", ""))
    metrics = train_with(scene, tmp_path / "run", settings, try_effect("exposure", log_gains=gains))["metrics"]
    (trial,) = metrics["trials"]
    assert trial["effect"] == "exposure" and trial["kept"] and trial["seconds"] > 0
    assert trial["gain"] > trial["needed"] and trial["sentence"].startswith("Tried exposure at iteration 20: +")
    assert "exposure" in metrics["effects"]
    assert "exposure.raw" in load_checkpoint(tmp_path / "run")[0]


def test_a_run_whose_trial_gains_nothing_is_the_run_without(unevenly_exposed, tmp_path):
    scene, _ = unevenly_exposed
    train(scene, tmp_path / "plain", replace(SETTINGS, effects=OFF))
    settings = replace(SETTINGS, effects=OFF.replace("caustics=off,", ""))
    metrics = train_with(scene, tmp_path / "tried", settings, try_effect("caustics"))["metrics"]
    (trial,) = metrics["trials"]
    assert not trial["kept"] and trial["gain"] <= trial["needed"] and "caustics" not in metrics["effects"]
    plain, tried = (load_checkpoint(tmp_path / name)[0] for name in ("plain", "tried"))
    assert plain.keys() == tried.keys() and all(torch.equal(plain[name], tried[name]) for name in plain)


def test_margin_is_the_least_ratio_of_a_figure_to_its_threshold():
    assert trials.margin({"gain": 12, "gain_least": 10, "spread": 0.1, "spread_most": 0.3}) == pytest.approx(1.2)
    assert trials.margin({"change": [0.05, 0.2, 0.1], "change_least": 0.1}) == pytest.approx(2)
    assert trials.margin({"range_ratio": 1.2, "range_ratio_least": 1.15, "none": None, "none_least": 1}) == np.inf


def test_a_lamp_whose_light_falls_off_far_beyond_the_threshold_is_not_tried():
    strong = {"bic_gain": 900.0, "bic_gain_least": 30.0, "falloff": 0.8, "falloff_least": 0.15}
    kind = {"inverse_square": 1.0, "inverse_square_least": 0.78, "color_of_loss": 0.19, "color_of_loss_most": 0.2}
    assert trials.margin(strong | kind) > trials.NEAR
    assert trials.margin(strong | kind | {"bic_gain": 35.0}) < trials.NEAR


@pytest.mark.parametrize(
    "state, gain_sd, bic_gain, tried",
    [("on", 0.06, 1300.0, False), ("on", 0.06, 120.0, True), ("off", 0.04, 1300.0, True)],
)
def test_an_exposure_that_the_plan_is_sure_of_is_not_tried(state, gain_sd, bic_gain, tried):
    """However little it varies: validation images, which have no exposure of their own, hardly show its gain."""
    evidence = {"gain_sd": gain_sd, "gain_sd_least": 0.045, "bic_gain": bic_gain, "bic_gain_least": 100.0}
    effects = dict.fromkeys(REGISTRY, PlannedEffect("off", {}, "", 0.0))
    plan = Plan(effects | {"exposure": PlannedEffect(state, evidence, "", 0.0)}, None, "")
    assert ("exposure" in trials.undetermined_effects(plan)) == tried


def test_moving_objects_are_found_and_nothing_else_is_masked(tiny_scene, tmp_path):
    plain = replace(SETTINGS, iterations=300, max_gaussians=1500)
    for name, effects in (("planned", ""), ("off", "moving_objects=off")):
        metrics = train(tiny_scene, tmp_path / name, replace(plain, iterations=150, effects=effects))["metrics"]
        assert "moving_objects" not in metrics["effects"]
    expected, got = (load_checkpoint(tmp_path / name)[0] for name in ("off", "planned"))
    assert expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)
    swum = tmp_path / "scene"
    shutil.copytree(tiny_scene, swum)
    names = split_views([view.name for view in load_scene(swum).views]).train
    for name, left in ((names[0], 12), (names[-1], 40)):
        pixels = cv2.imread(str(swum / "images" / name))
        pixels[16:30, left : left + 14] = (255, 0, 255)
        cv2.imwrite(str(swum / "images" / name), pixels)
    metrics = train(swum, tmp_path / "swum", plain)["metrics"]
    assert "moving_objects" in metrics["effects"]
    assert any("pixels of 2 images are masked out" in note for note in metrics["notes"]), metrics["notes"]


# Light ----------------------------------------------------------------------------------------------------------------


def test_light_is_scaled_exactly_and_differentiably():
    display = torch.linspace(0, 1.2, 400, dtype=torch.float64)[:, None]
    factor = torch.linspace(-3, 3, 31, dtype=torch.float64)
    torch.testing.assert_close(apply_gain(display, factor), to_display(to_light(display) * factor.exp()))
    inputs = (torch.tensor([[0.01, 0.05, 0.5], [0.9, 0.02, 0.3]]).double(), torch.tensor([[0.7], [-1.5]]).double())
    assert torch.autograd.gradcheck(apply_gain, [value.requires_grad_() for value in inputs])


def test_water_that_only_attenuates_has_no_background_light():
    raw = torch.tensor([0.1, -0.5, -1.0], dtype=torch.float64)
    colors, offsets = torch.rand(5, 3).double() * 0.8 + 0.1, torch.randn(5, 3).double()
    medium = Medium(raw, None, None, 2.0)
    expected = to_light(colors) * torch.exp(-medium.beta_D * offsets.norm(dim=1, keepdim=True))
    torch.testing.assert_close(to_light(through_water(colors, offsets, medium)), expected)
    assert medium.to_json()["B_inf"] == [0, 0, 0] and list(medium.parameters()) == ["attenuation"]
    inputs = [value.requires_grad_() for value in (colors, raw)]
    assert torch.autograd.gradcheck(lambda c, r: through_water(c, offsets, Medium(r, None, None, 2.0)), inputs)
