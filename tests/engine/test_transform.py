"""Moved splats look the same to a camera that moved along."""

from typing import Any

import numpy as np
import pytest
from scipy.special import sph_harm_y

from swag_engine.splats.splats import Splats, concatenate
from swag_engine.splats.transform import covariances, quaternions, rotation_matrices, sh_basis, sh_rotation, transformed

rng = np.random.default_rng(7)


def some_splats(count=50, degree=3):
    rotations = rng.normal(size=(count, 4))
    return Splats(
        rng.normal(size=(count, 3)).astype(np.float32),
        (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        np.exp(rng.normal(size=(count, 3)) - 3).astype(np.float32),
        rng.random(count).astype(np.float32),
        rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        {"label": np.arange(count, dtype=np.int32)},
    )


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def orthogonal(mirror):
    matrix = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return matrix * np.sign(np.linalg.det(matrix)) * (-1 if mirror else 1)


def affine(linear, translation=(0.3, -2.0, 5.0)):
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = translation
    return matrix


def colors(splats, eye):
    basis = sh_basis(unit(splats.positions - eye), splats.degree)
    return np.einsum("nk,nkc->nc", basis, splats.sh)


def test_basis_is_the_complex_harmonics_with_condon_shortley_phase():
    directions = unit(rng.normal(size=(100, 3)))
    azimuth, polar = np.arctan2(directions[:, 1], directions[:, 0]), np.arccos(directions[:, 2])
    basis = sh_basis(directions, 3)
    for band in range(4):
        for order in range(-band, band + 1):
            complex_value = sph_harm_y(band, abs(order), polar, azimuth)
            part = complex_value.imag if order < 0 else complex_value.real
            expected = part * (1 if order == 0 else 2**0.5)
            np.testing.assert_allclose(basis[:, band * band + band + order], expected, atol=1e-12)


def test_basis_of_a_lower_degree_is_the_beginning():
    directions = unit(rng.normal(size=(5, 3)))
    for degree in range(4):
        np.testing.assert_array_equal(sh_basis(directions, degree), sh_basis(directions, 3)[:, : (degree + 1) ** 2])


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_are_the_same_function_of_turned_directions(degree, mirror):
    turn = orthogonal(mirror)
    coefficients = rng.normal(size=(degree + 1) ** 2)
    directions = unit(rng.normal(size=(200, 3)))
    before = sh_basis(directions, degree) @ coefficients
    after = sh_basis(directions @ turn.T, degree) @ (sh_rotation(turn, degree) @ coefficients)
    np.testing.assert_allclose(after, before, atol=1e-12)


SIMILARITIES = {
    "turned": lambda: orthogonal(False),
    "turned and scaled": lambda: 2.5 * orthogonal(False),
    "mirrored in one axis": lambda: np.diag([-1.0, 1.0, 1.0]),
    "mirrored, turned and scaled": lambda: 0.1 * orthogonal(True),
    "half a turn": lambda: np.diag([1.0, -1.0, -1.0]),
    "point reflection": lambda: -np.eye(3),
}
UNEVEN = {
    "uneven scale": lambda: np.diag([0.5, 2.0, 1.0]),
    "sheared": lambda: orthogonal(False) + np.triu(np.ones((3, 3)), 1) * 0.7,
    "sheared and mirrored": lambda: orthogonal(True) @ np.diag([1.0, 3.0, 0.2]) @ orthogonal(False),
    "almost even": lambda: np.diag([1.0, 1.00001, 1.0]),
}


@pytest.mark.parametrize("linear", [make for make in (SIMILARITIES | UNEVEN).values()], ids=[*SIMILARITIES, *UNEVEN])
def test_positions_and_covariances_follow_the_matrix(linear):
    linear, splats = linear(), some_splats()
    moved = transformed(splats, affine(linear))
    np.testing.assert_allclose(moved.positions, splats.positions @ linear.T + (0.3, -2.0, 5.0), atol=1e-5)
    expected = linear @ covariances(splats) @ linear.T
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariances(moved) / size, expected / size, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(moved.rotations, axis=1), 1, atol=1e-6)
    assert (moved.scales >= 0).all()
    np.testing.assert_array_equal(moved.opacities, splats.opacities)
    np.testing.assert_array_equal(moved.extras["label"], splats.extras["label"])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("linear", SIMILARITIES.values(), ids=SIMILARITIES.keys())
def test_a_camera_moved_along_sees_the_same_colors(linear, degree):
    matrix, splats, eye = affine(linear()), some_splats(degree=degree), np.array([4.0, 1.0, -3.0])
    moved_eye = matrix[:3, :3] @ eye + matrix[:3, 3]
    np.testing.assert_allclose(colors(transformed(splats, matrix), moved_eye), colors(splats, eye), atol=2e-5)


def test_colors_under_an_uneven_scale_turn_with_its_rotation():
    turn, splats = orthogonal(False), some_splats()
    stretched = transformed(splats, affine(turn @ np.diag([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(stretched.sh, transformed(splats, affine(turn)).sh, atol=1e-5)


def test_order_of_axes_and_sizes_survives_a_similarity():
    splats = some_splats()
    np.testing.assert_allclose(transformed(splats, affine(3 * orthogonal(False))).scales, 3 * splats.scales, rtol=1e-6)


def test_a_shift_leaves_everything_but_positions_bit_equal():
    splats = some_splats()
    moved = transformed(splats, affine(np.eye(3)))
    for name in ("rotations", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(splats, name))


def test_a_flattening_matrix_gives_flat_splats():
    flat = transformed(some_splats(), affine(np.diag([1.0, 1.0, 0.0])))
    assert np.isfinite(flat.rotations).all() and np.isfinite(flat.sh).all()
    np.testing.assert_allclose(covariances(flat)[:, 2, :], 0, atol=1e-7)


def test_there_and_back_again():
    splats, matrix = some_splats(), affine(2 * orthogonal(False))
    back = transformed(transformed(splats, matrix), np.linalg.inv(matrix))
    np.testing.assert_allclose(back.positions, splats.positions, atol=1e-6)
    np.testing.assert_allclose(covariances(back), covariances(splats), atol=1e-6)
    np.testing.assert_allclose(back.sh, splats.sh, atol=1e-5)


def test_quaternions_invert_rotation_matrices_at_half_turns_too():
    wxyz = unit(np.concatenate([rng.normal(size=(100, 4)), np.eye(4), [[0, 1, 1, 0], [1e-9, 1, -1, 1]]]))
    back = quaternions(rotation_matrices(wxyz))
    np.testing.assert_allclose(np.abs(np.sum(back * wxyz, axis=1)), 1, atol=1e-12)


def test_bad_matrices_are_refused():
    perspective, endless = np.eye(4), np.eye(4)
    perspective[3, 0], endless[0, 0] = 1, np.inf
    for matrix in (np.eye(3), perspective, endless):
        with pytest.raises(ValueError, match="affine"):
            transformed(some_splats(), matrix)


@pytest.mark.parametrize(
    "change",
    [
        {"positions": np.zeros((3, 3))},
        {"rotations": np.zeros((3, 3), np.float32)},
        {"scales": np.zeros((2, 3), np.float32)},
        {"opacities": np.zeros((3, 1), np.float32)},
        {"sh": np.zeros((3, 5, 3), np.float32)},
        {"sh": np.zeros((3, 3), np.float32)},
        {"extras": {"label": np.zeros(2, np.int32)}},
        {"extras": {"label": np.array(["a", "b", "c"])}},
    ],
)
def test_wrong_shapes_and_dtypes_are_refused(change):
    good: dict[str, Any] = {
        "positions": np.zeros((3, 3), np.float32),
        "rotations": np.zeros((3, 4), np.float32),
        "scales": np.zeros((3, 3), np.float32),
        "opacities": np.zeros(3, np.float32),
        "sh": np.zeros((3, 4, 3), np.float32),
    }
    Splats(**good)
    with pytest.raises(ValueError, match="must"):
        Splats(**(good | change))


def test_concatenated_splats_keep_colors_and_extras():
    low, high = some_splats(3, 1), some_splats(2, 3)
    high.extras = {"similarity": np.full(2, 0.5, np.float32), "label": np.array([70000, 2], np.int64)}
    both = concatenate([low, high])
    assert len(both) == 5 and both.degree == 3
    np.testing.assert_array_equal(both.sh[:3, :4], low.sh)
    assert not both.sh[:3, 4:].any()
    np.testing.assert_array_equal(both.sh[3:], high.sh)
    np.testing.assert_array_equal(both.rotations[3:], high.rotations)
    np.testing.assert_array_equal(both.extras["label"], [0, 1, 2, 70000, 2])
    np.testing.assert_array_equal(both.extras["similarity"], np.array([0, 0, 0, 0.5, 0.5], np.float32))
    np.testing.assert_array_equal(both.subset(both.extras["label"] == 2).positions, both.positions[[2, 4]])
