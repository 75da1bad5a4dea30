"""LPIPS v0.1, how different two pictures look to people (Zhang et al., CVPR 2018, arXiv 1801.03924), in plain torch.

Weights are files in safetensors format, `lpips-alex.safetensors` and `lpips-vgg.safetensors`, under the names of where
they come from: `features.N.weight` and `.bias` of torchvision's AlexNet or VGG16 trained on ImageNet, and
`linK.model.1.weight` of the `lpips` package (weights/v0.1).
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from ..base.errors import InputError
from ..weights.registry import cache_folder

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Mean and deviation of what the networks were trained on, for pictures in -1..1."""
LEAST_SIDE = 32
"""Pixels: from smaller pictures the networks' pooling leaves nothing."""


@dataclass(frozen=True)
class Stage:
    """Convolutions up to the next place where pictures are compared.

    layers: their numbers in torchvision's `features`; each is followed by a ReLU. pool: side of the max pooling
    (stride 2) before them, 0 for none.
    """

    layers: tuple[int, ...]
    pool: int = 0
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Backbone:
    title: str
    stages: tuple[Stage, ...]


BACKBONES = {
    "alex": Backbone(
        "AlexNet",
        (Stage((0,), stride=4, padding=2), Stage((3,), pool=3, padding=2), Stage((6,), pool=3), Stage((8,)),
         Stage((10,))),
    ),
    "vgg": Backbone(
        "VGG16",
        (Stage((0, 2)), Stage((5, 7), pool=2), Stage((10, 12, 14), pool=2), Stage((17, 19, 21), pool=2),
         Stage((24, 26, 28), pool=2)),
    ),
}  # fmt: skip


class Lpips:
    """LPIPS with one backbone's weights."""

    def __init__(self, backbone: str, path: Path) -> None:
        """Read the weights at `path`. backbone: a name in BACKBONES. Raises InputError when they are not its."""
        self.stages = BACKBONES[backbone].stages
        try:
            self.weights = {name: tensor.float() for name, tensor in load_file(path).items()}
            blank = torch.zeros(LEAST_SIDE, LEAST_SIDE, 3)
            self(blank, blank)
        except (SafetensorError, OSError, KeyError, RuntimeError) as error:
            title = BACKBONES[backbone].title
            raise InputError(f"{path} does not hold LPIPS weights for {title} ({error}): make it again.") from error

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor) -> float:
        """LPIPS of two pictures (H, W, 3) in 0..1; not a number where a side is shorter than LEAST_SIDE."""
        if min(image.shape[:2]) < LEAST_SIDE:
            return float("nan")
        both = 2 * torch.stack([image, target]).float() - 1
        x = ((both - torch.tensor(SHIFT)) / torch.tensor(SCALE)).permute(0, 3, 1, 2)
        distance = 0.0
        for index, stage in enumerate(self.stages):
            if stage.pool:
                x = functional.max_pool2d(x, stage.pool, 2)
            for layer in stage.layers:
                weight, bias = self.weights[f"features.{layer}.weight"], self.weights[f"features.{layer}.bias"]
                x = functional.conv2d(x, weight, bias, stage.stride, stage.padding).relu()
            unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
            head = self.weights[f"lin{index}.model.1.weight"]
            distance += float(functional.conv2d((unit[:1] - unit[1:]).square(), head).mean())
        return distance


def load_lpips(weights_dir: Path | None) -> tuple[dict[str, Lpips], list[str]]:
    """LPIPS by backbone, from the files in `weights_dir`, else in the user's cache folder.

    For backbones without a file there is a sentence in the second list that says so. Raises InputError when a file
    is there but damaged or another network's.
    """
    folders = [folder for folder in (weights_dir, cache_folder()) if folder]
    found: dict[str, Lpips] = {}
    missing: list[str] = []
    for name, backbone in BACKBONES.items():
        file = f"lpips-{name}.safetensors"
        path = next((folder / file for folder in folders if (folder / file).is_file()), None)
        if path:
            found[name] = Lpips(name, path)
        else:
            missing.append(
                f"LPIPS with {backbone.title} is left out: put {file} into {folders[0]}, or name the folder that has "
                "it with --weights-dir."
            )
    return found, missing
