"""Views of Gaussians that stay on a graphics card through WebGPU, and steps to time."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..gaussians.cloud import LOG_SCALE_LIMITS, GaussianCloud
from ..kernels.webgpu_device import WebGpu
from ..kernels.webgpu_training import EXPOSURES, LINEAR, OPEN, SIMILARITY, WATER, ResidentGaussians, View, adam_fields
from ..rendering.render import DAZZLING, FARTHEST
from ..scene.cameras import Camera
from ..water.medium import MAX_DEGREE
from .losses import SURFACE_LIMITS
from .optimizer import BETAS, EPS, MOMENTS
from .targets import Target

RESIDENT = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
"""Parameters that are kept on the GPU, with their moments."""
SURFACE = 255
"""Value of a pixel of a training image that surely shows a surface, in photo.wgsl."""


def view_of(camera: Camera, sh_degree: int, water_degree: int, mode: int, effects: Mapping[str, Any]) -> View:
    """Return a view that is compared with nothing; arguments as of `View`."""
    return View(
        viewmat=torch.from_numpy(camera.world_to_camera).float(),
        K=torch.from_numpy(camera.K).float(),
        centre=torch.from_numpy(camera.centre).float(),
        width=camera.width,
        height=camera.height,
        sh_degree=sh_degree,
        water_degree=water_degree,
        mode=mode,
        effects=effects,
        surface=SURFACE_LIMITS,
        log_scale_limits=LOG_SCALE_LIMITS,
        farthest=FARTHEST,
        dazzling=DAZZLING,
    )


def words_of(target: Target) -> Tensor:
    """Return (H, W, 1) int32: a word a pixel, as photo.wgsl has it."""
    kind = target.valid.to(torch.uint8)
    if target.surface is not None:
        kind[target.surface & target.valid] = SURFACE
    return torch.cat([target.pixels, kind[..., None]], -1).contiguous().view(torch.int32)


def timed_step(gpu: WebGpu, cloud: GaussianCloud, target: Target, sh_degree: int) -> Callable[[], float]:
    """Return a step with water that changes nothing and returns its milliseconds; errors as of `outcomes`."""
    values = {name: getattr(cloud, name).detach() for name in RESIDENT}
    sizes = {name: value[0].numel() for name, value in values.items()}
    resident = ResidentGaussians(gpu, len(cloud), sizes, EXPOSURES)
    for name, value in values.items():
        resident.load(name, value)
        for moment in MOMENTS:
            resident.load(f"{name}.{moment}", torch.zeros_like(value))
    effects, mode = {"size": EXPOSURES, "medium_range": 1.0}, WATER | LINEAR | OPEN | SIMILARITY
    view = view_of(target.camera, sh_degree, MAX_DEGREE, mode, effects)
    view = replace(view, target=gpu.upload(words_of(target)), geometry=True, weights=(0.8, 0.2, 0.0, 0.0))
    rates = dict.fromkeys(sizes, adam_fields(0.0, *BETAS, EPS, 1))

    def once() -> float:
        started = time.perf_counter()
        resident.step("", view, rates)
        resident.outcomes(wait=True)
        return 1000 * (time.perf_counter() - started)

    return once
