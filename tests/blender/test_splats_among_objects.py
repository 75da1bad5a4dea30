"""Splats beside what else a Blender scene has: instances, other modifiers, meshes, holdouts, lamps."""

import numpy as np
import pytest

from tests.blender.splat_pictures import heap


@pytest.fixture
def heap_folder(tmp_path):
    np.savez(tmp_path / "heap.npz", **{name: array[:80] for name, array in heap().items()})
    return tmp_path


def test_instances_render_as_the_object_itself(blender, heap_folder):
    """A linked duplicate renders the rectangles. Instances of a collection or by geometry nodes share one geometry,
    which cannot face the camera for each of them: they are compared as ellipsoids."""
    found = blender.run("splats_among_objects.compare_instances", heap_folder)
    assert len(found) == 3 and min(found.values()) > 60, found


def test_modifiers_before_and_after_the_preview_change_what_is_rendered(blender, heap_folder):
    blender.run("splats_among_objects.other_modifiers", heap_folder)


@pytest.mark.parametrize("renderer", ["CYCLES", pytest.param("EEVEE", marks=pytest.mark.main_version)])
def test_meshes_and_holdouts_before_and_behind_splats(blender, renderer):
    """A mesh hides what is behind it, splats blend over what is behind them, a holdout cuts the image's alpha."""
    blender.run("splats_among_objects.meshes_and_holdouts", renderer)


def test_splats_cast_the_gaussians_shadow(blender):
    """A splat of opacity 0.8 lets a fifth of the lamp's light through at its middle. An ellipsoid casts the Gaussian's
    shadow in every direction, a rectangle in renders that of a flat disc."""
    rows = blender.run("splats_among_objects.shadow")
    x = (np.arange(101) - 50) / 101 * 4 + 1.0  # from the middle of the shadow
    near = abs(x) < 0.3
    for row, sigma in zip(rows, (0.1 / np.sqrt(0.5), 0.1), strict=True):
        transmitted, expected = np.array(row) / row[0], 1 - 0.8 * np.exp(-((x / sigma) ** 2) / 2)
        assert transmitted[near].min() < 0.3, sigma
        np.testing.assert_allclose(transmitted[near], expected[near], atol=0.01)
