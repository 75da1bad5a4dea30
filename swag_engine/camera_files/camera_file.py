"""Content of a file of cameras of any program, in COLMAP's terms.

Axes of a camera are x right, y down, z forward; the centre of the top left pixel is (0.5, 0.5).
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..scene.georeference import Georeference
from ..scene.lenses import Lens
from .polynomial_lens import PolynomialLens, rescaled

_ROTATION_TOLERANCE = 0.02
"""Largest deviation of the product of a rotation and its transpose from the identity: two decimals make 0.018."""
OPENGL_AXES = np.diag([1.0, -1.0, -1.0])
"""Camera axes x right, y up, z backward (OpenGL, Blender, Bundler) to COLMAP's."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Lens of a group of photos.

    Attributes:
        lens: The lens of photos of a width and a height in pixels.
        size: Width and height in pixels that the file gives, None where it has none.
    """

    lens: Callable[[int, int], Lens]
    size: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class FileCamera:
    """A posed photo.

    Attributes:
        name: What the file calls the photo: a path with forward slashes, a file name, or a label.
        calibration: Its lens.
        world_to_camera: Rigid transform (4, 4) float64.
        mask: Mask that the file names, None without one.
        depth: Depth image that the file names, None without one.
    """

    name: str
    calibration: Calibration
    world_to_camera: np.ndarray
    mask: Path | None = None
    depth: Path | None = None

    @property
    def centre(self) -> np.ndarray:
        """The projection centre in the world, (3,) float64."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


@dataclass(frozen=True, eq=False)
class FilePoints:
    """Sparse points.

    Attributes:
        positions: Positions (P, 3) float64 in the world of the cameras.
        colors: Display colors (P, 3) uint8 sRGB, (0, 3) where the file has none.
        observations: For each point (index in the list of cameras, x, y), in pixels from the middle of the image, y
            down. Empty where the file has none.
    """

    positions: np.ndarray
    colors: np.ndarray
    observations: Sequence[Sequence[tuple[int, float, float]]] = ()


@dataclass(frozen=True, eq=False)
class CameraFile:
    """Content of a file of cameras.

    Attributes:
        program: Name of the format, for messages.
        cameras: The posed photos.
        points: Sparse points, None where the file has none.
        points_file: PLY file of sparse points that the file names, None without one.
        georeference: Metres, axes and coordinates of the world, None where the file does not say.
        warnings: Sentences about what was left out.
    """

    program: str
    cameras: tuple[FileCamera, ...]
    points: FilePoints | None = None
    points_file: Path | None = None
    georeference: Georeference | None = None
    warnings: list[str] = field(default_factory=list)


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Name what is being read in the ValueError of anything wrong with it."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{what}: {reason}") from error


def photos_are(count: int) -> str:
    """Return the beginning of a sentence about some photos."""
    return "1 photo is" if count == 1 else f"{count} photos are"


def sized_calibration(lens: Lens) -> Calibration:
    """Make the calibration of a lens whose parameters are in pixels of images of a known size."""
    return Calibration(lambda width, height: rescaled(lens, width, height), (lens.width, lens.height))


def brown_lens(
    size: tuple[int, int],
    focal: Sequence[float],
    principal_point: Sequence[float],
    radial: Sequence[float] = (),
    tangential: Sequence[float] = (),
    skew: float = 0.0,
    higher_tangential: Sequence[float] = (),
) -> Lens:
    """Make the simplest lens for polynomial distortion in x/z and y/z.

    Args:
        size: Width and height, pixels.
        focal: Focal lengths in x and y, pixels.
        principal_point: Principal point, pixels.
        radial: Up to four coefficients of r^2, r^4, r^6 and r^8.
        tangential: p1 and p2 in OpenCV's order: x gets 2 p1 x y + p2 (r^2 + 2 x^2).
        skew: Pixels by which x grows with the distorted y.
        higher_tangential: Coefficients of r^2 and r^4 by which the tangential terms grow.
    """
    k1, k2, k3, k4 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    p1, p2 = (*tangential, 0.0, 0.0)[:2]
    axes = (focal[0], focal[1], principal_point[0], principal_point[1])
    if k4 or skew or (any(higher_tangential) and (p1 or p2)):
        higher = (*higher_tangential, 0.0, 0.0)[:2]
        return PolynomialLens("perspective", *size, (*axes, skew, k1, k2, k3, k4, p1, p2, *higher))
    if k3:
        return Lens("FULL_OPENCV", *size, (*axes, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    if k1 or k2 or p1 or p2:
        return Lens("OPENCV", *size, (*axes, k1, k2, p1, p2))
    return Lens("PINHOLE", *size, axes)


def rigid(rotation: Any, translation: Any) -> np.ndarray:
    """Make a transform (4, 4) float64 of a rotation (3, 3), made exactly orthogonal, and a translation (3,).

    Raises:
        ValueError: When the numbers are no rigid transform.
    """
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise ValueError("a rotation needs 3 x 3 numbers and a position 3")
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ValueError("a pose has numbers that are not finite")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError("a pose is not a rotation and a position")
    u, _, vt = np.linalg.svd(rotation)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = u @ vt, translation
    return transform


def pose_from_centre(rotation: Any, centre: Any) -> np.ndarray:
    """Make `world_to_camera` of the rotation from the world to the camera and the projection centre in the world."""
    pose = rigid(rotation, np.zeros(3))
    pose[:3, 3] = -pose[:3, :3] @ rigid(np.eye(3), centre)[:3, 3]
    return pose
