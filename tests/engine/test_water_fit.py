"""The water that is fitted in the middle of a run to the light of Gaussians in all images."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from swag_engine.effects.lamp import Lamp
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.kernels.reference.harmonics import C0
from swag_engine.rendering.model import SceneModel
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage
from swag_engine.training.water_fit import GaussianLight, colors_through, fit_again, fit_water, observe_gaussians
from swag_engine.water.medium import Medium
from swag_engine.water.network import WaterNetwork
from tests.engine.water_scenes import wall_cloud

BETA_D, BETA_B, B = (torch.tensor(values) for values in ([0.35, 0.09, 0.06], [0.3, 0.11, 0.085], [0.08, 0.16, 0.3]))
TRUE = Medium.starting(3.0, "linear", BETA_D, BETA_B, B)
WRONG = Medium.starting(3.0, "linear", 0.8 * BETA_D, 1.15 * BETA_B, 0.9 * B)
PHOTOS = {f"{number}.png": Path(f"{number}.png") for number in range(5)}
"""Files of photos that are not compressed."""


def observations(
    nearest: float = 2.0, outliers: float = 0.0, color_error: float = 0.01, lamp: Lamp | None = None
) -> GaussianLight:
    """300 Gaussians in six images each, up to four times as far away as the nearest, through the true water."""
    random = np.random.default_rng(0)
    gaussian = np.repeat(np.arange(300), 6)
    ranges = random.uniform(*((nearest, 4 * nearest) if nearest else (3.96, 4.04)), len(gaussian))
    J = random.uniform(0.02, 0.6, (300, 3))[gaussian] * np.exp(color_error * random.standard_normal((1800, 1)))
    r = ranges[:, None]
    if lamp:
        J = J * lamp.light(torch.from_numpy(r)).numpy()
    light = J * np.exp(-BETA_D.numpy() * r) + B.numpy() * -np.expm1(-BETA_B.numpy() * r)
    wrong = random.uniform(size=1800) < outliers
    light[wrong] = random.uniform(0.0, 0.6, (wrong.sum(), 3))
    background = np.broadcast_to(0.9 * B.numpy(), light.shape)  # what training has found
    columns = {"gaussian": gaussian, "range": ranges, "light": light, "weight": np.ones(1800), "background": background}
    found = {name: torch.from_numpy(np.array(values)) for name, values in columns.items()}
    return GaussianLight(**found, open_pixels=0.0, open_ratio=torch.zeros(3, dtype=torch.float64))


def coefficients(medium: Medium) -> torch.Tensor:
    """beta_D, beta_B and the background light (3, 3)."""
    assert medium.background_sh is not None
    return torch.stack([medium.beta_D, medium.beta_B, (medium.background_sh[0] * C0).sigmoid()])


def errors(found: Medium | WaterNetwork | None, true: Medium = TRUE) -> np.ndarray:
    """Relative errors (3, 3) of the coefficients."""
    assert isinstance(found, Medium)
    return (coefficients(found) / coefficients(true) - 1).abs().numpy()


def test_the_water_is_found_from_light_at_many_ranges():
    assert errors(WRONG).min() > 0.09
    assert errors(fit_water(observations(), WRONG)[0]).max() < 0.04


def test_light_of_other_surfaces_counts_little():
    found = fit_water(observations(outliers=0.2), WRONG)[0]
    assert errors(found).mean() < 0.03 and errors(found).max() < 0.1


def test_what_images_do_not_show_stays_as_it_was():
    found = fit_water(observations(nearest=0.0), WRONG)[0]
    assert errors(found, WRONG).max() < 0.3
    assert all(torch.isfinite(tensor).all() for tensor in found.parameters().values())


def test_open_water_shows_the_background_light():
    near = observations(nearest=0.3)
    known = replace(near, open_pixels=5000.0, open_ratio=torch.full((3,), 1 / 0.9, dtype=torch.float64))
    assert errors(fit_water(near, WRONG)[0])[2].max() > 0.05
    assert errors(fit_water(known, WRONG)[0])[2].max() < 0.01


def test_light_that_is_scattered_again_is_not_taken_for_a_brighter_background():
    """No open water is seen, and light is added that no background light explains."""
    observed = observations(nearest=0.5)
    observed.light = observed.light + 0.01 * observed.range[:, None]
    found = fit_water(observed, WRONG)[0]
    assert errors(found, WRONG)[2].mean() < 0.4  # .8 where the background light is known as badly as the coefficients


def test_backscatter_without_a_coefficient_of_its_own_keeps_that_of_the_attenuation():
    observed = observations()
    r = observed.range[:, None]
    J = (observed.light - B.double() * -torch.expm1(-BETA_B.double() * r)) / torch.exp(-BETA_D.double() * r)
    observed.light = J * torch.exp(-BETA_D.double() * r) + B.double() * -torch.expm1(-BETA_D.double() * r)
    found = fit_water(observed, replace(WRONG, backscatter=None))[0]
    assert found.backscatter is None
    assert errors(found, replace(TRUE, backscatter=None)).max() < 0.05


def test_water_that_only_attenuates_stays_without_backscatter():
    observed = observations()
    r = observed.range[:, None]
    observed.light = observed.light - B.double() * -torch.expm1(-BETA_B.double() * r)
    observed.background = torch.zeros_like(observed.background)
    found = fit_water(observed, replace(WRONG, backscatter=None, background_sh=None))[0]
    assert found.backscatter is None and found.background_sh is None
    assert (found.beta_D / BETA_D - 1).abs().max() < 0.03


def test_the_fall_off_of_a_lamp_is_told_from_attenuation():
    true = Lamp.starting(3.0, 1.5)
    found, lamp = fit_water(observations(lamp=true), WRONG, Lamp.starting(3.0, 6.0))
    assert lamp is not None and abs(lamp.tau / true.tau - 1) < 0.1
    assert errors(found)[0].max() < 0.05


def test_change_of_the_background_light_with_direction_stays():
    start = replace(WRONG, background_sh=WRONG.background_sh.clone())
    start.background_sh[1:] = torch.linspace(-0.5, 0.5, 24).reshape(8, 3)
    torch.testing.assert_close(fit_water(observations(), start)[0].background_sh[1:], start.background_sh[1:])


def wall(patch: int, lamp: Lamp | None = None) -> SceneModel:
    """A wall of patches of different colors, each of so many Gaussians along a side, in the true water."""
    patches = np.random.default_rng(0).uniform(0.2, 0.7, (-(-41 // patch), -(-49 // patch), 3))
    cloud = wall_cloud(np.repeat(np.repeat(patches, patch, 0), patch, 1)[:41, :49], 0.25, 0.0)
    return SceneModel(cloud, effects_of(TRUE, lamp))


def effects_of(medium: Medium, lamp: Lamp | None = None) -> SceneEffects:
    """Water, and a lamp."""
    return SceneEffects({"medium": deepcopy(medium)} | ({"lamp": deepcopy(lamp)} if lamp else {}))


@pytest.fixture
def model() -> SceneModel:
    """A wall of large patches."""
    return wall(4)


@pytest.fixture
def images(model) -> list[TrainingImage]:
    """Photos of that wall."""
    return photographed(model)


def photographed(model: SceneModel) -> list[TrainingImage]:
    """Photos of a wall from three to nine metres, through the water of its model."""
    found = []
    for number, distance in enumerate((3.0, 4.0, 5.5, 7.0, 9.0)):
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * number, -0.2 * number, distance
        camera = Camera(f"{number}.png", 160, 120, 150.0, 150.0, 80.0, 60.0, pose)
        color = render(model.cloud, camera, 0, model.effects.medium, lamp=model.effects.lamp).color
        found.append(
            TrainingImage(camera, (255 * color).round().clamp(0, 255).byte().numpy(), np.ones((120, 160), bool))
        )
    return found


def through_wrong_water(model: SceneModel, images: list[TrainingImage], lamp: Lamp | None = None) -> SceneModel:
    """The model with the wrong water and a lamp, and the colors that fit the photos best with them."""
    wrong = effects_of(WRONG, lamp)
    colors = colors_through(model.cloud, images, model.effects, wrong)
    return SceneModel(replace(model.cloud, sh0=((colors - 0.5) / C0)[:, None]), wrong)


@pytest.mark.parametrize("lamps", [(None, None), (Lamp.starting(3.0, 15.0), Lamp.starting(3.0, 45.0))])
def test_a_model_gets_the_water_of_its_photos_and_the_colors_that_fit_it(lamps: tuple[Lamp | None, Lamp | None]):
    model = wall(4, lamps[0])
    images = photographed(model)
    wrong = through_wrong_water(model, images, lamps[1])
    cloud, effects = wrong.cloud, wrong.effects
    seen = [render(cloud, image.camera, 0, effects.medium, lamp=effects.lamp).color for image in images]
    true = 0.5 + C0 * model.cloud.sh0
    before = (0.5 + C0 * cloud.sh0 - true).abs().mean()
    assert fit_again(wrong, images, PHOTOS, 0)
    assert errors(effects.medium).max() < 0.06
    if lamps[0]:
        assert effects.lamp and abs(effects.lamp.tau / lamps[0].tau - 1) < 0.05
    assert (0.5 + C0 * cloud.sh0 - true).abs().mean() < 0.35 * before
    for image, color in zip(images, seen, strict=True):
        assert (render(cloud, image.camera, 0, effects.medium, lamp=effects.lamp).color - color).abs().mean() < 0.02


def test_a_model_in_water_that_only_attenuates_gets_its_attenuation():
    true, wrong = (replace(medium, backscatter=None, background_sh=None) for medium in (TRUE, WRONG))
    model = SceneModel(wall(4).cloud, effects_of(true))
    images = photographed(model)
    assert fit_again(SceneModel(model.cloud, found := effects_of(wrong)), images, PHOTOS, 0)
    assert isinstance(found.medium, Medium) and found.medium.background_sh is None
    assert (found.medium.beta_D / BETA_D - 1).abs().max() < 0.03


def test_exposure_of_a_photo_is_not_taken_for_water(model, images, monkeypatch):
    exposures = {image.camera.name: factor for image, factor in zip(images, (1, 0.8, 0.7, 0.6, 0.5), strict=True)}
    monkeypatch.setattr(SceneEffects, "apply_to_image", lambda self, color, name: color * exposures[name])
    darker = [
        replace(image, pixels=(image.pixels * exposures[image.camera.name]).round().astype(np.uint8))
        for image in images
    ]
    wrong = through_wrong_water(model, images)
    assert fit_again(wrong, darker, PHOTOS, 0)
    assert errors(wrong.effects.medium).max() < 0.1


def test_what_compression_has_changed_in_photos_is_found_by_compressing_renders(tmp_path: Path):
    model = wall(1)
    images = photographed(model)
    true = observe_gaussians(model, images, PHOTOS, 0)
    files = {name: tmp_path / f"{name}.jpg" for name in PHOTOS}
    for image in images:
        file = files[image.camera.name]
        Image.fromarray(image.pixels).save(file, quality=85, subsampling="4:2:0")
        image.pixels = np.asarray(Image.open(file))
    without, following = (observe_gaussians(model, images, photos, 0) for photos in (PHOTOS, files))
    error = [(observed.light - true.light).abs().mean() for observed in (without, following)]
    assert error[1] < 0.1 * error[0]


def test_gaussians_that_are_not_the_surface_and_masked_pixels_are_not_observed(model, images):
    count = len(model.cloud)
    some = model.cloud.rows(slice(0, None, 40))
    floating = replace(
        some, means=some.means - torch.tensor([0.0, 0.0, 1.5]), opacity_logits=torch.full((len(some),), -1.0)
    )
    both = SceneModel(model.cloud.followed_by(floating), model.effects)
    observed = observe_gaussians(both, images, PHOTOS, 0)
    assert len(observed.gaussian) > 1000 and observed.gaussian.max() < count
    left = np.zeros((120, 160), bool)
    left[:, :60] = True
    masked = observe_gaussians(model, [replace(image, valid=left) for image in images], PHOTOS, 0)
    assert 0 < len(masked.gaussian) < 0.6 * len(observed.gaussian)


def test_with_too_few_observations_nothing_changes(model, images):
    wrong = through_wrong_water(model, images)
    sh0, attenuation = wrong.cloud.sh0.clone(), wrong.effects.medium.attenuation.clone()
    assert not fit_again(wrong, images[:2], PHOTOS, 0)
    assert torch.equal(wrong.cloud.sh0, sh0) and torch.equal(wrong.effects.medium.attenuation, attenuation)
