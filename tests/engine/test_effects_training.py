"""Effects in a training: what is off does not run, what is on is learned, what is doubtful is tried, all resumes."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from runs import train_with
from tiny import make_tiny_scene

from swag_engine.effects import caustics, exposure, image_gain, lamp, vignetting
from swag_engine.effects.exposure import Exposure
from swag_engine.experiments.evaluate_run import render_run
from swag_engine.planning import plan as planning
from swag_engine.rendering import render as rendering
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.split import split_views
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import motion, trials
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train
from swag_engine.water.light import relit, to_display, to_light
from swag_engine.water.medium import Medium, through_water

SETTINGS = TrainSettings(iterations=40, width=64, max_gaussians=400, sh_degree=1)
OFF = "water=off,lamp=off,exposure=off,vignetting=off,caustics=off,moving_objects=off"
CODE = {
    "attenuation": (rendering, "through_water"),
    "backscatter": (rendering, "open_water"),
    "lamp": (rendering, "lit"),
    "exposure": (exposure.Exposure, "log_gain"),
    "vignetting": (vignetting.Vignetting, "log_gain"),
    "caustics": (caustics.Illumination, "log_gain"),
    "moving_objects": (motion, "moving_mask"),
}


@pytest.fixture
def calls(monkeypatch):
    """How often the code of each effect runs, the plan's measuring of its cost aside."""
    monkeypatch.setattr(planning, "measured_costs", lambda *arguments: dict.fromkeys(EFFECTS, 0.0))
    counted = dict.fromkeys(CODE, 0)

    def counting(effect, run):
        def counted_run(*arguments, **named):
            counted[effect] += 1
            return run(*arguments, **named)

        return counted_run

    for effect, (owner, name) in CODE.items():
        monkeypatch.setattr(owner, name, counting(effect, getattr(owner, name)))
    return counted


def test_the_code_of_what_is_off_does_not_run(tiny_scene, tmp_path, calls):
    result = train(tiny_scene, tmp_path / "off", replace(SETTINGS, effects=OFF))
    assert not any(calls.values()), calls
    assert not set(result["metrics"]["effects"]) & set(EFFECTS)
    for effect in CODE:
        calls.update(dict.fromkeys(CODE, 0))
        chosen = replace(SETTINGS, iterations=10, effects=f"{OFF},{effect}=on".replace("water=off,", ""))
        if effect not in ("attenuation", "backscatter"):
            chosen = replace(chosen, effects=f"{OFF},{effect}=on")
        train(tiny_scene, tmp_path / effect, chosen)
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
    learned = {"lamp.log_tau", "exposure.raw", "vignetting.coefficients", "caustics.log_light", "medium.veil"}
    assert learned <= expected.keys() and expected["vignetting.coefficients"].abs().min() > 0
    assert expected["exposure.raw"].std() > 0 and expected["caustics.log_light"].std() > 0
    assert float(expected["lamp.log_tau"]) != 0


def test_what_is_restored_has_none_of_it(tiny_scene, tmp_path, monkeypatch):
    train(tiny_scene, tmp_path / "run", replace(SETTINGS, iterations=10, effects="lamp=on,exposure=on,caustics=on"))
    used = []
    monkeypatch.setattr(image_gain, "relit", lambda *a: used.append("picture") or relit(*a))
    monkeypatch.setattr(lamp, "relit", lambda colors, factor: used.append(float(factor.abs().max())) or colors)
    render_run(tmp_path / "run", tmp_path / "with", "view_02.png", 1.0)
    assert "picture" in used and max(value for value in used if value != "picture") > 0
    used.clear()
    render_run(tmp_path / "run", tmp_path / "without", "view_02.png", 0.0)
    assert "picture" not in used and all(value == 0 for value in used)


# Exposure that differs ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unevenly_exposed(tmp_path_factory):
    """The wall of discs with gains of sd .25 in light."""
    scene = make_tiny_scene(tmp_path_factory.mktemp("uneven") / "scene", views=16)
    gains = np.random.default_rng(3).normal(0, 0.25, 16)
    for path, gain in zip(sorted((scene / "images").iterdir()), gains, strict=True):
        light = to_light(torch.from_numpy(cv2.imread(str(path)) / 255)) * np.exp(gain)
        cv2.imwrite(str(path), (to_display(light).clamp(0, 1) * 255).round().byte().numpy())
    return scene, {path.name: gain for path, gain in zip(sorted((scene / "images").iterdir()), gains, strict=True)}


def test_gains_come_out(unevenly_exposed, tmp_path):
    scene, truth = unevenly_exposed
    settings = replace(SETTINGS, iterations=200, effects=f"{OFF},exposure=on")
    train(scene, tmp_path / "run", settings)
    tensors, state = load_checkpoint(tmp_path / "run")
    learned = tensors["exposure.raw"][:, 0].numpy()
    true = np.array([truth[name] for name in state["exposure"]])
    assert np.corrcoef(learned, true)[0, 1] > 0.8
    assert "view_00.png" not in state["exposure"] and "view_08.png" not in state["exposure"]  # held out


def test_a_held_out_gain_is_what_neighbours_let_expect():
    film = Exposure.starting({f"{k:02d}": 0.1 * k for k in range(10) if k != 5})
    known = film.log_gains[:, 0]
    assert float(film.log_gain("05")) == pytest.approx(float(known[4] + known[5]) / 2, rel=0.1)
    chance = Exposure.starting({f"{k:02d}": 0.3 * (-1) ** k for k in range(10)})
    assert float(chance.log_gain("045")) == 0  # neighbours say nothing
    assert float(Exposure.starting({"a": 0.1, "c": 0.3}).log_gain("b")) == 0


# Trials ---------------------------------------------------------------------------------------------------------------


def try_effect(name):
    """Leave an effect to a trial, whatever the plan says."""

    def change(trainer):
        trainer.selection.to_try = [name]
        trainer.selection.switch(trainer.state, {name: False})

    return change


def test_what_is_doubtful_is_tried_and_kept_where_it_gains(unevenly_exposed, tmp_path, monkeypatch):
    scene, _ = unevenly_exposed
    gains = iter([(0.1, 0.3), (0.9, 0.3)])
    monkeypatch.setattr(trials, "gain_of_effect", lambda without, having: next(gains))
    for kept in (False, True):
        metrics = train_with(scene, tmp_path / str(kept), SETTINGS, try_effect("exposure"))["metrics"]
        (trial,) = metrics["trials"]
        assert trial["effect"] == "exposure" and trial["kept"] is kept and trial["seconds"] > 0
        assert trial["sentence"].startswith("Tried exposure at iteration 4: +0.")
        assert ("exposure" in metrics["effects"]) is kept
        assert ("exposure.raw" in load_checkpoint(tmp_path / str(kept))[0]) is kept


def test_a_run_whose_trial_gains_nothing_is_the_run_without(unevenly_exposed, tmp_path, monkeypatch):
    scene, _ = unevenly_exposed
    train(scene, tmp_path / "plain", replace(SETTINGS, effects=OFF))
    monkeypatch.setattr(trials, "gain_of_effect", lambda without, having: (0.0, 0.3))
    settings = replace(SETTINGS, effects=OFF.replace("caustics=off,", ""))
    train_with(scene, tmp_path / "tried", settings, try_effect("caustics"))
    plain, tried = (load_checkpoint(tmp_path / name)[0] for name in ("plain", "tried"))
    assert plain.keys() == tried.keys() and all(torch.equal(plain[name], tried[name]) for name in plain)


def test_margins_say_what_is_near_a_threshold():
    assert trials.margin({"gain": 12, "gain_least": 10, "spread": 0.1, "spread_most": 0.3}) == pytest.approx(1.2)
    assert trials.margin({"change": [0.05, 0.2, 0.1], "change_least": 0.1}) == pytest.approx(2)
    assert trials.margin({"range_ratio": 1.2, "range_ratio_least": 1.15, "none": None, "none_least": 1}) == np.inf


def test_what_moves_is_found_without_being_asked_for_and_nothing_else(tiny_scene, tmp_path):
    plain = replace(SETTINGS, iterations=300, max_gaussians=1500)
    for name, effects in (("planned", ""), ("off", "moving_objects=off")):
        metrics = train(tiny_scene, tmp_path / name, replace(plain, effects=effects))["metrics"]
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
    torch.testing.assert_close(relit(display, factor), to_display(to_light(display) * factor.exp()))
    inputs = (torch.tensor([[0.01, 0.05, 0.5], [0.9, 0.02, 0.3]]).double(), torch.tensor([[0.7], [-1.5]]).double())
    assert torch.autograd.gradcheck(relit, [value.requires_grad_() for value in inputs])


def test_water_that_only_attenuates_has_no_veil():
    raw = torch.tensor([0.1, -0.5, -1.0], dtype=torch.float64)
    colors, offsets = torch.rand(5, 3).double() * 0.8 + 0.1, torch.randn(5, 3).double()
    medium = Medium(raw, None, None, 2.0)
    expected = to_light(colors) * torch.exp(-medium.beta_D * offsets.norm(dim=1, keepdim=True))
    torch.testing.assert_close(to_light(through_water(colors, offsets, medium)), expected)
    assert medium.to_json()["B_inf"] == [0, 0, 0] and list(medium.parameters()) == ["attenuation"]
    inputs = [value.requires_grad_() for value in (colors, raw)]
    assert torch.autograd.gradcheck(lambda c, r: through_water(c, offsets, Medium(r, None, None, 2.0)), inputs)
