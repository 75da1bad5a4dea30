"""Photos of a color chart before a textured wall in water of known coefficients, ray-cast in a second."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from swag_engine.base.transfer import linear_to_srgb
from swag_engine.colorchart.chart_kinds import PATCH, ChartKind, chart_kinds

BETA_D = np.array([0.35, 0.12, 0.08])
BETA_B = np.array([0.3, 0.15, 0.12])
B_INF = np.array([0.04, 0.16, 0.24])
TEXELS = 24
"""Texels of a chart's texture per unit of its grid."""
WALL = 5.0
"""Distance of the wall from the camera at x = y = z = 0."""


@dataclass
class Shot:
    """One photo.

    place: (3,) of the camera, which looks along z. chart: name of the chart's kind, None without one. width: width of
    the chart in metres. tilt, roll: degrees about the vertical, and about the line of sight. covered: fraction of the
    chart's width under a dark cloth, from its left. shadow: fraction of its width in shadow. centre: place of the
    chart. exposure: factor of the light.
    """

    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    chart: str | None = "24"
    width: float = 0.9
    tilt: float = 0.0
    roll: float = 0.0
    covered: float = 0.0
    shadow: float = 0.0
    centre: tuple[float, float, float] = (0.1, -0.05, 3.0)
    exposure: float = 0.9
    size: tuple[int, int] = (640, 480)
    beta_D: np.ndarray = field(default_factory=lambda: BETA_D)
    matrix: np.ndarray = field(default_factory=lambda: np.eye(3))

    @property
    def focal(self) -> float:
        return 1.1 * self.size[0]


def texture_of(kind: ChartKind, shot: Shot) -> np.ndarray:
    """Linear light of a chart with its black frame, one unit of its grid wide; alpha is everywhere 1."""
    width, height = np.round((kind.size + 2) * TEXELS).astype(int)
    texture = np.full((height, width, 3), 0.015, np.float32)
    for centre, light in zip(kind.centres + 1, kind.light, strict=True):
        left, top = np.round((centre - PATCH / 2) * TEXELS).astype(int)
        side = round(PATCH * TEXELS)
        texture[top : top + side, left : left + side] = light
    texture[:, : round(shot.covered * width)] = [0.05, 0.03, 0.02]
    texture[:, : round(shot.shadow * width)] *= 0.35
    return texture


def wall_texture() -> np.ndarray:
    random = np.random.default_rng(3)
    octaves = [
        cv2.resize(random.normal(0, 0.06, (1200 // k, 1600 // k, 3)), (1600, 1200), interpolation=cv2.INTER_CUBIC)
        for k in (4, 12, 40)
    ]
    return np.clip(np.sum(octaves, axis=0) + [0.3, 0.28, 0.22], 0.01, 0.9).astype(np.float32)


WALL_TEXTURE = wall_texture()


def chart_axes(shot: Shot) -> np.ndarray:
    """Unit vectors (2, 3) along the rows and the columns of the chart."""
    tilt, roll = np.radians([shot.tilt, shot.roll])
    right = np.array([np.cos(tilt), 0, np.sin(tilt)])
    down = np.array([0.0, 1.0, 0.0])
    return np.stack([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right])


def to_world(shot: Shot, points: np.ndarray) -> np.ndarray:
    """Points (N, 2) of the chart's grid as places (N, 3)."""
    kind = chart_kinds()[shot.chart]
    metre = shot.width / kind.size[0]
    return (points - kind.size / 2) * metre @ chart_axes(shot) + shot.centre


def to_pixels(shot: Shot, places: np.ndarray) -> np.ndarray:
    """Places (N, 3) as pixels (N, 2) of the photo, the centre of the first at 0.5."""
    seen = places - shot.place
    return shot.focal * seen[:, :2] / seen[:, 2:] + np.array(shot.size) / 2


def patch_ranges(shot: Shot) -> np.ndarray:
    return np.linalg.norm(to_world(shot, chart_kinds()[shot.chart].centres) - shot.place, axis=1)


def render(shot: Shot, water: float = 1.0) -> np.ndarray:
    """The photo (H, W, 3) uint8 sRGB."""
    scale = 2
    width, height = shot.size[0] * scale, shot.size[1] * scale
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - width / 2), (y - height / 2), np.full_like(x, shot.focal * scale)], -1) / (shot.focal * scale)
    place = np.array(shot.place)
    depth = WALL - place[2]
    at = rays * depth + place
    light = cv2.remap(
        WALL_TEXTURE, (at[..., 0] * 200 + 800).astype(np.float32), (at[..., 1] * 200 + 600).astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    ranges = np.linalg.norm(rays, axis=-1) * depth
    if shot.chart:
        kind = chart_kinds()[shot.chart]
        axes, texture = chart_axes(shot), texture_of(kind, shot)
        normal = np.cross(*axes)
        distance = ((np.array(shot.centre) - place) @ normal) / (rays @ normal)
        grid = ((rays * distance[..., None] + place - shot.centre) @ axes.T) / (shot.width / kind.size[0])
        u, v = np.moveaxis((grid + kind.size / 2 + 1) * TEXELS, -1, 0)
        inside = (u >= 0) & (v >= 0) & (u < texture.shape[1]) & (v < texture.shape[0])
        # A texture that is finer than the pixels is averaged first.
        blur = max(1.0, TEXELS * kind.size[0] / shot.width * np.median(distance[inside]) / (shot.focal * scale))
        texture = cv2.GaussianBlur(texture, (0, 0), 0.4 * blur)
        seen = cv2.remap(texture, (u - 0.5).astype(np.float32), (v - 0.5).astype(np.float32), cv2.INTER_LINEAR)
        light = np.where(inside[..., None], seen, light)
        ranges = np.where(inside, np.linalg.norm(rays, axis=-1) * distance, ranges)
    if water:
        far = ranges[..., None]
        light = light * np.exp(-shot.beta_D * far) + B_INF * (1 - np.exp(-BETA_B * far))
    light = cv2.resize((light @ shot.matrix.T).astype(np.float32), shot.size, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(1).normal(0, 1.0, light.shape)
    return np.clip(np.round(linear_to_srgb(shot.exposure * light) * 255 + noise), 0, 255).astype(np.uint8)


def write_scene(folder: Path, shots: list[Shot]) -> Path:
    """Write photos 0.png, 1.png and so on with their cameras and points of the wall and the chart to a folder."""
    images, model = folder / "images", folder / "sparse" / "0"
    images.mkdir(parents=True)
    model.mkdir(parents=True)
    random = np.random.default_rng(2)
    wall = np.column_stack([random.uniform(-2, 2, (1500, 2)) * [1, 0.75], np.full(1500, WALL)])
    chart = to_world(shots[0], chart_kinds()[shots[0].chart].centres) if shots[0].chart else np.empty((0, 3))
    points = np.concatenate([wall, chart])
    lines: list[str] = []
    tracks: list[list[str]] = [[] for _ in points]
    for index, shot in enumerate(shots):
        (images / f"{index}.png").write_bytes(cv2.imencode(".png", render(shot)[..., ::-1])[1].tobytes())
        pixels = to_pixels(shot, points)
        seen = ((pixels > 2) & (pixels < np.array(shot.size) - 2)).all(1)
        if shot.chart:  # which hides points of the wall
            kind = chart_kinds()[shot.chart]
            frame = to_pixels(shot, to_world(shot, (kind.outline - kind.size / 2) * 1.2 + kind.size / 2))
            hidden = [
                cv2.pointPolygonTest(frame.astype(np.float32), tuple(map(float, at)), False) >= 0 for at in pixels
            ]
            seen &= ~np.array(hidden) | (np.arange(len(points)) >= len(wall))
        for place, point in enumerate(np.flatnonzero(seen)):
            tracks[point].append(f"{index + 1} {place}")
        x, y, z = (-float(value) for value in shot.place)
        observed = " ".join(f"{pixels[point, 0]} {pixels[point, 1]} {point + 1}" for point in np.flatnonzero(seen))
        lines.append(f"{index + 1} 1 0 0 0 {x} {y} {z} 1 {index}.png\n{observed}\n")
    width, height = shots[0].size
    focal = shots[0].focal
    (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n")
    (model / "images.txt").write_text("".join(lines))
    rows = [
        f"{i + 1} {p[0]} {p[1]} {p[2]} 120 110 90 0.5 {' '.join(track)}\n"
        for i, (p, track) in enumerate(zip(points, tracks, strict=True))
        if track
    ]
    (model / "points3D.txt").write_text("".join(rows))
    return folder
