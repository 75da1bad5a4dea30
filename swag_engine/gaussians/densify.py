"""Densification: which Gaussians are added and removed while the scene is optimised."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from .cloud import GaussianCloud

PER_GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN", "features")
"""Fields of a cloud with a row per Gaussian."""

MIN_OPACITY = 0.01
"""Opacity below which a Gaussian is removed: it changes a pixel by less than 3 steps of an 8-bit image."""
MIN_SCORE = 2e-5
"""Mean gradient on screen above which a Gaussian is split, loss per half image width: a tenth of 3DGS's
threshold, because the budget limits the number."""
MAX_SCALE = 2.0
"""Standard deviation above which a Gaussian is removed as a floater, median ranges."""
SPLIT_OFFSET = 0.6
"""Distance of a child from its parent, standard deviations along the longest axis: with SPLIT_SCALE it keeps the
variance, .6^2 + .8^2 = 1."""
SPLIT_SCALE = 0.8
"""Standard deviation of a child along that axis, as a factor of the parent's."""
SPLIT_OPACITY = 0.625
"""Opacity of a child as a factor of the parent's: two children of .8 times the length keep the mass."""

# Of 3DGS-MCMC (arXiv 2404.09591), with the values of its authors.
DEAD_OPACITY = 0.005
"""Opacity below which a Gaussian is dead and relocated."""
MAX_SHARERS = 51
"""Largest number of Gaussians among which one opacity is divided: the published table has as many entries."""
NOISE = 5e5
"""Noise of the centres as a factor of their learning rate."""
NOISE_OPACITY = 0.15
"""Opacity from which centres get no noise: its sigmoid is below 1e-6."""
REGULARISATION = 0.01
"""Weight of the mean opacity and of the mean standard deviation (median ranges) in the loss."""


@dataclass
class DensificationStatistics:
    """Sums over the views since the last densification.

    Attributes:
        gradient: (N,) length of the loss's gradient by the position on screen, per half image width.
        views: (N,) number of views in which the Gaussian was visible.
    """

    gradient: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, n: int, device: torch.device) -> "DensificationStatistics":
        """Return the statistics of n Gaussians before the first view."""
        return cls(torch.zeros(n, device=device), torch.zeros(n, device=device))

    def add(self, means2d_gradient: Tensor, radii: Tensor, width: int) -> None:
        """Add one view.

        Args:
            means2d_gradient: (N, 2) gradient of the loss by the projected centres, per pixel.
            radii: (N,) extent on screen, pixels, 0 where a Gaussian is not visible.
            width: Width of the image, pixels.
        """
        self.gradient += means2d_gradient.norm(dim=-1) * (width / 2)
        self.views += radii > 0

    def first(self, count: int) -> "DensificationStatistics":
        """Return the statistics of the first Gaussians, as views."""
        return DensificationStatistics(self.gradient[:count], self.views[:count])

    def score(self) -> Tensor:
        """Return the mean gradient (N,) over the views in which each Gaussian was visible."""
        return self.gradient / self.views.clamp(min=1)


class DensificationStrategy(Protocol):
    """How a run changes the number of its Gaussians, and what belongs to that."""

    def densify(
        self,
        cloud: GaussianCloud,
        statistics: DensificationStatistics,
        budget: int,
        median_range: float,
        generator: torch.Generator,
        weight: Tensor | None = None,
    ) -> tuple[GaussianCloud, Tensor]:
        """Add and remove Gaussians once.

        Args:
            cloud: The N Gaussians; not changed.
            statistics: Statistics since the last time.
            budget: Largest number of Gaussians afterwards.
            median_range: Median range of the scene, scene units.
            generator: Random numbers of the iteration, from `random_of`.
            weight: (N,) factor of the score by which Gaussians are chosen; 1 by default.

        Returns:
            The cloud of N' Gaussians, and for each the index (N',) of the Gaussian whose optimiser state it keeps, -1
            for none.
        """

    def perturb(self, cloud: GaussianCloud, rate: float, median_range: float, generator: torch.Generator) -> None:
        """Change the cloud in place after a step of the optimiser.

        Args:
            cloud: The Gaussians.
            rate: Step size of the means, scene units.
            median_range: Median range of the scene, scene units.
            generator: Random numbers of the iteration.
        """

    def regularisation(self, cloud: GaussianCloud, median_range: float) -> Tensor | None:
        """Return what is added to the loss, a scalar, None for nothing.

        Args:
            cloud: The Gaussians.
            median_range: Median range of the scene, scene units.
        """


class SplitStrategy:
    """Splits the Gaussians with the largest gradient on screen along their longest axis; removes transparent ones.

    A split keeps the mass and the variance of the parent along that axis.
    """

    def densify(
        self,
        cloud: GaussianCloud,
        statistics: DensificationStatistics,
        budget: int,
        median_range: float,
        generator: torch.Generator,
        weight: Tensor | None = None,
    ) -> tuple[GaussianCloud, Tensor]:
        """See `DensificationStrategy.densify`; nothing is random."""
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
        densified = GaussianCloud(
            **{name: torch.cat([piece[name] for piece in pieces]) for name in PER_GAUSSIAN}, background=cloud.background
        )
        source = torch.cat([stay, torch.full((2 * len(parents),), -1, device=stay.device)])
        return densified, source

    def perturb(self, cloud: GaussianCloud, rate: float, median_range: float, generator: torch.Generator) -> None:
        """Change nothing."""

    def regularisation(self, cloud: GaussianCloud, median_range: float) -> Tensor | None:
        """Return None: nothing is added to the loss."""
        return None


class McmcStrategy:
    """3D Gaussian Splatting as Markov chain Monte Carlo (Kheradmand et al. 2024, arXiv 2404.09591).

    Dead Gaussians are relocated to living ones, which are drawn by their opacity and share it; the number rises to the
    budget in the same way. Centres of faint Gaussians get noise, and a loss on opacity and size removes Gaussians that
    nothing needs. Lengths are taken in median ranges, so that the scene's unit does not matter.
    """

    def densify(
        self,
        cloud: GaussianCloud,
        statistics: DensificationStatistics,
        budget: int,
        median_range: float,
        generator: torch.Generator,
        weight: Tensor | None = None,
    ) -> tuple[GaussianCloud, Tensor]:
        """See `DensificationStrategy.densify`.

        The statistics are not used. Gaussians that share an opacity start with a new optimiser state.
        """
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
        densified = GaussianCloud(
            **{name: torch.cat([values, values[drawn]]) for name, values in living.items()}, background=cloud.background
        )
        return densified, torch.cat([torch.where(shared, -1, alive), torch.full_like(drawn, -1)])

    @torch.no_grad()
    def perturb(self, cloud: GaussianCloud, rate: float, median_range: float, generator: torch.Generator) -> None:
        """Move each centre by rate NOISE sigmoid(100 (.005 - opacity)) Sigma eta: covariance Sigma, normal eta.

        Args:
            cloud: The Gaussians; their means are changed in place.
            rate: Step size of the means, scene units.
            median_range: Median range of the scene, scene units.
            generator: Random numbers of the iteration.
        """
        opacities = cloud.opacities
        faint = (opacities < NOISE_OPACITY).nonzero().squeeze(-1)
        normal = torch.randn(len(faint), 3, generator=generator).to(cloud.means)
        axes = rotation_matrices(cloud.quats[faint])
        variances = (cloud.scales[faint] / median_range).square()
        # Sigma eta = R S^2 R^T eta, and R^T eta has the distribution of eta.
        steps = (axes @ (variances * normal)[..., None]).squeeze(-1)
        size = rate * NOISE * torch.sigmoid(100 * (DEAD_OPACITY - opacities[faint]))
        cloud.means[faint] += size[:, None] * steps

    def regularisation(self, cloud: GaussianCloud, median_range: float) -> Tensor | None:
        """Return REGULARISATION times the sum of mean opacity and mean standard deviation in median ranges."""
        return REGULARISATION * (cloud.opacities.mean() + cloud.scales.mean() / median_range)


def random_of(seed: int, iteration: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Make the random numbers of one iteration, so that a resumed run draws the same ones.

    Args:
        seed: Seed of the run.
        iteration: Number of the iteration.
        device: Where numbers are drawn; each kind of device draws others.

    Returns:
        The generator.
    """
    state = int(np.random.SeedSequence((seed, iteration)).generate_state(1)[0])
    return torch.Generator(device).manual_seed(state)


def share_opacity(opacities: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Divide opacities among equal Gaussians in one place that together look as one did.

    3DGS-MCMC (arXiv 2404.09591): opacity o' = 1 - (1 - o)^(1/n) keeps the centre, and the factor of the scales keeps
    the integral along a line through it: o / sum_j C(n, j) (-1)^(j-1) o'^j / sqrt(j), j = 1..n (the double sum there,
    summed over i).

    Args:
        opacities: (N,) o, in 0..1.
        counts: (N,) number n of Gaussians that share each.

    Returns:
        Opacity (N,) of each sharer and factor (N,) of its scales.
    """
    o, n = opacities.double().clamp(max=1 - 1e-12), counts.double()
    shared = -torch.expm1(torch.log1p(-o) / n)
    term, total = torch.ones_like(o), torch.zeros_like(o)
    for j in range(1, int(counts.max()) + 1 if len(counts) else 1):
        term = term * shared * (n - j + 1) / j  # 0 from j = n + 1 on
        total = total - (-1) ** j * term / j**0.5
    return shared.to(opacities), (o / total).to(opacities)


def split_along_longest_axis(cloud: GaussianCloud, index: Tensor, sign: float) -> dict[str, Tensor]:
    """Make one of the two children of Gaussians that are split.

    Args:
        cloud: The Gaussians.
        index: (M,) those that are split.
        sign: +1 or -1: the side of the parent on which the child is.

    Returns:
        The children's tensors by name, M rows each.
    """
    child = {name: getattr(cloud, name)[index].clone() for name in PER_GAUSSIAN}
    scales = cloud.scales[index]
    longest = scales.argmax(dim=-1)
    rows = torch.arange(len(index), device=index.device)
    axis = rotation_matrices(cloud.quats[index])[rows, :, longest]
    child["means"] += sign * SPLIT_OFFSET * scales[rows, longest, None] * axis
    child["log_scales"][rows, longest] += float(torch.log(torch.tensor(SPLIT_SCALE)))
    child["opacity_logits"] = torch.logit(SPLIT_OPACITY * cloud.opacities[index], eps=1e-6)
    return child


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return the rotation matrices (M, 3, 3) of quaternions (M, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
