"""Splat files out of Blender and into it, through the operators."""

import sys

import numpy as np
import pytest

from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.spz import read_spz
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import covariances, sh_basis, transformed


def some_splats(count=200, degree=3, seed=0):
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    return Splats(
        random.normal(size=(count, 3)).astype(np.float32),
        rotations.astype(np.float32),
        np.exp(random.uniform(-5, -1, (count, 3))).astype(np.float32),
        random.uniform(0.01, 0.99, count).astype(np.float32),
        random.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        {"label": random.integers(0, 9, count).astype(np.int32)},
    )


def assert_same(a, b, tolerance=2e-5):
    """Compare splats by their covariances: signs of quaternions and the order of axes are free."""
    assert len(a) == len(b) and a.sh.shape == b.sh.shape
    assert np.allclose(a.positions, b.positions, atol=tolerance)
    scale = np.abs(covariances(b)).max()
    assert np.allclose(covariances(a), covariances(b), atol=tolerance * scale)
    assert np.allclose(a.opacities, b.opacities, atol=1e-6)
    assert np.allclose(a.sh, b.sh, atol=tolerance)
    assert np.array_equal(a.extras["label"], b.extras["label"])


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_an_exported_file_has_the_imported_splats(blender, tmp_path, suffix):
    """Upright, in the scene's frame, after a second round, and across both formats."""
    made = some_splats()
    made.origin = (3912345.25, 812345.5, 4954321.75)
    write_ply(tmp_path / "Riff ä.ply", made)
    blender.run("export.there_and_back", tmp_path, suffix)
    # The data of a GLB is y-up: its reader's default brings it into the PLY's frame.
    read = read_ply if suffix == "ply" else read_glb
    assert_same(read(tmp_path / f"upright.{suffix}"), made)
    assert_same(read(tmp_path / f"twice.{suffix}"), made)
    assert_same(read_ply(tmp_path / "scene.ply"), made)
    for found in (read(tmp_path / f"twice.{suffix}"), read_ply(tmp_path / "scene.ply")):
        assert np.allclose(found.origin, made.origin, rtol=0, atol=1e-8)
    assert len(read(tmp_path / f"both.{suffix}")) == 400


def test_the_objects_transform_is_applied(blender, tmp_path):
    """Moved, rotated and scaled in Blender under a rotated root: positions, sizes and colors follow."""
    made = some_splats()
    write_ply(tmp_path / "reef.ply", made)
    matrix = np.array(blender.run("export.transform", tmp_path))
    moved = read_ply(tmp_path / "moved.ply")
    assert_same(moved, transformed(made, matrix))
    # Without the function that exporting uses: positions, sizes, and colors along rotated directions.
    turn = matrix[:3, :3] / 2
    assert np.allclose(moved.positions, made.positions @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-4)
    assert np.allclose(np.prod(moved.scales, axis=1), 8 * np.prod(made.scales, axis=1), rtol=1e-3)
    direction = np.array([[0.36, 0.48, 0.8]])
    before = np.einsum("mk,nkc->nc", sh_basis(direction, 3), made.sh)
    after = np.einsum("mk,nkc->nc", sh_basis(direction @ turn.T, 3), moved.sh)
    assert np.allclose(before, after, atol=1e-4)


def test_upright_files_have_blenders_up_direction(blender, tmp_path):
    """A point two units above Blender's ground: y is -2 in the PLY (its viewers show -y as up), else +2."""
    one = some_splats(1, 0)
    one.positions[:] = 0
    write_ply(tmp_path / "one.ply", one)
    blender.run("export.raise_by_two_units", tmp_path)
    assert np.allclose(read_ply(tmp_path / "up.ply").positions, (0, -2, 0), atol=1e-6)
    assert np.allclose(read_glb(tmp_path / "up.glb", up=(0, 1, 0)).positions, (0, 2, 0), atol=1e-6)
    assert np.allclose(read_spz(tmp_path / "up.spz", up=(0, 1, 0)).positions, (0, 2, 0), atol=1e-6)


def test_an_spz_out_of_blender_and_into_it(blender, tmp_path):
    """The same splats to the precision of the format; that labels were left out is said."""
    made = some_splats()
    made.sh *= 0.2
    write_ply(tmp_path / "reef.ply", made)
    expected = blender.run("export.spz_there_and_back", tmp_path)
    back = read_ply(tmp_path / "back.ply")
    assert len(back) == len(made) and not back.extras
    assert np.allclose(back.positions, made.positions, atol=1e-3)
    assert np.allclose(np.sort(back.scales), np.sort(made.scales), rtol=0.04)
    assert np.allclose(back.sh[:, 0], made.sh[:, 0], atol=0.02)
    assert np.sqrt(np.mean((back.sh - made.sh) ** 2)) < 0.04
    assert "were left out: label" in blender.printed
    size = (tmp_path / "reef.spz").stat().st_size
    assert expected.startswith("200 splats, ") and abs(float(expected.split()[2]) * 1e6 - size) < 0.05e6 + 0.02 * size


def test_several_files_are_imported_with_fewer_harmonics_beside_a_damaged_one(blender, tmp_path):
    write_ply(tmp_path / "a.ply", some_splats(30))
    write_ply(tmp_path / "b.PLY", some_splats(40, 1))
    (tmp_path / "broken.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:2000])
    found = blender.run("export.import_several", tmp_path)
    assert "broken.ply" in found["message"] and "\n" not in found["message"]
    assert found["extensions"].startswith(".ply;.glb;.spz;.splat;") and found["operator"] == "swag.import_splats"


def test_refusals_are_one_sentence(blender, tmp_path):
    write_ply(tmp_path / "a.ply", some_splats(5))
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "occupied").write_text("a file, not a folder")
    messages = blender.run("export.refusals", tmp_path)
    named = {"foreign": "convert it with splat-transform", "project": "Export Cameras there, as Agisoft XML"}
    named |= {"not there": "nowhere.ply", "damaged": "text.ply", "unwritable": "x.ply", "full": "x.glb"}
    for case, message in messages.items():
        assert message.endswith(".") and "\n" not in message and named.get(case, "") in message, (case, message)
    assert (
        messages["no folder"].startswith(f"There is no folder {tmp_path / 'typo'}") and not (tmp_path / "typo").exists()
    )
    assert "select" in messages["nothing"] and not list(tmp_path.glob("x.*"))


@pytest.mark.main_version
def test_a_scene_that_cannot_be_read_is_refused_in_one_sentence(blender, tmp_path):
    messages = blender.run("export.refused_scenes", tmp_path, SWAG_ENGINE_PYTHON=sys.executable)
    assert all(message.endswith(".") and "\n" not in message for message in messages), messages
    assert "not here" in messages[1]
