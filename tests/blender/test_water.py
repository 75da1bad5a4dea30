"""The fitted water in Blender, on splats, behind them and on ordinary objects, against the engine's formula."""

import json

import numpy as np
import pytest

from tests.blender.splat_pictures import apply_water, heap, psnr, render_by_engine

WIDTH, HEIGHT, FOCAL = 96, 60, 90.0


@pytest.fixture(scope="module", params=["linear", "srgb"])
def medium(request):
    """Water whose background light changes with the direction; of linear light and of display values."""
    import torch

    from swag_engine.water.medium import Medium

    medium = Medium.starting(
        4.0, request.param, torch.tensor([0.20, 0.07, 0.04]), torch.tensor([0.15, 0.10, 0.08]),
        torch.tensor([0.05, 0.25, 0.4]),
    )  # fmt: skip
    medium.background_sh[1:] = torch.randn(8, 3, generator=torch.Generator().manual_seed(1)) * 0.5
    return medium


def test_splats_and_open_water_equal_the_engines_image(blender, medium, tmp_path):
    """The amount of water reaches the image: colors of splats, and what is behind them."""
    amount = 0.7
    np.savez(tmp_path / "heap.npz", **heap())
    (tmp_path / "water.json").write_text(json.dumps(medium.to_json()))
    blender.run("water_objects.render_splats_and_background", tmp_path, WIDTH, HEIGHT, FOCAL, amount)
    import torch

    from swag_engine.water.medium import open_water

    color, alpha = render_by_engine(
        heap(), WIDTH, HEIGHT, FOCAL, lambda colors, offsets: apply_water(medium, colors, offsets, amount)
    )
    K = torch.tensor([[FOCAL, 0, WIDTH / 2 - 3], [0, FOCAL, HEIGHT / 2 + 2], [0, 0, 1]])
    behind = open_water(medium, torch.eye(4), K, WIDTH, HEIGHT, amount=amount, backend="torch").detach().numpy()
    render = np.load(tmp_path / "render.npy")[..., :3]
    expected = color + (1 - alpha[..., None]) * behind
    print(psnr(render, expected))
    assert psnr(render, expected) > 55


def test_as_much_haze_is_rendered_as_is_shown(blender, tmp_path):
    """Files hold opacities without haze; Haze and Water bring those of the training back, as the engine does."""
    arrays = heap()
    haze = np.zeros(len(arrays["opacities"]), np.float32)
    haze[::4] = np.random.default_rng(0).uniform(0.3, 0.995, len(haze[::4]))
    trained = arrays["opacities"]
    arrays["opacities"] = trained * (1 - haze)
    np.savez(tmp_path / "heap.npz", **arrays)
    np.save(tmp_path / "haze.npy", haze)
    blender.run("water_objects.render_haze", tmp_path, WIDTH, HEIGHT, FOCAL)
    images = np.load(tmp_path / "images.npz")
    shown = {"none": 0.0, "half": 0.5, "all": 1.0, "water": 1.0}
    for name, amount in shown.items():
        opacities = arrays["opacities"] + amount * (trained - arrays["opacities"])
        color, alpha = render_by_engine(arrays | {"opacities": opacities}, WIDTH, HEIGHT, FOCAL)
        print(name, psnr(images[name][..., :3], color), psnr(images[name][..., 3], alpha))
        assert min(psnr(images[name][..., :3], color), psnr(images[name][..., 3], alpha)) > 55
    assert psnr(images["none"], images["all"]) < 30


def test_exports_have_the_haze_that_is_seen_and_its_splats_can_be_selected(blender, tmp_path):
    blender.run("water_objects.write_and_select_haze", tmp_path)


@pytest.mark.main_version
def test_objects_are_rendered_through_the_same_water(blender, medium, tmp_path):
    """A glowing and a lit wall, near and far: their light without water, taken through the engine's formula.

    Errors are at most 2e-3 where the shader knows the color. A lit surface has that accuracy in water of linear light,
    and 0.06 of a display value in water of display values, which a renderer cannot apply before it knows the light.
    """
    (tmp_path / "water.json").write_text(json.dumps(medium.to_json()))
    blender.run("water_objects.render_walls", tmp_path)
    import torch

    from swag_engine.kernels.reference.transfer import to_display, to_light

    images = np.load(tmp_path / "images.npz")
    steps = (np.arange(32) + 0.5 - 16) / 16 * np.tan(images["angle"] / 2)
    x, y = np.meshgrid(steps, -steps)
    for distance in (2, 9):
        dry, wet, removed = (images[f"{name}{distance}"] for name in ("dry", "wet", "removed"))
        wall = dry[..., 3] > 0
        assert np.array_equal(dry, removed)
        # From the camera at the origin to the wall, in the splats' own space.
        offsets = distance * np.stack([x, y, -np.ones_like(x)], axis=-1)[wall] @ images["turn"] / 2
        light = torch.tensor(dry[wall][:, :3])
        expected = apply_water(medium, to_display(light).numpy(), offsets)
        error = np.abs(to_display(torch.tensor(wet[wall][:, :3])).numpy() - expected)
        assert np.abs(to_light(torch.tensor(expected)).numpy() - light.numpy()).max() > 0.02
        print(medium.light, distance, error.max())
        assert error.max() < (2e-3 if medium.light == "linear" else 0.06)


def test_nodes_of_an_earlier_version_are_replaced_or_left_as_they_are(blender):
    blender.run("water_objects.nodes_of_an_earlier_version")


def test_scale_by_a_known_distance(blender):
    """Two cameras 3 units apart that are 1.5 m apart: afterwards the scene is in metres and its water per metre."""
    blender.run("water_objects.set_scale")


def test_water_is_saved_and_copied_with_the_splats(blender, tmp_path):
    """The amount of water acts after saving, opening and separating; damaged water is refused."""
    blender.run("water_objects.save_copy_and_remove", tmp_path)
