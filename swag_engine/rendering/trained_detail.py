"""Renders that sample Gaussians more finely or coarsely than the training images did.

The rasteriser widens every Gaussian by a fixed variance in pixels of the image that it renders (`BLUR`), and Gaussians
are trained with that of the training images. In a wider image, or from nearer, they would be thinner than trained, with
gaps between them: there they are widened. In a smaller image, or from farther, they would be wider than trained: there
more pixels are rendered, and averaged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from statistics import median
from typing import Any

import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..gaussians.sizes import sampling
from ..kernels.reference.projection import BLUR, NEAR
from ..scene.cameras import Camera
from .render import Picture, render

ROUNDING = 1e-4
"""Difference of two numbers of pixels per scene unit, relative, that counts as none."""
FINER = 1.15
"""How much finer than the pixels of a render the training images may have sampled the Gaussians."""
MOST_SAMPLES = 4
"""Pixels, in x and in y, that are averaged for one at most."""
MOST_PIXELS = 2**25
"""Pixels that are rendered for an image at most, where it has fewer itself."""


@dataclass(frozen=True)
class TrainedDetail:
    """How finely the training images sampled each Gaussian.

    Attributes:
        finest: (N,) highest number of pixels per scene unit over the training images that see it, 0 where none does.
        coarsest: (N,) the lowest number, 0 where none sees it.
        focal: Median focal length of the training images, pixels.
    """

    finest: Tensor
    coarsest: Tensor
    focal: float

    @classmethod
    def of_training(cls, means: Tensor, cameras: Sequence[Camera]) -> "TrainedDetail":
        """Measure the Gaussians with the given centres.

        Args:
            means: (N, 3) centres, scene units.
            cameras: At least one perspective camera of a training image, in the size that is trained with.

        Returns:
            The detail, on the device of the centres.
        """
        finest, coarsest = torch.zeros_like(means[:, 0]), torch.full_like(means[:, 0], torch.inf)
        for camera in cameras:
            rates, _ = sampling(means, [camera], 0.0)
            finest = torch.maximum(finest, rates)
            coarsest = torch.minimum(coarsest, torch.where(rates > 0, rates, torch.inf))
        focal = median(max(camera.fx, camera.fy) for camera in cameras)
        return cls(finest, torch.where(finest > 0, coarsest, 0.0), focal)

    @torch.no_grad()
    def widened(self, cloud: GaussianCloud, camera: Camera) -> GaussianCloud:
        """Return the Gaussians as a render by a camera shows the training images' detail.

        A Gaussian gets the widening that a training image has at its distance, or at the nearest or farthest distance
        from which one saw it. The variance is added along all axes, as in the 3D smoothing filter of Mip-Splatting (Yu
        et al. 2024, arXiv 2311.16493).

        Args:
            cloud: The N Gaussians that were measured.
            camera: The camera that renders.

        Returns:
            The Gaussians; where the image samples them no finer than training did, unchanged.
        """
        trained, rendered = self._rates(cloud.means, camera)
        finer = (trained > 0) & (rendered > (1 + ROUNDING) * trained)
        added = torch.where(finer, BLUR * (trained**-2 - rendered**-2), 0.0)[:, None]
        wider = (cloud.scales.square() + added).log() / 2
        return replace(cloud, log_scales=torch.where(finer[:, None], wider, cloud.log_scales))

    @torch.no_grad()
    def samples(self, means: Tensor, camera: Camera) -> int:
        """Return how many pixels, in x and in y, to render for one of a camera's image: 1 to MOST_SAMPLES.

        Args:
            means: (N, 3) centres that were measured.
            camera: The camera that renders.
        """
        planes = torch.from_numpy(camera.view_planes()).to(means)
        trained, rendered = self._rates(means, camera)
        shown = (torch.addmm(planes[:, 3:], planes[:, :3], means.T).amin(dim=0) > 0) & (trained > 0)
        if not shown.any():
            return 1
        ratio = float((trained / rendered)[shown].median())
        most = int((MOST_PIXELS / (camera.width * camera.height)) ** 0.5)
        return max(1, min(ceil(ratio / FINER), MOST_SAMPLES, most))

    def _rates(self, means: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Pixels per scene unit (N,) of the training images at the camera's distances, and of the camera's image."""
        focal = max(camera.fx, camera.fy)
        if camera.kind == "orthographic":
            return self.finest, torch.full_like(self.finest, focal)
        pose = torch.from_numpy(camera.world_to_camera).to(means)
        depths = (means @ pose[2, :3] + pose[2, 3]).clamp(min=NEAR)
        return torch.minimum(torch.maximum(self.focal / depths, self.coarsest), self.finest), focal / depths


@torch.no_grad()
def render_as_trained(
    cloud: GaussianCloud, camera: Camera, detail: TrainedDetail, sh_degree: int = 3, *more: Any, **options: Any
) -> Picture:
    """Render Gaussians as `render` does, with the detail that the training images have.

    Args:
        cloud: The Gaussians that `detail` measured.
        camera: The camera.
        detail: How finely training images sampled them.
        sh_degree: Degree of the Gaussians' colors, 0..3.
        more: Further arguments of `render`.
        options: Those by name; without `with_restored`.

    Returns:
        The image. Its `offsets` and `rendering` are those of the pixels that were averaged.
    """
    samples = detail.samples(cloud.means, camera)
    finer = camera.resized(camera.width * samples)
    picture = render(detail.widened(cloud, finer), finer, sh_degree, *more, **options)
    if samples == 1:
        return picture

    def averaged(image: Tensor) -> Tensor:
        rows = image.reshape(camera.height, samples, camera.width, samples, -1).mean(dim=(1, 3))
        return rows.reshape(camera.height, camera.width, *image.shape[2:])

    alpha, behind = averaged(picture.alpha), picture.behind
    if picture.range is not None:
        covered = torch.where(alpha > 0, alpha, torch.ones_like(alpha))
        picture = replace(picture, range=averaged(picture.range * picture.alpha) / covered)
    return replace(
        picture, color=averaged(picture.color), alpha=alpha, behind=None if behind is None else averaged(behind)
    )
