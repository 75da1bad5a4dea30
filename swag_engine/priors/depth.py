"""Depth of single images by a network, aligned to the scene's scale (docs/method.md section 3).

Networks give inverse depth up to a scale and a shift that differ per image. Sparse points determine both, or show that
the prediction is wrong for an image.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from ..base.errors import InputError
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, decode_image
from ..weights.onnx import Network

MEAN = np.array([0.485, 0.456, 0.406], np.float32)
"""Mean of ImageNet's images, sRGB in 0..1."""
STD = np.array([0.229, 0.224, 0.225], np.float32)
"""Their standard deviation."""
SHORT_SIDE = 518
"""Pixels of the shorter side of the network's input, as Depth Anything V2 was trained."""
PATCH = 14
"""Pixels of a patch of Depth Anything V2; the sides of the input are multiples of it."""
MIN_POINTS = 30
"""Sparse points that must lie on an image."""
MIN_FITTED = 0.7
"""Fraction of them that the line must fit."""
MIN_SPEARMAN = 0.8
"""Rank correlation of prediction and inverse range at the fitted points."""
SLOPE_FACTORS = (0.2, 5.0)
"""Smallest and largest slope of an image, as a factor of the median slope of the scene's images."""


class InverseDepth:
    """An inverse depth network in an ONNX file, such as Depth Anything V2.

    Input (1, 3, H, W): RGB in 0..1 minus ImageNet's mean, divided by its standard deviation; of the size of the file,
    or, where that is open, of multiples of PATCH with a short side of SHORT_SIDE. Output (1, H', W') or
    (1, 1, H', W'): larger is nearer. MiDaS takes the same input when exported from its weights; the ONNX files that its
    authors publish normalise the input themselves and give wrong results here.

    Args:
        path: The file.

    Raises:
        InputError: If the file is absent or another network.
    """

    def __init__(self, path: Path) -> None:
        shapes = [(1, None, None), (1, 1, None, None)]
        self.network = Network(path, "an inverse depth network", [(1, 3, None, None)], shapes)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Predict the inverse depth of an image.

        Args:
            image: (H, W, 3) uint8 sRGB.

        Returns:
            Inverse depth (H, W) float32, up to scale and shift.

        Raises:
            InputError: If the network fails.
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
    """Maps of inverse depth in the scene's folder: depth/NAME.npy, or depth/NAME.png with 8 or 16 bits.

    Args:
        scene: The scene.

    Raises:
        InputError: If the scene's images are distorted; the maps would have to be undistorted with them.
    """

    def __init__(self, scene: Scene) -> None:
        self.folder = scene.folder / "depth"
        if not all(view.lens.is_pinhole for view in scene.views):
            raise InputError(f"The maps in {self.folder} are of distorted images: undistort both first.")

    def __call__(self, image: TrainingImage) -> np.ndarray:
        """Read the map of an image.

        Args:
            image: The image.

        Returns:
            Inverse depth (H, W) float32, up to scale and shift, at the image's size.

        Raises:
            InputError: If the map is absent or cannot be read.
        """
        path = (self.folder / image.camera.name).with_suffix(".npy")
        try:
            if path.is_file():
                values = np.load(path, allow_pickle=False)
            else:
                path = path.with_suffix(".png")
                values = decode_image(path)
            values = np.asarray(values, np.float32)
        except (OSError, ValueError, TypeError, cv2.error) as error:
            raise InputError(f"{path} cannot be read as inverse depth: {error}.") from error
        if values.ndim != 2 or not values.size:
            raise InputError(f"{path} is not inverse depth: its shape is {values.shape}, not (height, width).")
        height, width = image.valid.shape
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True)
class Alignment:
    """Line from the prediction m of one image to inverse range, a m + b.

    Attributes:
        a: Slope, inverse scene units.
        b: Intercept, inverse scene units.
        count: Sparse points on the image.
        spearman: Rank correlation of m and inverse range at the points that the line fits.
        accepted: Whether the image has a depth prior.
        reason: Why it has none, a sentence; empty where it is accepted.
    """

    a: float
    b: float
    count: int
    spearman: float
    accepted: bool
    reason: str


def align(prediction: np.ndarray, points_uv: np.ndarray, inverse_range: np.ndarray) -> Alignment:
    """Fit inverse_range = a prediction + b by robust iteratively reweighted least squares.

    An image is accepted with at least MIN_POINTS points, of which MIN_FITTED fit the line, a rank correlation of
    MIN_SPEARMAN and a > 0; `reject_outlying_slopes` then compares images. The rank correlation is that of the points
    that the line fits, because 20 % of wrong points alone would bring it below MIN_SPEARMAN; therefore MIN_FITTED of
    them have to fit, or a prediction that is right in half of the image would be accepted.

    Args:
        prediction: (H, W) inverse depth up to scale and shift.
        points_uv: (P, 2) sparse points in the image, pixels; the centre of the top left pixel is at 0.5. Points outside
            the image do not count.
        inverse_range: (P,) 1 / Euclidean range of the points, inverse scene units. Values that are not finite do not
            count.

    Returns:
        The line, and whether it is accepted.
    """
    from scipy.stats import spearmanr  # here, because its import would make every start of the engine 0.4 s longer

    height, width = prediction.shape
    inside = (points_uv >= 0).all(1) & (points_uv <= (width, height)).all(1) & np.isfinite(inverse_range)
    uv, y = points_uv[inside], np.asarray(inverse_range, np.float64)[inside]
    x = map_coordinates(np.asarray(prediction, np.float64), uv.T[::-1] - 0.5, order=1, mode="nearest")
    x, y = x[np.isfinite(x)], y[np.isfinite(x)]
    count = len(x)
    if count < MIN_POINTS:
        return _rejected(count, f"Only {count} sparse points lie on the image, and {MIN_POINTS} are needed.")
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return _rejected(count, "The depths at its sparse points are all the same, so no scale can be determined.")
    a, b, fitted = _robust_line(x, y)
    spearman = float(spearmanr(x[fitted], y[fitted]).statistic)
    if fitted.mean() < MIN_FITTED:
        reason = (
            f"The predicted depth agrees with only {fitted.mean():.0%} of the sparse points, and {MIN_FITTED:.0%} are "
            "needed."
        )
    elif spearman <= -MIN_SPEARMAN:
        reason = "The predicted depth decreases where that of the sparse points increases: near and far are exchanged."
    elif not (spearman >= MIN_SPEARMAN and a > 0):
        reason = (
            f"The predicted depth does not follow the sparse points: rank correlation {spearman:.2f}, and "
            f"{MIN_SPEARMAN} is needed."
        )
    else:
        reason = ""
    return Alignment(a, b, count, spearman, not reason, reason)


def reject_outlying_slopes(alignments: Mapping[str, Alignment]) -> dict[str, Alignment]:
    """Reject images whose slope differs from the median slope of the scene by more than SLOPE_FACTORS.

    Args:
        alignments: Image name -> alignment.

    Returns:
        The same alignments, with outlying slopes rejected.
    """
    median = float(np.median([alignment.a for alignment in alignments.values() if alignment.accepted] or [np.nan]))
    low, high = SLOPE_FACTORS
    return {
        name: replace(
            alignment,
            accepted=False,
            reason=f"Its depth scale is {alignment.a / median:.2g} times the median of the scene, and {low} to "
            f"{high:g} times is accepted.",
        )
        if alignment.accepted and not low <= alignment.a / median <= high
        else alignment
        for name, alignment in alignments.items()
    }


def aligned_inverse_range(prediction: np.ndarray, alignment: Alignment) -> np.ndarray:
    """Apply an alignment.

    Args:
        prediction: (H, W) inverse depth m up to scale and shift.
        alignment: Line of the image.

    Returns:
        Inverse Euclidean range a m + b, (H, W) float32, inverse scene units, at least 0 (infinitely far).
    """
    return np.maximum(np.float32(alignment.a) * prediction + np.float32(alignment.b), 0)


def depth_priors(
    predict: Callable[[TrainingImage], np.ndarray], images: Sequence[TrainingImage], scene: Scene
) -> tuple[dict[str, np.ndarray], dict[str, Alignment]]:
    """Predict and align the depth of the images of one scene.

    Args:
        predict: Gives the inverse depth (H, W) of an image, up to scale and shift.
        images: Images of the scene.
        scene: The scene with its sparse points.

    Returns:
        Image name -> inverse range (H, W) float32 of the accepted images, inverse scene units, NaN at invalid pixels;
        and image name -> alignment of all images.

    Raises:
        InputError: As `predict` does.
    """
    indices = {view.name: view.point_indices for view in scene.views}
    predictions, alignments = {}, {}
    for image in images:
        name = image.camera.name
        predictions[name] = predict(image)
        alignments[name] = align(predictions[name], *sparse_points(image.camera, scene.points.positions[indices[name]]))
    alignments = reject_outlying_slopes(alignments)
    priors = {}
    for image in images:
        name = image.camera.name
        if alignments[name].accepted:
            inverse_range = aligned_inverse_range(predictions[name], alignments[name])
            priors[name] = np.where(image.valid, inverse_range, np.float32(np.nan))
    return priors, alignments


def sparse_points(camera: Camera, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points into a camera.

    Args:
        camera: The camera.
        positions: (P, 3) in its world.

    Returns:
        Pixels (Q, 2) and 1 / Euclidean range (Q,), inverse scene units, of the points in front of the camera.
    """
    in_camera = positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    in_camera = in_camera[in_camera[:, 2] > 0]
    projected = in_camera @ camera.K.T
    return projected[:, :2] / projected[:, 2:], 1 / np.linalg.norm(in_camera, axis=1)


def _rejected(count: int, reason: str) -> Alignment:
    return Alignment(float("nan"), float("nan"), count, float("nan"), False, reason)


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return slope, intercept and which points fit, by iteratively reweighted least squares.

    The first 20 steps minimise absolute residuals, which outliers change little; the others use Tukey's biweight
    (Beaton and Tukey 1974, constant 4.685), which ignores them.
    """
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
