"""Splats as Blender objects: their data, and what Cycles and EEVEE render."""

import numpy as np
import pytest

from tests.blender.splat_pictures import heap, psnr, render_by_engine


def to_light(display):
    """Linear light of display values by the sRGB curve."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def test_splats_are_read_back_bit_for_bit(blender, tmp_path):
    blender.run("splat_objects.round_trip", tmp_path)


def test_an_ellipsoid_has_the_gaussians_alpha(blender, tmp_path):
    """From the front: alpha = opacity exp(-r^2 / 2 sigma^2); display grey 0.7 is BT.709 linear light."""
    blender.run("splat_objects.render_one_ellipsoid", tmp_path)
    sigmas = np.arange(26) / 101 / 0.1
    for facing, color in ((False, ((0.7 + 0.055) / 1.055) ** 2.4), (True, 0.7)):
        row = np.load(tmp_path / f"{facing}.npy")[50, 50:76]
        assert np.allclose(row[:, 3], 0.8 * np.exp(-(sigmas**2) / 2), atol=1e-3), facing
        assert np.allclose(row[:, :3] / row[:, 3:], color, atol=1e-4), facing


# Rotation, uneven scale and shear about the centre of the heap.
UNEVEN = np.array([[1.6, 0.5, 0, -1], [-0.2, 0.5, 0.1, 0.5], [0.1, 0.3, 0.8, 2], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("renderer", "moved"),
    [
        ("CYCLES", "nothing"),
        ("CYCLES", "together"),
        ("CYCLES", "uneven"),
        pytest.param("EEVEE", "uneven", marks=pytest.mark.main_version),  # half a minute without a graphics card
    ],
)
def test_renders_equal_the_engines_image(blender, tmp_path, renderer, moved):
    """Display values, a camera with shift: equal to the rasterizer, also when scene and splats are turned together
    or the splats alone are scaled unevenly and sheared."""
    np.savez(tmp_path / "heap.npz", **heap())
    blender.run("splat_objects.render_heap", tmp_path, renderer, moved, UNEVEN.tolist())
    render = np.load(tmp_path / "render.npy")
    matrix = UNEVEN if moved == "uneven" else None
    color, alpha = render_by_engine(heap(), 160, 100, 150.0, matrix=matrix)
    print(psnr(render[..., :3], color), psnr(render[..., 3], alpha))
    assert psnr(render[..., :3], color) > 55 and psnr(render[..., 3], alpha) > 55


def test_linear_light_is_blended_after_the_srgb_curve(blender, tmp_path):
    """Two splats behind each other: the color is the blend of their linear light."""
    display = np.array([[0.9, 0.2, 0.03], [0.1, 0.8, 0.5]])
    blender.run("splat_objects.render_two_in_linear_light", tmp_path, display.tolist())
    light = to_light(display)
    middle = np.load(tmp_path / "render.npy")[18, 13]
    assert np.allclose(middle[:3], 0.6 * light[0] + 0.4 * 0.9 * light[1], atol=1e-3)
    assert middle[3] == pytest.approx(1 - 0.4 * 0.1, abs=1e-3)


def test_background_color_of_the_training_is_rendered_behind_the_splats(blender):
    display = np.array([0.2, 0.02, 0.9])
    found = blender.run("splat_objects.render_background", display.tolist())
    assert np.allclose(found["display"], display, atol=1e-4)
    assert np.allclose(found["light"], to_light(display), atol=1e-4)


def test_viewport_shows_points_or_splats(blender):
    blender.run("splat_objects.show_points_or_splats")
