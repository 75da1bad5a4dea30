"""Splats turn and scale with their points when Blender's operators and modifiers move those."""

import pytest

from swag_engine.formats.ply import write_ply
from swag_engine.splats.splats import Splats
from tests.blender.real_blender import in_window, new_folder
from tests.blender.splat_pictures import heap


@pytest.mark.parametrize(
    "function",
    [
        "apply_transforms",
        "undo_and_redo",
        "join",
        "join_points_without_splats",
        "scripts_that_move",
        "modifiers",
        "changes_of_the_extension",
    ],
)
def test_splats_follow_points(blender, function):
    blender.run(f"moved_points.{function}")


def test_points_moved_by_no_affine_map_are_reported(blender):
    blender.run("moved_points.scripts_that_move")
    assert "300 splats of reef" in blender.printed and "Merge" in blender.printed, blender.printed


def test_edit_mode_moves_splats_or_reports(blender):
    blender.run("moved_points.edit_mode")
    assert "of reef were moved" in blender.printed and "Merge" in blender.printed, blender.printed


def test_an_update_without_moved_points_costs_little(blender):
    """200 000 splats: 0.5 ms where nothing moved."""
    still, moved = blender.run("moved_points.seconds_of_an_update")
    assert still < 0.02 and moved < 30, (still, moved)


def test_edit_mode_in_a_window(real_blender, extension_zip):
    """Sizes and rotations follow when the user has ended a transform, and undo and redo find them."""
    folder = new_folder(real_blender, extension_zip, "moved_points")
    write_ply(folder / "splats.ply", Splats(**heap()))
    report = in_window("moved_points_window.py", real_blender, folder)
    assert not report["shapes change while points are moved"]
    assert report["error"] < 1e-4
    assert report["after"] == [["undo", True], ["redo", True]] * 2
