"""Gaussians that stay on a GPU, and one optimisation step on them through WebGPU.

A step is one command buffer. Water, lamp, gains and background are on the GPU too. What is read back is the outcome of
each step, a few numbers, for several steps together and while later ones run. Arrays with a row per Gaussian are in
parts that a binding holds.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from .protocol import check_pairs
from .webgpu import camera_fields
from .webgpu_device import Rows, WebGpu, Workspace
from .webgpu_tiles import (
    BLOCK,
    GROUP,
    MOMENTS,
    SPLAT_NUMBERS,
    THREADS,
    TILE,
    TileGrid,
    TileRows,
    count_tiles,
    depth_order,
    list_tiles,
)

WATER, LINEAR, LAMP, GAIN, OPEN, SIMILARITY = (1 << bit for bit in range(6))
"""Bits of `mode`, as in medium.wgsl."""
NUMBERS = 64
"""Numbers of water, lamp, gains and background, in the order of medium.wgsl."""
EXPOSURES = 54
"""Learned numbers of water, lamp, vignetting, beam and background, in the order of effects.wgsl; exposures follow."""
OUTCOME = 8
"""Numbers of a step's outcome, as in effects.wgsl."""
STEPS_READ = 8
"""Steps whose outcomes are read together. The host is at most twice as many ahead of the device, so that a run that is
stopped or paused does not have many to wait for."""
PIXEL_SUMS, GAUSSIAN_SUMS = 54, 34
"""Sums over pixels and over Gaussians, as in photo.wgsl and water.wgsl."""
GRADIENTS = ("means", "quats", "log_scales", "opacity_logits", "sh0")
"""Parameters by the bits of the flags of gaussians.wgsl."""
LOSS, OVERFLOW = 32, 64
"""Flags of effects.wgsl: the loss or a sum is not finite; there are more pairs than their lists hold."""
SUM_GROUPS = 256
"""Most groups of threads that sums over pixels, or over the Gaussians of a part, are made by."""
ALIGNED = 64
"""Gaussians that parts are a multiple of: their rows begin where a binding may."""
SPARE_ROOM = 1.25
"""Room of a list of pairs over the pairs it had to hold."""
PAIRS_GUESSED = 4
"""Pairs of a Gaussian before any were counted."""


def adam_fields(rate: float, beta1: float, beta2: float, eps: float, step: int) -> dict[str, float]:
    """Return the fields of `Call` in adam.wgsl; arguments as of `Kernels.adam_step`."""
    return {
        "step_size": rate / (1 - beta1**step), "root": math.sqrt(1 - beta2**step), "weight1": 1 - beta1,
        "weight2": 1 - beta2, "epsilon": eps,
    }  # fmt: skip


def sum_groups(count: int) -> int:
    """Return how many groups of threads make the sums over some pixels or Gaussians."""
    return min(SUM_GROUPS, -(-count // THREADS))


@dataclass(frozen=True)
class View:
    """What one step compares, and how.

    Attributes:
        target: Buffer of the training image: a word a pixel, as photo.wgsl has it.
        viewmat: (4, 4) world to camera.
        K: (3, 3) intrinsics, pixels.
        centre: (3,) of the camera, scene units.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        sh_degree: Degree of the Gaussians' colors, 0..3.
        water_degree: Degree of the background light, 0..2.
        mode: What is modelled, as bits.
        effects: Fields of `Call` in effects.wgsl that say how water, lamp, gains and background act and are learned.
        dropout: Fraction of the Gaussians that is dropped.
        seed: Random numbers of the iteration, 32 bits.
        geometry: Whether means, quats and log_scales have gradients.
        weights: Of L1, 1 - SSIM, L2 and what is left open of surfaces.
        surface: Differences from open water that are none, and that show a surface, display values; and the part of
            what is behind a surface that may be seen.
        log_scale_limits: Of the logs of the scales.
        farthest: Largest component of an offset, scene units.
        dazzling: Largest display value that water is applied to.
    """

    viewmat: Tensor
    K: Tensor
    centre: Tensor
    width: int
    height: int
    sh_degree: int
    water_degree: int
    mode: int
    effects: Mapping[str, Any]
    surface: tuple[float, float, float]
    log_scale_limits: tuple[float, float]
    farthest: float
    dazzling: float
    target: Any = None
    dropout: float = 0.0
    seed: int = 0
    geometry: bool = False
    weights: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one step.

    Attributes:
        label: What the caller called the step.
        loss: The loss.
        problem: What was not finite, as a clause; then nothing has changed. Empty where the step was made.
    """

    label: Any
    loss: float
    problem: str


@dataclass(frozen=True)
class Queued:
    """A step that was asked for and whose outcome is not known; arguments as of `ResidentGaussians.step`."""

    label: Any
    view: View
    adam: Mapping[str, Mapping[str, float]]


@dataclass
class Chunk:
    """Part of the Gaussians.

    Attributes:
        number: Its number.
        first: Number of Gaussians before it.
        count: Number of Gaussians in it.
    """

    number: int
    first: int
    count: int

    @property
    def groups(self) -> int:
        """Groups of threads that take a Gaussian each."""
        return -(-self.count // THREADS)

    def of(self, buffer: Any, numbers: int) -> Rows:
        """Return the chunk's part of a buffer of all Gaussians with some numbers each."""
        return Rows(buffer, 4 * numbers * self.first, 4 * numbers * self.count)


@dataclass
class ResidentGaussians:
    """N Gaussians on a GPU, with Adam's moments and what densification goes by.

    Attributes:
        gpu: The device.
        count: N.
        sizes: Numbers of a Gaussian by parameter name.
        learned: Learned numbers of water, lamp, gains and background.
        pairs_guessed: Initial capacity of the tile lists, pairs per Gaussian.
        longest_list: Most pairs in one list.
    """

    gpu: WebGpu
    count: int
    sizes: dict[str, int]
    learned: int
    pairs_guessed: float = PAIRS_GUESSED
    _arrays: dict[str, list[Any]] = field(default_factory=dict)
    _room: int = 0
    _lists: int = 1
    _asked: list[Queued] = field(default_factory=list)
    _reads: list[tuple[list[Queued], Callable[[], Tensor]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.space = Workspace(self.gpu, keeps=True)
        self._effects = self.gpu.empty(3 * self.learned)
        self._good_effects = self.gpu.empty(3 * self.learned)
        self.longest_list = self.gpu.largest_binding // 4
        self._room = min(max(BLOCK, int(self.pairs_guessed * self.count)), self.longest_list)

    @property
    def pairs_a_gaussian(self) -> float:
        """Pairs of a Gaussian and a tile that there is room for now, for each Gaussian."""
        return self._lists * self._room / self.count

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The parts: as many Gaussians as a binding holds of the largest parameter."""
        fits = self.gpu.largest_binding // (4 * max(6, *self.sizes.values()))
        rows = max(ALIGNED, fits // ALIGNED * ALIGNED)
        firsts = range(0, self.count, rows)
        return [Chunk(number, first, min(rows, self.count - first)) for number, first in enumerate(firsts)]

    def load(self, name: str, values: Tensor) -> None:
        """Send an array of a row per Gaussian to the device.

        Args:
            name: Name of the array.
            values: (N, ...) float32 on the CPU.
        """
        parts = [values.detach()[c.first : c.first + c.count] for c in self.chunks]
        known = self._arrays.get(name)
        if known is None:
            self._arrays[name] = [self.gpu.upload(part) for part in parts]
            return
        for buffer, part in zip(known, parts, strict=True):
            self.gpu.write(buffer, part.contiguous().numpy())

    def fetch(self, name: str, shape: tuple[int, ...]) -> Tensor:
        """Read an array back.

        Args:
            name: Name of the array.
            shape: Shape of the result; the first is N.
        """
        buffers = zip(self._array(name, math.prod(shape[1:])), self.chunks, strict=True)
        return torch.cat([self.gpu.read(buffer, (c.count, *shape[1:])) for buffer, c in buffers])

    def fetch_statistics(self) -> Tensor:
        """Read (N, 2) what densification goes by, gradient and views, and begin it anew."""
        values = self.fetch("statistics", (self.count, 2))
        for buffer in self._array("statistics", 2):
            self.gpu.clear(buffer)
        return values

    def load_effects(self, values: Tensor) -> None:
        """Send (3, learned) learned numbers of the effects and their moments, in the order of effects.wgsl."""
        self.gpu.write(self._effects, values.numpy())

    def fetch_effects(self, good: bool = False) -> Tensor:
        """Read what `load_effects` sent and steps have changed, or as `keep` kept it."""
        return self.gpu.read(self._good_effects if good else self._effects, (3, self.learned))

    def keep(self, names: Iterable[str]) -> None:
        """Copy arrays on the device, to `good.NAME`, and the learned numbers of the effects."""
        self.gpu.copy(self._effects, self._good_effects)
        for name in names:
            copies = self._array(f"good.{name}", self.sizes[name])
            for source, to in zip(self._arrays[name], copies, strict=True):
                self.gpu.copy(source, to)

    def not_finite(self, arrays: Mapping[str, int]) -> str:
        """Find an array with numbers that are not finite.

        Args:
            arrays: Numbers per Gaussian by the names of the arrays, at most 31.

        Returns:
            Its name, or that of the effects' parameters; empty where there is none.
        """
        flags = self.space.empty("not_finite", 1)
        self.gpu.clear(flags)
        call = {"count": 3 * self.learned, "bit": 1 << len(arrays)}
        self.space.run("find_not_finite", -(-call["count"] // THREADS), call, values=self._effects, flags=flags)
        for chunk in self.chunks:
            for place, (name, size) in enumerate(arrays.items()):
                call, values = {"count": size * chunk.count, "bit": 1 << place}, self._array(name, size)[chunk.number]
                self.space.run("find_not_finite", -(-size * chunk.count // THREADS), call, values=values, flags=flags)
        found = int(self.gpu.read(flags, (1,), torch.int32))
        named = (*arrays, "a parameter of the effects")
        return next((name for place, name in enumerate(named) if found >> place & 1), "")

    def step(self, label: Any, view: View, adam: Mapping[str, Mapping[str, float]]) -> None:
        """Ask for one step of all parameters that `adam` has; `outcomes` tells what came of it.

        Args:
            label: What the outcome is called.
            view: What is compared, and how.
            adam: The fields of `Call` in adam.wgsl by parameter name.

        Raises:
            MemoryError: The device has too little memory, or reads too little at once.
            WebGpuFailure: The device failed.
        """
        self._attempt(Queued(label, view, adam))

    def outcomes(self, wait: bool) -> list[Outcome]:
        """Return the outcomes that are known by now and have not been returned.

        Where the lists of pairs were too short for a step, it and those after it have changed nothing; they are made
        again with longer ones.

        Args:
            wait: Whether to wait for all steps.

        Raises:
            TooManyPairs: The Gaussians meet too many tiles.
            MemoryError: The device has too little memory, or reads too little at once.
            WebGpuFailure: The device failed.
        """
        found: list[Outcome] = []
        while len(self._reads) > 1 or (wait and (self._reads or self._asked)):
            rows = self._next_rows()
            found += [self._outcome(step, row) for step, row in rows if not int(row[4]) & OVERFLOW]
            if again := [(step, row) for step, row in rows if int(row[4]) & OVERFLOW]:
                while self._reads or self._asked:
                    again += self._next_rows()
                self._make_again(again)
        return found

    def _next_rows(self) -> list[tuple[Queued, Tensor]]:
        """Wait for the outcomes of the first steps of which none is known; return steps and outcomes."""
        if not self._reads:
            self._begin_to_read()
        steps, read = self._reads.pop(0)
        return list(zip(steps, read().view(-1, OUTCOME)[: len(steps)], strict=True))

    def _make_again(self, steps: list[tuple[Queued, Tensor]]) -> None:
        step, row = max(steps, key=lambda pair: int(pair[1][5]) & 0xFFFFFFFF)
        longest, pairs = (number & 0xFFFFFFFF for number in row[5:7].tolist())
        self._make_room(longest, pairs, step.view)
        self.gpu.clear(self._shared("flags"))
        for step, _ in steps:
            self._attempt(step)

    def _begin_to_read(self) -> None:
        asked, self._asked = self._asked, []
        self._reads.append((asked, self.gpu.read_later(self._shared("outcomes"))))

    def _attempt(self, step: Queued) -> None:
        view, grid = step.view, TileGrid(step.view.width, step.view.height)
        self.gpu.clear(self._shared("flags"), 4)
        for name in ("gradients", "ranges"):
            self.gpu.clear(self._shared(name, grid))
        lists = self._show(view, grid)
        self._compare(view)
        self._blend("blend_backward", view, grid, lists)
        for chunk in self.chunks:
            self._backward(chunk, view)
        self._conclude(view, len(self._asked))
        for chunk in self.chunks:
            self._update(chunk, view, step.adam)
        self.gpu.flush()
        self._asked.append(step)
        if len(self._asked) == STEPS_READ:
            self._begin_to_read()

    def _show(self, view: View, grid: TileGrid) -> list[tuple[TileRows, Any]]:
        """Blend the Gaussians; return the lists of the tiles."""
        self.space.run("set_numbers", 1, view.effects, learned=self._effects, numbers_out=self._numbers)
        for chunk in self.chunks:
            self._project(chunk, view)
        splats, keys, ids = (self._shared(name) for name in ("splats", "keys", "ids"))
        lists = self._list(grid, depth_order(self.space, splats, keys, ids, self.count))
        self._blend("blend_forward", view, grid, lists)
        return lists

    def render(self, view: View) -> tuple[Tensor, Tensor]:
        """Render a view; errors as of `outcomes`.

        Args:
            view: The view; what it compares with does not count.

        Returns:
            (height, width, 3) display values of the Gaussians over black, and (height, width) transmittance.
        """
        grid, size = TileGrid(view.width, view.height), (view.height, view.width)
        while True:
            self.gpu.clear(self._shared("ranges", grid))
            self._show(view, grid)
            found = self.gpu.read(self._shared("found"), (self._lists, 2), torch.int32).long() & 0xFFFFFFFF
            if bool((found[:, 0] <= found[:, 1]).all()):
                break
            self._make_room(int(found[:, 0].max()), int(found[:, 0].sum()), view)
        blended = self.gpu.read(self._image("blended", view, GROUP), (*size, GROUP))
        endings = self.gpu.read(self._image("endings", view, 2), (*size, 2))
        return blended[..., :3], endings[..., 0]

    # -- arrays -------------------------------------------------------------------------------------------------------

    def _array(self, name: str, numbers: int) -> list[Any]:
        """Return the parts of an array with some numbers per Gaussian."""
        if name not in self._arrays:
            self._arrays[name] = [self.gpu.empty(chunk.count * numbers) for chunk in self.chunks]
        return self._arrays[name]

    def _of(self, chunk: Chunk, **arrays: tuple[str, int]) -> dict[str, Any]:
        """Return a chunk's arrays by the names of their bindings, from the arrays' names and numbers per Gaussian."""
        return {name: self._array(array, numbers)[chunk.number] for name, (array, numbers) in arrays.items()}

    def _shared(self, name: str, grid: TileGrid | None = None) -> Any:
        """Return a buffer that is not in parts."""
        tiles = grid.tiles if grid else 0
        sizes = {
            "splats": SPLAT_NUMBERS * self.count, "keys": self.count, "ids": self.count, "channels": GROUP * self.count,
            "gradients": (MOMENTS + GROUP) * self.count, "ranges": 2 * tiles, "flags": 2, "found": 2 * self._lists,
            "outcomes": OUTCOME * STEPS_READ, "gaussian_sums": GAUSSIAN_SUMS * self._gaussian_rows,
        }  # fmt: skip
        return self.space.empty(name, sizes[name])

    def _image(self, name: str, view: View, numbers: int) -> Any:
        return self.space.empty(name, numbers * view.width * view.height)

    def _pixel_sums(self, view: View) -> Any:
        return self.space.empty("pixel_sums", PIXEL_SUMS * sum_groups(view.width * view.height))

    @property
    def _gaussian_rows(self) -> int:
        return sum(sum_groups(chunk.count) for chunk in self.chunks)

    # -- stages -------------------------------------------------------------------------------------------------------

    def _activation(self, chunk: Chunk, view: View) -> dict[str, Any]:
        least, most = view.log_scale_limits
        return {
            "centre": view.centre.tolist(), "count": chunk.count, "first": chunk.first, "seed": view.seed,
            "dropout": view.dropout, "least": least, "most": most, "farthest": view.farthest,
            "geometry": int(view.geometry), "half_width": view.width / 2,
        }  # fmt: skip

    def _camera(self, chunk: Chunk, view: View) -> dict[str, Any]:
        return camera_fields(view.viewmat, view.K) | {
            "count": chunk.count, "width": view.width, "height": view.height
        }  # fmt: skip

    def _shading(self, chunk: Chunk, view: View) -> dict[str, Any]:
        return {
            "count": chunk.count, "degree": view.water_degree, "mode": view.mode, "row": MOMENTS + GROUP,
            "first_sum": sum_groups(self.chunks[0].count) * chunk.number, "dazzling": view.dazzling,
        }  # fmt: skip

    def _colors(self, chunk: Chunk, view: View) -> dict[str, Any]:
        return {"count": chunk.count, "higher": self.sizes["shN"] // 3, "degree": view.sh_degree}

    def _project(self, chunk: Chunk, view: View) -> None:
        run, groups = self.space.run, chunk.groups
        scales, opacities, offsets = ("scales", 3), ("opacities", 1), ("offsets", 3)
        directions, colors, radii = ("directions", 3), ("colors", 3), ("radii", 1)
        own = {"means": ("means", 3), "log_scales": ("log_scales", 3), "logits": ("opacity_logits", 1)}
        made = {"scales": scales, "opacities": opacities, "offsets": offsets, "directions": directions}
        run("activate", groups, self._activation(chunk, view), **self._of(chunk, **own, **made))
        sh = {"sh0": ("sh0", 3), "shN": ("shN", self.sizes["shN"]), "directions": directions, "colors": colors}
        run("sh_forward", -(-3 * chunk.count // THREADS), self._colors(chunk, view), **self._of(chunk, **sh))
        shown = chunk.of(self._shared("channels"), GROUP)
        shaded = self._of(chunk, colors=colors, offsets=offsets, opacities=opacities)
        run("shade_forward", groups, self._shading(chunk, view), numbers=self._numbers, **shaded, shown=shown)
        flat = {"means2d": ("means2d", 2), "conics": ("conics", 3), "depths": ("depths", 1), "radii": radii}
        gaussians = {"means": ("means", 3), "quats": ("quats", 4), "scales": scales, "opacities": opacities}
        run("project_forward", groups, self._camera(chunk, view), **self._of(chunk, **gaussians, **flat))
        packed = {
            "packed": chunk.of(self._shared("splats"), SPLAT_NUMBERS), "keys": chunk.of(self._shared("keys"), 1),
            "ids": chunk.of(self._shared("ids"), 1),
        }  # fmt: skip
        call = {"count": chunk.count, "width": view.width, "height": view.height, "first": chunk.first}
        run("pack", groups, call, **self._of(chunk, **flat, opacities=opacities), **packed)

    @property
    def _numbers(self) -> Any:
        return self.space.empty("numbers", NUMBERS)

    def _list(self, grid: TileGrid, order: Any) -> list[tuple[TileRows, Any]]:
        """List the Gaussians of each tile, in as many lists as bindings call for; return each one's rows and list."""
        lists, ranges, found = [], self._shared("ranges", grid), self._shared("found")
        height = -(-grid.down // self._lists)
        for number in range(self._lists):
            rows = TileRows(number, min(number * height, grid.down), min((number + 1) * height, grid.down))
            counted = count_tiles(self.space, order, grid, rows)
            ids = list_tiles(self.space, order, counted, grid, rows, self._room, ranges, found)
            lists.append((rows, ids))
        return lists

    def _make_room(self, most: int, pairs: int, view: View) -> None:
        """Make lists longer, for the pairs of the longest and of all, or more where a binding holds no longer ones."""
        check_pairs(pairs)
        rows, room = TileGrid(view.width, view.height).down, max(self._room, int(SPARE_ROOM * most))
        if room <= self.longest_list:
            self._room = room
        elif self._lists < rows:
            self._lists = min(2 * self._lists, rows)
            self._room = self.longest_list
        else:
            self._room = most  # raises MemoryError where that is too much

    def _blend(self, kernel: str, view: View, grid: TileGrid, lists: list[tuple[TileRows, Any]]) -> None:
        shared = {
            "splats": self._shared("splats"), "channels": self._shared("channels"),
            "ranges": self._shared("ranges", grid),
        }  # fmt: skip
        image, endings = self._image("blended", view, GROUP), self._image("endings", view, 2)
        if kernel == "blend_forward":
            shared |= {"image": image, "endings_out": endings}
        else:
            shared |= {
                "endings": endings, "by_image": self._image("by_blended", view, GROUP),
                "by_alpha": self._image("by_alpha", view, 1), "gradients": self._shared("gradients"),
            }  # fmt: skip
        call = {"width": view.width, "height": view.height, "row": MOMENTS + GROUP, "count": self.count}
        for rows, ids in lists:
            tiles = {"first_tile": rows.first * grid.across, "end_tile": rows.end * grid.across}
            self.space.run(kernel, (rows.end - rows.first) * grid.across, call | tiles, **shared, ids=ids)

    def _compare(self, view: View) -> None:
        """Compare the photo of the blended image with the training image; set the gradients by the blended image."""
        run, pixels = self.space.run, view.width * view.height
        l1, ssim, l2, coverage = view.weights
        rows = camera_fields(view.viewmat, view.K)
        call = {name: rows[name] for name in ("row0", "row1", "row2", "intrinsics")} | {
            "width": view.width, "height": view.height, "degree": view.water_degree, "mode": view.mode,
            "absolute": l1 / (3 * pixels), "square": 2 * l2 / (3 * pixels), "open": coverage / pixels,
            "least": view.surface[0], "most": view.surface[1], "closed": view.surface[2],
        }  # fmt: skip
        sources = {
            "numbers": self._numbers, "blended": self._image("blended", view, GROUP),
            "ended": self._image("endings", view, 2), "wanted": view.target,
        }  # fmt: skip
        photo, aim, by_photo = (self._image(name, view, 3) for name in ("photo", "aim", "by_photo"))
        if ssim:
            run("photo_forward", -(-pixels // THREADS), call, **sources, photo=photo, aim=aim)
            squares, slopes = self._squares(view), self._image("slopes", view, 9)
            sums = self.space.empty("similarity", 2 * squares)
            images = {"image": photo, "wanted": aim}
            sizes = {"height": view.height, "width": view.width, "ssim_factor": -ssim / (3 * pixels)}
            run("l1_ssim_forward", squares, sizes, **images, sums=sums, derivatives=slopes)
            run("l1_ssim_backward", squares, sizes, **images, slopes=slopes, gradient=by_photo)
        outputs = {
            "by_photo": by_photo, "by_blended": self._image("by_blended", view, GROUP),
            "by_transparent": self._image("by_alpha", view, 1), "pixel_sums": self._pixel_sums(view),
        }  # fmt: skip
        run("photo_backward", sum_groups(pixels), call, **sources, **outputs)

    @staticmethod
    def _squares(view: View) -> int:
        return -(-view.height // TILE) * -(-view.width // TILE)

    def _backward(self, chunk: Chunk, view: View) -> None:
        run, groups, of = self.space.run, chunk.groups, self._of
        gradients, flags = chunk.of(self._shared("gradients"), MOMENTS + GROUP), self._shared("flags")
        splats, geometry = chunk.of(self._shared("splats"), SPLAT_NUMBERS), of(chunk, geometry=("geometry", MOMENTS))
        call = {"count": chunk.count, "row": MOMENTS + GROUP}
        run("turn_moments", groups, call, splats=splats, moments=gradients, **geometry)
        shaded = of(chunk, colors=("colors", 3), offsets=("offsets", 3), by_colors=("by_colors", 3))
        sums = {"gradients": gradients, "gaussian_sums": self._shared("gaussian_sums")}
        run(
            "shade_backward",
            sum_groups(chunk.count),
            self._shading(chunk, view),
            numbers=self._numbers,
            **shaded,
            **sums,
        )
        colors = of(
            chunk, directions=("directions", 3), shown=("colors", 3), by_colors=("by_colors", 3), by_sh0=("by.sh0", 3),
            by_shN=("by.shN", self.sizes["shN"]),
        )  # fmt: skip
        run("sh_backward", -(-3 * chunk.count // THREADS), self._colors(chunk, view), **colors, flags=flags)
        by = {"by_means": ("by.means", 3), "by_quats": ("by.quats", 4)}
        if view.geometry:
            gaussians = {"means": ("means", 3), "quats": ("quats", 4), "scales": ("scales", 3), "radii": ("radii", 1)}
            made = of(chunk, **gaussians, **by, by_scales=("by.log_scales", 3))
            run("project_backward", groups, self._camera(chunk, view), **made, incoming=geometry["geometry"])
        own = {"log_scales": ("log_scales", 3), "logits": ("opacity_logits", 1)}
        outputs = {"by_log_scales": ("by.log_scales", 3), "by_logits": ("by.opacity_logits", 1)}
        made = of(chunk, **own, **by, **outputs)
        run("activate_backward", groups, self._activation(chunk, view), **geometry, **made, flags=flags)

    def _conclude(self, view: View, row: int) -> None:
        squares = self._squares(view) if view.weights[1] else 0
        call = {
            **view.effects,
            "pixel_rows": sum_groups(view.width * view.height), "gaussian_rows": self._gaussian_rows,
            "squares": squares, "bands": self._lists, "row": row, "mode": view.mode,
        }  # fmt: skip
        sums = {"similarity": self.space.empty("similarity", 2 * self._squares(view)), "pairs": self._shared("found")}
        shared = {name: self._shared(name) for name in ("gaussian_sums", "flags", "outcomes")}
        shared |= sums | {"learned": self._effects, "pixel_sums": self._pixel_sums(view)}
        self.space.run("conclude", 1, call, **shared)

    def _update(self, chunk: Chunk, view: View, adam: Mapping[str, Mapping[str, float]]) -> None:
        flags = self._shared("flags")
        counted = self._of(chunk, geometry=("geometry", MOMENTS), radii=("radii", 1), statistics=("statistics", 2))
        self.space.run("count_views", chunk.groups, self._activation(chunk, view), **counted, flags=flags)
        for name, fields in adam.items():
            size = self.sizes[name]
            arrays = {
                "parameter": name,
                "gradient": f"by.{name}",
                "mean": f"{name}.exp_avg",
                "square": f"{name}.exp_avg_sq",
            }
            buffers = self._of(chunk, **{binding: (array, size) for binding, array in arrays.items()})
            numbers = size * chunk.count
            call = {**fields, "count": numbers}
            self.space.run("adam_step", -(-numbers // THREADS), call, **buffers, skipped=flags)

    @staticmethod
    def _outcome(step: Queued, row: Tensor) -> Outcome:
        l1, ssim, l2, coverage = step.view.weights
        pixels, flags = step.view.width * step.view.height, int(row[4])
        absolute, square, uncovered, similar = row[:4].view(torch.float32).tolist()
        loss = (l1 * absolute + l2 * square) / (3 * pixels) + coverage * uncovered / pixels
        if ssim:
            loss += ssim * (1 - similar / (3 * pixels))
        bad = [f"the gradient of {name}" for bit, name in enumerate(GRADIENTS) if flags & 1 << bit]
        bad += ["the loss"] if flags & LOSS else []
        return Outcome(step.label, loss, f"{bad[0]} is not finite" if bad else "")
