"""Runs with water: coefficients, restored colors, renders with less water, and resuming."""

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.effects.lamp import Lamp
from swag_engine.evaluation.metrics import restored_error
from swag_engine.experiments.develop_run import automatic_development
from swag_engine.experiments.evaluate_run import evaluate_run, load_newest, load_run, render_run, true_image
from swag_engine.experiments.find_haze import describe, find_haze
from swag_engine.experiments.report import write_report
from swag_engine.experiments.restore_photos import restore_photos
from swag_engine.formats.export import ExportOptions, export_run
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.rendering.trained_detail import TrainedDetail
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.develop_splats import bake_development
from swag_engine.splats.development import NO_DEVELOPMENT, Development
from swag_engine.splats.haze import MOST_HAZE, with_haze
from swag_engine.training.checkpoint import load_checkpoint, save_checkpoint
from swag_engine.training.trainer import make_trainer, train
from swag_engine.water.medium import Medium
from tests.engine.exr_files import read_exr

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck"
SETTINGS = TrainSettings(iterations=120, width=160, max_gaussians=6000, sh_degree=1)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same run with and without the water modelled."""
    folder = tmp_path_factory.mktemp("water")
    for recipe in ("swag", "3dgs"):
        train(REEF, folder / recipe, TrainSettings(**{**SETTINGS.to_json(), "recipe": recipe}))
    return folder


def test_the_water_is_found_and_written(runs):
    metrics = json.loads((runs / "swag" / "metrics.json").read_text())
    assert metrics["water"].startswith("Water is modelled: Red loses 7") and metrics["background"] == [0, 0, 0]
    water, truth = (json.loads(path.read_text()) for path in (runs / "swag" / "water.json", REEF / "truth.json"))
    truth = truth["water"]
    assert (water["light"], water["per"]) == ("linear", "unit")
    np.testing.assert_allclose(water["beta_D"], truth["beta_D"], rtol=0.2)
    np.testing.assert_allclose(water["B_inf"], truth["B_inf"], rtol=0.2)
    assert not (runs / "3dgs" / "water.json").exists()


def test_colors_of_small_jpeg_photos_are_said_to_be_less_true(runs, tmp_path):
    shutil.copy(runs / "swag" / "plan.json", tmp_path)
    settings = replace(SETTINGS, width=600)
    trainer = make_trainer(RunFolder(tmp_path), REEF, settings, False, lambda event: None, None, time.monotonic())
    assert any("JPEG" in note for note in trainer.notes)
    for recipe in ("swag", "3dgs"):  # trained at a quarter of the width
        assert "JPEG" not in " ".join(json.loads((runs / recipe / "metrics.json").read_text())["notes"])


def test_exported_gaussians_are_without_water(runs, tmp_path):
    restored, colors = (read_ply(runs / recipe / "result.ply") for recipe in ("swag", "3dgs"))
    # Water absorbs red most: without it the Gaussians have more red relative to green.
    redness = [np.median(s.sh[:, 0, 0] - s.sh[:, 0, 1]) for s in (restored, colors)]
    assert redness[0] > redness[1] + 0.1


def test_evaluation_repeats_the_figures_and_restored_colors_are_nearer_to_the_truth(runs):
    errors = {}
    for recipe in ("swag", "3dgs"):
        evaluation = evaluate_run(runs / recipe)
        metrics = json.loads((runs / recipe / "metrics.json").read_text())
        assert evaluation["test_psnr"] == metrics["test_psnr"]
        errors[recipe] = evaluation["restored"]["delta_e"]
    assert errors["swag"] < 0.7 * errors["3dgs"]


def test_the_result_has_limited_colors_and_their_confidence_and_the_checkpoint_those_of_training(runs):
    splats, loaded = read_ply(runs / "swag" / "result.ply"), load_run(runs / "swag")
    np.testing.assert_array_equal(splats.sh[:, 0], loaded.cloud.sh0[:, 0].numpy())
    confidence = splats.extras["confidence"]
    np.testing.assert_array_equal(confidence, loaded.confidence.numpy())
    assert confidence.dtype == np.float32 and 0 <= confidence.min() < 0.97 < confidence.max() <= 1
    trained = load_checkpoint(runs / "swag")[0]["cloud.sh0"]
    changed = (loaded.cloud.sh0 - trained).abs().amax((1, 2)).numpy()
    assert 0 < 2 * np.median(changed[confidence > 0.99]) < np.quantile(changed[confidence < 0.97], 0.9)
    assert read_glb(runs / "swag" / "result.glb").extras.keys() == {"confidence", "haze"}
    assert torch.equal(loaded.through(1).sh0, trained) and torch.equal(loaded.through(0).sh0, loaded.cloud.sh0)


def test_the_result_hides_open_water_and_keeps_how_to_show_it(runs):
    splats, loaded = read_ply(runs / "swag" / "result.ply"), load_run(runs / "swag")
    trained = load_checkpoint(runs / "swag")[0]["cloud.opacity_logits"]
    score = splats.extras["haze"]
    assert 0 < (score > 0.5).sum() < 0.2 * len(score) and score.min() >= 0
    assert score.max() <= np.float32(MOST_HAZE)
    assert torch.equal(loaded.through(1).opacity_logits, trained)
    torch.testing.assert_close(loaded.through(0, 1).opacities, trained.sigmoid())
    np.testing.assert_allclose(splats.opacities, (1 - score) * trained.sigmoid().numpy(), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(with_haze(splats, 1).opacities, trained.sigmoid().numpy(), rtol=1e-3, atol=1e-6)
    assert any(
        "look like open water" in note for note in json.loads((runs / "swag" / "metrics.json").read_text())["notes"]
    )


def test_open_water_is_found_in_runs_of_earlier_versions(runs, tmp_path):
    old = tmp_path / "old"
    shutil.copytree(runs / "swag", old)
    tensors, stored = load_checkpoint(old)
    score = tensors.pop("haze")
    save_checkpoint(old, stored["iteration"], tensors, stored)
    new, splats = read_ply(old / "result.ply"), read_ply(old / "result.ply")
    splats.opacities[:] = tensors["cloud.opacity_logits"].sigmoid()
    del splats.extras["haze"]
    RunFolder(old).write_result(splats, [0, 0, 1])
    assert torch.equal(load_run(old).through(0).opacity_logits, tensors["cloud.opacity_logits"])
    found = find_haze(old)
    assert found["haze"] == int((score > 0.5).sum()) and f"{found['haze']} of " in describe(found)
    torch.testing.assert_close(load_run(old).haze, score)
    again = read_ply(old / "result.ply")
    np.testing.assert_allclose(again.opacities, new.opacities, rtol=1e-3, atol=1e-6)
    assert again.extras.keys() == {"confidence", "haze"}
    (old / "result.ply").unlink()
    with pytest.raises(InputError, match="no result yet"):
        find_haze(old)


def test_exports_and_renders_show_as_much_haze_as_is_asked_for(runs, tmp_path):
    def alpha_of_haze(**options):
        export_run(runs / "swag", "ply", tmp_path / "out.ply", ExportOptions(develop="none", **options))
        return read_ply(tmp_path / "out.ply").opacities

    trained = load_run(runs / "swag").trained.opacities.numpy()
    clean, half, full = alpha_of_haze(), alpha_of_haze(haze=0.5), alpha_of_haze(haze=1.0)
    np.testing.assert_allclose(full, trained, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(half, 0.5 * (clean + trained), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(alpha_of_haze(water=1.0), trained, rtol=1e-3, atol=1e-6)
    pictures = [
        cv2.imread(str(render_run(runs / "swag", tmp_path / f"{haze}", "reef_000.jpg", 0.0, haze=haze)[0])).mean()
        for haze in (0.0, 0.5, 1.0)
    ]
    assert pictures[0] + 0.5 < pictures[1] < pictures[2] - 0.5, "haze is brighter than the black behind it"
    with pytest.raises(InputError, match="haze must be from 0 to 1"):
        render_run(runs / "swag", tmp_path, None, haze=2)


def test_the_report_maps_the_confidence(runs):
    page = write_report(runs / "swag").read_text()
    assert page.count("<figcaption>confidence</figcaption>") == 3 and "Confidence maps show" in page


def test_without_water_no_color_is_limited(runs):
    splats, trained = read_ply(runs / "3dgs" / "result.ply"), load_checkpoint(runs / "3dgs")[0]
    np.testing.assert_array_equal(splats.sh[:, 0], trained["cloud.sh0"][:, 0].numpy())
    assert splats.extras.keys() == {"haze"} and load_run(runs / "3dgs").confidence is None
    assert "Confidence" not in write_report(runs / "3dgs").read_text()


def test_the_amount_of_water_can_be_chosen(runs, tmp_path):
    means = []
    for amount in (0.0, 0.5, 1.0):
        (path,) = render_run(runs / "swag", tmp_path / str(amount), "reef_000.jpg", amount)
        means.append(cv2.imread(str(path)).mean((0, 1))[::-1])
    image = cv2.imread(str(REEF / "images" / "reef_000.jpg")).mean((0, 1))[::-1]
    assert np.abs(means[2] - image).max() < 12
    blueness = [mean[2] - mean[0] for mean in means]
    assert blueness[0] < blueness[1] < blueness[2]
    with pytest.raises(InputError, match="from 0 to 1, not 1.5"):
        render_run(runs / "swag", tmp_path, None, 1.5)


def test_restored_views_are_developed_and_what_is_measured_is_not(runs, tmp_path):
    cloud, effects, _ = load_newest(runs / "swag")
    found = automatic_development(runs / "swag", cloud, effects)
    assert max(found["clipped"]) <= 0.01 and max(found["clipped"]) <= max(found["clipped_before"])

    def picture(name, **options):
        (path,) = render_run(runs / "swag", tmp_path / name, "reef_000.jpg", **options)
        return path

    def pixels(name, **options):
        return cv2.imread(str(picture(name, **options)))[..., ::-1].astype(np.float64) / 255

    plain, developed = pixels("none", water=0, develop="none"), pixels("auto", water=0)
    wanted = Development.from_json(found).apply(plain)
    below = plain.max(axis=-1) < 0.99  # what 8 bits have cut cannot be developed
    assert np.abs(developed - wanted)[below].max() < 0.03 and np.abs(developed - plain).mean() > 0.005
    assert np.array_equal(pixels("photo", water=1), pixels("photo, none", water=1, develop="none"))
    assert pixels("brighter", water=1, develop="exposure=1").mean() > pixels("photo", water=1).mean() + 0.1
    assert picture("light", water=0, exr=True).suffix == ".exr"
    with pytest.raises(InputError, match="no color chart"):
        render_run(runs / "swag", tmp_path, None, 0.0, "chart")

    write_report(runs / "swag")
    assert "Development" in (runs / "swag" / "report.html").read_text(encoding="utf-8")
    kept = RunFolder(runs / "swag").color_view("auto").restored
    assert kept == Development.from_json(found)
    for develop, expected in (("none", NO_DEVELOPMENT), ("auto", kept)):
        out = tmp_path / f"{develop}.ply"
        result = export_run(runs / "swag", "ply", out, ExportOptions(develop=develop))
        wanted = bake_development(read_ply(runs / "swag" / "result.ply"), expected)
        np.testing.assert_allclose(read_ply(out).sh, wanted.sh, atol=1e-6)
        assert any("developed" in note for note in result["notes"]) == (develop == "auto")


def test_photos_without_modelled_water_are_not_developed(runs):
    cloud, effects, _ = load_newest(runs / "3dgs")
    found = automatic_development(runs / "3dgs", cloud, effects)
    assert Development.from_json(found) == NO_DEVELOPMENT and "No water" in found["note"]


@pytest.fixture
def settled(monkeypatch):
    """Few iterations are enough for the last fit of the water."""
    monkeypatch.setattr("swag_engine.training.effect_selection.SETTLED_AFTER", 0)


def test_the_water_is_fitted_once_and_then_stays(runs, tmp_path, settled):
    shutil.copy(runs / "swag" / "plan.json", tmp_path)
    trainer = make_trainer(RunFolder(tmp_path), REEF, SETTINGS, False, lambda event: None, None, time.monotonic())
    state, medium = trainer.state, trainer.state.effects.medium

    def water() -> torch.Tensor:
        return torch.cat([tensor.detach().reshape(-1) for tensor in medium.parameters().values()])

    while state.clock.fraction < 0.7:
        before = water()
        trainer.iterate()
        assert not torch.equal(water(), before) and not state.water_final
    learned = water()
    trainer.iterate()
    fitted = water()
    assert state.water_final and (fitted - learned).abs().max() > 10 * state.recipe.water_rate
    while state.clock.fraction < 0.95:
        trainer.iterate()
    assert torch.equal(water(), fitted)
    trainer.save()
    trainer.resume()
    assert trainer.state.water_final


@pytest.mark.parametrize("brighter, kept", [(0.01, True), (5.0, False)])
def test_a_fit_that_makes_validation_images_much_worse_is_left_out(
    runs, tmp_path, settled, monkeypatch, brighter, kept
):
    def fit(model, *_):
        with torch.no_grad():
            model.effects.medium.attenuation.add_(1)
            model.cloud.sh0.add_(brighter)

    monkeypatch.setattr("swag_engine.training.trainer.fit_again", fit)
    shutil.copy(runs / "swag" / "plan.json", tmp_path)
    trainer = make_trainer(RunFolder(tmp_path), REEF, SETTINGS, False, lambda event: None, None, time.monotonic())
    state = trainer.state
    state.clock.advance(100)
    learned = state.cloud.sh0.detach().clone()
    trainer._fit_water()
    assert torch.equal(state.cloud.sh0, learned) != kept and state.water_final
    assert torch.equal(state.guarded.last_good["sh0"], state.cloud.sh0)
    assert any("last fit of the water was left out" in note for note in trainer.notes) != kept


def test_the_lamp_stays_with_the_water(runs, tmp_path):
    shutil.copy(runs / "swag" / "plan.json", tmp_path)
    trainer = make_trainer(RunFolder(tmp_path), REEF, SETTINGS, False, lambda event: None, None, time.monotonic())
    state = trainer.state
    state.effects.models["lamp"] = Lamp.starting(2.0, 4.0)
    fitted = {"medium.attenuation", "medium.backscatter", "medium.background_sh", "lamp.log_tau"}
    assert fitted <= trainer.selection.learning_rates(state).keys()
    state.water_final = True
    assert not fitted & trainer.selection.learning_rates(state).keys()


def test_runs_whose_gaussians_have_not_settled_keep_the_water_that_they_learn(runs):
    assert not load_checkpoint(runs / "swag")[1]["water_final"]


@pytest.mark.parametrize("change", ["display values", "no water", "part of a survey"])
def test_other_water_is_not_fitted_again(runs, tmp_path, settled, monkeypatch, change):
    shutil.copy(runs / "swag" / "plan.json", tmp_path)
    trainer = make_trainer(RunFolder(tmp_path), REEF, SETTINGS, False, lambda event: None, None, time.monotonic())
    state, selection = trainer.state, trainer.selection
    assert not selection.fits_water(state)
    state.clock.advance(100)
    assert selection.fits_water(state)
    medium = state.effects.medium
    assert isinstance(medium, Medium)
    if change == "display values":
        state.effects.models["medium"] = replace(medium, light="srgb")
    elif change == "no water":
        del state.effects.models["medium"]
    else:
        monkeypatch.setattr(selection, "whole", object())
    assert not selection.fits_water(state)


def test_a_resumed_run_keeps_its_water(runs, tmp_path):
    asked = iter(range(10**9))
    settings = TrainSettings(**{**SETTINGS.to_json(), "recipe": "swag"})
    (tmp_path / "run").mkdir()
    shutil.copy(runs / "swag" / "plan.json", tmp_path / "run")  # saves making it again
    train(REEF, tmp_path / "run", settings, should_stop=lambda: next(asked) >= 60)
    train(REEF, tmp_path / "run", settings, resume=True)
    expected, _ = load_checkpoint(runs / "swag")
    got, _ = load_checkpoint(tmp_path / "run")
    assert {"medium.background_sh", "restoration.confidence"} <= set(expected)
    assert all(torch.equal(got[name], expected[name]) for name in expected)


def test_restored_photos_are_nearer_to_the_truth_than_renders_and_photos(runs, tmp_path):
    files = restore_photos(runs / "swag", tmp_path / "photos", width=160, develop="none")
    scene = load_scene(REEF)
    assert [file.name for file in files] == [f"{Path(view.name).stem}.png" for view in scene.views]
    rendered = {file.name for file in render_run(runs / "swag", tmp_path / "renders", None, 0.0, "none")}
    test = load_images(scene, [view for view in scene.views if f"{Path(view.name).stem}.png" in rendered], 160)
    errors = []
    for image in test:
        truth = true_image(scene, image)
        assert truth
        name = f"{Path(image.camera.name).stem}.png"
        made = [cv2.imread(str(tmp_path / folder / name))[..., ::-1] / 255 for folder in ("photos", "renders")]
        errors.append([restored_error(picture, *truth)[1] for picture in (*made, image.pixels / 255)])
    photos, renders, taken = np.mean(errors, axis=0)
    assert photos < 0.85 * renders and photos < 0.6 * taken


def test_a_photo_wider_than_the_training_images_is_restored_with_their_detail(runs, tmp_path, monkeypatch):
    scene = load_scene(REEF)
    [image] = load_images(scene, [view for view in scene.views if view.name == "reef_008.jpg"], 640)
    truth, valid = true_image(scene, image)
    errors = []
    for _ in range(2):
        [file] = restore_photos(runs / "swag", tmp_path, image.camera.name, develop="none")
        made = cv2.imread(str(file))[..., ::-1] / 255
        errors.append(np.square(made - truth)[valid].mean())
        monkeypatch.setattr(TrainedDetail, "widened", lambda self, cloud, camera: cloud)
    assert errors[0] < 0.99 * errors[1]


def test_a_photo_is_restored_at_full_size_and_as_light(runs, tmp_path):
    [file] = restore_photos(runs / "swag", tmp_path, "reef_001.jpg", exr=True)
    assert file == tmp_path / "reef_001.exr"
    light = read_exr(file)
    assert light.shape == (360, 640, 3) and light.min() >= 0 and 0.02 < np.median(light) < 0.5


def test_what_cannot_be_restored_is_said(runs, tmp_path):
    with pytest.raises(InputError, match="has no photo named other.jpg; the first is reef_000.jpg"):
        restore_photos(runs / "swag", tmp_path, "other.jpg")
    with pytest.raises(InputError, match="must not be replaced: choose another folder"):
        restore_photos(runs / "swag", REEF / "images" / "restored")
    with pytest.raises(InputError, match="at least 1 pixel, not 0"):
        restore_photos(runs / "swag", tmp_path, width=0)
    assert not list(tmp_path.iterdir()) and not (REEF / "images" / "restored").exists()
