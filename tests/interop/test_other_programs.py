"""Programs that are not ours read what we write: Khronos' glTF validator and PlayCanvas' splat-transform."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from swag_engine.errors import InputError
from swag_engine.formats.gltf import read_glb, write_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.gaussians.splats import Splats
from swag_engine.gaussians.transform import covariances, sh_basis, transformed

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def node():
    """Runs a script of tests/interop with node; the packages are installed as package-lock.json says, once."""
    if not (shutil.which("node") and shutil.which("npm")):
        pytest.skip("node and npm are not installed")
    lock, installed = HERE / "package-lock.json", HERE / "node_modules" / ".package-lock.json"
    if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
        # The peer is a 100 MB engine that the command-line program does not load.
        command = ["npm", "ci", "--ignore-scripts", "--omit=peer", "--no-audit", "--no-fund"]
        try:
            done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, timeout=300)
        except subprocess.TimeoutExpired:
            pytest.skip("the npm packages of tests/interop did not arrive within 5 minutes")
        if done.returncode:
            reason = next((line for line in done.stderr.splitlines() if line.startswith("npm error")), "npm failed")
            pytest.skip(f"the npm packages of tests/interop cannot be had: {reason}")

    def run(script, *arguments):
        done = subprocess.run(["node", HERE / script, *arguments], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


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
def test_khronos_validator_objects_to_nothing_but_prefixed_names(node, tmp_path, degree):
    """The validator of 2024 does not know extensions' attribute names with a colon; all else must be clean."""
    path = tmp_path / "with spaces & ü.glb"
    write_glb(path, some_splats(degree=degree))
    report = json.loads(node("validate.mjs", path))
    splat = {"ROTATION", "SCALE", "OPACITY"}
    splat |= {f"SH_DEGREE_{band}_COEF_{i}" for band in range(degree + 1) for i in range(2 * band + 1)}
    allowed = {f"/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:{name}" for name in splat}
    found = [(m["code"], m["pointer"]) for m in report["issues"]["messages"] if m["severity"] < 2]
    assert {code for code, _ in found} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert {pointer for _, pointer in found} == allowed and len(found) == len(allowed)
    others = {m["code"] for m in report["issues"]["messages"] if m["severity"] >= 2}
    assert others <= {"UNSUPPORTED_EXTENSION"}  # the validator says that it does not look into ours
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
        # Its writer knows no signed integers: the bits are ours, their type is uint.
        np.testing.assert_array_equal(theirs.extras[name].astype(values.dtype), values)


def test_splat_transform_sees_our_numbers_in_its_table(convert, tmp_path):
    splats = some_splats(50, 1)
    write_ply(tmp_path / "ours.ply", splats)
    table = np.genfromtxt(convert(tmp_path / "ours.ply", tmp_path / "table.csv"), delimiter=",", names=True)
    np.testing.assert_allclose(np.stack([table[c] for c in "xyz"], axis=1), splats.positions, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"])), splats.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(table["scale_1"]), splats.scales[:, 1], rtol=1e-5)
    np.testing.assert_allclose(table["rot_0"], splats.rotations[:, 0], atol=1e-6)
    np.testing.assert_allclose(table["f_rest_4"], splats.sh[:, 2, 1], rtol=1e-5)  # green of the second of degree 1


@pytest.mark.parametrize("degree", [0, 3])
def test_its_glb_equals_ours(convert, tmp_path, degree):
    """It turns a PLY half around z on its way to Y up, we leave the turn to the node: so compare in our world."""
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


def test_a_turn_by_splat_transform_equals_ours(node, tmp_path):
    """Positions, covariances and harmonics after 35 degrees around x and a scale of 2, done by the two programs."""
    splats = some_splats(extras=False)
    write_ply(tmp_path / "ours.ply", splats)
    program = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    node(program, "--quiet", tmp_path / "ours.ply", "-r", "35,0,0", "-s", "2", tmp_path / "turned.ply")
    theirs = read_ply(tmp_path / "turned.ply")
    # It turns in its own Y-up world, half around z from the file's: there, a turn around x is one the other way.
    cosine, sine = np.cos(np.radians(-35)), np.sin(np.radians(-35))
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    ours = transformed(splats, matrix)
    np.testing.assert_allclose(theirs.positions, ours.positions, atol=1e-5)
    np.testing.assert_allclose(covariances(theirs), covariances(ours), rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-5)


def test_through_spz_and_back(convert, tmp_path):
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
    spz.rename(tmp_path / "really.ply")
    with pytest.raises(InputError, match="compressed splat file"):
        read_ply(tmp_path / "really.ply")


def test_compressed_ply_is_refused_in_words(convert, tmp_path):
    write_ply(tmp_path / "ours.ply", some_splats(extras=False))
    with pytest.raises(InputError, match="compressed PLY of SuperSplat or PlayCanvas"):
        read_ply(convert(tmp_path / "ours.ply", tmp_path / "small.compressed.ply"))
