"""Models of effects: what they do, and their gradients by finite differences."""

from dataclasses import replace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

from swag_engine.effects.caustics import Illumination
from swag_engine.effects.exposure import Exposure
from swag_engine.effects.image_gain import apply_log_gains
from swag_engine.effects.lamp import Lamp, lit
from swag_engine.effects.moving_objects import fraction_with_objects, moving_mask, residual, residuals_elsewhere
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evaluation.metrics import render_image
from swag_engine.kernels.reference.transfer import to_display, to_light
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage
from swag_engine.training import motion
from swag_engine.training.motion import find_motion
from tests.scenes.clouds import make_cloud


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# -- lamp --------------------------------------------------------------------------------------------------------------


def shown(picture, model, name):
    """The picture under one image effect, as training applies it."""
    return apply_log_gains(picture, [model.log_gain(name, *picture.shape[:2])])


def test_a_lamp_is_1_at_the_median_range_and_falls_off_with_the_square():
    lamp = Lamp.starting(unit_range=5.0, tau=1e-4)
    ranges = torch.tensor([2.5, 5.0, 10.0])
    torch.testing.assert_close(lamp.light(ranges), torch.tensor([4.0, 1.0, 0.25]), rtol=1e-3, atol=0)
    assert lamp.tau == pytest.approx(1e-4)
    day = Lamp.starting(5.0, 1e6)
    torch.testing.assert_close(day.light(ranges), torch.ones(3), rtol=1e-3, atol=0)
    colors = random(3, 3).float()
    light = to_light(colors) * lamp.light(ranges)[:, None]
    torch.testing.assert_close(to_light(lit(colors, ranges, lamp)), light)


def test_gradients_of_the_lamp():
    def function(colors, ranges, log_tau):
        return lit(colors, ranges, Lamp(log_tau, 3.0))

    inputs = (random(6, 3), 1 + 4 * random(6, seed=1), torch.tensor(0.3, dtype=torch.float64))
    assert torch.autograd.gradcheck(function, [value.requires_grad_() for value in inputs])


@pytest.mark.parametrize("log_tau", [-1e4, 0.0, 1e4])
@pytest.mark.parametrize("range_", [0.0, 1e-20, 1e6])
def test_the_lamp_is_finite_at_extreme_values(log_tau, range_):
    colors, ranges = torch.tensor([[0.0, 0.5, 1.3]]), torch.tensor([range_])
    raw = torch.tensor(log_tau)
    inputs = [value.requires_grad_() for value in (colors, ranges, raw)]
    seen = lit(colors, ranges, Lamp(raw, 1.0))
    assert seen.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(seen.sum(), inputs))


# -- exposure ----------------------------------------------------------------------------------------------------------


def test_log_gains_have_mean_0():
    exposure = Exposure.starting({"a": 0.1, "b": 0.3, "c": 0.5}, channels=3)
    assert exposure.raw.shape == (3, 3)
    torch.testing.assert_close(exposure.log_gains.mean(0), torch.zeros(3))
    picture = random(4, 5, 3).float()
    torch.testing.assert_close(shown(picture, exposure, "b"), picture)
    twice = to_light(shown(picture, exposure, "c")) / to_light(picture)
    torch.testing.assert_close(twice, torch.full_like(twice, 0.2).exp())


@pytest.mark.parametrize("channels", [1, 3])
def test_gradients_of_the_exposure(channels):
    def function(picture, raw):
        return shown(picture, Exposure(raw, list("abcd")), "b")

    inputs = (random(3, 4, 3), random(4, channels, seed=1))
    assert torch.autograd.gradcheck(function, [value.requires_grad_() for value in inputs])


def test_gains_are_learned():
    truth = torch.tensor([0.2, -0.3, 0.1])
    picture = random(8, 9, 3).float()
    known = Exposure.starting(dict(zip("abc", truth.tolist(), strict=True)))
    photographs = [shown(picture, known, name) for name in "abc"]
    exposure = Exposure.starting(dict.fromkeys("abc", 0.0))
    exposure.raw.requires_grad_()
    optimizer = torch.optim.Adam([exposure.raw], lr=0.03)
    for step in range(150):
        optimizer.zero_grad()
        (shown(picture, exposure, "abc"[step % 3]) - photographs[step % 3]).square().mean().backward()
        optimizer.step()
    torch.testing.assert_close(exposure.log_gains[:, 0].detach(), truth, atol=0.02, rtol=0)


# -- caustics ----------------------------------------------------------------------------------------------------------


def test_caustics_start_even_and_keep_the_mean_brightness():
    illumination = Illumination.starting(["a", "b"], 64, 36)
    assert illumination.log_light.shape == (2, 18, 32)
    picture = random(36, 64, 3).float() + 0.1
    torch.testing.assert_close(shown(picture, illumination, "a"), picture)
    illumination.log_light[1] += 0.5  # a gain of the whole image is exposure
    torch.testing.assert_close(shown(picture, illumination, "b"), picture)
    illumination.log_light[0, :, :16] += 1.0
    ratio = to_light(shown(picture, illumination, "a")) / to_light(picture)
    torch.testing.assert_close(ratio[:, 0].log(), torch.full((36, 3), 0.5))
    torch.testing.assert_close(ratio[:, -1].log(), torch.full((36, 3), -0.5))


def test_gradients_of_the_caustics():
    def function(picture, log_light):
        return shown(picture, Illumination(log_light, ["a", "b"]), "b")

    inputs = (random(6, 8, 3), random(2, 3, 4, seed=1))
    assert torch.autograd.gradcheck(function, [value.requires_grad_() for value in inputs])


def test_modelled_caustics_leave_truer_colors():
    """The same wall under sixteen light patterns: with caustics modelled, the learned colors are nearer to the wall."""
    r, (rows, columns) = np.random.default_rng(0), (36, 64)
    wall = torch.from_numpy(cv2.GaussianBlur(r.uniform(0, 1, (rows, columns, 3)), (0, 0), 1.2)).float().clamp(0.2, 0.8)
    waves = [cv2.GaussianBlur(r.standard_normal((rows, columns)), (0, 0), 4) for _ in range(16)]
    light = [1 / np.maximum(np.abs(1 + 0.4 * wave / wave.std()), 0.3) for wave in waves]  # as waves focus it
    photographs = [
        to_display(to_light(wall) * torch.from_numpy(focus / focus.mean()).float()[..., None]).clamp(0, 1)
        for focus in light
    ]
    errors = {}
    for modelled in (False, True):
        learned = torch.stack(photographs).mean(0).requires_grad_()
        field = Illumination.starting([str(view) for view in range(16)], columns, rows)
        field.log_light.requires_grad_()
        optimizer = torch.optim.Adam([{"params": [learned]}, {"params": [field.log_light]}])
        for step in range(400):
            for group, rate in zip(optimizer.param_groups, (5e-3, 2e-2), strict=True):
                group["lr"] = rate * (1 - step / 400)
            seen = shown(learned, field, str(step % 16)) if modelled else learned
            optimizer.zero_grad()
            (seen - photographs[step % 16]).abs().mean().backward()
            optimizer.step()
        ratio = to_light(learned.detach()) / to_light(wall)
        errors[modelled] = float((ratio / ratio.median()).log().std())
    assert errors[True] < 0.9 * errors[False], errors


# -- moving objects ----------------------------------------------------------------------------------------------------


def noisy_image(noise=0.02):
    r = np.random.default_rng(0)
    picture = cv2.GaussianBlur(r.uniform(0, 1, (90, 160, 3)), (0, 0), 3)
    return picture, picture + noise * r.standard_normal(picture.shape)


def mask_of(photograph, picture, valid, elsewhere=0.0):
    return moving_mask(residual(photograph, picture, valid), np.full(valid.shape, elsewhere), valid)


def test_a_fish_is_masked_whole_and_noise_is_not():
    picture, photograph = noisy_image()
    valid = np.ones((90, 160), bool)
    assert not mask_of(photograph, picture, valid).any()
    fish = np.zeros((90, 160), np.uint8)
    cv2.ellipse(fish, (60, 40), (20, 8), 20, 0, 360, (1,), -1)
    swum = np.where(fish[..., None] > 0, 0.9, photograph)
    mask = mask_of(swum, picture, valid)
    assert (mask & (fish > 0)).sum() / fish.sum() > 0.95
    assert (mask & (fish > 0)).sum() / mask.sum() > 0.6
    assert fraction_with_objects([mask, np.zeros_like(mask)]) == 0.5


def test_residuals_that_other_images_share_are_no_object():
    picture, photograph = noisy_image()
    valid = np.ones((90, 160), bool)
    swum = photograph.copy()
    swum[30:60, 40:90] = 0.9
    assert mask_of(swum, picture, valid, elsewhere=0.03).any()
    assert not mask_of(swum, picture, valid, elsewhere=0.3).any()


def wall_and_cameras():
    """Return Gaussians that are a wall, and three cameras in a row before it."""
    steps = torch.linspace(-2, 2, 41)
    places = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    wall = make_cloud(len(places), dtype=torch.float32)
    wall.means = torch.cat([places, torch.full((len(places), 1), 4.0)], 1)
    wall.log_scales, wall.opacity_logits = torch.full_like(wall.means, -3.0), torch.full((len(places),), 6.0)
    cameras = []
    for k, x in enumerate((-0.5, 0.0, 0.5)):
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(Camera(f"{k}", 80, 60, 80.0, 80.0, 40.0, 30.0, pose))
    return wall, cameras


def test_residuals_elsewhere_are_those_of_the_same_place():
    """Residuals at one place in all three images and at another in the first."""
    wall, cameras = wall_and_cameras()
    residuals = [np.zeros((60, 80), np.float32) for _ in cameras]
    for k, x in enumerate((-0.5, 0.0, 0.5)):
        middle = 40 - round(20 * x)  # of the wall, in this picture
        residuals[k][25:35, middle - 5 : middle + 5] = 0.2
    residuals[0][5:15, 40:50] = 0.3
    first, second = residuals_elsewhere(wall, cameras, residuals, [0, 1], "torch")
    assert first[28:32, 48:52].mean() == pytest.approx(0.2, rel=0.2)
    assert first[7:13, 42:48].max() < 0.03
    assert second[7:13, 32:38].mean() == pytest.approx(0.15, rel=0.25)  # the first of two others has it


def test_motion_is_looked_for_in_other_images_only_where_there_may_be_some(monkeypatch):
    wall, cameras = wall_and_cameras()
    effects, static = SceneEffects({}), []
    for camera in cameras:
        shown = render_image(wall, camera, 0, "cpu", effects).numpy()
        static.append(TrainingImage(camera, (255 * shown).round().astype(np.uint8), np.ones((60, 80), bool)))
    with_fish = static[1].pixels.copy()
    with_fish[10:30, 20:50] = 255
    moving = [static[0], replace(static[1], pixels=with_fish), static[2]]
    assert find_motion(wall, effects, moving, 0, "cpu").keys() == {"1"}
    monkeypatch.setattr(motion, "residuals_elsewhere", rendered := Mock(wraps=residuals_elsewhere))
    find_motion(wall, effects, moving, 0, "cpu")
    assert rendered.call_args.args[3] == [1]
    rendered.reset_mock()
    assert find_motion(wall, effects, static, 0, "cpu") == {} and not rendered.called


def test_motion_is_looked_for_in_all_images_only_where_a_sample_shows_some(monkeypatch):
    """A hundred and twenty copies of two images: every second one is compared first."""
    wall, (camera, *_) = wall_and_cameras()
    effects = SceneEffects({})
    shown = render_image(wall, camera, 0, "cpu", effects).numpy()
    static = TrainingImage(camera, (255 * shown).round().astype(np.uint8), np.ones((60, 80), bool))
    with_fish = replace(static, pixels=static.pixels.copy())
    with_fish.pixels[10:30, 20:50] = 255
    monkeypatch.setattr(motion, "residuals_elsewhere", lambda cloud, cameras, residuals, wanted, backend: [
        np.zeros((60, 80), np.float32) for _ in wanted
    ])  # fmt: skip
    monkeypatch.setattr(motion, "render_image", rendered := Mock(wraps=render_image))
    # The number of images with a fish among those compared first and the others, and of renders.
    for among_first, among_others, renders in ((0, 0, 60), (1, 12, 60), (2, 0, 120), (6, 6, 120)):
        images = [static] * 120
        images[: 2 * among_first : 2] = [with_fish] * among_first
        images[1 : 2 * among_others : 2] = [with_fish] * among_others
        images = [replace(one, camera=replace(camera, name=str(k))) for k, one in enumerate(images)]
        rendered.reset_mock()
        found = find_motion(wall, effects, images, 0, "cpu")
        assert rendered.call_count == renders
        assert len(found) == (12 if among_first == among_others == 6 else 0)


def test_brightness_edges_and_invalid_pixels_are_no_objects():
    picture, photograph = noisy_image()
    valid = np.ones((90, 160), bool)
    assert not mask_of(photograph + 0.3, picture, valid).any()
    shifted = np.where((np.arange(160) // 20 % 2)[None, :, None], 0.8, 0.2) * np.ones((90, 1, 3))
    assert not mask_of(np.roll(shifted, 1, 1), shifted, valid).any()
    valid[20:60, 20:60] = False
    outside = photograph.copy()
    outside[20:60, 20:60] = 1.0
    assert not mask_of(outside, picture, valid).any()
    assert not mask_of(photograph, picture, np.zeros_like(valid)).any()
