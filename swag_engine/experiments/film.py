"""Films: a camera path rendered to an image sequence or a video, with alpha and depth."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError
from ..base.files import atomic_path, unexplained
from ..base.transfer import srgb_to_linear
from ..effects.scene_effects import SceneEffects
from ..formats.camera_path import PathFrame, frames_near
from ..formats.exr import write_exr, write_light_exr
from ..formats.ply import read_ply
from ..formats.run_folder import RunFolder, read_json
from ..formats.survey_folder import COARSE, SurveyFolder
from ..formats.water import DAMAGED, has_background_light
from ..gaussians.cloud import GaussianCloud
from ..kernels.hardware import device_for
from ..rendering.haze import with_haze
from ..rendering.model import SceneModel
from ..rendering.render import Picture, render
from ..rendering.trained_detail import TrainedDetail, render_as_trained
from ..scene.cameras import Camera
from ..scene.colmap import load_scene
from ..scene.scene_part import read_part
from ..splats.development import AS_RESTORED, ColorView, Development
from ..splats.haze import HAZE, check_haze, haze_amount
from ..training.checkpoint import checkpoints
from ..water.medium import Medium
from .develop_run import color_view
from .evaluate_run import load_run

log = logging.getLogger(__name__)

VIDEO_SUFFIX = ".mp4"
VIDEO_CODEC = "mp4v"
"""MPEG-4 Part 2: the only codec of MP4 that every build of OpenCV writes."""
EMPTY_DEPTH = 1e10
"""Depth where nothing is, as in Blender's depth pass."""
LEAST_ALPHA = 0.5 / 255
"""Alpha below which a pixel is empty in 8 bits, and its mean range is noise."""


@dataclass(frozen=True)
class FilmOptions:
    """What a film's files hold.

    Attributes:
        alpha: Leave the background out: PNG files get an alpha channel, a video gets a second one, NAME_alpha.mp4.
        depth: Write depth (z) of each frame to an EXR file.
        overwrite: Render frames whose files exist; without it they are kept.
        fps: Frames of a video per second.
        unit: Length of a scene unit in units of the depth.
        exr: Write linear light without development to OpenEXR files in place of PNG files, with alpha premultiplied.

    Raises:
        InputError: If a number is not above 0.
    """

    alpha: bool = False
    depth: bool = False
    overwrite: bool = False
    fps: float = 24.0
    unit: float = 1.0
    exr: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.fps <= 1000:
            raise InputError(f"The frames per second must be from above 0 to 1000, not {self.fps}.")


@dataclass
class FilmModel(SceneModel):
    """What a film shows: Gaussians without haze in open water.

    Attributes:
        detail: How finely training images sampled the Gaussians; None where that is not known.
        haze: (N,) how sure it is that a Gaussian is open water; None where none is.
    """

    detail: TrainedDetail | None = None
    haze: Tensor | None = None


def film_model(
    splats: Path | None, run: Path | None, water: Path | None = None, background: Sequence[float] = (0.0, 0.0, 0.0)
) -> FilmModel:
    """Load what a film shows.

    Args:
        splats: File of splats (PLY) in the coordinates of the run; None for the Gaussians of the run.
        run: Folder of the run, whose newest checkpoint has water, lamp and background; None without.
        water: File in the format of water.json, per scene unit, for splats without a run.
        background: Display values (3,) behind splats without a run, 0..1.

    Returns:
        The model on the device of the fastest backend. Its effects on whole images, such as exposure, are not part of
        a film. The detail is known where the scene of the run can be read.

    Raises:
        InputError: Where there are neither splats nor a checkpoint, or a file is damaged.
    """
    if run is not None and (splats is None or checkpoints(run)):
        loaded = load_run(run)
        cloud, effects = loaded.cloud, loaded.effects
        if splats is None:
            return FilmModel(cloud, effects, _detail(run, cloud, False), loaded.haze)
        background = cloud.background.sigmoid().tolist()
    elif splats is None:
        raise InputError("A film needs splats or a run.")
    else:
        effects = SceneEffects({} if water is None else {"medium": read_medium(water)})
    device = device_for("auto")
    shown = read_ply(splats)
    cloud = GaussianCloud.from_splats(shown, background).to(device)
    haze = torch.from_numpy(shown.extras[HAZE].astype(np.float32)) if HAZE in shown.extras else None
    return FilmModel(cloud, effects.to(device), None if run is None else _detail(run, cloud, True), haze)


def _detail(run: Path, cloud: GaussianCloud, of_blocks: bool) -> TrainedDetail | None:
    """Measure how finely training images sampled Gaussians; None where their scene cannot be read.

    Args:
        run: Folder of the run.
        cloud: The Gaussians.
        of_blocks: Whether those of a survey's coarse model are the Gaussians of its blocks.
    """
    survey_folder = SurveyFolder(run.parent)
    try:
        if of_blocks and run.name == COARSE and survey_folder.survey.is_file():
            survey = survey_folder.read()
            scene, settings = read_part(survey_folder.all_views, survey.scene), survey.settings
        else:
            folder, settings, _ = RunFolder(run).read_config()
            scene = load_scene(folder, read_scale=False)
    except InputError as error:
        log.warning("Frames larger or smaller than the training images lose detail, as the scene is missing: %s", error)
        return None
    return TrainedDetail.of_training(cloud.means, scene.training_cameras(settings.width))


def read_medium(path: Path) -> Medium:
    """Read a water per scene unit.

    Args:
        path: File in the format of water.json.

    Returns:
        The water.

    Raises:
        InputError: If the file does not hold coefficients per scene unit.
    """
    water = read_json(path, f"There is no {path}.")
    try:
        beta_D, beta_B, background_sh = (
            torch.tensor(water[name]).float() for name in ("beta_D", "beta_B", "background_sh")
        )
        if water["per"] != "unit" or water["light"] not in ("linear", "srgb"):
            raise ValueError("another unit or light")
        # The inverse of softplus, log(exp(x) - 1), without its overflow.
        attenuation, backscatter = (beta + torch.log(-torch.expm1(-beta)) for beta in (beta_D, beta_B))
        background_sh = background_sh.reshape(9, 3)
        light = background_sh if has_background_light(background_sh.tolist()) else None
        return Medium(attenuation, backscatter, light, 1.0, water["light"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(DAMAGED) from error


def film_run(
    folder: Path, out: Path, frames: Sequence[PathFrame], options: FilmOptions, develop: str = "auto", **more: Any
) -> dict[str, Any]:
    """Render the Gaussians of a run along a camera path, developed as `color_view` says.

    Further arguments and the result are those of `render_film`.
    """
    scene_folder, settings, _ = RunFolder(folder).read_config()
    suffix = ".exr" if options.exr else ".png"
    RunFolder(folder).refuse_own(out, *(out / f"{frame.camera.name}{suffix}" for frame in frames))
    model = film_model(None, folder)
    with suppress(InputError):  # a film needs no photos
        frames = frames_near(frames, load_scene(scene_folder, read_scale=False).origin)
    colors = color_view(folder, develop, model.cloud, model.effects)
    return render_film(model, out, frames, options, sh_degree=settings.sh_degree, colors=colors, **more)


def render_film(
    model: FilmModel,
    out: Path,
    frames: Sequence[PathFrame],
    options: FilmOptions,
    water: float = 1.0,
    haze: float = 0.0,
    sh_degree: int = 3,
    colors: ColorView = AS_RESTORED,
    progress: Callable[[int, int], None] = lambda done, total: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Render a camera path.

    Args:
        model: Gaussians and effects.
        out: Folder of NAME.png (or NAME.exr) and depth/NAME.exr; or a video, NAME.mp4, with NAME_alpha.mp4 and
            NAME_depth/NAME.exr.
        frames: The frames, with different names.
        options: What the files hold.
        water: Amount of water for frames that have none of their own, 0..1.
        haze: Fraction of the haze in open water that such frames show, 0..1; at least that of the water is shown.
        sh_degree: Highest degree of spherical harmonics.
        colors: How colors are developed; EXR files are not.
        progress: Called with the number of finished frames and that of all frames.
        should_stop: Asked between two frames. A stopped sequence keeps its frames, a stopped video is not written.

    Returns:
        `out`; numbers of `frames`, of `rendered` ones and of those `kept` because they existed; `interrupted`.

    Raises:
        InputError: If an amount of water or haze is not from 0 to 1, a video exists or its frames differ in size, the
            image is too large, or a file cannot be written.
    """
    if not 0 <= water <= 1:
        raise InputError(f"The amount of water must be from 0 to 1, not {water}.")
    check_haze(haze)
    is_video = out.suffix.lower() == VIDEO_SUFFIX
    if is_video and options.exr:
        raise InputError(f"{out.name} is a video, which has no linear light: name a folder to write EXR files.")
    depth_folder = out.with_name(f"{out.stem}_depth") if is_video else out / "depth"
    suffix = ".exr" if options.exr else ".png"
    result: dict[str, Any] = {"out": str(out), "frames": len(frames), "rendered": 0, "kept": 0, "interrupted": False}
    try:
        with _video(out, frames, options) if is_video else _sequence(out) as write:
            for done, frame in enumerate(frames):
                if should_stop():
                    raise _StoppedError
                image, depth = out / f"{frame.camera.name}{suffix}", depth_folder / f"{frame.camera.name}.exr"
                files = [image, depth] if options.depth else [image]
                if not (is_video or options.overwrite) and all(file.exists() for file in files):
                    result["kept"] += 1
                else:
                    amount = water if frame.water is None else frame.water
                    shown = haze_amount(amount, haze if frame.haze is None else frame.haze)
                    picture = _picture(model, frame.camera, amount, shown, sh_degree, options)
                    if options.exr:
                        write_light_exr(image, _light(picture, options.alpha))
                    else:
                        write(frame.camera.name, _pixels(picture, options.alpha, colors.at(amount)))
                    if options.depth:
                        write_exr(depth, _depth(picture, frame.camera, options.unit))
                    result["rendered"] += 1
                progress(done + 1, len(frames))
    except _StoppedError:
        result["interrupted"] = True
    return result


def describe(result: dict[str, Any]) -> str:
    """Return a sentence about a film.

    Args:
        result: What `render_film` returned.
    """
    done, kept = result["rendered"] + result["kept"], result["kept"]
    existed = f" ({kept} of them existed and were kept)" if kept else ""
    if not result["interrupted"]:
        return f"{done} frames{existed}: {result['out']}"
    if Path(result["out"]).suffix.lower() == VIDEO_SUFFIX:
        return f"Stopped after {done} of {result['frames']} frames; the video was not written."
    return f"Stopped after {done} of {result['frames']} frames{existed}; start again to render the others."


class _StoppedError(Exception):
    """The film is to stop: an unfinished video is removed by the end of its `with` block."""


Write = Callable[[str, np.ndarray], None]
"""Function of the name of a frame and its pixels (H, W, 3 or 4) uint8, straight alpha."""


@contextmanager
def _sequence(folder: Path) -> Iterator[Write]:
    """Write each frame to a PNG file."""

    def write(name: str, pixels: np.ndarray) -> None:
        order = cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR
        with atomic_path(folder / f"{name}.png") as temporary:
            temporary.write_bytes(cv2.imencode(".png", cv2.cvtColor(pixels, order))[1].tobytes())

    yield write


@contextmanager
def _video(path: Path, frames: Sequence[PathFrame], options: FilmOptions) -> Iterator[Write]:
    """Write all frames to a video, and their alpha to a second one where it is asked for."""
    first = frames[0].camera
    other = next((f.camera for f in frames if (f.camera.width, f.camera.height) != (first.width, first.height)), None)
    if other is not None:
        raise InputError(
            f"A video has frames of one size, but {first.name} has {first.width} x {first.height} pixels and "
            f"{other.name} {other.width} x {other.height}: render an image sequence."
        )
    paths = [path, path.with_name(f"{path.stem}_alpha{path.suffix}")] if options.alpha else [path]
    existing = next((file for file in paths if file.exists()), None)
    if existing and not options.overwrite:
        raise InputError(f"{existing} exists already: choose another name, or overwrite it.")
    with ExitStack() as stack:
        writers = [stack.enter_context(_video_file(file, first, options.fps)) for file in paths]

        def write(_: str, pixels: np.ndarray) -> None:
            writers[0].write(cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2BGR))
            if options.alpha:
                writers[1].write(cv2.cvtColor(np.ascontiguousarray(pixels[..., 3]), cv2.COLOR_GRAY2BGR))

        yield write


@contextmanager
def _video_file(path: Path, camera: Camera, fps: float) -> Iterator[cv2.VideoWriter]:
    """Open a video that is whole or does not exist. Raises InputError when OpenCV cannot write it."""
    with atomic_path(path) as temporary:
        size = (camera.width, camera.height)
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*VIDEO_CODEC), fps, size)  # type: ignore[attr-defined]
        if not writer.isOpened():
            raise InputError(f"This OpenCV cannot write the video {path}: render an image sequence.")
        try:
            yield writer
        finally:
            writer.release()
        if not cv2.VideoCapture(str(temporary), cv2.CAP_FFMPEG).isOpened():  # OpenCV does not say that a write failed
            raise unexplained(temporary, "OpenCV wrote no video")


@torch.no_grad()
def _picture(
    model: FilmModel, camera: Camera, amount: float, haze: float, sh_degree: int, options: FilmOptions
) -> Picture:
    draw = render if model.detail is None else partial(render_as_trained, detail=model.detail)
    cloud = with_haze(model.cloud, model.haze, haze)
    return draw(
        cloud, camera, sh_degree=sh_degree, medium=model.effects.medium, amount=amount, lamp=model.effects.lamp,
        with_range=options.depth, with_background=not options.alpha,
    )  # fmt: skip


def _pixels(picture: Picture, with_alpha: bool, development: Development) -> np.ndarray:
    """Return (H, W, 3) uint8 display values, with straight alpha (H, W, 4) where it is asked for."""
    color = development.apply(_straight(picture, with_alpha))
    if with_alpha:
        color = np.concatenate([color, picture.alpha[..., None].cpu().numpy()], axis=-1)
    return np.round(color.clip(0, 1) * 255).astype(np.uint8)


def _light(picture: Picture, with_alpha: bool) -> np.ndarray:
    """Return linear light (H, W, 3), with alpha (H, W, 4), premultiplied, where it is asked for."""
    light = srgb_to_linear(_straight(picture, with_alpha))
    if with_alpha:
        alpha = picture.alpha[..., None].cpu().numpy()
        light = np.concatenate([light * alpha, alpha], axis=-1)
    return light


def _straight(picture: Picture, with_alpha: bool) -> np.ndarray:
    """Return display values (H, W, 3), of the Gaussians alone where alpha is asked for."""
    color = picture.color
    if with_alpha:
        color = color / picture.alpha[..., None].clamp(min=LEAST_ALPHA)
    return color.cpu().numpy()


def _depth(picture: Picture, camera: Camera, unit: float) -> np.ndarray:
    """Return the depth (H, W) float32 along the camera's axis, scene units times `unit`; EMPTY_DEPTH without splats."""
    assert picture.range is not None
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    ray_length = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
    depth = picture.range.cpu().numpy() / ray_length * unit
    return np.where(picture.alpha.cpu().numpy() < LEAST_ALPHA, EMPTY_DEPTH, depth).astype(np.float32)
