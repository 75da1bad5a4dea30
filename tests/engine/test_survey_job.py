"""Jobs of a survey: what blocks take over from the coarse model, and going on after whatever ended them."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.claim import claimed
from swag_engine.base.errors import InputError
from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.effects.exposure import Exposure
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evaluation.metrics import render_color
from swag_engine.formats.ply import read_ply
from swag_engine.formats.survey_folder import COARSE, SurveyFolder, inside
from swag_engine.formats.survey_state import progress_of
from swag_engine.rendering.model import SceneModel
from swag_engine.scene.colmap import load_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.survey.job import hash_of, run_job
from swag_engine.survey.plan import plan_survey
from swag_engine.survey.whole_model import load_whole, measure_exposures
from swag_engine.training.checkpoint import checkpoints, load_checkpoint
from tests.scenes.survey_scenes import tiny_survey

BLOCK = "B-001"
SETTINGS = TrainSettings(iterations=40, width=64, max_gaussians=20_000, effects="water=on,exposure=on", backend="cpu")


@pytest.fixture(scope="module")
def coarse(tmp_path_factory) -> Path:
    """A survey of two blocks whose coarse model is trained; not to be written to."""
    folder = tmp_path_factory.mktemp("survey")
    tiny_survey(folder / "scene")
    plan_survey(folder / "scene", folder / "survey", SETTINGS, 12)
    assert run_job(folder / "survey", COARSE)["state"] == "done"
    return folder


@pytest.fixture(scope="module")
def finished(coarse, tmp_path_factory) -> Path:
    """The same with a trained block; not to be written to."""
    folder = shutil.copytree(coarse, tmp_path_factory.mktemp("finished") / "all")
    assert run_job(folder / "survey", BLOCK)["state"] == "done"
    return folder / "survey"


@pytest.fixture
def survey(coarse, tmp_path) -> Path:
    return shutil.copytree(coarse, tmp_path / "copy") / "survey"


def test_a_block_changes_neither_water_nor_exposure_nor_surroundings(finished):
    files = SurveyFolder(finished)
    block, whole = files.read_block(BLOCK), load_whole(files)
    tensors, stored = load_checkpoint(files.run(BLOCK).path)
    fixed = stored["fixed"]
    surroundings = whole.surroundings
    ground = files.read().ground.on_ground(surroundings.means.numpy())
    outside = torch.from_numpy(~inside(block.extended, ground))
    assert 0 < fixed <= int(outside.sum())
    # The last rows are those of the coarse model, to the bit.
    rows = {row.numpy().tobytes() for row in surroundings.means[outside]}
    assert all(row.numpy().tobytes() in rows for row in tensors["cloud.means"][-fixed:])
    kept = torch.isin(surroundings.means[:, 0], tensors["cloud.means"][-fixed:, 0])
    for name in ("quats", "log_scales", "opacity_logits", "sh0", "shN"):
        assert torch.equal(tensors[f"cloud.{name}"][-fixed:], getattr(surroundings, name)[kept]), name
    assert torch.equal(tensors["cloud.background"], surroundings.background)
    for name, value in whole.effects.parameters().items():
        assert torch.equal(tensors[name], value), name
    assert {"medium", "exposure"} <= set(whole.effects.models)
    # What is its own has changed, and the result holds nothing else.
    result = read_ply(files.run(BLOCK).ply)
    assert len(result) == len(tensors["cloud.means"]) - fixed
    assert inside(block.extended, files.read().ground.on_ground(result.positions)).mean() > 0.9


def test_a_seam_changes_the_gaussians_of_both_blocks_in_it_alone(finished, tmp_path):
    survey = shutil.copytree(finished.parent, tmp_path / "copy") / "survey"
    files = SurveyFolder(survey)
    (name,) = files.read().seams
    seam, ground = files.read_block(name), files.read().ground
    with pytest.raises(InputError, match=r"Block B-002 .* is not done, and its seams come after it"):
        run_job(survey, name)
    assert run_job(survey, "B-002")["state"] == "done"
    clouds = []
    for block in (files.read_block(side) for side in seam.sides):
        tensors, stored = load_checkpoint(files.run(block.name).path)
        cloud = SceneModel.from_checkpoint(tensors, stored).cloud
        places = ground.on_ground(cloud.means.numpy())
        own = inside(block.core, places) & (np.arange(len(places)) < len(places) - stored["fixed"])
        clouds.append((cloud, places, own))
    started = sum(int((inside(seam.core, places) & own).sum()) for _, places, own in clouds)
    assert run_job(survey, name)["gaussians"] == started > 20
    tensors, stored = load_checkpoint(files.run(name).path)
    means = {row.numpy().tobytes() for row in tensors["cloud.means"][-stored["fixed"] :]}
    trained = {row.numpy().tobytes() for row in tensors["cloud.means"][: -stored["fixed"]]}
    beside = [
        row.numpy().tobytes() for cloud, places, own in clouds for row in cloud.means[own & ~inside(seam.core, places)]
    ]
    assert len(means.intersection(beside)) > 0.5 * len(beside), "the blocks do not surround the seam"
    started_at = {
        row.numpy().tobytes() for cloud, places, own in clouds for row in cloud.means[own & inside(seam.core, places)]
    }
    assert not started_at & means and len(trained & started_at) < 0.1 * started, "they were not trained"
    for parameter, value in load_whole(files).effects.parameters().items():
        assert torch.equal(tensors[parameter], value), parameter


def test_every_training_image_of_the_survey_has_an_exposure_and_no_held_out_one(finished):
    files = SurveyFolder(finished)
    scene = load_scene(files.read().scene)
    exposure = load_whole(files).effects.models["exposure"]
    assert isinstance(exposure, Exposure) and set(exposure.names) == set(scene.split.train)


def test_exposures_are_measured_against_the_coarse_model(survey):
    files = SurveyFolder(survey)
    scene, whole = load_scene(files.read().scene), load_whole(files)
    effects = SceneEffects({"medium": whole.effects.medium})
    few = Exposure(torch.tensor([[0.1], [-0.1]]), scene.split.train[:2], centred=False)
    true = dict(zip(scene.split.train[2:5], (-0.4, 0.05, 0.3), strict=True))
    for view in scene.views:
        if view.name in true:
            color = render_color(whole.surroundings, view.camera, 3, effects=effects).numpy()
            photo = linear_to_srgb(np.exp(true[view.name]) * srgb_to_linear(color))
            pixels = (255 * photo).round().clip(0, 255).astype(np.uint8)[..., ::-1]
            view.path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    measured = measure_exposures(SceneModel(whole.surroundings, effects), few, scene)
    assert set(measured) == set(scene.split.train)
    assert measured[few.names[0]] == pytest.approx([0.1])
    assert [measured[name][0] for name in true] == pytest.approx(list(true.values()), abs=0.02)


def test_a_finished_job_is_left_alone_and_a_stopped_one_ends_as_if_it_had_not_been(survey, finished):
    calls = iter([False] * 15 + [True] * 1000)
    stopped = run_job(survey, BLOCK, should_stop=lambda: next(calls))
    assert stopped["state"] == "begun" and stopped["iteration"] == 15
    files = SurveyFolder(survey)
    states = [progress_of(files, name, 40).state for name in files.read().jobs]
    assert states == ["done", "begun", "waiting", "waiting"]
    assert run_job(survey, BLOCK)["result_sha256"] == hash_of(SurveyFolder(finished).run(BLOCK).ply)
    changed = SurveyFolder(survey).done(BLOCK).stat().st_mtime_ns
    assert run_job(survey, BLOCK)["state"] == "done"
    assert SurveyFolder(survey).done(BLOCK).stat().st_mtime_ns == changed


def test_damaged_checkpoints_and_results_are_made_again(survey, finished):
    files = SurveyFolder(survey)
    calls = iter([False] * 15 + [True] * 1000)
    run_job(survey, BLOCK, should_stop=lambda: next(calls))
    for path in checkpoints(files.run(BLOCK).path):
        path.write_bytes(b"damaged")
    expected = hash_of(SurveyFolder(finished).run(BLOCK).ply)
    assert run_job(survey, BLOCK)["result_sha256"] == expected
    with open(files.run(BLOCK).ply, "r+b") as result:
        result.seek(3000)
        result.write(b"damaged")
    assert run_job(survey, BLOCK)["result_sha256"] == expected == hash_of(files.run(BLOCK).ply)


def test_a_seam_names_the_block_whose_checkpoint_is_damaged_and_what_it_says_to_do_helps(survey):
    files = SurveyFolder(survey)
    (seam,) = files.read().seams
    expected = [run_job(survey, name)["result_sha256"] for name in files.read().blocks]
    for path in checkpoints(files.run(BLOCK).path):
        path.write_bytes(b"damaged")
    with pytest.raises(InputError, match=f"The seams of block {BLOCK} start from its checkpoint, .*Remove .*done.json"):
        run_job(survey, seam)
    files.done(BLOCK).unlink()
    assert run_job(survey, BLOCK)["result_sha256"] == expected[0]
    assert run_job(survey, seam)["state"] == "done"


def test_a_job_that_another_process_has_is_left_to_it(survey):
    with claimed(SurveyFolder(survey).job(BLOCK)):
        found = run_job(survey, BLOCK)
    assert found["state"] == "running" and BLOCK in found["note"]


def test_what_keeps_a_block_from_being_trained_is_said_and_kept(survey):
    files = SurveyFolder(survey)
    photo = files.read().scene / "images" / files.read_block(BLOCK).training[0]
    content = photo.read_bytes()
    photo.unlink()
    with pytest.raises(InputError, match=f"not whole on this machine; .* .1 in all.: .*{photo.name}"):
        run_job(survey, BLOCK)
    failed = progress_of(files, BLOCK, 40)
    assert failed.state == "failed" and photo.name in failed.problem
    photo.write_bytes(content)
    document = files.read()
    files.write(replace(document, engine="0.0.9"))
    with pytest.raises(InputError, match="planned with version 0.0.9 of SWAG Splatting, and this machine has"):
        run_job(survey, BLOCK)
    files.write(document)
    with pytest.raises(InputError, match="has no block B-9"):
        run_job(survey, "B-9")
    assert run_job(survey, BLOCK)["state"] == "done"
    assert not files.failed(BLOCK).exists()


def test_a_block_waits_for_the_coarse_model(survey):
    SurveyFolder(survey).whole.unlink()
    with pytest.raises(InputError, match="coarse model of .* is not trained yet"):
        run_job(survey, BLOCK)
