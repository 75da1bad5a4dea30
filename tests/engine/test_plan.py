"""The plan: decisions, plan.json, choices of the user, and the table for a terminal."""

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.effects.registry import REGISTRY
from swag_engine.planning.costs import ROUNDS, measured_costs
from swag_engine.planning.plan import Plan, describe, made_from, plan_scene, read_plan
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.split import split_views
from swag_engine.settings.effect_names import EFFECTS, parse_effects

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck"


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    return plan_scene(REEF, folder), folder / "plan.json"


def test_the_demo_scene_is_planned(planned):
    plan, _ = planned
    assert list(plan.effects) == list(EFFECTS)
    assert [name for name in EFFECTS if plan.on(name)] == [
        "attenuation",
        "backscatter",
        "separate_backscatter",
        "moving_objects",  # undetermined before training
        "semantics",
    ]
    truth = json.loads((REEF / "truth.json").read_text())["water"]
    for name in ("beta_D", "B_inf"):
        assert plan.water[name] == pytest.approx(truth[name], rel=0.35)
    assert plan.water["light"] == "linear" and plan.water["per"] == "unit"
    low, high = plan.water["intervals"]["beta_D"]
    assert all(a <= value <= b for a, value, b in zip(low, plan.water["beta_D"], high, strict=True))


def test_costs_are_measured_on_this_machine(planned):
    plan, _ = planned
    costs = {name: effect.cost_ms for name, effect in plan.effects.items()}
    measured = ("attenuation", "backscatter", "lamp", "exposure", "vignetting", "caustics", "semantics", "depth_prior")
    assert all(costs[name] > 0 for name in measured)
    assert costs["interpolation"] == costs["separate_backscatter"] == 0
    small = measured_costs(80, 45)
    assert small["exposure"] < costs["exposure"] and small["caustics"] < costs["caustics"]


def test_costs_do_not_depend_on_other_load(monkeypatch):
    measured = []

    def probe(name, wait):
        def work():
            measured.append((name, torch.get_num_threads()))
            time.sleep(wait)  # as another program's turn on the processor
            return torch.ones((), requires_grad=True) * 2

        return replace(REGISTRY["exposure"], cost=lambda _: work)

    monkeypatch.setattr(
        "swag_engine.planning.costs.REGISTRY", {"waits": probe("waits", 0.02), "other": probe("other", 0.0)}
    )
    threads = torch.get_num_threads()
    found = measured_costs(8, 8, "cpu")
    assert found["waits"] < 5
    assert measured == [("waits", 1), ("other", 1)] * (ROUNDS + 1), "in turns, on one thread"
    assert torch.get_num_threads() == threads


def test_plan_json_is_read_back(planned):
    plan, path = planned
    document = json.loads(path.read_text())
    assert set(document) == {"effects", "water", "scene"}
    assert {"state", "evidence", "reason", "cost_ms"} <= set(document["effects"]["lamp"])
    assert read_plan(path) == plan


@pytest.mark.parametrize("content", ["{", "[]", '{"effects": {}}', '{"effects": {"lamp": 1}, "water": null}'])
def test_other_documents_are_refused_as_plans(tmp_path, content):
    path = tmp_path / "plan.json"
    path.write_text(content)
    with pytest.raises(InputError):
        read_plan(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_plan(tmp_path / "absent.json")


def test_a_plan_from_before_an_effect_existed_is_read_with_it_off(planned, tmp_path):
    document = planned[0].to_json()
    del document["effects"]["caustics"]
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(document))
    plan = read_plan(path)
    assert not plan.on("caustics") and "before this effect existed" in plan.effects["caustics"].reason
    assert plan.effects["attenuation"] == planned[0].effects["attenuation"]
    document["effects"]["fog"] = document["effects"]["lamp"]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="not known here, fog: make the plan again"):
        read_plan(path)


def test_the_key_of_a_plan_is_the_scene_and_not_the_code(planned, tmp_path):
    scene = load_scene(REEF)
    assert made_from(scene) == planned[0].scene
    moved = replace(scene, points=replace(scene.points, positions=scene.points.positions + 1))
    assert made_from(moved) != planned[0].scene


def test_test_images_are_not_read(planned, tmp_path):
    for part in ("images", "sparse"):
        shutil.copytree(REEF / part, tmp_path / part)
    test = split_views([path.name for path in (REEF / "images").iterdir()]).test
    assert len(test) == 3
    for name in test:
        (tmp_path / "images" / name).write_bytes(b"not an image")
    plan = plan_scene(tmp_path)
    assert plan.water == planned[0].water
    for name, effect in planned[0].effects.items():
        assert replace(plan.effects[name], cost_ms=effect.cost_ms) == effect


def test_choices_of_the_user_are_parsed():
    assert parse_effects("caustics=off, exposure=on,exposure=off") == {"caustics": False, "exposure": False}
    assert parse_effects("") == {}
    assert parse_effects("grey-world=on") == {"grey_world": True}
    water = ("attenuation", "backscatter", "separate_backscatter")
    assert parse_effects("water=off") == parse_effects("attenuation=off") == dict.fromkeys(water, False)
    assert parse_effects("separate_backscatter=on") == dict.fromkeys(water, True)
    wrong = {
        "fog=on": "no effect 'fog'",
        "=on": "no effect ''",
        "lamp=maybe": "not 'maybe'",
        "lamp": "lamp=on or lamp=off",
        "attenuation=off,backscatter=on": "backscatter needs attenuation: switch both on, or both off",
    }
    for text, words in wrong.items():
        with pytest.raises(InputError, match=words):
            parse_effects(text)


def test_choices_of_the_user_replace_decisions(planned):
    plan, _ = planned
    changed = plan.overruled({"attenuation": False, "lamp": True})
    assert not changed.on("attenuation") and changed.on("lamp") and changed.on("backscatter")
    assert changed.effects["lamp"].overruled and not changed.effects["backscatter"].overruled
    assert changed.effects["attenuation"].evidence == plan.effects["attenuation"].evidence
    assert Plan.from_json(changed.to_json()) == changed


def test_the_table_has_a_line_for_each_effect(planned):
    text = describe(planned[0])
    lines = text.splitlines()
    assert len(lines) == len(EFFECTS) + 4
    assert lines[0].startswith("attenuation") and "Red loses 7" in lines[0] and " ms " in lines[0]
    assert any(line.startswith("moving objects") and "undetermined" in line for line in lines)
    assert lines[-3].startswith("attenuation per unit") and "red 0.1" in lines[-3]


def test_masks_of_the_user_mark_moving_objects(tmp_path):
    for part in ("images", "sparse"):
        shutil.copytree(REEF / part, tmp_path / part)
    (tmp_path / "masks").mkdir()
    mask = np.full((360, 640), 255, np.uint8)
    mask[100:200, 100:200] = 0
    cv2.imwrite(str(tmp_path / "masks" / "reef_001.png"), mask)
    effect = plan_scene(tmp_path).effects["moving_objects"]
    assert effect.state == "on" and effect.evidence["masked_images"] == 1


def test_the_command_prints_and_writes_the_plan(tiny_scene, tmp_path, capsys):
    words = ["plan", str(tiny_scene), "--out", str(tmp_path / "plan")]
    assert main([*words, "--json"]) == 0
    written = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert json.loads(capsys.readouterr().out) == written and set(written["effects"]) == set(EFFECTS)
    assert main(words) == 0
    assert capsys.readouterr().out.count("\n") >= len(EFFECTS)
