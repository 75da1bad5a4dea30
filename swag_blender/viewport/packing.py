"""Splats and splat objects as rows of texels, the form in which the shaders of shaders.py read them.

Textures hold 4 float32 per texel. A splat takes as many consecutive texels as its kind of data needs; the shader finds
them by the splat's number.
"""

import math
from dataclasses import dataclass

import numpy as np

from ...swag_engine.splats.haze import HAZE
from ...swag_engine.splats.splats import Splats
from ..water_values import WaterValues

GEOMETRY_TEXELS = 3
"""Texels of a splat's position, opacity, covariance and least variance."""
HARMONICS_TEXELS = (1, 3, 9, 12)
"""Texels of a splat's color by degree of spherical harmonics: four coefficients in three texels from degree 1."""
OBJECT_TEXELS = 24
"""Texels of an object's matrices, display settings and water."""
HIDDEN_ALPHA = 1.0
"""Alpha of a tint that marks a splat as not drawn."""
LARGEST_TINT_ALPHA = 0.99


def geometry_texels(splats: Splats) -> np.ndarray:
    """Position and opacity, covariance, its least eigenvalue and haze, in the object's own space: (N, 3, 4) float32."""
    texels = np.zeros((len(splats), GEOMETRY_TEXELS, 4), np.float32)
    texels[:, 0, :3] = splats.positions
    texels[:, 0, 3] = splats.opacities
    xx, xy, xz, yy, yz, zz = _covariances(splats.rotations, splats.scales)
    texels[:, 1] = np.stack([xx, xy, xz, yy], axis=1)
    texels[:, 2, :3] = np.stack([yz, zz, splats.scales.min(axis=1) ** 2], axis=1)
    if HAZE in splats.extras:
        texels[:, 2, 3] = splats.extras[HAZE]
    return texels


def harmonics_texels(sh: np.ndarray, degree: int) -> np.ndarray:
    """Spherical harmonics (N, K, 3) up to `degree` as (N, texels, 4) float32; missing coefficients are 0."""
    texels = HARMONICS_TEXELS[degree]
    packed = np.zeros((len(sh), texels * 4), np.float32)
    kept = sh[:, : (degree + 1) ** 2].reshape(len(sh), -1)
    packed[:, : kept.shape[1]] = kept
    return packed.reshape(len(sh), texels, 4)


def state_texels(hidden: np.ndarray | None, tint: np.ndarray | None, count: int) -> np.ndarray:
    """Color that is mixed in by its alpha, and whether a splat is drawn at all, as (N, 4) float32.

    Args:
        hidden: (N,) bool; None for none.
        tint: (N, 4) linear light and alpha; None for none.
        count: Number of splats N.
    """
    texels = np.zeros((count, 4), np.float32)
    if tint is not None:
        texels[:] = tint
        texels[:, 3] = texels[:, 3].clip(0, LARGEST_TINT_ALPHA)
    if hidden is not None:
        texels[hidden, 3] = HIDDEN_ALPHA
    return texels


def contributions(splats: Splats) -> np.ndarray:
    """Opacity times area of the two largest axes (N,) float32, in squared units of length: a splat's visual weight."""
    smallest, middle, largest = np.sort(splats.scales, axis=1).T
    return (splats.opacities * middle * largest).astype(np.float32)


@dataclass(frozen=True)
class ObjectTexels:
    """What the shader needs to know of one splat object, or one instance of it, in one view.

    Attributes:
        object_to_view: (4, 4) from the object's own space to the view's, z backwards as in OpenGL.
        sh_degree: Highest degree of spherical harmonics to use.
        density: Fraction of the splats to draw.
        water: The fitted water, None for none.
        water_amount: Fraction of it to show.
        haze_amount: Fraction of the haze in open water to show.
        pixel_size: 1 / focal length in pixels of the training images, 0 where it is not known.
        crop: (4, 4) from the object's own space to one where kept splats are between -1 and 1; None for no crop box.
    """

    object_to_view: np.ndarray
    sh_degree: int = 3
    density: float = 1.0
    water: WaterValues | None = None
    water_amount: float = 0.0
    haze_amount: float = 0.0
    pixel_size: float = 0.0
    crop: np.ndarray | None = None

    def texels(self) -> np.ndarray:
        """The values as (OBJECT_TEXELS, 4) float32, in the order in which shaders.py reads them."""
        rows = np.zeros((OBJECT_TEXELS, 4), np.float32)
        rows[0:3] = self.object_to_view[:3]
        eye = np.linalg.inv(self.object_to_view.astype(np.float64))
        rows[3, :3] = eye[:3, 3]
        rows[4] = self.sh_degree, self.density, self.crop is not None, self.pixel_size
        rows[5, :3], rows[5, 3] = eye[:3, 2] / np.linalg.norm(eye[:3, 2]), self.haze_amount
        if self.water is not None and self.water_amount > 0:
            rows[6, :3], rows[6, 3] = self.water.beta_D, self.water_amount
            rows[7, :3], rows[7, 3] = self.water.beta_B, self.water.display
            rows[8:17, :3] = self.water.background
        if self.crop is not None:
            rows[17:20] = self.crop[:3]
        # The view's axes in the object's own space: direction of a pixel's ray for the background light.
        rows[20:23, :3] = eye[:3, :3].T
        return rows


def _covariances(rotations: np.ndarray, scales: np.ndarray) -> list[np.ndarray]:
    """Upper triangles of R S S R^T as six arrays (N,) float32, of quaternions wxyz (N, 4) and sigmas (N, 3)."""
    lengths = np.linalg.norm(rotations, axis=1)
    w, x, y, z = rotations.T / np.where(lengths > 0, lengths, 1)
    w = np.where(lengths > 0, w, 1)
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    scaled = [[axis * scale for axis in column] for column, scale in zip(columns, scales.T, strict=True)]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    return [sum((column[i] * column[j] for column in scaled), np.zeros(len(scales), np.float32)) for i, j in pairs]


def fitting_degree(count: int, degree: int, width: int, height: int) -> int:
    """Highest degree of spherical harmonics, at most `degree`, whose texels fit a texture of that size."""
    while degree > 0 and count * HARMONICS_TEXELS[degree] > width * height:
        degree -= 1
    return degree


def most_splats(width: int, height: int) -> int:
    """Number of splats that fit textures of that size."""
    return width * height // GEOMETRY_TEXELS


def texture_rows(count: int, texels: int, width: int) -> int:
    """Height of a texture of `width` that holds the texels of `count` splats, at least 1."""
    return max(1, math.ceil(count * texels / width))
