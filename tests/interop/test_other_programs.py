"""Other programs read the files that are written here: Khronos' glTF validator and PlayCanvas' splat-transform."""

import json
import os

import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.formats.gltf import read_glb, write_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.spz import read_spz, write_spz
from swag_engine.scene.cameras import Camera
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import covariances, rotation_matrices, sh_basis, transformed
from swag_engine.survey import merge
from swag_engine.survey.export import export_survey
from swag_engine.survey.merge import merge_survey
from tests.interop.install import HERE, NODE
from tests.scenes.small_surveys import make_survey, random_splats


@pytest.fixture
def convert(node):
    def run(source, target):
        node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", "--quiet", "--gpu", "cpu", source, target)
        return target

    return run


def some_splats(count=200, degree=3, extras=True):
    rng = np.random.default_rng(3)
    rotations = rng.normal(size=(count, 4))
    own = {
        "label": rng.integers(0, 9, count).astype(np.int32),
        "instance": rng.integers(-900, 900, count).astype(np.int32),
        "similarity": rng.random(count).astype(np.float32),
    }
    return Splats(
        rng.normal(size=(count, 3)).astype(np.float32),
        (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        np.exp(rng.normal(size=(count, 3)) - 4).astype(np.float32),
        rng.uniform(0.01, 0.99, count).astype(np.float32),
        (rng.normal(size=(count, (degree + 1) ** 2, 3)) / 3).astype(np.float32),
        own if extras else {},
    )


@pytest.mark.parametrize("degree", [0, 3])
def test_the_khronos_validator_rejects_only_prefixed_names(node, tmp_path, degree):
    """The validator of 2024 does not know extensions' attribute names with a colon; it may report nothing else."""
    path = tmp_path / "with spaces & ü.glb"
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrices(np.array([0.5, -0.5, 0.5, 0.5])), (1, 2, 3)
    cameras = [Camera(f"Öl {i}.jpg", 640, 480, 500.0 + i, 510.0, 310.0, 250.0, pose) for i in range(3)]
    write_glb(path, some_splats(degree=degree), cameras=cameras)
    report = json.loads(node("validate.mjs", path))
    splat = {"ROTATION", "SCALE", "OPACITY"}
    splat |= {f"SH_DEGREE_{band}_COEF_{i}" for band in range(degree + 1) for i in range(2 * band + 1)}
    allowed = {f"/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:{name}" for name in splat}
    found = [(m["code"], m["pointer"]) for m in report["issues"]["messages"] if m["severity"] < 2]
    assert {code for code, _ in found} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert {pointer for _, pointer in found} == allowed and len(found) == len(allowed)
    others = {m["code"] for m in report["issues"]["messages"] if m["severity"] >= 2}
    assert others <= {"UNSUPPORTED_EXTENSION"}  # the validator does not check this extension
    assert report["info"]["totalVertexCount"] == 200


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splat_transform_reads_and_writes_the_same_ply(convert, tmp_path, degree):
    splats = some_splats(degree=degree)
    write_ply(tmp_path / "ours.ply", splats)
    theirs = read_ply(convert(tmp_path / "ours.ply", tmp_path / "theirs.ply"))
    np.testing.assert_array_equal(theirs.positions, splats.positions)
    np.testing.assert_array_equal(theirs.sh, splats.sh)
    np.testing.assert_allclose(theirs.rotations, splats.rotations, atol=1e-7)
    np.testing.assert_allclose(theirs.scales, splats.scales, rtol=1e-6)
    np.testing.assert_allclose(theirs.opacities, splats.opacities, atol=1e-7)
    for name, values in splats.extras.items():
        # splat-transform writes signed integers as unsigned ones of the same bits.
        np.testing.assert_array_equal(theirs.extras[name].astype(values.dtype), values)


def test_splat_transform_reads_the_same_numbers_into_its_table(convert, tmp_path):
    splats = some_splats(50, 1)
    write_ply(tmp_path / "ours.ply", splats)
    table = np.genfromtxt(convert(tmp_path / "ours.ply", tmp_path / "table.csv"), delimiter=",", names=True)
    np.testing.assert_allclose(np.stack([table[c] for c in "xyz"], axis=1), splats.positions, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"])), splats.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(table["scale_1"]), splats.scales[:, 1], rtol=1e-5)
    np.testing.assert_allclose(table["rot_0"], splats.rotations[:, 0], atol=1e-6)
    np.testing.assert_allclose(table["f_rest_4"], splats.sh[:, 2, 1], rtol=1e-5)  # green of the second of degree 1


@pytest.mark.parametrize("degree", [0, 3])
def test_the_glb_of_splat_transform_is_the_same(convert, tmp_path, degree):
    """splat-transform rotates a PLY by 180 degrees around z for Y up, here the glTF node does: compare in the world."""
    splats = some_splats(degree=degree, extras=False)
    write_ply(tmp_path / "ours.ply", splats)
    theirs = read_glb(convert(tmp_path / "ours.ply", tmp_path / "theirs.glb"), up=(0, 1, 0))
    write_glb(tmp_path / "ours.glb", transformed(splats, np.diag([-1.0, -1.0, 1.0, 1.0])), up=(0, 1, 0))
    ours = read_glb(tmp_path / "ours.glb", up=(0, 1, 0))
    np.testing.assert_allclose(theirs.positions, ours.positions, atol=1e-6)
    np.testing.assert_allclose(covariances(theirs), covariances(ours), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(theirs.scales, ours.scales, rtol=1e-6)
    np.testing.assert_allclose(theirs.opacities, ours.opacities, atol=1e-6)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-6)


def test_a_rotation_by_splat_transform_is_the_same(node, tmp_path):
    """Positions, covariances and harmonics after 35 degrees around x and a scale of 2, done by the two programs."""
    splats = some_splats(extras=False)
    write_ply(tmp_path / "ours.ply", splats)
    program = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    node(program, "--quiet", tmp_path / "ours.ply", "-r", "35,0,0", "-s", "2", tmp_path / "turned.ply")
    theirs = read_ply(tmp_path / "turned.ply")
    # Its Y-up world is rotated by 180 degrees around z from the file's: rotations around x have the opposite sign.
    cosine, sine = np.cos(np.radians(-35)), np.sin(np.radians(-35))
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    ours = transformed(splats, matrix)
    np.testing.assert_allclose(theirs.positions, ours.positions, atol=1e-5)
    np.testing.assert_allclose(covariances(theirs), covariances(ours), rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-5)


def test_splats_survive_conversion_to_spz_and_back(convert, tmp_path):
    """SPZ quantises: the same splats in the same order, to its precision."""
    splats = some_splats(extras=False)
    write_ply(tmp_path / "ours.ply", splats)
    spz = convert(tmp_path / "ours.ply", tmp_path / "packed.spz")
    back = read_ply(convert(spz, tmp_path / "back.ply"))
    np.testing.assert_allclose(back.positions, splats.positions, atol=1e-3)
    np.testing.assert_allclose(back.scales, splats.scales, rtol=0.05)
    np.testing.assert_allclose(back.opacities, splats.opacities, atol=0.01)
    directions = np.random.default_rng(1).normal(size=(20, 3))
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 3)
    difference = np.einsum("mk,nkc->mnc", basis, back.sh - splats.sh)
    assert np.sqrt(np.mean(difference**2)) < 0.1 and np.abs(back.sh[:, 0] - splats.sh[:, 0]).max() < 0.05
    # Its SPZ has the axes of the PLY, which it does not declare.
    np.testing.assert_allclose(read_spz(spz, up=(0, 1, 0)).positions, back.positions, atol=1e-6)
    spz.rename(tmp_path / "really.ply")
    with pytest.raises(InputError, match="compressed splat file"):
        read_ply(tmp_path / "really.ply")


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_the_same_spz(convert, tmp_path, degree):
    write_spz(tmp_path / "ours.spz", some_splats(degree=degree))
    ours = read_spz(tmp_path / "ours.spz", up=(0, 1, 0))  # as the file has it
    theirs = read_ply(convert(tmp_path / "ours.spz", tmp_path / "theirs.ply"))
    np.testing.assert_array_equal(theirs.positions, ours.positions)
    np.testing.assert_allclose(theirs.scales, ours.scales, rtol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(theirs.rotations * ours.rotations, axis=1)), 1, atol=1e-5)
    np.testing.assert_allclose(theirs.opacities, ours.opacities, atol=1e-6)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_compressed_ply_of_splat_transform_is_read(convert, tmp_path, degree):
    """The numbers equal those of its own reader, and the originals to the format's precision."""
    splats = some_splats(600, degree, extras=False)  # more than two chunks
    write_ply(tmp_path / "ours.ply", splats)
    small = convert(tmp_path / "ours.ply", tmp_path / "small.compressed.ply")
    assert b"packed_position" in small.read_bytes()[:2000]
    ours = read_ply(small)
    theirs = read_ply(convert(small, tmp_path / "unpacked.ply"))
    np.testing.assert_allclose(ours.positions, theirs.positions, atol=1e-6)
    np.testing.assert_allclose(ours.scales, theirs.scales, rtol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(ours.rotations * theirs.rotations, axis=1)), 1, atol=1e-6)
    np.testing.assert_allclose(ours.opacities, theirs.opacities, atol=1e-6)
    np.testing.assert_allclose(ours.sh, theirs.sh, atol=1e-5)
    # splat-transform sorts the splats along a curve: match each with the nearest original.
    nearest = np.linalg.norm(ours.positions[:, None] - splats.positions, axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(600))
    originals = splats.subset(nearest)
    np.testing.assert_allclose(ours.positions, originals.positions, atol=5e-3)
    np.testing.assert_allclose(ours.opacities, originals.opacities, atol=3e-3)
    assert np.abs(np.sum(ours.rotations * originals.rotations, axis=1)).min() > 0.999
    np.testing.assert_allclose(ours.sh, originals.sh, atol=0.03)


def test_a_damaged_compressed_ply_is_refused_in_one_sentence(convert, tmp_path):
    write_ply(tmp_path / "ours.ply", some_splats(300, 1, extras=False))
    small = convert(tmp_path / "ours.ply", tmp_path / "small.compressed.ply")
    data = small.read_bytes()
    changes = [
        data[: len(data) // 2],
        data[:-1],
        data.replace(b"element chunk 2", b"element chunk 1"),
        data.replace(b"element chunk 2", b"element chunk 9"),
        data.replace(b"element vertex 300", b"element vertex 301"),
        data.replace(b"element vertex 300", b"element vertex 999999999999"),
        data.replace(b"element sh 300", b"element sh 299"),
        data.replace(b"uint packed_scale", b"uint packed_other"),
        data.replace(b"float min_x", b"float mum_x"),
        data.replace(b"f_rest_8", b"f_rest_9"),
        data.replace(b"binary_little_endian", b"ascii"),
    ]
    for changed in changes:
        assert changed != data
        small.write_bytes(changed)
        with pytest.raises(InputError) as error:
            read_ply(small)
        assert str(small) in str(error.value) and "\n" not in str(error.value)


def test_splat_transform_packs_the_levels_of_a_survey(npm_packages, tmp_path, monkeypatch):
    """The streamed SOG has every level with all its splats, and replaces an earlier one whole."""
    monkeypatch.setattr(merge, "TILE_SPLATS", 200)
    monkeypatch.setattr(merge, "COARSEST", 150)
    monkeypatch.setenv(
        "PATH", os.pathsep.join([str(HERE / "node_modules" / ".bin"), str(NODE.parent), os.environ["PATH"]])
    )
    survey = make_survey(tmp_path / "survey", random_splats(1200, degree=3))
    levels = [level["splats"] for level in merge_survey(survey.path)["levels"]]
    out = tmp_path / "sog"
    for first in (1, 0):
        export_survey(survey.path, "sog", out, first)
        meta = json.loads((out / "lod-meta.json").read_text())
        assert meta["lodLevels"] == len(levels) - first
        assert {path.name for path in tmp_path.iterdir()} == {"survey", "sog"}
    assert len(levels) > 1
