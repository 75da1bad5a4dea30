"""Connected parts of a mask that is larger than memory, found tile by tile."""

import cv2
import numpy as np

from .tiles import Tile


class Components:
    """Connected parts of a mask; pixels that touch at a corner belong together.

    Each tile numbers its own parts; parts that touch across tiles are joined (union-find).
    """

    def __init__(self) -> None:
        self._parents = [0]
        self._sums: list[list[float]] = []
        self._roots = np.zeros(1, np.int64)

    def add(self, numbers: np.ndarray, tile: Tile, mask: np.ndarray, *summed: np.ndarray) -> None:
        """Number the parts of the next tile; tiles come row by row.

        Args:
            numbers: (H, W) int32 of the whole map, which the numbers are written to, 0 outside the mask.
            tile: The tile.
            mask: (height, width) its part of the mask.
            summed: (height, width) each, what is summed over the parts; as many in all tiles.
        """
        count, own = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        first = len(self._parents) - 1
        numbers[tile.place] = np.where(own > 0, own + first, 0)
        self._parents += range(first + 1, first + count)
        self._sums += np.stack(
            [np.bincount(own.ravel(), each.ravel(), count)[1:] for each in (mask, *summed)], 1
        ).tolist()
        if count == 1:
            return
        top, left, bottom, right = tile.row, tile.column, tile.row + tile.height, tile.column + tile.width
        if top:
            self._join(numbers[top, left:right], numbers[top - 1, max(left - 1, 0) : right + 1], min(left, 1))
        if left:
            self._join(numbers[top:bottom, left], numbers[max(top - 1, 0) : bottom + 1, left - 1], min(top, 1))

    def _join(self, own: np.ndarray, beside: np.ndarray, shift: int) -> None:
        """Join the parts along an edge (N,) with those of the line beside it, which begins `shift` pixels earlier."""
        own, beside = np.array(own), np.array(beside)
        for step in (-1, 0, 1):
            places = np.arange(len(own)) + shift + step
            inside = (places >= 0) & (places < len(beside))
            pairs = np.stack([own[inside], beside[places[inside]]])
            for a, b in np.unique(pairs[:, (pairs > 0).all(axis=0)], axis=1).T.tolist():
                first, second = sorted((self._root(a), self._root(b)))
                self._parents[second] = first

    def _root(self, number: int) -> int:
        while self._parents[number] != number:
            self._parents[number] = self._parents[self._parents[number]]
            number = self._parents[number]
        return number

    def choose(self, least_size: int, *least: float) -> None:
        """Keep the parts with at least as many pixels, and as large sums of what was summed, in its order."""
        roots = np.array([self._root(number) for number in range(len(self._parents))])
        bounds, kept = (least_size, *least), np.ones(len(roots), bool)
        for sums, bound in zip(np.reshape(self._sums, (-1, len(bounds))).T, bounds, strict=True):
            kept &= np.bincount(roots[1:], sums, len(roots)) >= bound
        self._roots = np.where(kept, np.arange(len(roots)), 0)[roots]

    def chosen(self, numbers: np.ndarray) -> np.ndarray:
        """Replace numbers of a tile by the number that the whole part has, 0 where it was not kept."""
        return self._roots[numbers]
