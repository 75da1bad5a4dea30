"""The loss of one iteration."""

import torch
from torch import Tensor

from ..effects.depth_prior import depth_loss
from ..rendering.render import Picture
from ..settings.recipes import Recipe, Weights
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .losses import attenuation_order, grey_world, photometric, smoothness, uncovered_pixels, uncovered_surface
from .targets import Target

OCEANIC = (0, 1, 2)
"""Channels by attenuation in clear oceanic water: red most, blue least."""
CONSISTENCY_EVERY = 8
"""One Gaussian in so many takes part in the range consistency of a water network in an iteration."""


class Objective:
    """The loss of a recipe.

    Args:
        recipe: Which terms count, and how much.
        median_range: Median range of the scene, scene units.
        order: Channels by the attenuation that the sparse points gave, largest first; None where they gave none.
        backend: What computes.
    """

    def __init__(self, recipe: Recipe, median_range: float, order: tuple[int, int, int] | None, backend: str) -> None:
        self.recipe, self.median_range, self.backend = recipe, median_range, backend
        self.order = OCEANIC if recipe.hinge_order == "oceanic" else order

    def in_stage_two(self, fraction: float) -> bool:
        """Return whether geometry and water are frozen, `fraction` (0..1) of the way through the run."""
        return fraction >= self.recipe.stage_two_from

    def needs_range(self, target: Target, fraction: float) -> bool:
        """Return whether the rendered image has to come with ranges."""
        geometry = self.recipe.smoothness > 0 or (
            "depth_prior" in self.recipe.effects and target.inverse_range is not None
        )
        return geometry and not self.in_stage_two(fraction)

    def needs_restored(self, medium: object, fraction: float) -> bool:
        """Return whether the rendered image has to come with the same image without water."""
        return self.recipe.grey_world > 0 and medium is not None and not self.in_stage_two(fraction)

    def is_photometric(self, target: Target, medium: Medium | WaterNetwork | None, fraction: float) -> bool:
        """Return whether a target's loss is `photometric` with equal weights and `uncovered_surface`."""
        recipe = self.recipe
        if target.interpolated or target.emphasis is not None or recipe.relative or recipe.open_water:
            return False
        hinge = recipe.hinge and medium is not None and self.order
        consistency = recipe.range_consistency and isinstance(medium, WaterNetwork)
        others = self.needs_range(target, fraction) or self.needs_restored(medium, fraction) or hinge or consistency
        return self.in_stage_two(fraction) or not others

    def photometric_weights(self, fraction: float) -> tuple[float, float, float]:
        """Return the weights of L1, 1 - SSIM and L2, `fraction` (0..1) of the way through the run."""
        weights = self.recipe.photometric_two if self.in_stage_two(fraction) else self.recipe.photometric
        return _at(weights.l1, fraction), weights.ssim, _at(weights.l2, fraction)

    def reconstruction(self, color: Tensor, target: Target, fraction: float) -> Tensor:
        """Compare a rendered image with its target.

        Args:
            color: (H, W, 3) display values.
            target: The training image.
            fraction: How far the run is, 0..1.

        Returns:
            The loss, a scalar; differentiable in color.
        """
        if target.emphasis is not None:
            # A pixel of weight 1/2 is moved half of the way to the target, so that SSIM is weighted too.
            color = torch.lerp(target.color, color, target.emphasis[..., None])
        weights = self.photometric_weights(fraction)
        return photometric(color, target.color, target.valid, *weights, self.recipe.relative, self.backend)

    def __call__(
        self, picture: Picture, target: Target, medium: Medium | WaterNetwork | None, fraction: float
    ) -> Tensor:
        """Compute the loss of one rendered image.

        Args:
            picture: The image, with what needs_range and needs_restored asked for.
            target: The training image.
            medium: The water, None without.
            fraction: How far the run is, 0..1.

        Returns:
            The loss, a scalar.
        """
        recipe, two = self.recipe, self.in_stage_two(fraction)
        loss = self.reconstruction(picture.color, target, fraction)
        if target.interpolated:
            return target.weight * loss
        if recipe.coverage and picture.behind is not None:
            loss = loss + recipe.coverage * uncovered_surface(picture.alpha, target.color, picture.behind, target.valid)
        if recipe.coverage_of_color and picture.behind is None and target.surface is not None:
            loss = loss + recipe.coverage_of_color * uncovered_pixels(picture.alpha, target.surface & target.valid)
        if two:
            return loss
        if "depth_prior" in recipe.effects and target.inverse_range is not None and picture.range is not None:
            weight = recipe.depth_weight * 0.1 ** (fraction / recipe.stage_two_from)
            loss = loss + weight * depth_loss(picture.range, picture.alpha, target.inverse_range, self.median_range)
        if recipe.smoothness and picture.range is not None:
            guide = target.color if recipe.smoothness_edges == "image" else picture.color
            loss = loss + recipe.smoothness * smoothness(picture.range, picture.alpha, guide, self.median_range)
        if recipe.grey_world and picture.restored is not None:
            loss = loss + recipe.grey_world * grey_world(picture.restored, picture.alpha, recipe.grey_world_target)
        if recipe.hinge and medium is not None and self.order:
            # Coefficients per median range, so that the margin means the same in every scene.
            loss = loss + recipe.hinge * attenuation_order(medium.beta_D * self.median_range, self.order)
        if recipe.range_consistency and isinstance(medium, WaterNetwork):
            loss = loss + recipe.range_consistency * medium.range_consistency(picture.offsets[::CONSISTENCY_EVERY])
        return loss


def _at(weights: Weights, fraction: float) -> float:
    """A weight that changes linearly over the run."""
    return weights[0] + (weights[1] - weights[0]) * fraction
