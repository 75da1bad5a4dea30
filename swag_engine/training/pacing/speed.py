"""Speed of this machine on a scene, measured on a few iterations, and the predicted time of a run."""

import math
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass

import torch

from ...effects.scene_effects import SceneEffects
from ...gaussians.cloud import GaussianCloud
from ...gaussians.densify import PER_GAUSSIAN
from ...gaussians.init import gaussians_from_points
from ...kernels.backends import KERNELS
from ...kernels.hardware import hardware_of
from ...kernels.webgpu import WebGpuKernels
from ...kernels.webgpu_device import WebGpuFailure
from ...rendering.render import render
from ...scene.colmap import Scene
from ...scene.images import TrainingImage, load_images
from ...settings.presets import Size, Surface
from ...settings.settings import TrainSettings
from ...water.medium import Medium
from ..losses import photometric
from ..optimizer import Optimizer
from ..resident import timed_step
from ..schedule import STANDARD
from ..targets import Target

TIMED_GAUSSIANS = 20_000
"""Gaussians of the timed iterations."""
TIMED_WIDTH = 480
"""Width of the timed images, pixels."""
TIMINGS = 5
"""Rounds of timing; the fastest counts."""
LOADED = 4
"""Images that loading is timed with."""
STEPS = 20
"""Parts of a run over which its predicted time is summed."""


@dataclass(frozen=True)
class Speed:
    """Time of an iteration as a linear model.

    Attributes:
        fixed: Time of every iteration, ms.
        per_gaussian: Additional time for each Gaussian, ms.
        per_pixel: Additional time for each pixel, ms.
        load: Time to prepare one image at TIMED_WIDTH, s.
    """

    fixed: float
    per_gaussian: float
    per_pixel: float
    load: float

    def milliseconds(self, gaussians: float, pixels: float) -> float:
        """Return the time of one iteration, ms."""
        return self.fixed + gaussians * self.per_gaussian + pixels * self.per_pixel

    def times(self, factor: float) -> "Speed":
        """Return a speed at which everything takes `factor` times as long."""
        return Speed(*(factor * value for value in astuple(self)))


@dataclass(frozen=True)
class Extent:
    """Size of a scene, as far as it decides how long training takes.

    Attributes:
        training: Number of training images.
        held_out: Number of validation and test images.
        points: Number of sparse points.
        overlap: Mean number of images that see a point of the surface.
        width: Width of the largest image, pixels.
        height: Its height, pixels.
    """

    training: int
    held_out: int
    points: int
    overlap: float
    width: int
    height: int

    @classmethod
    def of(cls, scene: Scene) -> "Extent":
        """Return the size of a scene."""
        split = scene.split
        camera = max((view.camera for view in scene.views), key=lambda camera: camera.width)
        held_out = len(split.validation) + len(split.test)
        tracks = scene.points.track_lengths
        overlap = max(2.0, float(tracks.mean())) if len(tracks) else 2.0
        return cls(len(split.train), held_out, len(tracks), overlap, camera.width, camera.height)

    def pixels(self, width: int) -> float:
        """Return the number of pixels of an image reduced to `width`."""
        width = min(width, self.width)
        return width * width * self.height / self.width

    @property
    def surface(self) -> Surface:
        """Surface in the images: their area over the number of images that see a point."""
        return Surface(self.width, self.width * self.height * (self.training + self.held_out) / self.overlap)


def measure_speed(scene: Scene, settings: TrainSettings) -> Speed:
    """Measure the speed of a few iterations on one image; takes about a second.

    Args:
        scene: The scene.
        settings: Settings of the run.

    Returns:
        The speed.

    Raises:
        InputError: If the image cannot be read.
    """
    image = load_images(scene, scene.views[:1], TIMED_WIDTH)[0]
    others = scene.views[1 : 1 + LOADED]  # the first alone would count what is only done once
    started = time.perf_counter()
    load_images(scene, others, TIMED_WIDTH)
    load = (time.perf_counter() - started) / max(1, len(others))
    points = gaussians_from_points(scene.points, TIMED_GAUSSIANS, settings.sh_degree, 0, torch.zeros(3).numpy())
    cloud, half = _grown(points, TIMED_GAUSSIANS), _grown(points, TIMED_GAUSSIANS // 2)
    pixels = image.camera.width * image.camera.height
    try:
        work = [_iteration(*timed, image, settings) for timed in ((cloud, 1), (cloud, 2), (half, 1))]
        # In turns, so that other load on the machine affects all of them alike.
        rounds = [[once() for once in work] for _ in range(TIMINGS)]
    except WebGpuFailure as failure:
        kernels = KERNELS["wgpu"]
        assert isinstance(kernels, WebGpuKernels)
        kernels.fail(failure)
        return measure_speed(scene, settings)
    whole, smaller, fewer = (min(times) for times in zip(*rounds, strict=True))
    per_pixel = max(0.0, (whole - smaller) / (0.75 * pixels))
    per_gaussian = max(0.0, (whole - fewer) / (len(cloud) - len(half)))
    return Speed(max(0.0, whole - per_pixel * pixels - per_gaussian * len(cloud)), per_gaussian, per_pixel, load)


def _grown(points: GaussianCloud, count: int) -> GaussianCloud:
    """The cloud as densification leaves it: so many Gaussians near those of the points, with the same total area."""
    of_point = torch.arange(count) % len(points)
    parts = {name: getattr(points, name)[of_point] for name in PER_GAUSSIAN}
    cloud = GaussianCloud(**parts, background=points.background.clone())
    cloud.means += cloud.log_scales.exp() * torch.randn(cloud.means.shape, generator=torch.Generator().manual_seed(0))
    cloud.log_scales += 0.5 * math.log(len(points) / count)
    return cloud


def _iteration(cloud: GaussianCloud, factor: int, image: TrainingImage, settings: TrainSettings) -> Callable[[], float]:
    """An iteration at 1/factor of the image's size, which returns how many milliseconds it took."""
    hardware = hardware_of(settings)
    backend, device, kernels = settings.backend, hardware.device, KERNELS[hardware.backend]
    target = Target.shrunk(image, factor, device)
    if isinstance(kernels, WebGpuKernels):
        return timed_step(kernels.gpu, cloud, target, settings.sh_degree)
    optimizer = Optimizer(cloud.to(device), SceneEffects({"medium": Medium.starting(1.0)}).to(device), backend)
    rates = dict.fromkeys(optimizer.parameters(), 0.0)

    def once() -> float:
        started = time.perf_counter()
        picture = render(optimizer.cloud, target.camera, settings.sh_degree, optimizer.effects.medium, backend=backend)
        loss = photometric(picture.color, target.color, target.valid, 0.8, 0.2, 0.0, False, backend)
        loss.backward()
        optimizer.step(rates)
        hardware.synchronize()
        return 1000 * (time.perf_counter() - started)

    return once


def predicted_milliseconds(speed: Speed, extent: Extent, size: Size, fraction: float, densify_until: float) -> float:
    """Predict the time of an iteration; early in a run images are smaller and Gaussians fewer.

    Args:
        speed: Speed of the machine.
        extent: Size of the scene.
        size: Size of the run.
        fraction: How far the run is, 0..1.
        densify_until: Fraction of the run at which densification ends.

    Returns:
        Time, ms.
    """
    schedule = STANDARD
    factor = next((factor for until, factor in schedule.coarse if fraction < until), 1)
    duration = max(1e-9, densify_until - schedule.densify_from)
    grown = min(1.0, 1.25 * max(0.0, fraction - schedule.densify_from) / duration)
    start = min(extent.points, size.max_gaussians)
    gaussians = start + (size.max_gaussians - start) * grown
    return speed.milliseconds(gaussians, extent.pixels(size.width) / factor**2)


def predicted_seconds(speed: Speed, extent: Extent, size: Size, densify_until: float) -> float:
    """Predict the time of a whole run: loading, iterations, validation and the final scores.

    Args:
        speed: Speed of the machine.
        extent: Size of the scene.
        size: Size of the run.
        densify_until: Fraction of the run at which densification ends.

    Returns:
        Time, s.
    """
    middles = [(step + 0.5) / STEPS for step in range(STEPS)]
    mean = sum(predicted_milliseconds(speed, extent, size, middle, densify_until) for middle in middles) / STEPS
    larger = extent.pixels(size.width) / extent.pixels(TIMED_WIDTH)
    loading = speed.load * (extent.training + extent.held_out) * larger
    # Rendering without a gradient takes a third of an iteration; each held-out image is rendered about six times.
    last = speed.milliseconds(size.max_gaussians, extent.pixels(size.width))
    drawing = 0.3 * last * extent.held_out * 6
    return loading + (mean * size.iterations + drawing) / 1000
