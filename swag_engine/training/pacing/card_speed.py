"""Time of an iteration on a graphics card through WebGPU, where the Gaussians stay between the steps."""

import time
from collections.abc import Callable

import torch

from ...gaussians.cloud import LOG_SCALE_LIMITS, GaussianCloud
from ...gaussians.densify import PER_GAUSSIAN
from ...kernels.webgpu_device import WebGpu
from ...kernels.webgpu_training import (
    EXPOSURES,
    LINEAR,
    OPEN,
    SIMILARITY,
    STEPS_READ,
    WATER,
    ResidentGaussians,
    View,
    adam_fields,
)
from ...rendering.render import DAZZLING, FARTHEST
from ..losses import SURFACE_LIMITS
from ..optimizer import BETAS, EPS, MOMENTS
from ..targets import Target

TIMED_MILLISECONDS = 40
"""Time after which another iteration adds nothing to a measurement: waiting for the card takes less than 1 ms."""


def steps_on_card(gpu: WebGpu, cloud: GaussianCloud, target: Target, sh_degree: int) -> Callable[[], float]:
    """Prepare iterations with water that leave the Gaussians as they are.

    Args:
        gpu: The device.
        cloud: The Gaussians.
        target: The image, on the CPU.
        sh_degree: Degree of the Gaussians' colors, 0..3.

    Returns:
        A function that makes up to STEPS_READ of them and returns how many milliseconds one took; it raises
        WebGpuFailure and MemoryError as `ResidentGaussians.outcomes` does.
    """
    values = {name: getattr(cloud, name).detach() for name in PER_GAUSSIAN if name != "features"}
    sizes = {name: value[0].numel() for name, value in values.items()}
    resident = ResidentGaussians(gpu, len(cloud), sizes, EXPOSURES)
    for name, value in values.items():
        resident.load(name, value)
        for moment in MOMENTS:
            resident.load(f"{name}.{moment}", torch.zeros_like(value))
    camera, valid = target.camera, target.valid.to(torch.uint8)[..., None]
    view = View(
        target=gpu.upload(torch.cat([target.pixels, valid], -1).contiguous().view(torch.int32)),
        viewmat=torch.from_numpy(camera.world_to_camera).float(),
        K=torch.from_numpy(camera.K).float(),
        centre=torch.from_numpy(camera.centre).float(),
        width=camera.width,
        height=camera.height,
        sh_degree=sh_degree,
        water_degree=2,
        mode=WATER | LINEAR | OPEN | SIMILARITY,
        effects={"size": EXPOSURES, "lamp_range": 1.0, "medium_range": 1.0},
        dropout=0.0,
        seed=0,
        geometry=True,
        weights=(0.8, 0.2, 0.0, 0.0),
        surface=SURFACE_LIMITS,
        log_scale_limits=LOG_SCALE_LIMITS,
        farthest=FARTHEST,
        dazzling=DAZZLING,
    )
    still = dict.fromkeys(sizes, adam_fields(0.0, *BETAS, EPS, 1))

    count = 1

    def once() -> float:
        nonlocal count
        started = time.perf_counter()
        for _ in range(count):
            resident.step("", view, still)
        resident.outcomes(wait=True)
        milliseconds = 1000 * (time.perf_counter() - started) / count
        count = min(STEPS_READ, 1 + int(TIMED_MILLISECONDS / milliseconds))
        return milliseconds

    return once
