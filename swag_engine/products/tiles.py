"""Orthographic rendering of splats tile by tile, in memory that does not grow with the size of the map."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ..gaussians.sh import evaluate_sh
from ..kernels.hardware import device_for
from ..rasterize.api import contributions, rasterize
from ..splats.splats import Splats
from ..splats.transform import covariances
from .grid import MapGrid, splat_size

Progress = Callable[[str, float], None]
"""Called with the stage of the work and its fraction, 0 to 1; what it raises ends the work."""
TILE = 512
"""Edge of a tile, pixels: a multiple of the blocks that GeoTIFF files have."""
MOST_FINE = 2048
"""Largest edge of a rendered image, pixels."""
MOST_SUPERSAMPLING = 64
"""Largest number of samples along the edge of a pixel."""
BLUR = 0.3
"""Variance that the projection adds, pixel^2 (kernels/reference/projection.py)."""
REACH = 3.4
"""Standard deviations beyond which alpha is below 1/255."""
SEEN = 0.5
"""Least alpha of a pixel that shows something; others are holes."""
ABOVE = 1.0
"""Height of the camera above the highest splat, length units of the map; depth must be beyond the near plane."""
DOWN = (0.0, 0.0, -1.0)
"""Viewing direction in the frame of a map."""


@dataclass(frozen=True)
class Tile:
    """A part of a grid: columns [column, column + width) and rows [row, row + height)."""

    column: int
    row: int
    width: int
    height: int

    @property
    def place(self) -> tuple[slice, slice]:
        """Its rows and columns."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)


def tiles_of(grid: MapGrid, edge: int = TILE, stage: str = "", progress: Progress | None = None) -> Iterator[Tile]:
    """Yield the tiles of a grid, row by row.

    Args:
        grid: The pixels.
        edge: Largest edge of a tile, pixels.
        stage: What is done to the tiles, for `progress`.
        progress: Called before each tile.
    """
    for row in range(0, grid.height, edge):
        for column in range(0, grid.width, edge):
            if progress:
                progress(stage, (row + min(edge, grid.height - row) * column / grid.width) / grid.height)
            yield Tile(column, row, min(edge, grid.width - column), min(edge, grid.height - row))


class TileRenderer:
    """Renders channels of splats from above.

    Pixels that are larger than the splats are sampled several times along each edge and averaged: the projection
    widens a Gaussian to about a pixel without making it more transparent, so one sample would show too much of it.

    Args:
        splats: Splats in the frame of a map.
        grid: The pixels.
        backend: What computes, as in `kernels_for`.
        seen: Least alpha of a pixel that shows something.
    """

    def __init__(self, splats: Splats, grid: MapGrid, backend: str = "auto", seen: float = SEEN) -> None:
        self.splats, self.grid, self.backend, self.seen = splats, grid, backend, seen
        self.device = device_for(backend)
        self.supersampling = int(np.clip(np.ceil(grid.pixel / max(splat_size(splats), 1e-30)), 1, MOST_SUPERSAMPLING))
        covariance = covariances(splats)
        widening = BLUR * (grid.pixel / self.supersampling) ** 2
        self._reach = REACH * np.sqrt(covariance[:, [0, 1], [0, 1]] + widening).astype(np.float32)
        self.top = float(splats.positions[:, 2].max()) + ABOVE
        # The height of a Gaussian's ridge over the plane is linear: z + slope . (x, y), by regression of z on x and y.
        xx, yy, xy = covariance[:, 0, 0] + widening, covariance[:, 1, 1] + widening, covariance[:, 0, 1]
        xz, yz, determinant = covariance[:, 0, 2], covariance[:, 1, 2], xx * yy - xy * xy
        self.slopes = np.stack([(yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant], axis=1)

    def colors(self) -> np.ndarray:
        """Return the colors (N, 3) of the splats seen from above, display values."""
        sh = torch.from_numpy(self.splats.sh)
        directions = torch.tensor(DOWN).expand(len(self.splats), 3)
        colors = evaluate_sh(sh[:, :1].contiguous(), sh[:, 1:].contiguous(), directions, self.splats.degree, "cpu")
        return colors.numpy()

    def inside(self, tile: Tile) -> np.ndarray:
        """Return the indices (M,) of the splats that reach into a tile."""
        return np.flatnonzero(self._reaching(tile, slice(None)))

    def _reaching(self, tile: Tile, chosen: np.ndarray | slice) -> np.ndarray:
        """Return which of the chosen splats reach into a tile, (M,) bool."""
        grid = self.grid
        left, right = (grid.left + grid.pixel * c for c in (tile.column, tile.column + tile.width))
        top, bottom = (grid.top - grid.pixel * r for r in (tile.row, tile.row + tile.height))
        x, y = self.splats.positions[chosen, 0], self.splats.positions[chosen, 1]
        reach_x, reach_y = self._reach[chosen, 0], self._reach[chosen, 1]
        return (x + reach_x >= left) & (x - reach_x <= right) & (y + reach_y >= bottom) & (y - reach_y <= top)

    def render(self, tile: Tile, chosen: np.ndarray, channels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Render a tile.

        Args:
            tile: The tile.
            chosen: (M,) indices of the splats, as `inside` returns them.
            channels: (M, C) values to blend.

        Returns:
            (height, width, C) blended values over 0, premultiplied by alpha, and alpha (height, width), float32.
        """
        image = np.zeros((tile.height, tile.width, channels.shape[1]), np.float32)
        alpha = np.zeros((tile.height, tile.width), np.float32)
        samples = self.supersampling
        edge = max(1, MOST_FINE // samples)
        for row in range(0, tile.height if len(chosen) else 0, edge):
            for column in range(0, tile.width, edge):
                height, width = min(edge, tile.height - row), min(edge, tile.width - column)
                part = Tile(tile.column + column, tile.row + row, width, height)
                near = self._reaching(part, chosen)
                camera, gaussians = self._view(part), self._gaussians(part, chosen[near])
                values = torch.from_numpy(np.ascontiguousarray(channels[near], np.float32)).to(self.device)
                background = values.new_zeros(channels.shape[1])
                drawn = rasterize(
                    *gaussians, values, *camera, width * samples, height * samples, background, self.backend,
                    "orthographic",
                )  # fmt: skip
                place = slice(row, row + height), slice(column, column + width)
                image[place] = _averaged(drawn.channels, samples)
                alpha[place] = _averaged(drawn.alpha[..., None], samples)[..., 0]
        return image, alpha

    def visible_weights(self, tile: Tile, chosen: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Sum the visible parts of splats over images of a tile.

        Args:
            tile: The tile.
            chosen: (M,) indices of the splats.
            weights: (height, width, R) images.

        Returns:
            (M, R) sums of transmittance times alpha times weight, per pixel.
        """
        camera, gaussians = self._view(tile, 1), self._gaussians(tile, chosen)
        values = gaussians[0].new_zeros(len(chosen), 1)
        images = torch.from_numpy(np.ascontiguousarray(weights, np.float32)).to(self.device)
        found = contributions(
            *gaussians, values, *camera, tile.width, tile.height, values.new_zeros(1), images, backend=self.backend,
            kind="orthographic",
        )  # fmt: skip
        return found.weighted.cpu().numpy()

    def _centre(self, tile: Tile) -> np.ndarray:
        """Middle of a tile at the height of the camera, (3,) float64."""
        grid = self.grid
        x = grid.left + grid.pixel * (tile.column + tile.width / 2)
        return np.array([x, grid.top - grid.pixel * (tile.row + tile.height / 2), self.top])

    def _view(self, tile: Tile, samples: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
        """View matrix and intrinsics of a tile whose splats are relative to its middle."""
        samples = samples or self.supersampling
        scale = samples / self.grid.pixel
        viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1], device=self.device))
        width, height = tile.width * samples, tile.height * samples
        K = torch.tensor([[scale, 0, width / 2], [0, scale, height / 2], [0, 0, 1]], device=self.device)
        return viewmat, K

    def _gaussians(
        self, tile: Tile, chosen: np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Means relative to the middle of a tile, quaternions, scales and opacities of splats."""
        splats = self.splats
        means = (splats.positions[chosen] - self._centre(tile)).astype(np.float32)
        arrays = means, splats.rotations[chosen], splats.scales[chosen], splats.opacities[chosen]
        means_, quats, scales, opacities = (torch.from_numpy(array).to(self.device) for array in arrays)
        return means_, quats, scales, opacities


def _averaged(image: torch.Tensor, samples: int) -> np.ndarray:
    """Average blocks of samples x samples pixels of an image (H, W, C)."""
    if samples > 1:
        height, width, channels = image.shape
        image = image.view(height // samples, samples, width // samples, samples, channels).mean((1, 3))
    return image.cpu().numpy()
