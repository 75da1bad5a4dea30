"""Regions in a training: features that change no picture, and switches that do."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from swag_engine.experiments.label_run import search_run
from swag_engine.formats.ply import read_ply
from swag_engine.rendering.model import cloud_from_checkpoint
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.semantics.regions import ImageRegions, common_labels
from swag_engine.settings.recipes import recipe_of
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import guidance as guidance_module
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.guidance import Guidance, find_guidance, is_pruned, open_water_loss, salience
from swag_engine.training.objective import Objective
from swag_engine.training.targets import Target
from swag_engine.training.trainer import train
from tests.scenes.clouds import make_cloud
from tests.scenes.tiny import make_tiny_scene

SETTINGS = TrainSettings(iterations=100, width=64, max_gaussians=400, sh_degree=1)
ALL_ON = "salient-densification=on,salient-pixels=on,open-water=on,class-pruning=on,reallocation=on"
NAMES = ("open water", "coral")
TRAINED = tuple(f"view_{number:02d}.png" for number in (2, 3, 4, 5, 6, 7))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene with masks in its folder `labels`: open water to the left, coral to the right."""
    folder = make_tiny_scene(tmp_path_factory.mktemp("scenes") / "tiny")
    (folder / "labels").mkdir()
    (folder / "labels" / "labels.txt").write_text("\n".join(NAMES))
    drawn = np.full((48, 64), 2, np.uint8)
    drawn[:, :20] = 1
    for photograph in (folder / "images").iterdir():
        cv2.imwrite(str(folder / "labels" / photograph.name), drawn)
    return folder


@pytest.fixture(scope="module")
def plain(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "plain"
    train(scene, run, SETTINGS)
    return run


@pytest.fixture(scope="module")
def learned(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "learned"
    result = train(scene, run, replace(SETTINGS, effects="semantics=on"))
    assert "Labelled by masks: coral, open water." in result["metrics"]["notes"]
    return run


def tensors_of(run: Path) -> dict[str, torch.Tensor]:
    loaded = load_checkpoint(run)
    assert loaded is not None
    return loaded[0]


def same_pictures(run: Path, other: Path) -> bool:
    """Whether all that is drawn is bit-equal in two runs: Gaussians, their Adam moments, the background."""
    first, second = tensors_of(run), tensors_of(other)
    return all(torch.equal(tensor, second[name]) for name, tensor in first.items() if ".features" not in name)


def test_features_alone_change_no_picture(plain: Path, learned: Path) -> None:
    assert same_pictures(plain, learned)
    metrics = [json.loads((run / "metrics.json").read_text())["test_psnr"] for run in (plain, learned)]
    assert metrics[0] == metrics[1]
    assert not (plain / "labels.json").exists() and tensors_of(plain)["cloud.features"].shape[1] == 0


def test_features_are_learned_and_grow_with_the_gaussians(scene: Path, learned: Path) -> None:
    tensors, table = tensors_of(learned), json.loads((learned / "labels.json").read_text())
    features = tensors["cloud.features"]
    assert features.shape == (len(tensors["cloud.means"]), 32) and len(features) > 300
    assert [entry["name"] for entry in table["labels"]] == ["coral", "open water"] and table["regions"] == "masks"
    labels = torch.from_numpy(read_ply(learned / "result.ply").extras["label"].astype(np.int64))
    said = guidance(scene).labels_of(features)
    known = (said > 0) & (labels > 0)
    assert known.float().mean() > 0.7 and (said == labels)[known].float().mean() > 0.95
    similarity, names = search_run(learned, "coral")
    assert names == ["coral"] and similarity[labels == 1].mean() > similarity[labels == 2].mean() + 0.5


def test_stage_two_freezes_features(scene: Path, tmp_path: Path) -> None:
    # Nothing is tried: every question is then of an iteration.
    untried = "lamp=off,exposure=off,vignetting=off,caustics=off,moving_objects=off"
    settings = replace(SETTINGS, effects=f"semantics=on,{untried}")
    asked = iter(range(1000))
    stop = round(0.95 * SETTINGS.iterations)  # stage two begins at 90 %
    train(scene, tmp_path / "run", settings, should_stop=lambda: next(asked) >= stop)
    before = tensors_of(tmp_path / "run")
    train(scene, tmp_path / "run", settings, resume=True)
    after = tensors_of(tmp_path / "run")
    assert torch.equal(before["cloud.features"], after["cloud.features"]) and before["cloud.features"].any()
    assert not torch.equal(before["cloud.sh0"], after["cloud.sh0"])


def test_a_resumed_run_is_bit_equal_with_every_switch_on(scene: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, effects=ALL_ON)
    train(scene, tmp_path / "whole", settings)
    asked = iter(range(1000))
    train(scene, tmp_path / "parts", settings, should_stop=lambda: next(asked) >= 45)
    train(scene, tmp_path / "parts", settings, resume=True)
    whole, parts = tensors_of(tmp_path / "whole"), tensors_of(tmp_path / "parts")
    assert whole.keys() == parts.keys()
    assert all(torch.equal(tensor, parts[name]) for name, tensor in whole.items())
    assert (tmp_path / "whole" / "result.ply").read_bytes() == (tmp_path / "parts" / "result.ply").read_bytes()


def empty_masks(scene: Path, tmp_path: Path) -> dict[str, str]:
    folder = tmp_path / "masks" / "coral"
    folder.mkdir(parents=True)
    for photograph in (scene / "images").iterdir():
        cv2.imwrite(str(folder / photograph.name), np.zeros((48, 64), np.uint8))
    return {"masks": str(tmp_path / "masks")}


def masks_of_another_size(scene: Path, tmp_path: Path) -> dict[str, str]:
    folder = tmp_path / "masks" / "coral"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "view_01.png"), np.full((30, 30), 255, np.uint8))
    return {"masks": str(tmp_path / "masks")}


@pytest.mark.parametrize(
    ("wrong", "note"),
    [
        (empty_masks, "found no region in any of the"),
        (masks_of_another_size, "30 x 30 pixels, which is not the aspect ratio of its image, 64 x 48"),
        (lambda scene, tmp_path: {"masks": str(tmp_path / "absent")}, "There is no folder"),
        (lambda scene, tmp_path: {"words": "coral,,wreck"}, "One of the words to look for is empty"),
        (lambda scene, tmp_path: {"words": "coral"}, "is not on this machine"),
    ],
)
def test_what_cannot_be_labelled_does_not_harm_a_training(
    scene: Path, plain: Path, tmp_path: Path, wrong: Callable[[Path, Path], dict[str, Any]], note: str
) -> None:
    settings = replace(SETTINGS, effects="semantics=on", **wrong(scene, tmp_path))
    result = train(scene, tmp_path / "run", settings)
    assert len(result["metrics"]["notes"]) == 1 and result["metrics"]["notes"][0].startswith("No labels: ")
    assert note in result["metrics"]["notes"][0] and "Traceback" not in result["metrics"]["notes"][0]
    assert same_pictures(plain, tmp_path / "run") and not (tmp_path / "run" / "labels.json").exists()


def test_an_embedding_that_is_no_number_does_not_harm_a_training(
    scene: Path, plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        name, key = "broken", "broken"

        def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
            return np.full(40, np.nan, np.float32)

    monkeypatch.setattr(guidance_module, "make_embedder", lambda *arguments, **more: Broken())
    result = train(scene, tmp_path / "run", replace(SETTINGS, effects="semantics=on"))
    assert "made numbers that are not finite" in result["metrics"]["notes"][0]
    assert same_pictures(plain, tmp_path / "run")


@pytest.mark.parametrize("count", [1, 300])
def test_one_label_and_300_labels_do_not_harm_a_training(scene: Path, plain: Path, tmp_path: Path, count: int) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    (folder / "labels.txt").write_text("\n".join(f"thing {number}" for number in range(1, count + 1)))
    rows, columns = np.mgrid[:48, :64]
    for number, photograph in enumerate(sorted((scene / "images").iterdir())):
        drawn = 1 + (rows // 4 * 16 + columns // 4 + 40 * number) % count  # 192 regions a photograph
        cv2.imwrite(str(folder / photograph.name), drawn.astype(np.uint16))
    short = replace(SETTINGS, iterations=20)
    train(scene, tmp_path / "plain", short)
    result = train(scene, tmp_path / "run", replace(short, effects="semantics=on", masks=str(folder)))
    assert same_pictures(tmp_path / "plain", tmp_path / "run")
    note = result["metrics"]["notes"][0]
    assert note.startswith("Labelled by masks: thing ") and ("labels distinguish nothing" in note) == (count == 1)
    assert len(json.loads((tmp_path / "run" / "labels.json").read_text())["labels"]) == count


# What labels do to pictures -------------------------------------------------------------------------------------------


def guidance(scene: Path, effects: str = "semantics=on") -> Guidance:
    loaded = load_scene(scene)
    images = load_images(loaded, [view for view in loaded.views if view.name in TRAINED], 64)
    note, found = find_guidance(loaded, images, recipe_of("swag", effects), SETTINGS, None)
    assert found is not None, note
    return found


def test_open_water_is_cleared_and_gives_the_tail_its_color() -> None:
    alpha = torch.tensor([[0.5, 0.5, 0.9]], requires_grad=True)
    behind = torch.zeros(3, requires_grad=True)
    photograph = torch.tensor([[[0.1, 0.2, 0.3]] * 3])
    water = torch.tensor([[True, True, False]])
    loss = open_water_loss(alpha, behind, photograph, water)
    assert float(loss.detach()) == pytest.approx(0.5 + 0.2)
    loss.backward()
    assert alpha.grad is not None and alpha.grad.tolist() == [[0.5, 0.5, 0.0]]
    assert behind.grad is not None and torch.allclose(behind.grad, torch.full((3,), -1 / 3))
    assert float(open_water_loss(alpha.detach(), behind.detach(), photograph, torch.zeros_like(water))) == 0


def test_the_open_water_switch_empties_open_water(scene: Path, plain: Path, tmp_path: Path) -> None:
    train(scene, tmp_path / "run", replace(SETTINGS, effects="open-water=on"))
    camera = load_images(load_scene(scene), load_scene(scene).views[1:2], 64)[0].camera
    shown = [render(cloud_from_checkpoint(tensors_of(run)), camera).alpha.detach() for run in (plain, tmp_path / "run")]
    cleared = [float((shown[1] - shown[0])[:, columns].mean()) for columns in (slice(0, 18), slice(24, 64))]
    assert cleared[0] < -0.05 and cleared[0] < 3 * cleared[1]


def test_pixels_of_what_stands_out_count_more(scene: Path) -> None:
    found = guidance(scene, "salient-pixels=on")
    found.weights = torch.tensor([1.0, 1.5, 0.5])  # coral, open water
    image = load_images(load_scene(scene), load_scene(scene).views[2:3], 64)[0]
    target = Target.shrunk(image, 1, torch.device("cpu"))
    found.emphasise([target])
    assert target.emphasis is not None
    assert torch.allclose(target.emphasis[:, :20], torch.tensor(1 / 3)) and (target.emphasis[:, 20:] == 1).all()
    objective = Objective(recipe_of("swag"), 1.0, None, "torch")
    off = target.color.clone()
    off[:, :20] += 0.3
    counted = float(objective.reconstruction(off, target, 1.0))
    target.emphasis = None
    assert 1 / 9 < counted / float(objective.reconstruction(off, target, 1.0)) < 1 / 3  # squares and absolute values
    guidance(scene).emphasise([target])
    assert target.emphasis is None


def test_growth_prefers_and_pruning_drops_by_the_features_of_gaussians(scene: Path) -> None:
    found = guidance(scene, "salient-densification=on,class-pruning=on")
    found.weights = torch.tensor([1.0, 1.5, 0.5])
    cloud = make_cloud(5, dtype=torch.float32)
    coral, water = torch.from_numpy(found.regions.prototypes)
    # The last two are not sure: one has hardly been pulled, one lies between.
    cloud.features = torch.stack([coral, 0.8 * water, coral, 0.2 * water, 0.5 * (coral + water)])
    between = torch.nn.functional.normalize(cloud.features[4], dim=0) @ coral < 0.7
    assert found.labels_of(cloud.features).tolist() == [1, 2, 1, 0, 0] or not between
    assert found.densification_weights(cloud).tolist()[:4] == [1.5, 0.5, 1.5, 1.0]
    before = cloud.opacity_logits.clone()
    found.prune(cloud)
    assert (cloud.opacity_logits != before).tolist() == [False, True, False, False, False]
    assert cloud.opacities[1] < 1e-6
    cloud.features = water.repeat(5, 1)
    before = cloud.opacity_logits.clone()
    found.prune(cloud)  # it would leave nothing
    assert torch.equal(cloud.opacity_logits, before)
    off = guidance(scene)
    cloud.features[1:] = coral
    off.prune(cloud)
    assert torch.equal(cloud.opacity_logits, before) and off.densification_weights(cloud) is None


def test_pruned_classes_are_words_of_a_name() -> None:
    assert all(map(is_pruned, ("fish", "a school of Fish", "open water", "haze")))
    assert not any(map(is_pruned, ("starfish", "sea fan", "water bottle", "thing 1")))


def test_salience_is_high_for_what_differs_and_least_for_open_water() -> None:
    random = np.random.default_rng(1)
    pixels = np.full((96, 128, 3), (20, 60, 90), np.uint8)  # water above, sand below, a red thing on it
    pixels[40:] = np.clip(random.normal((120, 120, 90), 12, (56, 128, 3)), 0, 255)
    pixels[60:85, 50:80] = np.clip(random.normal((210, 40, 30), 12, (25, 30, 3)), 0, 255)
    index = np.full((96, 128), 1, np.uint16)
    index[40:], index[60:85, 50:80] = 2, 3
    names = ("open water", "sand", "sponge")
    regions = common_labels({"a": ImageRegions(index, names, np.eye(40, dtype=np.float32)[:3])}, names)
    camera = Camera("a", 128, 96, 100.0, 100.0, 64, 48, np.eye(4))
    none, water, sand, sponge = salience(regions, [TrainingImage(camera, pixels, index > 0)]).tolist()
    assert none == 1 and sponge == 1.5 and water == pytest.approx(0.5, abs=0.05) and water < sand < 1.2
