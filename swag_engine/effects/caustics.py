"""Caustics: light that waves throw on the ground flickers, and no two images share it.

A coarse field of light for each image multiplies what is rendered and keeps the flicker out of the colors of the scene
(benchmarks/caustics.py compares it with a weight that trusts patches of other brightness less).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.observations import Observations
from ..evidence.scene_evidence import SceneEvidence
from .effect import CostProbe, Effect, InitialContext
from .image_gain import apply_log_gains

FIELD_SIDE = 32
"""Cells of the field along an image's width."""
LEAST_FLICKER = 0.06
"""Standard deviation of the log light that neighbouring points share."""
LEAST_SHARED = 0.0035
"""That standard deviation times the neighbours' correlation."""
BESIDE = 0.04
"""Distance of neighbouring points, in halves of an image's diagonal."""
MOST_BESIDE = 1000
"""Pairs of neighbours of two images that are used."""
SMOOTH_DEGREES = {4: 60, 2: 0}
"""Degree of the polynomial over an image that is no flicker, for so many points at least: waves are finer than the
fall-off of a lens, the beam of a lamp, and contrast that a phone evens out."""
LEAST_STEADINESS = 0.6
"""Flicker between the nearer half of the views over that of the farther half: waves do not depend on the camera's
place, but shine and the shadows of a lamp do."""
PAIR_ANGLE = 10.0
"""Angle between two views of a point that counts as nearly the same place, degrees."""
PAIR_RANGE = 0.05
"""Log ratio of their ranges, likewise."""
LEAST_PAIR = 30
"""Points that two images must share, and pairs of neighbours that are needed in all."""
LEAST_FARTHER = 0.01
"""Flicker between farther views below which it is taken as this much."""


@dataclass
class Illumination:
    """Light that differs over each training image.

    Attributes:
        log_light: (V, rows, columns) log of the light in a coarse grid over each of V images.
        names: Names of the images.
    """

    log_light: Tensor
    names: Sequence[str]

    @classmethod
    def starting(cls, names: Sequence[str], width: int, height: int) -> "Illumination":
        """Return even light over images of width x height pixels."""
        return cls(torch.zeros(len(names), max(1, round(FIELD_SIDE * height / width)), FIELD_SIDE), list(names))

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        return {"log_light": self.log_light}

    def settings(self) -> list[str]:
        """Return the image names, for a checkpoint."""
        return list(self.names)

    def log_gain(self, image: str, height: int, width: int) -> Tensor | None:
        """Return the log of the light (height, width, 1) in an image; None, even light, where none was learned for it.

        The mean over an image is 0: its brightness as a whole belongs to the exposure.
        """
        if image not in self.names:
            return None
        field = self.log_light[self.names.index(image)]
        field = (field - field.mean())[None, None]
        return torch.nn.functional.interpolate(field, size=(height, width), mode="bilinear", align_corners=False)[
            0, 0, ..., None
        ]


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from points that images show brighter or darker from nearly the same place."""
    centres = np.stack([image.camera.centre for image in evidence.images])
    return decide_by_flicker(evidence.observations, centres, evidence.scene.points.positions)


def decide_by_flicker(observations: Observations, centres: np.ndarray, positions: np.ndarray) -> Decision:
    """Decide from points that look brighter or darker from nearly the same place, together with their neighbours.

    Only changes that whole images do not share count, and those of single points are errors of matching.

    Args:
        observations: Observations of sparse points.
        centres: (V, 3) centres of the cameras.
        positions: (P, 3) positions of the points.

    Returns:
        The decision.
    """
    views = len(centres)
    grey = np.log(observations.light.mean(1) + 1e-3)
    changes: list[np.ndarray] = []
    angles: list[np.ndarray] = []
    by_image = [np.flatnonzero(observations.image == k) for k in range(views)]
    for a in range(views):
        tracks_a = observations.track[by_image[a]]
        for b in range(a + 1, views):
            _, left, right = np.intersect1d(tracks_a, observations.track[by_image[b]], return_indices=True)
            left, right = by_image[a][left], by_image[b][right]
            places = positions[observations.track[left]]
            rays = [places - centres[k] for k in (a, b)]
            cosine = (rays[0] * rays[1]).sum(1) / np.maximum(
                observations.ranges[left] * observations.ranges[right], 1e-12
            )
            same = (cosine > np.cos(np.radians(PAIR_ANGLE))) & (
                np.abs(np.log(observations.ranges[left] / observations.ranges[right])) < PAIR_RANGE
            )
            if same.sum() < LEAST_PAIR:
                continue
            place = observations.place[left][same]
            beside = cKDTree(place).query_pairs(BESIDE, output_type="ndarray")
            beside = beside[:: 1 + len(beside) // MOST_BESIDE]
            changes.append(_rough(grey[right][same] - grey[left][same], place)[beside])
            angles.append(np.arccos(np.clip(cosine[same], -1, 1))[beside].mean(1))
    change, angle = np.concatenate([np.zeros((0, 2)), *changes]), np.concatenate([np.zeros(0), *angles])
    figures: dict[str, Any] = {
        "flicker_least": LEAST_FLICKER,
        "shared_least": LEAST_SHARED,
        "steadiness_least": LEAST_STEADINESS,
        "pairs": len(change),
        "pairs_least": LEAST_PAIR,
    }
    if len(change) < LEAST_PAIR:
        return Decision(
            "unknown",
            figures,
            f"Cannot be determined: only {len(change)} times ({LEAST_PAIR} at least) do two photos show neighbours "
            f"from nearly the same place (within {PAIR_ANGLE:.0f} degrees and {PAIR_RANGE:.0%} of range).",
        )
    nearer = angle <= np.median(angle)
    flicker, correlation = _flicker(change)
    farther = _flicker(change[~nearer])[0] if (~nearer).any() else flicker
    steadiness = _flicker(change[nearer])[0] / max(farther, LEAST_FARTHER)
    shared = flicker * correlation
    found = flicker > LEAST_FLICKER and shared > LEAST_SHARED and steadiness > LEAST_STEADINESS
    figures |= {"flicker": flicker, "neighbours": correlation, "shared": shared, "steadiness": steadiness}
    return Decision(
        "on" if found else "off",
        figures,
        f"Seen again from nearly the same place, light on the ground differs by {flicker:.1%} (threshold "
        f"{LEAST_FLICKER:.0%}), alike for neighbouring points (correlation {correlation:.2f}; product {shared:.2%}, "
        f"threshold {LEAST_SHARED:.2%}), and as much between near views as between farther ones (ratio "
        f"{steadiness:.2g}, threshold {LEAST_STEADINESS}).",
    )


def _rough(change: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Log changes (n,) without what is smooth over the image."""
    usual = 3 * _robust_sd(change)
    middle = np.median(change)
    degree = next(degree for degree, least in SMOOTH_DEGREES.items() if len(change) >= least)
    x, y = place.T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], 1)
    smooth = np.linalg.lstsq(terms, np.clip(change, middle - usual, middle + usual), rcond=None)[0]
    return change - terms @ smooth


def _flicker(change: np.ndarray) -> tuple[float, float]:
    """Standard deviation of the log light that two neighbouring points (n, 2) share, and their correlation."""
    usual = 3 * max(_robust_sd(change), 1e-6)
    clipped = np.clip(change, -usual, usual)
    correlation = float(np.corrcoef(clipped.T)[0, 1]) if (np.ptp(clipped, axis=0) > 0).all() else 0.0
    return usual / 3 * float(np.sqrt(max(correlation, 0))), correlation


def _robust_sd(values: np.ndarray) -> float:
    """Standard deviation by the median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _initial(context: InitialContext) -> Illumination:
    return Illumination.starting(context.images, context.width, context.height)


def _load(tensors: dict[str, Tensor], settings: Any) -> Illumination:
    return Illumination(**tensors, names=settings)


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    height, width = probe.camera.height, probe.camera.width
    field = Illumination.starting([""], width, height)
    field.log_light = field.log_light.to(probe.device).requires_grad_()
    image, weights = probe.image(), probe.image().detach()
    return lambda: (apply_log_gains(image, [field.log_gain("", height, width)]) * weights).sum()


EFFECT = Effect(
    "Caustics",
    "image",
    decide,
    initial=_initial,
    load=_load,
    learning_rate=2e-2,
    row_an_image=True,
    cost=_cost,
    tried_at=0.1,
)
