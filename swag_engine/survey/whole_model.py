"""What blocks take over from the coarse model: water, lamp, lens, exposure of each image, colors and surroundings."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from ..base.errors import InputError, reading
from ..base.transfer import linear_of_bytes, srgb_to_linear
from ..effects.exposure import Exposure
from ..effects.scene_effects import SceneEffects
from ..evidence.noise import Noise, estimate_noise
from ..experiments.develop_run import automatic_development
from ..formats.run_folder import read_json, write_json
from ..formats.survey_folder import Block, Ground, SurveyFolder, inside
from ..gaussians.cloud import GaussianCloud
from ..planning.plan import read_plan
from ..rendering.model import SceneModel
from ..rendering.render import render
from ..rendering.restoration import SceneColors, restoration_limit
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, load_images
from ..scene.scene_part import read_part
from ..settings.recipes import RECIPES
from ..training.checkpoint import load_checkpoint
from ..training.whole import Whole
from ..water.medium import Medium

MEASURED_WIDTH = 160
"""Width in pixels at which the exposure of an image is measured: means over many pixels."""
AT_ONCE = 100
"""Images that are in memory at once while exposures are measured."""
COVERED = 0.9
"""Least alpha of a pixel that exposure is measured on."""
DARKEST, BRIGHTEST = 0.005, 0.9
"""Linear light between which a pixel counts: darker ones are noise, brighter ones are clipped."""
FEWEST_PIXELS = 200
"""Pixels from which an exposure counts as measured; else that of the neighbours is taken."""


def keep_whole(folder: SurveyFolder) -> None:
    """Find what blocks take over from the finished coarse run, and write whole.json and development.json.

    Args:
        folder: The survey.

    Raises:
        InputError: If the coarse run has no checkpoint, or an image cannot be read.
    """
    survey = folder.read()
    part = read_part(folder.scene_part("coarse"), survey.scene)
    model, stored = _coarse_model(folder)
    document: dict = {"choices": stored["choices"], "log_gains": None, "colors": None, "noise": None}
    medium = model.effects.medium
    training = set(survey.coarse_training)
    if isinstance(medium, Medium) and medium.light == "linear":
        images = load_images(part, [view for view in part.views if view.name in training], survey.coarse_settings.width)
        noise = estimate_noise(images, part.views)
        cameras = [image.camera for image in images]
        _, _, colors = restoration_limit(model.cloud, cameras, medium, noise, model.effects.lamp)
        document |= {"colors": colors.to_json(), "noise": noise.to_json()}
    exposure = model.effects.models.get("exposure")
    if isinstance(exposure, Exposure):
        views = read_part(folder.all_views, survey.scene)
        document["log_gains"] = measure_exposures(model, _fitted(folder, exposure), views)
    folder.coarse.write_development(automatic_development(folder.coarse.path, model.cloud, model.effects, part))
    write_json(folder.whole, document)


def _fitted(folder: SurveyFolder, learned: Exposure) -> Exposure:
    """Return the exposures of the coarse images as the plan fitted them to all observations, else the learned ones.

    On a generated reef of 300 images the fitted log gains were wrong by .025, and the learned ones by .07 after 1000
    iterations: each image had been visited four times.
    """
    if not folder.coarse.plan.exists():
        return learned
    fitted = read_plan(folder.coarse.plan).effects["exposure"].start.get("log_gains")
    if not isinstance(fitted, dict) or not set(learned.names) <= set(fitted):
        return learned
    return Exposure.starting({name: float(fitted[name]) for name in learned.names}, learned.raw.shape[1])


def load_whole(folder: SurveyFolder) -> Whole:
    """Read what blocks take over from the coarse model; its surroundings are all Gaussians of the model.

    Args:
        folder: The survey.

    Raises:
        InputError: If the coarse model is not finished, or a file is damaged.
    """
    survey = folder.read()
    document = read_json(folder.whole, f"The coarse model of {folder.path} is not trained yet: train it first.")
    model, _ = _coarse_model(folder)
    plan = read_plan(folder.coarse.plan) if RECIPES[survey.settings.recipe].planned else None
    again = f"remove it and {folder.done('coarse').name} beside it, and run the survey again"
    with reading(folder.whole, again):
        gains, colors, noise = document["log_gains"], document["colors"], document["noise"]
        if gains is not None:
            names = sorted(gains)
            raw = torch.tensor([gains[name] for name in names], dtype=torch.float32)
            model.effects.models["exposure"] = Exposure(raw, names, centred=False)
        return Whole(
            plan,
            model.effects,
            model.cloud,
            {str(name): bool(on) for name, on in document["choices"].items()},
            colors and SceneColors.from_json(colors),
            noise and Noise.from_json(noise),
        )


def around(whole: Whole, ground: Ground, block: Block, cameras: list[Camera]) -> Whole:
    """Return what a block is trained with: of the coarse Gaussians those outside its extended box that it sees.

    Args:
        whole: What was taken over from the coarse model.
        ground: Ground of the survey.
        block: The block.
        cameras: Cameras of the block.
    """
    outside = _outside(whole.surroundings, ground, block)
    return replace(whole, surroundings=whole.surroundings.rows(_seen(whole.surroundings, cameras) & outside))


def around_seam(whole: Whole, folder: SurveyFolder, ground: Ground, seam: Block, cameras: list[Camera]) -> Whole:
    """Return what a seam is trained with: it starts from the Gaussians of its two blocks that are in it.

    Those that surround it are the Gaussians of the block on each side of the border, in the margin of the seam, and
    coarse ones beyond.

    Args:
        whole: What was taken over from the coarse model.
        folder: The survey.
        ground: Ground of the survey.
        seam: The seam.
        cameras: Cameras of the seam.

    Raises:
        InputError: If a block beside it is not done, or its checkpoint is damaged.
    """
    first, second = (folder.read_block(name) for name in seam.sides)
    x_gap = max(first.core[0], second.core[0]) - min(first.core[2], second.core[2])
    axis = 0 if x_gap == 0 else 1
    low, high = sorted((first, second), key=lambda block: block.core[axis])
    clouds = []
    for block in (low, high):
        cloud = _trained_of(folder, block.name)
        along = ground.on_ground(cloud.means.numpy())[:, axis]
        of_side = along < high.core[axis] if block is low else along >= high.core[axis]
        clouds.append(cloud.rows(torch.from_numpy(of_side)))
    both, coarse = clouds[0].followed_by(clouds[1]), whole.surroundings
    places = ground.on_ground(both.means.numpy())
    within = inside(seam.core, places)
    margin = torch.from_numpy(inside(seam.extended, places) & ~within)
    surroundings = coarse.rows(_outside(coarse, ground, seam)).followed_by(both.rows(margin))
    start = both.rows(torch.from_numpy(within))
    return replace(whole, surroundings=surroundings.rows(_seen(surroundings, cameras)), start=start)


def _trained_of(folder: SurveyFolder, name: str) -> GaussianCloud:
    """Return the Gaussians that a block has trained; those in its result have their colors limited for display."""
    if not folder.done(name).exists():
        raise InputError(f"Block {name} of {folder.path} is not done, and its seams come after it: train it first.")
    try:
        loaded = load_checkpoint(folder.run(name).path)
    except InputError:
        loaded = None
    if loaded is None:
        raise InputError(
            f"The seams of block {name} start from its checkpoint, and {folder.run(name).path} has none that can be "
            f"read. Remove {folder.done(name)}: survey run then trains the block again."
        )
    cloud = SceneModel.from_checkpoint(*loaded).cloud
    return cloud.rows(slice(len(cloud) - loaded[1]["fixed"]))


def _outside(cloud: GaussianCloud, ground: Ground, block: Block) -> torch.Tensor:
    """Return which Gaussians (N,) bool are outside the extended box of a block."""
    return torch.from_numpy(~inside(block.extended, ground.on_ground(cloud.means.numpy())))


def measure_exposures(model: SceneModel, known: Exposure, views: Scene) -> dict[str, list[float]]:
    """Measure the exposure of images against a model that was trained on some of them.

    It is the median over the pixels of the log of photographed over rendered light. Images whose exposure is known
    keep it; those that show too little of the model get that of their neighbours.

    Args:
        model: The model.
        known: Exposures that are known.
        views: Cameras of all images, and their split: held-out images are not looked at.

    Returns:
        Log gains, 1 or 3 an image, by image name.
    """
    effects = SceneEffects({key: each for key, each in model.effects.models.items() if key != "exposure"})
    light = torch.from_numpy(linear_of_bytes()).float()
    gains = {name: known.log_gain(name).tolist() for name in known.names}
    wanted, missing = set(views.split.train) - set(gains), []
    for image in _images_of(views, [view for view in views.views if view.name in wanted]):
        ratios = _log_ratios(SceneModel(model.cloud, effects), image, light)
        if len(ratios) < FEWEST_PIXELS:
            missing.append(image.camera.name)
            continue
        channels = ratios.median(0).values
        gains[image.camera.name] = (channels if known.raw.shape[1] == 3 else ratios.median().reshape(1)).tolist()
    names = sorted(gains)
    measured = Exposure(torch.tensor([gains[name] for name in names]), names, centred=False)
    return gains | {name: measured.log_gain(name).tolist() for name in missing}


@torch.no_grad()
def _log_ratios(model: SceneModel, image: TrainingImage, light: torch.Tensor) -> torch.Tensor:
    """Return the logs (M, 3) of photographed over rendered light in the pixels that can be compared."""
    effects = model.effects
    picture = render(model.cloud, image.camera, 3, effects.medium, lamp=effects.lamp)
    shown = effects.apply_to_image(picture.color, image.camera.name).cpu()
    rendered = torch.from_numpy(srgb_to_linear(shown.numpy())).float()
    photographed = light[torch.from_numpy(image.pixels).long()]
    both = torch.cat([rendered, photographed], dim=-1)
    chosen = (both > DARKEST).all(-1) & (both < BRIGHTEST).all(-1)
    chosen &= torch.from_numpy(image.valid) & (picture.alpha.cpu() > COVERED)
    return (photographed[chosen] / rendered[chosen]).log()


def _images_of(scene: Scene, views: list) -> Iterator[TrainingImage]:
    for start in range(0, len(views), AT_ONCE):
        yield from load_images(scene, views[start : start + AT_ONCE], MEASURED_WIDTH)


def _coarse_model(folder: SurveyFolder) -> tuple[SceneModel, dict]:
    loaded = load_checkpoint(folder.coarse.path)
    if loaded is None:
        raise InputError(f"The coarse model of {folder.path} is not trained yet: train it first.")
    return SceneModel.from_checkpoint(*loaded), loaded[1]


def _seen(cloud: GaussianCloud, cameras: list[Camera]) -> torch.Tensor:
    """Return which Gaussians (N,) bool reach into the view of a camera."""
    reach = 3 * cloud.scales.amax(1)
    seen = torch.zeros(len(cloud), dtype=torch.bool)
    for camera in cameras:
        planes = torch.from_numpy(camera.view_planes()).float()
        seen |= (torch.addmm(planes[:, 3:], planes[:, :3], cloud.means.T) > -reach).all(dim=0)
    return seen
