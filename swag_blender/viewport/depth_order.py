"""Order of splats from back to front for blending, computed by a thread beside the interface."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

SYNCHRONOUS = 100_000
"""Splats up to this number are sorted at once: it takes less time than a frame, and the order is never late."""


@dataclass(frozen=True)
class Part:
    """The splats of one object that take part in the order.

    Attributes:
        positions: (N, 3) float32, in the object's own space.
        contributions: (N,) float32, the visual weight of each splat (packing.contributions).
        first: Number of its first splat in the textures.
    """

    positions: np.ndarray
    contributions: np.ndarray
    first: int


def back_to_front(
    parts: Sequence[Part],
    depth_rows: Sequence[np.ndarray],
    near: float | None,
    limit: int | None = None,
    exact: bool = True,
) -> np.ndarray:
    """Numbers of the splats before the eye and of the parts they are from, farthest first.

    Args:
        parts: The objects to draw; several may be of the same splats.
        depth_rows: For each part (4,): depth = row[:3] . position + row[3], larger when farther.
        near: Splats with a smaller depth are left out, more than 0; None for none, as in orthographic views.
        limit: Most splats to keep, those of the largest contribution on the image; None for all.
        exact: Whether depths are compared to the last bit; otherwise to 16 bits of their logarithm, in half the time.

    Returns:
        (M, 2) float32, exact up to 2^24: textures have no integers in Blender's Python.
    """
    if not parts:
        return np.empty((0, 2), np.float32)
    depths = [
        part.positions @ row[:3].astype(np.float32) + np.float32(row[3])
        for part, row in zip(parts, depth_rows, strict=True)
    ]
    depth = depths[0] if len(depths) == 1 else np.concatenate(depths)
    visible, largest = len(depth), None
    weight = np.concatenate([part.contributions for part in parts]) if limit is not None else None
    if near is None:
        depth = depth - depth.min() if len(depth) else depth
    else:
        before = depth > near
        visible = int(np.count_nonzero(before))
        # What is nearer comes last in the order, where it is cut off: quicker than to leave it out before.
        depth = np.maximum(depth, np.float32(near))
        weight = None if weight is None else np.where(before, weight / (depth * depth), -1)
    if limit is not None and weight is not None and visible > limit:
        largest = np.argpartition(weight, len(weight) - limit)[len(weight) - limit :]
        depth, visible = depth[largest], limit
    order = _descending(depth, exact)[:visible]
    if largest is not None:
        order = largest[order]
    numbers = np.empty((len(order), 2), np.float32)
    if len(parts) == 1:
        np.add(order, parts[0].first, out=numbers[:, 0], casting="unsafe")
        numbers[:, 1] = 0
        return numbers
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])[:-1]
    own = np.searchsorted(starts, order, side="right") - 1
    # Parts without splats start where the next one does, and are passed over.
    numbers[:, 0] = order + (np.array([part.first for part in parts]) - starts)[own]
    numbers[:, 1] = own
    return numbers


def _descending(values: np.ndarray, exact: bool) -> np.ndarray:
    """Order (N,) of float32 values, none negative, from the largest; equal ones stay in their order.

    Such a float compares as its bits do, and its bits grow about as its logarithm. Numpy sorts 16-bit integers by
    radix, in linear time: once for the upper 16 of the bits in use, twice for all.
    """
    if not len(values):
        return np.empty(0, np.intp)
    bits = values.astype(np.float32, copy=False).view(np.uint32)
    bits = bits.max() - bits
    used = int(bits.max()).bit_length()
    if used <= 16 or not exact:
        return np.argsort((bits >> max(0, used - 16)).astype(np.uint16), kind="stable")
    low = np.argsort(bits.astype(np.uint16), kind="stable")
    high = np.argsort((bits >> 16).astype(np.uint16)[low], kind="stable")
    return low[high]


class Sorter:
    """The order of one view: `request` starts a sort unless the order is known, `take` gives what is done."""

    _thread = ThreadPoolExecutor(1, thread_name_prefix="swag-splat-order")

    def __init__(self) -> None:
        self.taken: object = None
        """Key of the order that was taken last."""
        self._sorting: Future[np.ndarray] | None = None
        self._sorting_key: object = None

    def request(
        self,
        key: object,
        parts: Sequence[Part],
        depth_rows: Sequence[np.ndarray],
        near: float | None,
        limit: int | None,
    ) -> None:
        """Start a sort, unless its key is that of the order taken last or another sort is under way.

        Args:
            key: Equal for equal orders.
            parts: See back_to_front, as for the others. With a limit, which is for a moving view, depths are compared
                to 16 bits.
            depth_rows: See there.
            near: See there.
            limit: See there.
        """
        if key == self.taken or self._sorting is not None:
            return
        self._sorting_key = key
        exact = limit is None
        if sum(len(part.positions) for part in parts) > SYNCHRONOUS:
            self._sorting = self._thread.submit(back_to_front, parts, depth_rows, near, limit, exact)
        else:
            self._sorting = Future()
            self._sorting.set_result(back_to_front(parts, depth_rows, near, limit, exact))

    @property
    def is_sorting(self) -> bool:
        """Whether a sort is under way or has not been taken."""
        return self._sorting is not None

    @property
    def is_done(self) -> bool:
        """Whether `take` gives an order now."""
        return self._sorting is not None and self._sorting.done()

    def take(self) -> np.ndarray | None:
        """The order of a sort that has ended since the last call, else None."""
        if self._sorting is None or not self._sorting.done():
            return None
        order, self._sorting, self.taken = self._sorting.result(), None, self._sorting_key
        return order
