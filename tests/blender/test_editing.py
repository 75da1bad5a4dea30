"""Editing splats in Blender: select, hide, delete, crop, find floaters, read points."""

import re
import sys

import numpy as np
import pytest

from swag_engine.app.protocol import parse_request


def test_box_lasso_and_circle_select_what_they_enclose(blender):
    blender.run("editing.select_in_views")


def test_sphere_and_flood_select_around_a_splat(blender):
    blender.run("editing.select_around_points")


def test_the_selection_tools_are_a_group_of_the_toolbar(blender):
    found = blender.run("editing.toolbar")
    names = ("box", "circle", "lasso", "brush", "sphere", "flood")
    assert found == {"groups": [[f"swag.tool_{name}" for name in names]], "without icon": []}


def test_what_is_behind_the_viewer_or_clipped_is_not_selected(blender):
    blender.run("editing.select_in_perspective")


def test_without_select_through_only_visible_splats_are_selected(blender):
    blender.run("editing.select_what_is_in_front")


def test_splats_are_selected_by_what_they_are_like(blender):
    blender.run("editing.select_by_properties")


def test_splats_are_hidden_shown_and_deleted_and_undo_brings_them_back(blender):
    blender.run("editing.hide_delete_and_undo")


def test_a_crop_box_limits_what_is_selected_and_drawn(blender, tmp_path):
    blender.run("editing.crop", tmp_path)


def test_hidden_and_cropped_splats_are_not_rendered(blender):
    shown = blender.run("editing.render_crop_and_hidden")
    assert shown == [[True, True, True], [True, False, True], [True, False, False]]


def test_floaters_are_found_by_the_cameras(blender):
    blender.run("editing.find_floaters")


def test_clean_up_proposes_kinds_that_are_switched_and_removed_in_one_step(blender):
    blender.run("editing.clean_up_by_kinds")


def test_a_point_is_read_in_the_unit_of_the_scene(blender):
    blender.run("editing.read_points")


@pytest.mark.main_version
def test_the_psnr_without_the_selected_splats(blender, finished_run, tmp_path):
    sentence = blender.run(
        "editing.score_selection", finished_run, tmp_path / "no run", SWAG_ENGINE_PYTHON=sys.executable
    )
    after, before = map(float, re.findall(r"([\d.]+) dB", sentence)[:2])
    assert before > after + 1, sentence


def test_the_score_of_an_edit_is_that_of_the_remaining_gaussians(finished_run, tmp_path):
    from swag_engine.base.errors import InputError
    from swag_engine.base.strict_json import from_json
    from swag_engine.experiments.evaluate_run import load_newest
    from swag_engine.experiments.score_edit import score_edit
    from swag_engine.formats.run_folder import RunFolder

    masks = tmp_path / "masks.npy"
    count = len(load_newest(finished_run)[0])
    none = np.zeros(count, bool)
    np.save(masks, [~none, none])
    score = score_edit(finished_run, masks)
    metrics = from_json(RunFolder(finished_run).metrics.read_text())
    assert score["before"] == pytest.approx(metrics["test_psnr"], abs=0.02)
    assert score["after"] < score["before"] - 3 and score["views"] == 2
    np.save(masks, np.ones((2, count - 1), bool))
    with pytest.raises(InputError, match="continue it with train"):
        score_edit(finished_run, masks)
    masks.write_text("no array")
    with pytest.raises(InputError, match="cannot be read as a mask"):
        score_edit(finished_run, masks)
    assert parse_request('{"request": "score_edit", "run": "/r", "masks": "/m"}')
