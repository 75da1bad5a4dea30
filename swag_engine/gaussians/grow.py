"""Where Gaussians are added and taken away while the scene is optimised."""

from dataclasses import dataclass

import torch
from torch import Tensor

from .cloud import GaussianCloud

PER_GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")


@dataclass
class GrowthStatistics:
    """Sums over the views since the last event: gradient (N,) of the loss with respect to the position on screen, in
    units of half the image width, and views (N,) in which the Gaussian was seen."""

    gradient: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, n: int, device: torch.device) -> "GrowthStatistics":
        return cls(torch.zeros(n, device=device), torch.zeros(n, device=device))

    def add(self, means2d_gradient: Tensor, radii: Tensor, width: int) -> None:
        """Add one view: means2d_gradient (N, 2) per pixel, radii (N,) in pixels with 0 for what was not seen."""
        self.gradient += means2d_gradient.norm(dim=-1) * (width / 2)
        self.views += radii > 0

    def score(self) -> Tensor:
        """(N,) mean gradient over the views that saw the Gaussian."""
        return self.gradient / self.views.clamp(min=1)


@dataclass(frozen=True)
class Growth:
    """Split what the loss pulls at most, along its longest axis, up to a budget; drop what has become transparent.

    A split keeps the mass and the variance of its parent along that axis: offset .6 sigma, sigma .8, opacity .625.
    """

    min_opacity: float = 0.01
    min_score: float = 2e-5
    max_scale: float = 2.0
    """In median ranges: what is wider is taken for a floater and dropped."""

    def event(
        self, cloud: GaussianCloud, statistics: GrowthStatistics, budget: int, median_range: float
    ) -> tuple[GaussianCloud, Tensor]:
        """The cloud after one event of at most `budget` Gaussians, and for each the index (N',) of the Gaussian whose
        optimiser state it continues, -1 for a new one."""
        scales = cloud.scales
        finite = torch.isfinite(cloud.means).all(dim=-1) & torch.isfinite(cloud.log_scales).all(dim=-1)
        keep = (cloud.opacities > self.min_opacity) & (scales.amax(dim=-1) < self.max_scale * median_range) & finite
        if not keep.any():
            return cloud, torch.arange(len(cloud), device=keep.device)
        score = torch.where(keep, statistics.score(), torch.zeros_like(statistics.gradient))
        room = max(0, budget - int(keep.sum()))
        wanted = score > self.min_score
        count = min(room, int(wanted.sum()))
        # A stable sort breaks ties by index: the same run always splits the same Gaussians.
        chosen = torch.sort(score, descending=True, stable=True).indices[:count]
        split = torch.zeros_like(keep)
        split[chosen] = True
        stay = (keep & ~split).nonzero().squeeze(-1)
        parents = split.nonzero().squeeze(-1)
        pieces = [{name: getattr(cloud, name)[stay] for name in PER_GAUSSIAN}]
        pieces += [split_along_longest_axis(cloud, parents, sign) for sign in (1.0, -1.0)]
        grown = GaussianCloud(
            **{name: torch.cat([piece[name] for piece in pieces]) for name in PER_GAUSSIAN}, background=cloud.background
        )
        source = torch.cat([stay, torch.full((2 * len(parents),), -1, device=stay.device)])
        return grown, source


def split_along_longest_axis(cloud: GaussianCloud, index: Tensor, sign: float) -> dict[str, Tensor]:
    """One of the two children (sign +1 or -1) of the Gaussians `index` (M,)."""
    child = {name: getattr(cloud, name)[index].clone() for name in PER_GAUSSIAN}
    scales = cloud.scales[index]
    longest = scales.argmax(dim=-1)
    rows = torch.arange(len(index), device=index.device)
    axis = rotation_matrices(cloud.quats[index])[rows, :, longest]
    child["means"] += sign * 0.6 * scales[rows, longest, None] * axis
    child["log_scales"][rows, longest] += float(torch.log(torch.tensor(0.8)))
    child["opacity_logits"] = torch.logit(0.625 * cloud.opacities[index], eps=1e-6)
    return child


def rotation_matrices(quats: Tensor) -> Tensor:
    """(M, 3, 3) rotation matrices of quaternions (M, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
