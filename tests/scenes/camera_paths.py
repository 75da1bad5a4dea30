"""Generated underwater photos of which cameras and lens are known exactly: to measure structure from motion.

    made = make_camera_scene("orbit", Path("/tmp/orbit"))
    made.centres  # of the photos in /tmp/orbit, in the order of made.names

A photo is ray-traced: a textured sea floor with rocks (a height field), seen through the lens and through water. Above
the floor z is positive; units are metres. For a wall, z is the distance from it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from swag_engine.scene.lenses import Lens

HEIGHT_CELL = 0.02
"""Spacing of the height field, metres."""
_MARCH_STEP = 0.06
"""Distance in metres at which a ray looks whether it is below the floor: thinner edges can be missed."""
FARTHEST = 14.0
"""Range in metres beyond which only water is seen."""
_DETAIL_LEVELS = 5
"""Levels of the texture, each with half the resolution of the one before."""


@dataclass(frozen=True)
class Water:
    """Water, light and the camera's noise; colors are linear red, green, blue.

    Attributes:
        attenuation: Attenuation, 1/m.
        background: Light of endless water.
        ambient: Light on the floor from above.
        noise: Standard deviation of the camera's noise, of 255.
        lamp: Light of a lamp beside the camera at 1 m, 0 for none. It moves with the camera, and so do its shadows.
    """

    attenuation: tuple[float, float, float] = (0.22, 0.09, 0.07)
    background: tuple[float, float, float] = (0.02, 0.13, 0.17)
    ambient: float = 0.9
    noise: float = 1.5
    lamp: float = 0.0


@dataclass(frozen=True)
class Floor:
    """How the floor is made: `size` (x, y) in metres, `relief` as a factor on its heights, whether it has a `mound`."""

    size: tuple[float, float]
    relief: float = 1.0
    mound: bool = False


@dataclass(frozen=True, eq=False)
class CameraScene:
    """Photos and the truth about them.

    Attributes:
        folder: Folder of the photos.
        names: Names of the photos, in the order in which they were taken.
        lens: The lens of all.
        world_to_camera: Rigid transforms (N, 4, 4) float64, axes as COLMAP has them.
    """

    folder: Path
    names: tuple[str, ...]
    lens: Lens
    world_to_camera: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """Projection centres (N, 3), metres."""
        return -np.einsum("nji,nj->ni", self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3])

    @property
    def path_length(self) -> float:
        """Length of the camera's path, metres."""
        return float(np.linalg.norm(np.diff(self.centres, axis=0), axis=1).sum())


def make_camera_scene(
    name: str, folder: Path, seed: int = 0, width: int | None = None, images: int | None = None
) -> CameraScene:
    """Write the photos of a scene to a folder.

    Args:
        name: One of `SCENES`.
        folder: Folder of the photos; it is made.
        seed: Another seed gives another floor, path and noise.
        width: Width of the photos in pixels, the scene's own if None; the field of view stays.
        images: Number of photos from the start of the path, all if None.

    Returns:
        The photos with their true cameras.
    """
    layout = SCENES[name]
    random = np.random.default_rng([seed, list(SCENES).index(name)])
    lens = _resized(layout.lens, width or layout.lens.width)
    world_to_camera = layout.path(layout.images, random)
    distance = float(np.median(world_to_camera[:, 2, 3]))
    ground = Ground(layout.floor, random, texel=max(0.6 * distance / lens.params[0], 0.001))
    rays = _rays(lens)
    world_to_camera = world_to_camera[:images]
    names = tuple(f"{number:04d}.jpg" for number in range(len(world_to_camera)))
    folder.mkdir(parents=True, exist_ok=True)
    for photo, pose in zip(names, world_to_camera, strict=True):
        picture = _render(ground, layout.water, lens, rays, pose, random)
        (folder / photo).write_bytes(
            cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        )
    return CameraScene(folder, names, lens, world_to_camera)


def _resized(lens: Lens, width: int) -> Lens:
    """Return the lens for photos of another width; the first parameters of its model are lengths in pixels."""
    factor = width / lens.width
    lengths = {"SIMPLE_RADIAL": 3, "OPENCV_FISHEYE": 4}[lens.model]
    params = tuple(value * factor if place < lengths else value for place, value in enumerate(lens.params))
    return Lens(lens.model, width, round(lens.height * factor), params)


def _rays(lens: Lens) -> np.ndarray:
    """Return the directions (H, W, 3) float32 of the pixels, of length 1, in the camera's axes."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.camera.cam_ray_from_img(np.stack([x.ravel(), y.ravel()], -1))
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return rays.reshape(lens.height, lens.width, 3).astype(np.float32)


# The floor


class Ground:
    """Heights and textures of a floor, with the middle of its area at x = y = 0."""

    def __init__(self, floor: Floor, random: np.random.Generator, texel: float):
        columns, rows = (round(side / HEIGHT_CELL) for side in floor.size)
        self.origin = np.array(floor.size, np.float32) / 2
        self.texel = texel
        self.heights = floor.relief * _heights(rows, columns, random)
        if floor.mound:
            self.heights += _mound(rows, columns, random)
        self.find_slopes()
        tint = np.dstack([octaves(rows, columns, (0.25, 1.0), HEIGHT_CELL, random) for _ in range(3)])
        self.colors = np.clip(0.45 + 0.04 * tint, 0.2, 0.7).astype(np.float32)
        across, along = (round(side / texel) for side in floor.size)
        sizes = texel * 2.0 ** np.arange(1, 9)
        detail = octaves(along, across, tuple(sizes[sizes < 1]), texel, random)
        detail *= np.clip(
            0.5 + 0.35 * octaves(along, across, (0.8,), texel, random), 0.12, 1
        )  # sand has little texture
        level: np.ndarray = np.clip(128 + 55 * detail, 0, 255).astype(np.uint8)
        self.details = [level]
        for _ in range(_DETAIL_LEVELS - 1):
            level = cv2.resize(level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA)
            self.details.append(level)

    def find_slopes(self) -> None:
        """Compute what follows from the heights: their limits and the normals."""
        self.lowest, self.highest = float(self.heights.min()), float(self.heights.max())
        slope_y, slope_x = np.gradient(self.heights, HEIGHT_CELL)
        normals = np.dstack([-slope_x, -slope_y, np.ones_like(slope_x)])
        self.normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)

    def sample(self, grid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Read a grid over the floor's area, of any resolution, at positions (H, W) in metres."""
        rows, columns = grid.shape[:2]
        across, up = columns / (2 * self.origin[0]), rows / (2 * self.origin[1])
        return cv2.remap(
            grid,
            (x + self.origin[0]) * across - np.float32(0.5),
            (y + self.origin[1]) * up - np.float32(0.5),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return the ranges (H, W) float32 at which rays from a point meet the floor, `FARTHEST` where they do not."""
        with np.errstate(divide="ignore", invalid="ignore"):
            entry = (self.highest - origin[2]) / rays[..., 2]
            exit_ = (self.lowest - origin[2]) / rays[..., 2]
        down = rays[..., 2] < 0
        far = np.where(down, np.clip(exit_, 0, FARTHEST), FARTHEST).astype(np.float32)
        near = np.where(down, np.clip(entry, 0, FARTHEST), FARTHEST).astype(np.float32)
        near = np.minimum(near, far)
        steps = int(np.clip(np.ceil((far - near).max() / _MARCH_STEP), 8, 160))
        step = (far - near) / steps
        before, after = near.copy(), far.copy()
        found = np.zeros(near.shape, bool)
        for number in range(1, steps + 1):
            at = near + step * number
            below = self._below(origin, rays, at) & ~found
            after[below] = at[below]
            found |= below
            before = np.where(found, before, at)
            if found.all():
                break
        for _ in range(9):
            middle = (before + after) / 2
            below = self._below(origin, rays, middle)
            after = np.where(below, middle, after)
            before = np.where(below, before, middle)
        return np.where(found, after, np.float32(FARTHEST))

    def _below(self, origin: np.ndarray, rays: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        x, y, z = (origin[axis] + rays[..., axis] * ranges for axis in range(3))
        return z <= self.sample(self.heights, x, y)

    def albedo(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Return colors (H, W, 3) of the floor at points (H, W, 3), smoothed over a footprint (H, W) in metres."""
        # Sheared by the height, so that steep sides have texture too.
        x, y = points[..., 0] + 0.7 * points[..., 2], points[..., 1] + 0.5 * points[..., 2]
        level = np.clip(np.log2(footprint / self.texel), 0, _DETAIL_LEVELS - 1.001)
        detail = np.zeros(level.shape, np.float32)
        for number, texture in enumerate(self.details):
            weight = np.maximum(0, 1 - np.abs(level - number))
            if weight.any():
                detail += weight * self.sample(texture, x, y)
        return self.sample(self.colors, points[..., 0], points[..., 1]) * (detail / 128)[..., None] ** 1.5

    def lit(self, points: np.ndarray, towards: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Return 1 where light from a lamp reaches points (H, W, 3), 0 in shadow: (H, W) float32."""
        clear = np.ones(distance.shape, np.float32)
        for fraction in np.geomspace(0.01, 0.9, 20).astype(np.float32):
            at = points + towards * (distance * fraction)[..., None]
            above = at[..., 2] + 0.01 - self.sample(self.heights, at[..., 0], at[..., 1])
            clear = np.minimum(clear, np.clip(1 + above / 0.02, 0, 1))
        return clear


def octaves(rows: int, columns: int, sizes: tuple[float, ...], cell: float, random: np.random.Generator) -> np.ndarray:
    """Return smooth noise (rows, columns) float32 of standard deviation about 1, summed over sizes in metres."""
    total = np.zeros((rows, columns), np.float32)
    for size in sizes:
        grid = [max(2, round(side * cell / size)) for side in (rows, columns)]
        noise = random.standard_normal(grid, np.float32)
        total += cv2.resize(noise, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return total / np.float32(0.7 * np.sqrt(len(sizes)))


def _heights(rows: int, columns: int, random: np.random.Generator) -> np.ndarray:
    """Return a floor (rows, columns) float32 of slopes and rocks, metres."""
    heights = 0.12 * octaves(rows, columns, (3.0,), HEIGHT_CELL, random)
    heights += 0.03 * octaves(rows, columns, (0.1, 0.3, 0.8), HEIGHT_CELL, random)
    area = rows * columns * HEIGHT_CELL**2
    for _ in range(round(1.2 * area)):
        radius = random.uniform(0.12, 0.4)
        reach = round(1.3 * radius / HEIGHT_CELL)
        row, column = random.integers(0, rows), random.integers(0, columns)
        added = rock(radius, random.uniform(0.5, 1.1) * radius, random)
        top, left = max(0, row - reach), max(0, column - reach)
        part = heights[top : row + reach, left : column + reach]
        part += added[top - row + reach :, left - column + reach :][: part.shape[0], : part.shape[1]]
    return heights


def rock(radius: float, height: float, random: np.random.Generator) -> np.ndarray:
    """Return the heights (2n, 2n) float32 that a rock adds, with an uneven outline."""
    reach = round(1.3 * radius / HEIGHT_CELL)
    across = (np.arange(2 * reach, dtype=np.float32) - reach) * HEIGHT_CELL
    x, y = across, across[:, None]
    turn, stretch = random.uniform(0, np.pi), random.uniform(1.0, 1.5)
    along, aside = x * np.cos(turn) + y * np.sin(turn), stretch * (y * np.cos(turn) - x * np.sin(turn))
    angle = np.arctan2(y, x)
    outline = 1 + 0.12 * np.sin(3 * angle + random.uniform(0, 6)) + 0.06 * np.sin(7 * angle + random.uniform(0, 6))
    distance = np.hypot(along, aside) / (radius * outline)
    return (height * np.sqrt(np.clip(1 - distance**2, 0, 1))).astype(np.float32)


def _mound(rows: int, columns: int, random: np.random.Generator) -> np.ndarray:
    """Return the heights of a coral head of 1.3 m in the middle of the floor."""
    x = (np.arange(columns, dtype=np.float32) - columns / 2) * HEIGHT_CELL
    y = (np.arange(rows, dtype=np.float32)[:, None] - rows / 2) * HEIGHT_CELL
    bumps = 1 + 0.15 * octaves(rows, columns, (0.2, 0.5), HEIGHT_CELL, random)
    return 1.3 * np.sqrt(np.clip(1 - (x**2 + y**2) / 1.1**2, 0, 1)) * bumps


# Photos


def _render(
    ground: Ground, water: Water, lens: Lens, rays: np.ndarray, pose: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Return a photo (H, W, 3) uint8 RGB."""
    rotation = pose[:3, :3]
    centre = (-rotation.T @ pose[:3, 3]).astype(np.float32)
    towards = rays @ rotation.astype(np.float32)
    ranges = ground.hit(centre, towards)
    points = centre + towards * ranges[..., None]
    normals = ground.sample(ground.normals, points[..., 0], points[..., 1])
    facing = np.clip(-(normals * towards).sum(-1), 0.15, 1)
    albedo = ground.albedo(points, ranges / lens.params[0] / np.sqrt(facing))
    sun = np.array([0.4, 0.3, 0.87], np.float32)
    light = water.ambient * (0.35 + 0.65 * np.clip(normals @ sun, 0, 1))[..., None] * np.ones(3, np.float32)
    attenuation, background = np.array(water.attenuation, np.float32), np.array(water.background, np.float32)
    haze = background * np.ones_like(albedo)
    if water.lamp:
        place = centre + np.array([0.35, -0.25, 0.0], np.float32) @ rotation.astype(np.float32)
        to_lamp = place - points
        distance = np.linalg.norm(to_lamp, axis=2)
        to_lamp /= distance[..., None]
        beam = np.clip(-to_lamp @ rotation[2].astype(np.float32), 0, 1) ** 4
        strength = beam * np.clip((normals * to_lamp).sum(-1), 0, 1) * ground.lit(points, to_lamp, distance)
        light += (water.lamp * strength / distance**2)[..., None] * np.exp(-distance[..., None] * attenuation)
        haze += 0.03 * water.lamp * beam[..., None] * background
    through = np.exp(-ranges[..., None] * attenuation) * (ranges < FARTHEST)[..., None]
    linear = albedo * light * through + haze * (1 - through)
    display = 255 * np.clip(linear, 0, 1) ** (1 / 2.2)
    display += water.noise * random.standard_normal(display.shape, np.float32)
    return np.clip(display + 0.5, 0, 255).astype(np.uint8)


# Paths


def _poses(centres: np.ndarray, forward: np.ndarray, up: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return world-to-camera transforms (N, 4, 4).

    Args:
        centres: Projection centres (N, 3).
        forward: Directions of view (N, 3).
        up: Directions (3,) or (N, 3) that are up in the photos.
        turns: Small further rotations (N, 3) about the camera's x, y and z, degrees.
    """
    z = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    x = np.cross(z, np.broadcast_to(up, z.shape))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(z), 1, 1))
    for number, turn in enumerate(np.radians(turns)):
        axes = np.stack([x[number], np.cross(z[number], x[number]), z[number]])
        poses[number, :3, :3] = cv2.Rodrigues(turn)[0] @ axes
        poses[number, :3, 3] = -poses[number, :3, :3] @ centres[number]
    return poses


def _drift(count: int, random: np.random.Generator) -> np.ndarray:
    """Return smooth changes (count, 3) of about -1 to 1: a diver's or a vehicle's motion."""
    at = np.linspace(0, 1, count)[:, None]
    return sum(
        np.sin(2 * np.pi * (waves * at + random.uniform(0, 1, 3))) / weight
        for waves, weight in ((1.3, 1.6), (3.1, 2.2), (7.3, 4.0))
    )


def _orbit(count: int, random: np.random.Generator) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centres = np.stack([3.2 * np.cos(angle), 3.2 * np.sin(angle), 1.9 + 0 * angle], -1)
    centres += 0.12 * _drift(count, random)
    return _poses(centres, [0, 0, 0.5] - centres, np.array([0, 0, 1.0]), 2 * _drift(count, random))


def _lanes(
    lanes: int, spacing: float, length: float, altitude: float
) -> Callable[[int, np.random.Generator], np.ndarray]:
    """Return the path of a lawn-mower survey that looks straight down; every second lane goes back."""

    def path(count: int, random: np.random.Generator) -> np.ndarray:
        lane = np.arange(count) * lanes // count
        first = np.searchsorted(lane, lane)
        along = (np.arange(count) - first) / np.maximum(1, np.bincount(lane)[lane] - 1) - 0.5
        back = np.where(lane % 2, -1.0, 1.0)
        x, y = back * along * length, (lane - (lanes - 1) / 2) * spacing
        centres = np.stack([x, y, altitude + 0 * x], -1) + 0.08 * _drift(count, random)
        forward = np.tile([0.0, 0.0, -1.0], (count, 1))
        up = back[:, None] * [1.0, 0.0, 0.0]
        return _poses(centres, forward, up, 4 * _drift(count, random))

    return path


def _forward(count: int, random: np.random.Generator) -> np.ndarray:
    x = np.linspace(-0.5, 0.5, count)
    centres = np.stack([x - 3, 0 * x, 1.5 + 0 * x], -1) + 0.02 * _drift(count, random)
    forward = np.tile([1.0, 0.0, -0.35], (count, 1))
    return _poses(centres, forward, np.array([0, 0, 1.0]), 2.5 * _drift(count, random))


def _wall(count: int, random: np.random.Generator) -> np.ndarray:
    there = np.linspace(-3.5, 3.5, count // 2)
    x = np.concatenate([there, there[::-1]])
    y = np.repeat([-0.5, 0.5], count // 2)
    centres = np.stack([x, y, 2.1 + 0 * x], -1) + 0.12 * _drift(len(x), random)
    forward = np.stack([0.35 * np.sin(np.arange(len(x)) / 3), 0 * x, -1 + 0 * x], -1)
    return _poses(centres, forward, np.array([0, 1.0, 0]), 3 * _drift(len(x), random))


def _two_heights(count: int, random: np.random.Generator) -> np.ndarray:
    half = count // 2
    angle = np.linspace(0, 2 * np.pi, half, endpoint=False)
    radius, height = np.repeat([1.6, 2.2], half), np.repeat([1.8, 3.2], half)
    angle = np.concatenate([angle, -angle])
    centres = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    centres += 0.1 * _drift(len(centres), random)
    forward = np.stack([-0.3 * np.cos(angle), -0.3 * np.sin(angle), -1 + 0 * angle], -1)
    up = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], -1)
    return _poses(centres, forward, up, 3 * _drift(len(centres), random))


@dataclass(frozen=True)
class _Layout:
    floor: Floor
    path: Callable[[int, np.random.Generator], np.ndarray]
    images: int = 32
    water: Water = Water()
    lens: Lens = Lens("SIMPLE_RADIAL", 480, 320, (530.0, 240.0, 160.0, -0.04))


_WALL = _Layout(Floor((12, 6), relief=1.6), _wall, images=28)
_SURVEY = _Layout(Floor((10, 8)), _lanes(4, 0.9, 3.6, 2.4))
_FISHEYE = Lens("OPENCV_FISHEYE", 480, 360, (225.0, 225.0, 240.0, 180.0, 0.03, -0.01, 0.0, 0.0))
_DIM = Water((0.75, 0.5, 0.55), (0.012, 0.035, 0.03), ambient=0.35, noise=4)
_DARK = Water((0.35, 0.15, 0.13), (0.002, 0.004, 0.005), ambient=0.01, noise=2.5, lamp=6.0)

SCENES: dict[str, _Layout] = {
    "orbit": _Layout(Floor((16, 16), mound=True), _orbit),
    "lawn-mower": _SURVEY,
    "forward video": _Layout(Floor((24, 16)), _forward),
    "wall": _WALL,
    "two heights": _Layout(Floor((12, 12)), _two_heights),
    "lamp": replace(_SURVEY, water=_DARK),
    "turbid": replace(_SURVEY, water=_DIM),
    "fisheye": replace(_SURVEY, lens=_FISHEYE, images=24),
    "large photos": replace(_WALL, images=44, lens=Lens("SIMPLE_RADIAL", 1500, 1000, (1656.0, 750.0, 500.0, -0.04))),
    "large survey": _Layout(
        Floor((28, 40)),
        _lanes(25, 1.35, 22, 3.0),
        images=1000,
        lens=Lens("SIMPLE_RADIAL", 240, 160, (264.0, 120.0, 80.0, -0.04)),
    ),
}
"""Scenes by name.

All are for accuracy but the last two: `large photos` are for time, the 1000 of `large survey` for the choice of pairs.
"""
