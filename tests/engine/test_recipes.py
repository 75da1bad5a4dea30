"""Recipes and their switches."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.evaluation.ssim import ssim
from swag_engine.formats.run_folder import RunFolder
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.georeference import Georeference, write_georeference
from swag_engine.scene.images import load_images
from swag_engine.scene.split import split_views
from swag_engine.settings import recipes
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.recipes import RECIPES, SWITCHES, Photometric, Recipe, recipe_of
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.losses import CLOSED
from swag_engine.training.network_priors import depth_of_images, frames_between
from swag_engine.training.objective import Objective
from swag_engine.training.step import GEOMETRY
from swag_engine.training.targets import Target
from swag_engine.training.trainer import Trainer, train
from tests.scenes.tiny import make_tiny_scene

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck"
SETTINGS = TrainSettings(iterations=60, width=64, max_gaussians=400, sh_degree=1)


def trainer_of(scene, folder, monkeypatch, **values):
    """A trainer of the plain recipe with `values` changed."""
    monkeypatch.setitem(RECIPES, "3dgs", replace(Recipe(), **values))
    return Trainer(load_scene(scene), RunFolder(folder), replace(SETTINGS, recipe="3dgs"), lambda event: None, None)


def test_switches_turn_parts_on_and_off():
    assert recipe_of("seasplat", "water=off") == replace(RECIPES["seasplat"], effects=frozenset())
    assert recipe_of("3dgs", "depth_prior=on, grey-world=on") == Recipe(
        effects=frozenset({"depth_prior"}), grey_world=0.02
    )
    for effect in (*EFFECTS, *SWITCHES):
        assert recipe_of("swag", f"{effect}=on,{effect}=off") == recipe_of("swag", f"{effect}=off")


def test_switching_on_a_part_of_the_recipe_keeps_its_values():
    assert recipe_of("paper", "grey-world=on,stages=on") == RECIPES["paper"]


@pytest.mark.parametrize("effects", ["fog=on", "water", "water=yes", "=on"])
def test_unknown_switches_are_refused(effects):
    with pytest.raises(InputError, match="There is no effect|can be on or off"):
        TrainSettings(effects=effects)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_trains_and_resumes_bit_equal(recipe, tiny_scene, tmp_path):
    settings = replace(SETTINGS, recipe=recipe)
    asked = iter(range(10**9))
    train(tiny_scene, tmp_path / "whole", settings)
    train(tiny_scene, tmp_path / "parts", settings, should_stop=lambda: next(asked) >= 40)
    result = train(tiny_scene, tmp_path / "parts", settings, resume=True)
    expected, _ = load_checkpoint(tmp_path / "whole")
    got, _ = load_checkpoint(tmp_path / "parts")
    assert expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)
    assert all(tensor.isfinite().all() for tensor in got.values())
    assert result["metrics"]["test_psnr"] > result["metrics"]["control_psnr"]


# Stages ---------------------------------------------------------------------------------------------------------------


def test_stage_two_freezes_geometry_and_water_bit_by_bit(tiny_scene, tmp_path, monkeypatch):
    trainer = trainer_of(tiny_scene, tmp_path, monkeypatch, effects=recipes.WATER, stage_two_from=0.5)
    while trainer.state.iteration < 30:
        trainer.iterate()
    kept = {name: tensor.detach().clone() for name, tensor in trainer.state.optimizer.parameters().items()}
    moments = {name: trainer.state.optimizer.moments[name][0].clone() for name in GEOMETRY}
    while trainer.state.iteration < 60:
        trainer.iterate()
    for name, tensor in trainer.state.optimizer.parameters().items():
        frozen = name in GEOMETRY or name.startswith("medium.")
        assert torch.equal(tensor.detach(), kept[name]) == frozen or name == "background", name
    assert all(torch.equal(trainer.state.optimizer.moments[name][0], moments[name]) for name in GEOMETRY)
    assert any(trainer.state.effects.medium.parameters())


def test_stage_two_has_its_own_weights():
    recipe = Recipe(photometric=Photometric((1.0, 1.0), 0.0), stage_two_from=0.5, photometric_two=recipes.TRUE_L2)
    objective = Objective(recipe, 1.0, None, "torch")
    color = torch.full((4, 4, 3), 0.75)
    target: Any = StubTarget()
    assert objective.reconstruction(color, target, 0.4).item() == pytest.approx(0.25)
    assert objective.reconstruction(color, target, 0.6).item() == pytest.approx(0.05 * 0.25 + 0.9 * 0.0625)


def test_surfaces_are_closed_in_front_of_open_water_alone():
    objective = Objective(Recipe(stage_two_from=0.5, coverage=0.1), 1.0, None, "torch")
    color: torch.Tensor = torch.full((4, 4, 3), 0.5)
    target: Any = StubTarget()
    target.valid = torch.ones(4, 4, dtype=torch.bool)
    picture: Any = StubPicture(color, torch.full((4, 4), 0.25), behind=torch.zeros(4, 4, 3))
    for fraction in (0.0, 0.4, 0.6):
        assert objective(picture, target, None, fraction).item() == pytest.approx(0.1 * (0.75 - CLOSED))
    picture.behind = None
    assert objective(picture, target, None, 0.6).item() == 0


@dataclass
class StubPicture:
    color: torch.Tensor
    alpha: torch.Tensor
    behind: torch.Tensor | None
    range = restored = None


class StubTarget:
    interpolated = False
    color = torch.full((4, 4, 3), 0.5)
    valid = None
    weight = 1.0
    inverse_range = None
    emphasis = None


def test_weights_follow_the_paper_over_time():
    objective = Objective(RECIPES["paper"], 1.0, None, "torch")
    color = torch.full((4, 4, 3), 0.75)
    target: Any = StubTarget()
    t = 0.3
    similar = ssim(color, StubTarget.color, "torch").item()
    expected = (0.7 + 0.5 * t) * 0.8 * 0.25 + 0.2 * (1 - similar) + 0.1 * t * 0.0625
    assert objective.reconstruction(color, target, t).item() == pytest.approx(expected, rel=1e-5)
    t = 0.8
    expected = (0.7 + 0.5 * t) * 0.25 + 0.9 * 0.0625
    assert objective.reconstruction(color, target, t).item() == pytest.approx(expected, rel=1e-5)


def test_reallocation_keeps_the_number_and_ends_before_stage_two(tiny_scene, tmp_path, monkeypatch):
    values = {"reallocation": "balanced", "densify_until": 0.4, "stage_two_from": 0.8}
    trainer = trainer_of(tiny_scene, tmp_path, monkeypatch, **values)
    moved = []
    replace_free = trainer.state.replace_free

    def watched(cloud, source):
        moved.append((trainer.state.iteration, len(trainer.state.cloud), len(cloud)))
        replace_free(cloud, source)

    trainer.state.replace_free = watched
    while trainer.state.iteration < 60:
        trainer.iterate()
    assert [iteration for iteration, _, _ in moved] == [24, 30, 36, 42]
    assert all(before == after for _, before, after in moved)


# Priors and presets ---------------------------------------------------------------------------------------------------


def test_training_continues_without_networks_with_a_note(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path / "cache"))
    settings = replace(SETTINGS, recipe="3dgs", effects="depth_prior=on,interpolation=on", iterations=10)
    metrics = train(tiny_scene, tmp_path / "run", settings)["metrics"]
    depth, frames = metrics["notes"]
    assert depth.startswith("No depth prior: The network depth-anything-v2-small") and "get it" in depth
    assert frames.startswith("No interpolated frames: The network rife") and "get it" in frames


def test_stored_depth_becomes_the_prior(tmp_path):
    scene_folder = shutil.copytree(REEF, tmp_path / "scene")
    (scene_folder / "depth").mkdir()
    for path in sorted((REEF / "range").glob("*.png")):
        millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32)
        inverse = np.where(millimetres > 0, 1000 / np.maximum(millimetres, 1), 0)
        np.save(scene_folder / "depth" / f"{path.stem}.npy", 3 * inverse + 0.2)
    scene = load_scene(scene_folder)
    images = load_images(scene, scene.views[::8], 160)
    note, priors = depth_of_images(scene, images, None)
    assert note == "Depth prior on 3 of 3 images."
    for image in images:
        stored = cv2.imread(str(REEF / "range" / f"{image.camera.name[:-4]}.png"), cv2.IMREAD_UNCHANGED)
        truth = cv2.resize(stored, (160, image.valid.shape[0]), interpolation=cv2.INTER_NEAREST) / 1000
        error = np.abs(priors[image.camera.name] * truth - 1)[truth > 0]
        assert np.median(error) < 0.02
    objective = Objective(Recipe(effects=frozenset({"depth_prior"})), 1.0, None, "torch")
    with_prior = Target.shrunk(images[0], 2, torch.device("cpu"), priors[images[0].camera.name])
    assert with_prior.inverse_range.shape == with_prior.valid.shape
    assert objective.needs_range(with_prior, 0.1)
    assert not objective.needs_range(Target.shrunk(images[0], 2, torch.device("cpu")), 0.1)


def test_damaged_depth_is_ignored_with_a_note(tmp_path):
    scene_folder = shutil.copytree(REEF, tmp_path / "scene")
    (scene_folder / "depth").mkdir()
    scene = load_scene(scene_folder)
    images = load_images(scene, scene.views[1:2], 80)
    (scene_folder / "depth" / "reef_001.npy").write_bytes(b"no array")
    note, priors = depth_of_images(scene, images, None)
    assert note.startswith("No depth prior: ") and "reef_001.npy cannot be read" in note and not priors


@pytest.mark.parametrize(
    "values, message",
    [
        ({"water_type": "IX", "metres_per_unit": 1.0}, "not known: use one of I, IA"),
        ({"water_type": "-1,0,0", "metres_per_unit": 1.0}, "from 0 to 10"),
        ({"metres_per_unit": -1.0}, "must be a number from"),
    ],
)
def test_impossible_water_settings_are_refused(values, message):
    with pytest.raises(InputError, match=message):
        TrainSettings(**values)


def test_a_water_type_needs_the_scale_of_the_scene(tiny_scene, tmp_path):
    with pytest.raises(InputError, match="scene's scale is needed"):
        train(tiny_scene, tmp_path / "run", replace(SETTINGS, water_type="II"))
    assert not (tmp_path / "run").exists()


def test_training_takes_the_measured_scale_of_the_scene(tiny_scene, tmp_path):
    scene, run = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(tiny_scene, scene)
    measured = Georeference(0.5, 0.01, "targets", "estimated", np.eye(3), np.zeros(3))
    write_georeference(scene, measured)
    train(scene, run, replace(SETTINGS, water_type="II", iterations=4))
    assert json.loads((run / "config.json").read_text())["settings"]["metres_per_unit"] == 0.5
    assert json.loads((run / "water.json").read_text())["per"] == "metre"
    train(scene, tmp_path / "own", replace(SETTINGS, metres_per_unit=2.0, iterations=4))
    assert json.loads((tmp_path / "own" / "config.json").read_text())["settings"]["metres_per_unit"] == 2.0


def test_a_chosen_water_type_is_modelled_whatever_the_evidence(tiny_scene, tmp_path):
    settings = replace(SETTINGS, water_type="II", metres_per_unit=0.5, iterations=10)
    metrics = train(tiny_scene, tmp_path / "run", settings)["metrics"]
    assert metrics["water"] == "Water is modelled: starting from the type II."
    water = json.loads((tmp_path / "run" / "water.json").read_text())
    assert water["per"] == "metre"
    np.testing.assert_allclose(water["beta_D"], (0.260, 0.076, 0.062), rtol=0.15)


@pytest.mark.parametrize("recipe", ["swag", "paper", "seasplat"])
@pytest.mark.parametrize("case", ["grey", "two views", "black"])
def test_images_with_little_evidence_are_trained(case, recipe, tmp_path):
    scene = make_tiny_scene(tmp_path / "scene", views=2 if case == "two views" else 5)
    for path in (scene / "images").glob("*.png"):
        pixels = cv2.imread(str(path))
        if case != "two views":
            pixels[:] = pixels.mean(axis=2, keepdims=True) if case == "grey" else 0
        cv2.imwrite(str(path), pixels)
    settings = replace(SETTINGS, recipe=recipe, effects="grey-world=on,smoothness=on,hinge=on", iterations=20)
    metrics = train(scene, tmp_path / "run", settings)["metrics"]
    tensors, _ = load_checkpoint(tmp_path / "run")
    assert all(tensor.isfinite().all() for tensor in tensors.values())
    if recipe == "swag":  # one range and little color: the water is undetermined
        assert metrics["water"].startswith("No water is modelled: ")


# Interpolated frames --------------------------------------------------------------------------------------------------


def test_frames_lie_between_training_images_and_count_for_color_only(tmp_path, monkeypatch):
    scene_folder = make_tiny_scene(tmp_path / "scene", views=12)
    scene = load_scene(scene_folder)
    split = split_views(view.camera.name for view in scene.views)
    images = {image.camera.name: image for image in load_images(scene, scene.views, 64)}
    order = sorted(images)
    used: list[str] = []

    def frame_between(a, b, t):
        """The true image between two; a blend of two that are neighbours."""
        first, second = (next(name for name in order if images[name].pixels is pixels) for pixels in (a, b))
        used.extend((first, second))
        gap = order.index(second) - order.index(first)
        return images[order[order.index(first) + 1]].pixels if gap == 2 else cv2.addWeighted(a, 0.5, b, 0.5, 0)

    note, frames = frames_between(frame_between, scene, [images[name] for name in split.train])
    assert frames and note.startswith(f"{len(frames)} interpolated frames (100.0 dB")
    assert set(used) == set(split.train)
    for frame in frames:
        first, _, second = frame.camera.name.partition("@")[0].partition("+")
        assert order.index(second) == order.index(first) + 1 and {first, second} <= set(split.train)

    trainer = trainer_of(scene_folder, tmp_path / "run", monkeypatch)
    trainer.targets.frames = frames
    weights = []
    target: Target
    add = trainer.state.statistics.add
    trainer.state.statistics.add = lambda *arguments: (weights.append(target.weight), add(*arguments))
    seen = set()
    for _ in range(len(split.train) + len(frames)):
        target = trainer.targets.next(trainer.state, 0.0)
        seen.add((target.camera.name, target.weight))
        trainer.iterate()
    assert {weight for name, weight in seen if "+" in name} == {0.1}
    assert {name for name, _ in seen if "+" not in name} == set(split.train)
    assert set(weights) == {1.0} and len(weights) == len(split.train)


def test_poor_frames_are_not_used(tmp_path):
    scene = load_scene(make_tiny_scene(tmp_path / "scene", views=12))
    note, frames = frames_between(lambda a, b, t: np.zeros_like(a), scene, load_images(scene, scene.views, 64))
    assert not frames and note.startswith("No interpolated frames: Interpolated frames differ from the images")
