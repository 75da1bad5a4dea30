"""Where Gaussians are added and taken away while the scene is optimised."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .cloud import GaussianCloud

PER_GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN", "features")

MIN_OPACITY = 0.01
MIN_SCORE = 2e-5
MAX_SCALE = 2.0
"""In median ranges: what is wider is taken for a floater and dropped."""

# Of 3DGS-MCMC, with the values of its authors.
DEAD_OPACITY = 0.005
MAX_SHARERS = 51
NOISE = 5e5
REGULARISATION = 0.01


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


class Growth:
    """How a run changes its number of Gaussians, and what comes with it. This one splits and drops.

    Split what the loss pulls at most, along its longest axis, up to a budget; drop what has become transparent.
    A split keeps the mass and the variance of its parent along that axis: offset .6 sigma, sigma .8, opacity .625.
    """

    def event(
        self,
        cloud: GaussianCloud,
        statistics: GrowthStatistics,
        budget: int,
        median_range: float,
        generator: torch.Generator,
        weight: Tensor | None = None,
    ) -> tuple[GaussianCloud, Tensor]:
        """The cloud after one event of at most `budget` Gaussians, and for each the index (N',) of the Gaussian whose
        optimiser state it continues, -1 for a new one.

        generator: what is drawn at random is drawn from it (random_of). weight (N,): multiplied into the score that
        Gaussians are chosen by, 1 for all by default.
        """
        scales = cloud.scales
        finite = torch.isfinite(cloud.means).all(dim=-1) & torch.isfinite(cloud.log_scales).all(dim=-1)
        keep = (cloud.opacities > MIN_OPACITY) & (scales.amax(dim=-1) < MAX_SCALE * median_range) & finite
        if not keep.any():
            return cloud, torch.arange(len(cloud), device=keep.device)
        score = torch.where(keep, statistics.score(), torch.zeros_like(statistics.gradient))
        if weight is not None:
            score = score * weight
        room = max(0, budget - int(keep.sum()))
        wanted = score > MIN_SCORE
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

    def perturb(self, cloud: GaussianCloud, rate: float, median_range: float, generator: torch.Generator) -> None:
        """What is added to the cloud, in place, after each step of the optimiser; rate: the step size of the means."""

    def regularisation(self, cloud: GaussianCloud, median_range: float) -> Tensor | None:
        """What is added to the loss (a scalar), None for nothing."""
        return None


class McmcGrowth(Growth):
    """3D Gaussian Splatting as Markov chain Monte Carlo (Kheradmand et al. 2024, arXiv 2404.09591).

    Dead Gaussians move to where living ones are, which are drawn by their opacity and share it; the number grows to
    the budget in the same way. Faint Gaussians wander, and a loss on opacity and size lets the useless die. Lengths
    are taken in median ranges, so that the scene's unit does not matter.
    """

    def event(
        self,
        cloud: GaussianCloud,
        statistics: GrowthStatistics,
        budget: int,
        median_range: float,
        generator: torch.Generator,
        weight: Tensor | None = None,
    ) -> tuple[GaussianCloud, Tensor]:
        """As Growth.event; `statistics` are not looked at. Optimiser states of all that share an opacity are new."""
        opacities = cloud.opacities
        sums = cloud.means.sum(1) + cloud.quats.sum(1) + cloud.log_scales.sum(1) + cloud.sh0.sum((1, 2))
        finite = torch.isfinite(sums + cloud.shN.sum((1, 2)))
        alive = ((opacities > DEAD_OPACITY) & finite).nonzero().squeeze(-1)
        chances = opacities[alive] if weight is None else opacities[alive] * weight[alive]
        # On the CPU in float64: the same draws on every device.
        total = chances.detach().double().cpu().cumsum(0)
        if not len(alive) or total[-1] <= 0:
            return cloud, torch.arange(len(cloud), device=opacities.device)
        draws = torch.rand(max(0, budget - len(alive)), generator=generator, dtype=torch.float64) * total[-1]
        drawn = torch.searchsorted(total, draws, right=True).clamp(max=len(alive) - 1).to(alive.device)
        counts = torch.bincount(drawn, minlength=len(alive)) + 1
        opacity, shrink = share_opacity(opacities[alive], counts.clamp(max=MAX_SHARERS))
        living = {name: getattr(cloud, name)[alive] for name in PER_GAUSSIAN}
        shared = counts > 1
        logits = torch.logit(opacity.clamp(min=DEAD_OPACITY, max=1 - 1e-6))
        living["opacity_logits"] = torch.where(shared, logits, living["opacity_logits"])
        living["log_scales"] = living["log_scales"] + torch.where(shared, shrink, 1.0).log()[:, None]
        grown = GaussianCloud(
            **{name: torch.cat([values, values[drawn]]) for name, values in living.items()}, background=cloud.background
        )
        return grown, torch.cat([torch.where(shared, -1, alive), torch.full_like(drawn, -1)])

    @torch.no_grad()
    def perturb(self, cloud: GaussianCloud, rate: float, median_range: float, generator: torch.Generator) -> None:
        """Move each centre by rate NOISE sigmoid(100 (.005 - opacity)) Sigma eta: covariance Sigma, normal eta.

        Those of opacity over .15, whose sigmoid is below 1e-6, are left out.
        """
        opacities = cloud.opacities
        faint = (opacities < 0.15).nonzero().squeeze(-1)
        normal = torch.randn(len(faint), 3, generator=generator).to(cloud.means)
        axes = rotation_matrices(cloud.quats[faint])
        variances = (cloud.scales[faint] / median_range).square()
        # Sigma eta = R S^2 R^T eta, and R^T eta is as normal as eta.
        steps = (axes @ (variances * normal)[..., None]).squeeze(-1)
        size = rate * NOISE * torch.sigmoid(100 * (DEAD_OPACITY - opacities[faint]))
        cloud.means[faint] += size[:, None] * steps

    def regularisation(self, cloud: GaussianCloud, median_range: float) -> Tensor | None:
        """REGULARISATION times the mean opacity, and times the mean standard deviation in median ranges."""
        return REGULARISATION * (cloud.opacities.mean() + cloud.scales.mean() / median_range)


def random_of(seed: int, iteration: int) -> torch.Generator:
    """The random numbers of one iteration, on the CPU: a run that is continued draws what it would have drawn."""
    return torch.Generator().manual_seed(int(np.random.SeedSequence((seed, iteration)).generate_state(1)[0]))


def share_opacity(opacities: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity (N,) and factor (N,) of the scales with which `counts` (N,) equal Gaussians in one place look as one did.

    3DGS-MCMC: opacity o' = 1 - (1 - o)^(1/n) keeps the centre, and the factor keeps the integral along a
    line through it: o / sum_j C(n, j) (-1)^(j-1) o'^j / sqrt(j), j = 1..n (the double sum there, summed over i).
    """
    o, n = opacities.double().clamp(max=1 - 1e-12), counts.double()
    shared = -torch.expm1(torch.log1p(-o) / n)
    term, total = torch.ones_like(o), torch.zeros_like(o)
    for j in range(1, int(counts.max()) + 1 if len(counts) else 1):
        term = term * shared * (n - j + 1) / j  # 0 from j = n + 1 on
        total = total - (-1) ** j * term / j**0.5
    return shared.to(opacities), (o / total).to(opacities)


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
