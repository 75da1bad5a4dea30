"""Drawing of splats in viewports, as far as it can be checked without a window; see also test_real_viewport.py."""

import pytest


def test_texels_hold_the_splats_and_what_does_not_fit_is_left_out(blender):
    blender.run("viewport.texels")


def test_texels_of_an_object_hold_its_eye_and_its_water(blender):
    blender.run("viewport.object_texels")


def test_splats_are_ordered_back_to_front(blender):
    blender.run("viewport.order")


@pytest.mark.main_version
def test_many_splats_are_sorted_by_a_thread(blender):
    blender.run("viewport.sorter")


def test_only_what_changed_is_uploaded(blender):
    blender.run("viewport.uploads")


def test_display_settings_reach_points_and_renders(blender):
    blender.run("viewport.settings")
