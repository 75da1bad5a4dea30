"""Places of textured boxes, ray-cast without Blender: a street by day, a room lit by lamps, flat ground from above.

They stand for images taken on land: highlights that change with the view, distant objects of other colors than near
ones, sky behind them, and lamps that are fixed in the place and not to the camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from tests.scenes.reef_model import Passes

SUN = np.array([0.35, -0.5, 0.79])
SKY = np.array([0.35, 0.55, 0.95])
TEXELS, PER_METRE, LEVELS = 1024, 64, 5


@dataclass
class Place:
    """Boxes (N, 2, 3) of low and high corners, metres, z up; their textures; what lights them.

    lamps: (L, 3) places of lamps, None under sun and sky. inside: the first box is a room seen from inside. shine: how
    much glass and ground mirror.
    """

    boxes: np.ndarray
    textures: list[list[np.ndarray]]
    lamps: np.ndarray | None
    inside: bool
    shine: float


def texture(random: np.random.Generator, base: np.ndarray, windows: bool) -> list[np.ndarray]:
    """Mip levels of a repeating surface (TEXELS, TEXELS, 4): linear color, and how much of it mirrors."""
    rough = np.zeros((TEXELS, TEXELS))
    for size in (4, 16, 64, 256):
        noise = random.standard_normal((TEXELS // size + 1,) * 2).astype(np.float32)
        rough += cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    blotch = cv2.resize(random.standard_normal((9, 9, 3)).astype(np.float32), (TEXELS, TEXELS))
    color = base * np.exp(0.3 * rough[..., None] + 0.25 * blotch)
    mirror = np.full((TEXELS, TEXELS), 0.15)
    if windows:
        step = TEXELS // 6
        for row, column in np.ndindex(6, 6):
            y, x = row * step + step // 4, column * step + step // 3
            color[y : y + step // 2, x : x + step // 3] = random.uniform(0.01, 0.08, 3)
            mirror[y : y + step // 2, x : x + step // 3] = 1.0
            edge = random.uniform(0.3, 0.8)
            color[y : y + step // 2, x : x + 4] = color[y : y + 4, x : x + step // 3] = edge
    levels = [np.concatenate([color.clip(0.005, 0.9), mirror[..., None]], 2).astype(np.float32)]
    while len(levels) < LEVELS:
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return levels


def street(seed: int) -> Place:
    """Two rows of houses along x; those far ahead are bluer and duller than those near by."""
    random = np.random.default_rng((seed, 11))
    boxes: list[list[list[float]]] = [[[-80, -60, -1], [120, 60, 0]]]
    bases = [np.array([0.12, 0.12, 0.12])]
    for side in (-1, 1):
        x = -25.0
        while x < 60:
            width, front, tall = random.uniform(6, 11), random.uniform(5, 7.5), random.uniform(5, 13)
            y = sorted((side * front, side * (front + 8)))
            boxes.append([[x, y[0], 0], [x + width, y[1], tall]])
            far = np.clip((x + 10) / 50, 0, 1)
            near = random.choice([[0.45, 0.16, 0.1], [0.6, 0.5, 0.3], [0.55, 0.53, 0.5]])
            bases.append((1 - far) * near + far * np.array([0.2, 0.26, 0.36]))
            x += width + random.uniform(0, 2)
    for _ in range(14):  # what stands about
        x, y, size = random.uniform(-12, 25), random.uniform(-4.5, 4.5), random.uniform(0.3, 0.9, 3)
        boxes.append([[x, y, 0], [x + size[0], y + size[1], 2 * size[2]]])
        bases.append(random.uniform(0.03, 0.7, 3))
    textures = [texture(random, base, 0 < k < len(boxes) - 14) for k, base in enumerate(bases)]
    return Place(np.array(boxes, float), textures, None, False, 1.0)


def room(seed: int) -> Place:
    """Twelve by nine metres with furniture, lit by two lamps under the ceiling."""
    random = np.random.default_rng((seed, 12))
    boxes, bases = [[[-6, -4.5, 0], [6, 4.5, 3]]], [np.array([0.5, 0.45, 0.38])]
    for _ in range(16):
        x, y, size = random.uniform(-5, 4), random.uniform(-4, 3), random.uniform(0.4, 1.3, 3)
        boxes.append([[x, y, 0], [x + size[0], y + size[1], size[2]]])
        bases.append(random.uniform(0.03, 0.6, 3))
    textures = [texture(random, base, k % 3 == 1) for k, base in enumerate(bases)]
    return Place(np.array(boxes, float), textures, np.array([[-3.5, 0, 2.6], [3.5, 1, 2.6]]), True, 0.5)


def ground(seed: int) -> Place:
    """Nothing but a plane at z = 0."""
    random = np.random.default_rng((seed, 13))
    return Place(
        np.array([[[-60.0, -60, -1], [60, 60, 0]]]),
        [texture(random, np.array([0.4, 0.36, 0.28]), False)],
        None,
        False,
        0,
    )


def passes_of(place: Place, pose: np.ndarray, width: int, height: int, focal: float) -> Passes:
    """What a camera at `pose` (world_to_camera, OpenCV axes) sees of a place; focal in pixels."""
    centre = -pose[:3, :3].T @ pose[:3, 3]
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ pose[:3, :3]
    rays = rays.reshape(height, width, 3)
    distance, hit, axis = np.full((height, width), np.inf), np.full((height, width), -1), np.zeros((height, width), int)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k, (low, high) in enumerate(place.boxes):
            part = _pixels_of(low, high, pose, width, height, focal)
            a, b = (low - centre) / rays[part], (high - centre) / rays[part]
            enters, leaves = np.minimum(a, b), np.maximum(a, b)
            near, far = enters.max(2), leaves.min(2)
            if place.inside and k == 0:
                t, side, there = far, leaves.argmin(2), far > 0
            else:
                t, side, there = near, enters.argmax(2), (near < far) & (near > 0)
            nearer = there & (t < distance[part])
            distance[part][nearer], hit[part][nearer], axis[part][nearer] = t[nearer], k, side[nearer]
    rays, distance, hit, axis = rays.reshape(-1, 3), distance.ravel(), hit.ravel(), axis.ravel()
    color, sun_share = np.zeros((len(rays), 3)), np.zeros(len(rays))
    solid = hit >= 0
    points = centre + rays * np.where(solid, distance, 0)[:, None]
    for k in np.unique(hit[solid]):
        levels = place.textures[k]
        for side in range(3):
            own = np.flatnonzero((hit == k) & (axis == side))
            if not len(own):
                continue
            u, v = np.delete(points[own], side, axis=1).T
            level = np.clip(np.round(np.log2(distance[own] / focal * PER_METRE)), 0, LEVELS - 1).astype(int)
            surface = np.zeros((len(own), 4))
            for n in np.unique(level):
                chosen, size = level == n, TEXELS >> n
                s, t = (np.floor(w[chosen] * PER_METRE / 2**n).astype(int) % size for w in (u, v))
                surface[chosen] = levels[n][t, s]
            normal = np.zeros(3)
            inward = place.inside and k == 0
            normal[side] = 1
            facing = -np.sign(rays[own, side]) * normal[side]
            light, mirrored, share = _lit(place, points[own], rays[own], side, facing)
            shine = place.shine * surface[:, 3:] * (0.0 if inward else 1.0)
            cosine = np.abs(rays[own, side])[:, None]
            fresnel = (0.04 + 0.96 * (1 - cosine) ** 5) * shine
            color[own] = surface[:, :3] * light * (1 - fresnel) + fresnel * mirrored
            sun_share[own] = share
    shape = (height, width)
    return Passes(
        color.reshape(*shape, 3).astype(np.float32),
        solid.reshape(shape).astype(np.float32),
        distance.reshape(shape).astype(np.float32),
        sun_share.reshape(shape).astype(np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.uint8),
    )


def _pixels_of(
    low: np.ndarray, high: np.ndarray, pose: np.ndarray, width: int, height: int, focal: float
) -> tuple[slice, slice]:
    """Return the rows and columns of the pixels that may show a box; all where it reaches behind the camera."""
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T, high, low) @ pose[:3, :3].T + pose[:3, 3]
    if corners[:, 2].max() <= 0:
        return slice(0, 0), slice(0, 0)
    if corners[:, 2].min() < 0.01:
        return slice(0, height), slice(0, width)
    columns, rows = (focal * corners[:, :2] / corners[:, 2:] + [width / 2, height / 2]).T
    return tuple(  # type: ignore[return-value]
        slice(max(0, int(at.min()) - 1), max(0, min(most, int(at.max()) + 2)))
        for at, most in ((rows, height), (columns, width))
    )


def _lit(
    place: Place, points: np.ndarray, rays: np.ndarray, side: int, facing: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return light on points (P, 3) of faces along an axis, their reflection (P, 3), and the fraction from the sun."""
    mirror = rays.copy()
    mirror[:, side] *= -1
    if place.lamps is None:
        sun = 0.9 * np.maximum(facing * SUN[side], 0)[:, None]
        sky = 0.35 * (0.75 + 0.25 * SKY) + np.zeros((len(points), 3))
        glint = 6 * np.maximum(mirror @ SUN, 0)[:, None] ** 60
        above = np.clip(mirror[:, 2:] + 0.15, 0, 1)
        return sun + sky, SKY * above + 0.1 + glint, (sun / (sun + sky)).mean(1)
    light, glint = np.full((len(points), 3), 0.02), np.full((len(points), 3), 0.05)
    for lamp in place.lamps:
        towards = lamp - points
        away = np.linalg.norm(towards, axis=1)
        towards /= away[:, None]
        strength = np.maximum(facing * towards[:, side], 0) * 2.2 / (0.3 + away**2)
        light += strength[:, None] * np.array([1.0, 0.85, 0.65])
        glint += 3 * np.maximum((mirror * towards).sum(1), 0)[:, None] ** 40
    return light, glint, np.zeros(len(points))
