"""The scene of `gpu_check.py` as a step of the backend wgpu takes it."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from swag_engine.gaussians.cloud import LOG_SCALE_LIMITS
from swag_engine.kernels.webgpu_device import WebGpu
from swag_engine.kernels.webgpu_training import (
    EXPOSURES,
    GAIN,
    LINEAR,
    OPEN,
    SIMILARITY,
    WATER,
    ResidentGaussians,
    View,
    adam_fields,
)
from swag_engine.rendering.render import DAZZLING, FARTHEST
from swag_engine.training.losses import SURFACE_LIMITS
from swag_engine.training.optimizer import BETAS, EPS, MOMENTS

LEARNING_RATE = 1e-9
"""Step size, so small that all steps find the same scene."""
ADAM = adam_fields(LEARNING_RATE, *BETAS, EPS, 1)
MEDIAN_RANGE = 4.0
"""Scene units."""


@dataclass
class WgpuScene:
    """Gaussians on a device, and what their steps compare: water, exposure, L1 and SSIM, as in the recipe swag.

    Attributes:
        resident: The Gaussians.
        view: What is compared.
    """

    resident: ResidentGaussians
    view: View

    @classmethod
    def of(
        cls,
        gpu: WebGpu,
        parameters: dict[str, torch.Tensor],
        viewmat: torch.Tensor,
        K: torch.Tensor,
        size: tuple[int, int],
    ) -> "WgpuScene":
        """Send a scene to a device.

        Args:
            gpu: The device.
            parameters: Parameters by name, as training optimises them, on the CPU.
            viewmat: (4, 4) world to camera.
            K: (3, 3) intrinsics, pixels.
            size: Width and height of the image, pixels.

        Returns:
            The scene.
        """
        count, (width, height) = len(parameters["means"]), size
        sizes = {name: math.prod(values.shape[1:]) for name, values in parameters.items()}
        resident = ResidentGaussians(gpu, count, sizes, EXPOSURES + 1)
        for name, values in parameters.items():
            resident.load(name, values)
            for moment in MOMENTS:
                resident.load(f"{name}.{moment}", torch.zeros_like(values))
        learned = torch.zeros(3, EXPOSURES + 1)
        learned[0, :6] = -0.7  # beta of 0.1 at the median range below
        resident.load_effects(learned)
        pixels = np.random.default_rng(0).integers(0, 255, (height, width, 4), dtype=np.uint8)
        pixels[..., 3] = 255
        view = View(
            target=gpu.upload(torch.from_numpy(pixels).view(torch.int32)),
            viewmat=viewmat,
            K=K,
            centre=torch.zeros(3),
            width=width,
            height=height,
            sh_degree=3,
            water_degree=2,
            mode=WATER | LINEAR | GAIN | OPEN | SIMILARITY,
            effects={
                "size": EXPOSURES + 1,
                "images": 1,
                "channels": 1,
                "medium_range": MEDIAN_RANGE,
                "lamp_range": MEDIAN_RANGE,
                "center_x": 0.5,
                "center_y": 0.5,
                "least": 0.05,
                "most": 2.0,
                "rates": (LEARNING_RATE,) * 4,
                "more_rates": (LEARNING_RATE,) * 3,
            }
            | {name: value for name, value in ADAM.items() if name != "step_size"},
            dropout=0.0,
            seed=0,
            geometry=True,
            weights=(0.8, 0.2, 0.0, 0.3),
            surface=SURFACE_LIMITS,
            log_scale_limits=LOG_SCALE_LIMITS,
            farthest=FARTHEST,
            dazzling=DAZZLING,
        )
        return cls(resident, view)

    def step(self) -> None:
        """Ask for one step of all parameters."""
        self.resident.step(None, self.view, dict.fromkeys(self.resident.sizes, ADAM))
