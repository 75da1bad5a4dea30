"""Pseudo-depth of single photographs, brought to the scene's scale, and the loss that holds rendered ranges to it.

Networks give inverse depth up to a scale and a shift that differ per image. SfM points give the two, or show that the
network does not understand this image (docs/method.md section 3).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.stats import spearmanr

from ..base.errors import InputError
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.images import TrainingImage
from ..weights.onnx import Network

MEAN, STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)  # ImageNet's
SHORT_SIDE, PATCH = 518, 14  # what Depth Anything V2 was trained with, and its patch

MIN_POINTS, MIN_FITTED, MIN_SPEARMAN, SLOPE_FACTORS = 30, 0.7, 0.8, (0.2, 5.0)


class InverseDepth:
    """An inverse depth network in an ONNX file, such as Depth Anything V2.

    Input (1, 3, H, W): RGB in 0..1 less ImageNet's mean, over its standard deviation, of the file's size, or of
    multiples of 14 with a short side of 518 where the file leaves the size open. Output (1, H', W') or (1, 1, H', W'):
    larger is nearer. MiDaS takes the same input when exported from its weights, but the ONNX files that its authors
    publish normalise inside and are fed wrongly here.
    """

    def __init__(self, path: Path) -> None:
        """Raises InputError when the file is absent or no such network."""
        shapes = [(1, None, None), (1, 1, None, None)]
        self.network = Network(path, "an inverse depth network", [(1, 3, None, None)], shapes)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Inverse depth up to scale and shift, (H, W) float32, of an image (H, W, 3) uint8 sRGB.

        Raises InputError when the network fails.
        """
        height, width = image.shape[:2]
        scale = SHORT_SIDE / min(height, width)
        rows, columns = (
            fixed or PATCH * max(1, round(size * scale / PATCH))
            for fixed, size in zip(self.network.inputs[0][2:], (height, width), strict=True)
        )
        resized = cv2.resize(image.astype(np.float32) / 255, (columns, rows), interpolation=cv2.INTER_CUBIC)
        made = self.network(((resized - MEAN) / STD).transpose(2, 0, 1)[None])
        return cv2.resize(made.reshape(made.shape[-2:]), (width, height), interpolation=cv2.INTER_LINEAR)


class StoredDepth:
    """Inverse depth, or depth of any kind that falls with it, which somebody made before: depth/NAME.npy, or .png of 8
    or 16 bits, beside the photographs of a scene."""

    def __init__(self, scene: Scene) -> None:
        """Raises InputError where the photographs have to be undistorted first: the maps could not follow."""
        self.folder = scene.folder / "depth"
        if not all(view.lens.is_pinhole for view in scene.views):
            raise InputError(f"The maps in {self.folder} are of distorted photographs: undistort both first.")

    def __call__(self, image: TrainingImage) -> np.ndarray:
        """Inverse depth up to scale and shift, (H, W) float32. Raises InputError when it cannot be read."""
        path = (self.folder / image.camera.name).with_suffix(".npy")
        try:
            if path.is_file():
                values = np.load(path, allow_pickle=False)
            else:
                path = path.with_suffix(".png")
                values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
            values = np.asarray(values, np.float32)
        except (OSError, ValueError, TypeError, cv2.error) as error:
            raise InputError(f"{path} cannot be read as inverse depth: {error}.") from error
        if values.ndim != 2 or not values.size:
            raise InputError(f"{path} is not inverse depth: its shape is {values.shape}, not (height, width).")
        height, width = image.valid.shape
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)


# Alignment ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Alignment:
    """How one image's prediction m becomes inverse range: a m + b, in inverse scene units.

    `count` SfM points lie on the image, and `spearman` is the rank correlation of m and inverse range at those that the
    line fits. `reason` says in a sentence why the image has no prior, and is empty where it is accepted.
    """

    a: float
    b: float
    count: int
    spearman: float
    accepted: bool
    reason: str


def align(prediction: np.ndarray, points_uv: np.ndarray, inverse_range: np.ndarray) -> Alignment:
    """Fit inverse_range = a prediction + b by robust IRLS (docs/method.md section 3).

    prediction (H, W) inverse depth up to scale and shift; points_uv (P, 2) pixels, the top left pixel's centre at 0.5;
    inverse_range (P,) 1 / Euclidean range of SfM points, in inverse scene units. Points beside the picture and numbers
    that are not finite do not count. Accepted are >= 30 points, Spearman >= .8 and a > 0; `gate` compares images.

    Spearman is taken at the points that the line fits: a fifth of wrong points alone would bring it below .8. For that,
    70 % of the points have to fit, or a prediction that is right in half of the image would pass.
    """
    height, width = prediction.shape
    inside = (points_uv >= 0).all(1) & (points_uv <= (width, height)).all(1) & np.isfinite(inverse_range)
    uv, y = points_uv[inside], np.asarray(inverse_range, np.float64)[inside]
    x = map_coordinates(np.asarray(prediction, np.float64), uv.T[::-1] - 0.5, order=1, mode="nearest")
    x, y = x[np.isfinite(x)], y[np.isfinite(x)]
    count = len(x)
    if count < MIN_POINTS:
        return _refused(count, f"Only {count} sparse points lie on the photograph, and {MIN_POINTS} are needed.")
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return _refused(count, "The depths at its sparse points are all the same, so no scale can be found.")
    a, b, fitted = _robust_line(x, y)
    spearman = float(spearmanr(x[fitted], y[fitted]).statistic)
    if fitted.mean() < MIN_FITTED:
        reason = (
            f"The predicted depth agrees with only {fitted.mean():.0%} of the sparse points, and {MIN_FITTED:.0%} are "
            "needed."
        )
    elif spearman <= -MIN_SPEARMAN:
        reason = "The predicted depth runs against that of the sparse points: near and far are exchanged."
    elif not (spearman >= MIN_SPEARMAN and a > 0):
        reason = (
            f"The predicted depth does not follow the sparse points: rank correlation {spearman:.2f}, and "
            f"{MIN_SPEARMAN} is needed."
        )
    else:
        reason = ""
    return Alignment(a, b, count, spearman, not reason, reason)


def gate(alignments: Mapping[str, Alignment]) -> dict[str, Alignment]:
    """The same, without the images whose a is beyond [.2, 5] times the median of the accepted ones' (docs/method.md
    section 3): one network sees one scene at about one scale."""
    median = float(np.median([alignment.a for alignment in alignments.values() if alignment.accepted] or [np.nan]))
    low, high = SLOPE_FACTORS
    return {
        name: replace(
            alignment,
            accepted=False,
            reason=f"Its depth scale is {alignment.a / median:.2g} times the usual one of this scene, and {low} to "
            f"{high:g} times is believed.",
        )
        if alignment.accepted and not low <= alignment.a / median <= high
        else alignment
        for name, alignment in alignments.items()
    }


def prior(prediction: np.ndarray, alignment: Alignment) -> np.ndarray:
    """q (H, W) float32: inverse Euclidean range in inverse scene units, a m + b, and 0 (infinitely far) at least."""
    return np.maximum(np.float32(alignment.a) * prediction + np.float32(alignment.b), 0)


def depth_priors(
    predict: Callable[[TrainingImage], np.ndarray], images: Sequence[TrainingImage], scene: Scene
) -> tuple[dict[str, np.ndarray], dict[str, Alignment]]:
    """Predict, align and gate the photographs of one scene. predict: inverse depth (H, W) up to scale and shift.

    Returns q (H, W) float32 by name for the accepted images, not a number at invalid pixels, and the alignments of all.
    Raises InputError as `predict` does.
    """
    indices = {view.name: view.point_indices for view in scene.views}
    predictions, alignments = {}, {}
    for image in images:
        name = image.camera.name
        predictions[name] = predict(image)
        alignments[name] = align(predictions[name], *sparse_points(image.camera, scene.points.positions[indices[name]]))
    alignments = gate(alignments)
    priors = {
        image.camera.name: np.where(image.valid, prior(predictions[image.camera.name], alignment), np.float32(np.nan))
        for image in images
        if (alignment := alignments[image.camera.name]).accepted
    }
    return priors, alignments


def sparse_points(camera: Camera, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera sees those of positions (P, 3) that lie in front of it: pixels (Q, 2) and 1 / range (Q,)."""
    in_camera = positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    in_camera = in_camera[in_camera[:, 2] > 0]
    projected = in_camera @ camera.K.T
    return projected[:, :2] / projected[:, 2:], 1 / np.linalg.norm(in_camera, axis=1)


def _refused(count: int, reason: str) -> Alignment:
    return Alignment(float("nan"), float("nan"), count, float("nan"), False, reason)


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Slope, intercept and which points fit, by iteratively reweighted least squares: least absolute residuals first,
    which outliers move little, then Tukey's biweight, which they do not move at all."""
    floor = 1e-9 * float(np.abs(y).max())
    weights = np.ones_like(x)
    slope, middle_x, middle_y = 0.0, 0.0, 0.0
    for step in range(40):
        middle_x, middle_y = np.average(x, weights=weights), np.average(y, weights=weights)
        centred = weights * (x - middle_x)
        slope = float((centred * (y - middle_y)).sum() / max((centred * (x - middle_x)).sum(), 1e-300))
        residual = np.abs(y - middle_y - slope * (x - middle_x))
        scale = max(1.4826 * float(np.median(residual)), floor)
        if step < 20:
            weights = 1 / np.maximum(residual, 0.01 * scale)
        else:
            weights = np.maximum(1 - (residual / (4.685 * scale)) ** 2, 0) ** 2
    return slope, float(middle_y - slope * middle_x), weights > 0


# Loss -----------------------------------------------------------------------------------------------------------------
