"""A reef and a wreck modelled with Blender, and the passes Cycles renders of it.

World: metres, z up, the sand at about z = 0. The hull lies along x at the origin; the cameras stand on its -y side.
Everything is seeded, so the same seed gives the same scene.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from numpy.typing import ArrayLike

from swag_engine.colorchart.chart_kinds import PATCH, chart_kinds

try:
    import bpy
    from mathutils import Matrix, Vector
except ModuleNotFoundError:
    if os.environ.get("CI"):
        raise
    pytest.skip("Blender's Python package bpy is missing.", allow_module_level=True)

SUN = np.array([-0.42, -0.38, 0.82]) / np.linalg.norm([-0.42, -0.38, 0.82])  # towards the sun
RGB = tuple[float, float, float]
Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices (V,3), quads (F,4), tint (V,) in 0..1


# ---------------------------------------------------------------------------------------------------- noise


def noise(p: np.ndarray, seed: int = 0) -> np.ndarray:
    """Smooth value noise in -1..1 at points (..., 3), one feature per unit."""
    p = np.atleast_2d(p)
    cell = np.floor(p).astype(np.int64)
    f = p - cell
    f = f * f * f * (f * (f * 6 - 15) + 10)

    def corner(dx: int, dy: int, dz: int) -> np.ndarray:
        x, y, z = (cell[..., 0] + dx), (cell[..., 1] + dy), (cell[..., 2] + dz)
        h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (seed * 2654435761)
        h = (h ^ (h >> 13)) * 1274126177 & 0xFFFFFFFF
        h = (h ^ (h >> 16)) * 2246822519 & 0xFFFFFFFF
        return ((h ^ (h >> 15)) & 0xFFFF) / 32767.5 - 1  # int64 wraps around, which is what a hash wants

    total = np.zeros(p.shape[:-1])
    for dx in (0, 1):
        for dy in (0, 1):
            for dz in (0, 1):
                weight = np.where(dx, f[..., 0], 1 - f[..., 0])
                weight = weight * np.where(dy, f[..., 1], 1 - f[..., 1]) * np.where(dz, f[..., 2], 1 - f[..., 2])
                total += weight * corner(dx, dy, dz)
    return total


def fbm(p: np.ndarray, octaves: int = 4, seed: int = 0) -> np.ndarray:
    return sum(noise(p * 2**k, seed + k) / 2**k for k in range(octaves))


# ---------------------------------------------------------------------------------------------------- meshes


def joined(parts: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(v) for v, _, _ in parts[:-1]])
    return (
        np.concatenate([v for v, _, _ in parts]),
        np.concatenate([f + o for (_, f, _), o in zip(parts, offsets, strict=True)]),
        np.concatenate([t for _, _, t in parts]),
    )


def sheet(grid: np.ndarray, tint: np.ndarray | float = 0.0, closed: bool = False) -> Mesh:
    """Quads over a grid of points (n, m, 3); `closed` joins the last column to the first."""
    n, m = grid.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    right = np.roll(index, -1, axis=1) if closed else index[:, 1:]
    left = index if closed else index[:, :-1]
    quads = np.stack([left[:-1], right[:-1], right[1:], left[1:]], axis=-1).reshape(-1, 4)
    return grid.reshape(-1, 3), quads, np.broadcast_to(tint, (n, m)).reshape(-1).astype(float)


def tube(path: np.ndarray, radii: np.ndarray | float, sides: int = 8, tint: np.ndarray | float = 0.0) -> Mesh:
    """A round bar along a path (n, 3), its ends drawn to a point."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(radii, len(path)).astype(float)
    tint = np.broadcast_to(tint, len(path)).astype(float)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    path, along, tint = (np.concatenate([a[:1], a, a[-1:]]) for a in (path, along, tint))
    radii = np.concatenate([[1e-4], radii, [1e-4]])
    helper = np.array([0.3, 0.2, 0.93]) if abs(along[len(along) // 2] @ [0.3, 0.2, 0.93]) < 0.8 else np.eye(3)[0]
    u = np.cross(along, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(along, u)
    angle = np.arange(sides) / sides * 2 * np.pi
    ring = np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * v[:, None]
    return sheet(path[:, None] + radii[:, None, None] * ring, tint[:, None], closed=True)


def lathe(radius: np.ndarray, height: np.ndarray, sides: int = 32, tint: np.ndarray | float = 0.0) -> Mesh:
    angle = np.arange(sides) / sides * 2 * np.pi
    grid = np.stack(
        [
            np.outer(radius, np.cos(angle)),
            np.outer(radius, np.sin(angle)),
            np.broadcast_to(np.asarray(height, float)[:, None], (len(radius), sides)),
        ],
        axis=-1,
    )
    return sheet(grid, np.broadcast_to(tint, len(radius))[:, None], closed=True)


def slab(corners: np.ndarray, thickness: np.ndarray, tint: float = 0.0) -> Mesh:
    """A plank: a grid of points (n, 2, 3) made solid by the offset vectors (n, 2, 3) or (3,)."""
    inner = corners + thickness
    loop = np.stack([corners[:, 0], corners[:, 1], inner[:, 1], inner[:, 0]], axis=1)
    v, f, t = sheet(loop, tint, closed=True)
    last = 4 * (len(corners) - 1)
    return v, np.concatenate([f, [[3, 2, 1, 0], [last, last + 1, last + 2, last + 3]]]), t


def board(start: ArrayLike, end: ArrayLike, width: float, thick: float, tint: float = 0.0, pieces: int = 2) -> Mesh:
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, [0, 0, 1.0] if abs(along[2]) < 0.9 else [0, 1.0, 0])
    side *= width / np.linalg.norm(side)
    up = np.cross(side, along)
    up *= thick / np.linalg.norm(up)
    line = start + np.linspace(0, 1, pieces)[:, None] * (end - start)
    return slab(np.stack([line - side / 2, line + side / 2], axis=1) - up / 2, up, tint)


def moved(mesh: Mesh, matrix: Matrix) -> Mesh:
    m = np.array(matrix)
    return mesh[0] @ m[:3, :3].T + m[:3, 3], mesh[1], mesh[2]


def ball(rings: int, shape: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray | float]]) -> Mesh:
    """A sphere of 2 `rings` x `rings` quads; `shape` gives radius and tint for unit directions (..., 3)."""
    polar = (np.linspace(0, np.pi, rings) + 1e-4).clip(1e-3, np.pi - 1e-3)
    angle = np.arange(2 * rings) / rings * np.pi
    d = np.stack(
        [
            np.outer(np.sin(polar), np.cos(angle)),
            np.outer(np.sin(polar), np.sin(angle)),
            np.outer(np.cos(polar), np.ones_like(angle)),
        ],
        axis=-1,
    )
    radius, tint = shape(d)
    return sheet(d * np.asarray(radius)[..., None], tint, closed=True)


# ---------------------------------------------------------------------------------------------------- materials


def material(
    name: str,
    colors: list[tuple[float, float, float]],
    *,
    scale: float,
    stretch: tuple[float, float, float] = (1, 1, 1),
    fine: float = 6.0,
    cells: float = 0.0,
    tip: tuple[float, float, float] | None = None,
    growth: Sequence[tuple[tuple[float, float, float], float, float]] = (),
    vary: float = 0.06,
    bump: float = 0.4,
    wave: float = 0.0,
) -> bpy.types.Material:
    """A diffuse material of noise at several scales.

    `colors` are a ramp over noise of `scale` features per metre; `fine` times finer noise darkens and lightens;
    `cells` Voronoi cells per metre dot the surface as polyps or pebbles do; `tip` is the color where the mesh's tint
    is 1; each of `growth` is a color, a scale and a share of the surface it covers; `vary` moves hue by object;
    `wave` ripples per metre.
    """
    result = bpy.data.materials.new(name)
    result.use_nodes = True
    tree = result.node_tree
    tree.nodes.clear()

    def node(kind: str, inputs: dict = {}, **settings: object) -> bpy.types.Node:  # noqa: B006 (never changed)
        n = tree.nodes.new("ShaderNode" + kind)
        for key, value in settings.items():
            setattr(n, key, value)
        for key, value in inputs.items():
            if isinstance(value, bpy.types.NodeSocket):
                tree.links.new(value, n.inputs[key])
            else:
                n.inputs[key].default_value = value
        return n

    def ramp(factor: bpy.types.NodeSocket, stops: list[tuple[float, tuple]]) -> bpy.types.NodeSocket:
        n = node("ValToRGB", {0: factor})
        while len(n.color_ramp.elements) < len(stops):
            n.color_ramp.elements.new(0.5)
        for element, (position, color) in zip(n.color_ramp.elements, stops, strict=True):
            element.position, element.color = position, (*color, 1)
        return n.outputs[0]

    def mixed(factor: object, a: object, b: object, blend: str = "MIX") -> bpy.types.NodeSocket:
        return node("Mix", {0: factor, 6: a, 7: b}, data_type="RGBA", blend_type=blend).outputs[2]

    def noisy(size: float, detail: float, vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return node("TexNoise", {"Vector": vector, "Scale": size, "Detail": detail, "Roughness": 0.62}).outputs[0]

    where = node("TexCoord").outputs["Object"]
    random = node("ObjectInfo").outputs["Random"]
    shift = node("VectorMath", {0: random, 1: (37, 91, 53)}, operation="MULTIPLY").outputs[0]
    where = node("VectorMath", {0: where, 1: shift}, operation="ADD").outputs[0]
    grain = node("VectorMath", {0: where, 1: stretch}, operation="MULTIPLY").outputs[0]

    coarse = noisy(scale, 3, grain)
    stops = np.linspace(0.33, 0.67, len(colors))
    color = ramp(coarse, [(s, c) for s, c in zip(stops, colors, strict=True)])
    detail = noisy(scale * fine, 4, grain)
    color = mixed(1.0, color, ramp(detail, [(0.3, (0.42,) * 3), (0.5, (1.0,) * 3), (0.72, (1.55,) * 3)]), "MULTIPLY")
    height = detail
    if tip:
        tint = node("Attribute", attribute_name="tint").outputs["Fac"]
        color = mixed(
            tint, color, mixed(1.0, (*tip, 1), ramp(detail, [(0.3, (0.7,) * 3), (0.6, (1.1,) * 3)]), "MULTIPLY")
        )
    for index, (growth_color, size, share) in enumerate(growth):
        patch = noisy(size, 3, node("VectorMath", {0: where, 1: (index * 7.7, 3.1, 5.3)}).outputs[0])
        edge = 0.5 + (0.5 - share) * 0.5
        mask = ramp(patch, [(edge - 0.02, (0,) * 3), (edge + 0.03, (1,) * 3)])
        coat = mixed(1.0, (*growth_color, 1), ramp(detail, [(0.3, (0.5,) * 3), (0.7, (1.4,) * 3)]), "MULTIPLY")
        color = mixed(mask, color, coat)
    if cells:
        dots = node("TexVoronoi", {"Vector": where, "Scale": cells}).outputs["Distance"]
        color = mixed(1.0, color, ramp(dots, [(0.15, (1.3,) * 3), (0.65, (0.5,) * 3)]), "MULTIPLY")
        height = node("Math", {0: height, 1: dots}, operation="SUBTRACT").outputs[0]
    if wave:
        bent = node("VectorMath", {0: where, 1: (0.9, 1.0, 0.3)}, operation="MULTIPLY").outputs[0]
        ripple = node(
            "TexWave", {"Vector": bent, "Scale": wave, "Distortion": 5.0, "Detail": 2.0, "Detail Scale": 0.7}
        ).outputs["Fac"]
        color = mixed(1.0, color, ramp(ripple, [(0.0, (0.72,) * 3), (1.0, (1.12,) * 3)]), "MULTIPLY")
        height = node("Math", {0: height, 1: ripple}, operation="ADD").outputs[0]
    if vary:
        hue = node("Math", {0: random, 1: 2 * vary, 2: 0.5 - vary}, operation="MULTIPLY_ADD").outputs[0]
        value = node("Math", {0: random, 1: 7.31}, operation="MULTIPLY").outputs[0]
        value = node("Math", {0: value}, operation="FRACT").outputs[0]
        value = node("Math", {0: value, 1: 0.5, 2: 0.75}, operation="MULTIPLY_ADD").outputs[0]
        color = node("HueSaturation", {"Hue": hue, "Value": value, "Color": color}).outputs[0]
    normal = node("Bump", {"Strength": bump, "Distance": 0.03, "Height": height}).outputs[0]
    shader = node("BsdfDiffuse", {"Color": color, "Normal": normal})
    tree.links.new(shader.outputs[0], node("OutputMaterial").inputs[0])
    return result


# ---------------------------------------------------------------------------------------------------- corals


def staghorn(rng: np.random.Generator) -> Mesh:
    parts: list[Mesh] = []

    def grow(start: np.ndarray, direction: np.ndarray, length: float, radius: float, level: int) -> None:
        bend = rng.normal(0, 0.25, 3) + [0, 0, 0.25]
        s = np.linspace(0, 1, 5)[:, None]
        path = start + length * (s * direction + 0.5 * s**2 * bend)
        parts.append(tube(path, np.linspace(radius, radius * 0.72, 5), 7, np.linspace(0, 1, 5) ** 2 * (level > 0)))
        if level < 3:
            for _ in range(3 if level else 4):
                turn = direction + rng.normal(0, 0.65, 3) + [0, 0, 0.15]
                at = path[rng.integers(2, 5)]
                grow(at, turn / np.linalg.norm(turn), length * rng.uniform(0.55, 0.8), radius * 0.72, level + 1)

    for _ in range(3):
        direction = np.array([*rng.normal(0, 0.6, 2), 1.0])
        grow(np.array([0, 0, -0.05]), direction / np.linalg.norm(direction), 0.3, 0.04, 0)
    return joined(parts)


def table(rng: np.random.Generator) -> Mesh:
    s = np.concatenate([np.linspace(0.02, 1, 26), np.linspace(1, 0.12, 14), np.full(4, 0.1)])
    height = np.concatenate(
        [0.42 + 0.06 * np.linspace(0, 1, 26) ** 2, 0.45 - 0.14 * np.linspace(0, 1, 14), [0.25, 0.1, 0, -0.1]]
    )
    v, f, t = lathe(s * 0.55, height, 72)
    angle = np.arctan2(v[:, 1], v[:, 0])
    edge = 1 + 0.16 * noise(np.stack([np.cos(angle) * 2, np.sin(angle) * 2, angle * 0 + rng.uniform(0, 99)], -1))
    edge += 0.05 * noise(np.stack([np.cos(angle) * 9, np.sin(angle) * 9, angle * 0 + rng.uniform(0, 99)], -1))
    r = np.linalg.norm(v[:, :2], axis=1) / 0.55
    v[:, :2] *= (1 + (edge - 1) * r)[:, None]
    v[:, 2] += 0.03 * noise(v * 14) * (r > 0.1) + 0.05 * noise(v * 3 + 5)
    return v, f, np.clip((r - 0.8) / 0.25, 0, 1)


def brain(rng: np.random.Generator) -> Mesh:
    offset = rng.uniform(0, 50, 3)

    def shape(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        level = noise(d * 3.2 + offset) + 0.35 * noise(d * 7 + offset)
        ridge = 0.5 + 0.5 * np.cos(level * 2 * np.pi * 4)
        return 0.42 * (1 + 0.12 * noise(d * 1.4 + offset)) + 0.028 * ridge**0.7, ridge**2

    v, f, t = ball(150, shape)
    v[:, 2] *= 0.75
    return v, f, t


def sponge(rng: np.random.Generator) -> Mesh:
    parts = []
    for _ in range(rng.integers(4, 8)):
        h, r = rng.uniform(0.3, 0.7), rng.uniform(0.06, 0.11)
        z = np.concatenate([np.linspace(0, 1, 12), [1.02, 1.0], np.linspace(0.97, 0.3, 6)])
        radius = r * np.concatenate(
            [0.65 + 0.35 * np.linspace(0, 1, 12) ** 0.7, [0.95, 0.8], np.linspace(0.75, 0.5, 6)]
        )
        tint = np.concatenate([np.zeros(12), [0.1, 0.5], np.linspace(0.8, 1, 6)])
        v, f, t = lathe(radius, z * h, 20, tint)
        v[:, :2] *= (1 + 0.13 * noise(v * 16 + rng.uniform(0, 99)))[:, None]
        lean = rng.normal(0, 0.28, 2)
        v[:, :2] += (v[:, 2:] / h) ** 1.5 * h * lean + rng.normal(0, 0.1, 2)
        parts.append((v, f, t))
    return joined(parts)


def fan(rng: np.random.Generator) -> Mesh:
    parts: list[Mesh] = []

    def grow(x: float, z: float, angle: float, length: float, radius: float, level: int) -> None:
        s = np.linspace(0, 1, 4)
        a = angle + rng.normal(0, 0.12) * s
        px, pz = x + length * s * np.sin(a), z + length * s * np.cos(a)
        y = 0.05 * np.sin(px * 4) + 0.02 * np.cos(pz * 9)
        parts.append(tube(np.stack([px, y, pz], -1), np.linspace(radius, radius * 0.85, 4), 5, level / 8))
        if level < 8:
            spread = 0.34 + 0.1 * rng.random()
            children = (-1, 1) if rng.random() < 0.86 else (-1, 0, 1)
            for k in children:
                grow(
                    px[-1],
                    pz[-1],
                    a[-1] * 0.97 + k * spread,
                    length * rng.uniform(0.78, 0.93),
                    max(radius * 0.78, 0.005),
                    level + 1,
                )

    for angle in (-0.45, 0.05, 0.5):
        grow(0, -0.05, angle, 0.17, 0.022, 1)
    return joined(parts)


def fingers(rng: np.random.Generator) -> Mesh:
    parts = []
    for _ in range(26):
        base = rng.normal(0, 0.14, 2)
        h, r = rng.uniform(0.15, 0.42) * np.exp(-3 * (base @ base)), rng.uniform(0.035, 0.06)
        s = np.linspace(0, 1, 9)
        lean = base * 1.4 + rng.normal(0, 0.08, 2)
        path = np.stack([base[0] + lean[0] * s * h * 2, base[1] + lean[1] * s * h * 2, s * h - 0.04], -1)
        v, f, t = tube(
            path, r * np.sqrt(np.clip(1.02 - s**6, 0.05, 1)) * (1 + 0.15 * np.sin(s * 7 + rng.uniform(0, 6))), 10, s**2
        )
        parts.append((v + 0.012 * noise(v * 25)[:, None], f, t))
    return joined(parts)


def grass(rng: np.random.Generator) -> Mesh:
    parts = []
    for _ in range(45):
        base, h, w = rng.normal(0, 0.16, 2), rng.uniform(0.25, 0.7), rng.uniform(0.01, 0.02)
        s, lean, turn = np.linspace(0, 1, 8), rng.normal([0.25, 0.1], 0.2), rng.uniform(0, np.pi)
        centre = np.stack([base[0] + lean[0] * s**2 * h, base[1] + lean[1] * s**2 * h, s * h * 0.95 - 0.03], -1)
        side = np.array([np.cos(turn), np.sin(turn), 0]) * w
        width = (1 - s**3)[:, None] * side
        parts.append(sheet(np.stack([centre - width, centre + width], axis=1), s[:, None]))
    return joined(parts)


def cups(rng: np.random.Generator) -> Mesh:
    parts = []
    for _ in range(4):
        s, angle = np.linspace(0.1, 1, 18), np.linspace(0, 2.4 * np.pi, 90)
        r = (
            0.36
            * s[:, None]
            * (1 + 0.12 * np.sin(angle * 5 + rng.uniform(0, 6)) * s[:, None])
            * (0.75 + 0.1 * angle / np.pi)
        )
        z = 0.3 * s[:, None] ** 1.6 + 0.05 * s[:, None] * np.sin(angle * 8 + rng.uniform(0, 6)) + 0.035 * angle
        grid = np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
        grid += 0.01 * noise(grid * 20)[..., None]
        matrix = Matrix.Translation((*rng.normal(0, 0.2, 2), rng.uniform(-0.05, 0.1)))
        matrix = matrix @ Matrix.Rotation(rng.normal(0, 0.3), 4, "X") @ Matrix.Rotation(rng.uniform(0, 6), 4, "Z")
        parts.append(moved(sheet(grid, np.clip((s[:, None] - 0.85) / 0.15, 0, 1)), matrix))
    return joined(parts)


def anemone(rng: np.random.Generator) -> Mesh:
    parts = [lathe(np.array([0.16, 0.17, 0.18, 0.16, 0.01]), np.array([-0.05, 0.05, 0.12, 0.15, 0.15]), 20)]
    for _ in range(130):
        base, s = rng.normal(0, 0.075, 2), np.linspace(0, 1, 6)
        out = base * 4 + rng.normal(0, 0.25, 2)
        h = rng.uniform(0.12, 0.24)
        path = np.stack(
            [base[0] + out[0] * s**1.5 * h, base[1] + out[1] * s**1.5 * h, 0.13 + h * (s - 0.45 * s**3)], -1
        )
        parts.append(tube(path, np.linspace(0.012, 0.009, 6), 5, s**3))
    return joined(parts)


def urchin(rng: np.random.Generator) -> Mesh:
    parts = [ball(16, lambda d: (np.full(d.shape[:2], 0.07), 0.0))]
    for _ in range(140):
        d = rng.normal(size=3)
        d[2] = abs(d[2]) * 1.2
        d /= np.linalg.norm(d)
        parts.append(tube(np.stack([d * 0.05, d * rng.uniform(0.16, 0.22)]), np.array([0.005, 0.002]), 4, 0.3))
    return joined([moved(p, Matrix.Translation((0, 0, 0.05))) for p in parts])


def starfish(rng: np.random.Generator) -> Mesh:
    s = np.concatenate([np.linspace(0.01, 1, 14), [0.98]])
    v, f, t = lathe(s, np.concatenate([0.05 * np.sqrt(1 - np.linspace(0, 1, 14) ** 2) + 0.006, [-0.01]]), 90)
    angle = np.arctan2(v[:, 1], v[:, 0])
    arm = np.abs(((angle * 5 / (2 * np.pi)) % 1) - 0.5) * 2  # 1 on an arm, 0 between
    r = np.linalg.norm(v[:, :2], axis=1)
    v[:, :2] *= (0.07 + 0.15 * arm**2.2)[:, None]
    v[:, 2] *= 0.5 + 0.5 * (1 - r * (1 - arm))
    return v, f, 0.9 * (noise(v * 45) > 0.25)


def rock(rng: np.random.Generator) -> Mesh:
    offset = rng.uniform(0, 50, 3)

    def shape(d: np.ndarray) -> tuple[np.ndarray, float]:
        cracks = np.abs(noise(d * 2.1 + offset)) + 0.5 * np.abs(noise(d * 4.6 + offset))
        return 0.62 + 0.25 * noise(d * 1.1 + offset) + 0.25 * cracks + 0.07 * fbm(d * 8 + offset, 3), 0.0

    v, f, t = ball(110, shape)
    return v * [1, 1, 0.72], f, t


# ---------------------------------------------------------------------------------------------------- wreck

LENGTH = 4.6  # half the hull's length


def hull(t: ArrayLike, s: ArrayLike, inset: float = 0.0) -> np.ndarray:
    """Points of the hull's skin: t from bow (-1) to stern (1), s from keel (0) to gunwale (1), negative to port."""
    t, s = np.broadcast_arrays(np.asarray(t, float), np.asarray(s, float))
    breadth = 1.5 * np.clip(1 - np.abs(t) ** 2.4, 0, None) ** 0.8 + 0.03
    depth = 1.55 + 0.75 * t**2 + 0.25 * np.clip(-t, 0, 1) ** 3
    rocker = 0.55 * np.abs(t) ** 5
    a = np.minimum(np.abs(s), 1.25) * np.pi / 2
    y = np.sign(s) * np.clip(breadth * np.sin(np.minimum(a, np.pi / 2)) ** 0.85 - inset, 0, None)
    z = (
        rocker
        + (depth - rocker) * (1 - np.cos(np.minimum(a, np.pi / 2))) ** 0.85
        + depth * np.clip(np.abs(s) - 1, 0, 1)
    )
    return np.stack([t * LENGTH, y, z + inset * 0.6 * (np.abs(s) < 0.4)], axis=-1)


def wreck(rng: np.random.Generator) -> tuple[Mesh, Mesh]:
    """Timber and iron of a broken wooden hull, in the hull's own axes."""
    timber: list[Mesh] = []
    rows = 13
    for side in (-1, 1):
        for row in range(rows):
            low, high = row / rows, (row + 0.94) / rows
            t = np.linspace(-0.985, 0.985, 120)
            decay = fbm(np.stack([t * 4.2, np.full_like(t, row * 0.45), np.full_like(t, side * 9.0)], -1), 3, 5)
            height = row / rows
            kept = (
                decay
                + 0.75
                - 0.95 * height * (0.35 + np.clip(t + 0.35, 0, 1.2))
                - 0.6 * (side < 0) * np.exp(-(((t - 0.1) / 0.2) ** 2)) * (height > 0.3)
                > 0
            )
            butts = rng.choice(120, 3)  # where one plank ends and the next begins
            for run in np.split(np.arange(120), np.flatnonzero(~kept | np.isin(np.arange(120), butts))):
                if len(run) < 6:
                    continue
                run = run[1:]
                warp = rng.normal(0, 0.012) + 0.02 * noise(np.stack([t[run] * 6, t[run] * 0 + row, t[run] * 0], -1))
                outer = np.stack([hull(t[run], side * low), hull(t[run], side * high)], axis=1)
                outer[..., 1] += side * (warp[:, None] + 0.01)
                inner = np.stack([hull(t[run], side * low, 0.06), hull(t[run], side * high, 0.06)], axis=1)
                timber.append(slab(outer, inner - outer, rng.random()))
    for t in np.linspace(-0.9, 0.9, 27):
        for side in (-1, 1):
            top = rng.uniform(0.95, 1.12) if t < 0.1 else rng.uniform(0.6, 1.12)
            s = np.linspace(0, top, 22) * side
            centre = hull(np.full(22, t), s, 0.13)
            wide = np.array([0.055, 0, 0])
            deep = hull(np.full(22, t), s, 0.24) - centre
            timber.append(
                slab(np.stack([centre - wide, centre + wide], axis=1), np.stack([deep, deep], axis=1), rng.random())
            )
    for t in np.linspace(-0.75, 0.7, 10):
        a, b = hull(t, -0.84, 0.1), hull(t, 0.84, 0.1)
        if rng.random() < 0.3:
            b = a + (b - a) * rng.uniform(0.3, 0.7)
        timber.append(board(a, b, 0.14, 0.13, rng.random()))
    for y in np.arange(-1.3, 1.35, 0.165):  # what is left of the fore deck
        inside = np.linspace(-0.88, 0.05, 60)
        inside = inside[hull(inside, 0.84)[:, 1] > abs(y) + 0.1]
        if len(inside) < 10 or rng.random() < 0.14:
            continue
        start, end = inside[0], inside[-1] - max(0, rng.normal(0.12, 0.2))
        if end - start > 0.1:
            z = 0.07
            a, b = hull(start, 0.84), hull(end, 0.84)
            timber.append(board([a[0], y, a[2] + z], [b[0], y, b[2] + z], 0.15, 0.045, rng.random()))
    keel = hull(np.linspace(-1, 1, 40), 0.0)
    timber.append(tube(keel - [0, 0, 0.05], 0.1, 6, 0.2))
    bow: np.ndarray = hull(np.full(14, -0.985), np.linspace(0, 1.15, 14)) * [1, 0, 1]
    bow[:, 0] -= np.linspace(0, 1, 14) ** 2 * 0.75
    bow[:, 2] += np.linspace(0, 1, 14) ** 2 * 0.5
    timber.append(slab(np.stack([bow - [0.12, 0.07, 0], bow - [0.12, -0.07, 0]], axis=1), np.array([0.24, 0, 0]), 0.4))
    stern: np.ndarray = hull(np.full(14, 0.985), np.linspace(0, 1.0, 14)) * [1, 0, 1]
    stern[:, 0] += np.linspace(0, 1, 14) ** 2 * 0.4
    timber.append(slab(np.stack([stern - [0.1, 0.07, 0], stern - [0.1, -0.07, 0]], axis=1), np.array([0.2, 0, 0]), 0.7))
    for side in (-1, 1):  # wales: two thick strakes
        for s in (0.62, 1.0):
            t = np.linspace(-0.97, 0.25 if side < 0 else 0.75, 60)
            timber.append(tube(hull(t, side * s) + [0, side * 0.04, 0], 0.065, 6, rng.random()))
    timber.append(
        tube(
            np.array([[-0.9, 0, 0.2], [-0.92, 0.02, 1.7], [-1.0, 0.06, 2.75], [-1.02, 0.1, 2.9]]),
            np.array([0.17, 0.16, 0.15, 0.05]),
            14,
            0.5,
        )
    )

    iron: list[Mesh] = []
    for t, s in ((-0.3, 1.0), (-0.6, 1.0), (0.35, 0.62)):  # chain plates and straps
        for side in (-1, 1):
            iron.append(tube(hull(np.full(10, t), side * np.linspace(s - 0.35, s, 10)) + [0, side * 0.06, 0], 0.035, 6))
    for x in (-0.35, 0.35):
        iron.append(
            lathe(np.array([0.19, 0.19, 0.21, 0.21, 0.19]), np.array([0.0, 0.02, 0.03, 0.1, 0.11]) + 1.9 + x, 24)
        )
    iron = [moved(m, Matrix.Translation((-0.95, 0.03, -0.3))) if k >= 6 else m for k, m in enumerate(iron)]
    return joined(timber), joined(iron)


def mast() -> Mesh:
    s = np.linspace(0, 1, 24)
    path = np.stack([s * 5.6, 0.08 * np.sin(s * 3), 0 * s], -1)
    spar = np.array([[4.3, -1.4, 0.14], [4.35, 0, 0.18], [4.5, 1.2, 0.15]])
    bands = [tube(path[k : k + 2] * [1, 1, 1], 0.165 - 0.0025 * k, 14, 1.0) for k in (4, 12, 19)]
    return joined([tube(path, 0.15 - 0.06 * s, 14, 0.3), tube(spar, 0.07, 10, 0.6), *bands])


def amphora() -> Mesh:
    z = np.array([0, 0.03, 0.12, 0.25, 0.4, 0.52, 0.6, 0.66, 0.72, 0.84, 0.86, 0.9, 0.9, 0.8, 0.7])
    r = np.array([0.02, 0.04, 0.1, 0.155, 0.185, 0.18, 0.14, 0.08, 0.055, 0.05, 0.075, 0.075, 0.05, 0.035, 0.03])
    fine = np.linspace(0, 1, 60) * (len(z) - 1)
    parts = [lathe(np.interp(fine, range(15), r), np.interp(fine, range(15), z), 36)]
    for side in (-1, 1):
        x = np.array([0.05, 0.13, 0.16, 0.16, 0.15]) * side
        parts.append(tube(np.stack([x, x * 0, np.array([0.83, 0.84, 0.79, 0.68, 0.58])], -1), 0.018, 8))
    return joined(parts)


def crate(rng: np.random.Generator) -> Mesh:
    parts = []
    for k in range(4):
        for face in range(6):
            if rng.random() < 0.1:
                continue
            y = -0.3 + 0.2 * k
            plank = board([-0.4, y, 0.3], [0.4, y, 0.3], 0.185, 0.03, rng.random())
            if face >= 2:
                plank = moved(plank, Matrix.Rotation(np.pi / 2, 4, "Y")) if face >= 4 else plank
            axis, turn = (("X", 0), ("X", 1), ("X", 2), ("X", 3), ("Z", 0), ("Z", 2))[face]
            parts.append(moved(plank, Matrix.Rotation(turn * np.pi / 2, 4, axis)))
    return joined(parts)


def anchor() -> Mesh:
    shank = tube(np.array([[0, 0, 0], [0, 0, 1.7]]), 0.07, 10)
    a = np.linspace(-1.15, 1.15, 20)
    arms = tube(np.stack([np.sin(a) * 0.75, 0 * a, 0.72 - np.cos(a) * 0.75], -1), 0.075 - 0.03 * np.abs(a) / 1.2, 10)
    stock = tube(np.array([[0, -0.7, 1.55], [0, 0.7, 1.55]]), 0.06, 8)
    c = np.linspace(0, 2 * np.pi, 24)
    ring = tube(np.stack([np.sin(c) * 0.16, 0 * c, 1.88 + np.cos(c) * 0.16], -1), 0.03, 8)
    flukes = [board([x * 0.62, 0, 0.36], [x * 0.78, 0, 0.62], 0.3, 0.04) for x in (-1, 1)]
    return joined([shank, arms, stock, ring, *flukes])


def fish() -> Mesh:
    s = np.linspace(0, 1, 28)
    half = 0.11 * np.sin(np.pi * np.clip(s, 0, 1) ** 0.7) ** 0.8 + 0.012
    v, f, t = lathe(half, (s - 0.5) * 0.52, 24, 0.5 + 0.5 * np.tanh(8 * np.cos(s * 14) - 5))
    body = v[:, [2, 0, 1]] * [1, 0.42, 1]
    edge = np.linspace(-1, 1, 9)
    tail = np.stack(
        [
            np.stack([np.full(9, 0.24), 0 * edge, 0.03 * edge], -1),
            np.stack([0.36 + 0.05 * np.abs(edge), 0 * edge, 0.15 * edge], -1),
        ]
    )
    x = np.linspace(-0.12, 0.2, 9)
    top = np.interp(x, (s - 0.5) * 0.52, half)
    fins = [
        sheet(
            np.stack([np.stack([x, 0 * x, k * top * 0.9], -1), np.stack([x + 0.05, 0 * x, k * (top + 0.06)], -1)]), 0.95
        )
        for k in (-1, 1)
    ]
    return joined([(body, f, t), sheet(tail, 1.0), *fins])


# ---------------------------------------------------------------------------------------------------- the scene


def seabed_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    p = np.stack([x, y, np.zeros_like(x)], -1)
    hills = 0.22 * fbm(p * 0.22, 3, 3) + 0.05 * fbm(p * 0.9, 3, 8)
    ridge = 1.5 * np.exp(-(((y - 6.5 - 1.2 * np.sin(x * 0.35)) / 2.4) ** 2)) * (0.75 + 0.5 * noise(p * 0.28, 4))
    scour = -0.22 * np.exp(-((x / 4.8) ** 2 + (y / 2.0) ** 2))
    return hills + ridge + scour


LABELS = ("open water", "sand", "rock", "wreck", "amphora", "coral", "sponge", "seagrass", "fish")
"""What things are called in the truth; open water is where there is no surface."""

_LABEL_OF = {  # by the first word of a mesh's name; whatever else lives here is a coral
    "seabed": "sand", "rock": "rock", "hull": "wreck", "mast": "wreck", "anchor": "wreck", "crate": "wreck",
    "plank": "wreck", "amphora": "amphora", "sponge": "sponge", "grass": "seagrass", "fish": "fish",
}  # fmt: skip


def label_of(mesh_name: str) -> str:
    return _LABEL_OF.get(mesh_name.split(".")[0].split()[0], "coral")


CHART_PLACE = (0.5, -2.9)
"""Place of the color chart, metres."""


class Model:
    """The Blender scene. Only one exists at a time: Blender's data is global."""

    def __init__(self, seed: int, chart: bool = False) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.rng = np.random.default_rng(seed)
        self.path = np.array([np.linalg.inv(pose)[:3, 3] for pose in camera_path(96)])
        self.living: set[str] = set()
        self.materials = _materials()
        self.still = bpy.data.collections.new("still")
        self.moving = bpy.data.collections.new("moving")
        for collection in (self.still, self.moving):
            self.scene.collection.children.link(collection)
        self._light()
        self._model()
        if chart:
            self._chart()

    def place(
        self, mesh: bpy.types.Mesh, matrix: Matrix, collection: bpy.types.Collection | None = None
    ) -> bpy.types.Object:
        item = bpy.data.objects.new(mesh.name, mesh)
        item.matrix_world = matrix
        item.pass_index = 1 + LABELS.index(label_of(mesh.name))
        (collection or self.still).objects.link(item)
        return item

    def mesh(self, name: str, shape: Mesh, look: str, smooth: bool = True) -> bpy.types.Mesh:
        vertices, quads, tint = shape
        result = bpy.data.meshes.new(name)
        result.from_pydata(vertices.tolist(), [], quads.tolist())
        result.polygons.foreach_set("use_smooth", np.full(len(result.polygons), smooth))
        result.attributes.new("tint", "FLOAT", "POINT").data.foreach_set("value", tint.astype(np.float32))
        result.materials.append(self.materials[look])
        return result

    def _light(self) -> None:
        light = bpy.data.lights.new("sun", "SUN")
        light.energy, light.angle = 3.9, 0.06
        sun = bpy.data.objects.new("sun", light)
        sun.rotation_mode = "QUATERNION"
        sun.rotation_quaternion = Vector(SUN).to_track_quat("Z", "Y")
        sun.lightgroup = "sun"
        self.scene.collection.objects.link(sun)
        world = bpy.data.worlds.new("sky")
        world.use_nodes = True
        world.node_tree.nodes["Background"].inputs[0].default_value = (0.72, 0.75, 0.8, 1)
        self.scene.world = world
        self.scene.view_layers[0].lightgroups.add(name="sun")

    def _chart(self) -> None:
        """Stand a 24-patch color chart of a metre on the sand before the reef, leaning back."""
        kind = chart_kinds()["24"]
        centres = np.concatenate([[kind.size / 2], kind.centres])
        sides = np.concatenate([[kind.size + 1], np.full((24, 2), PATCH)])
        corners = centres[:, None] + sides[:, None] / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
        flat = (corners - kind.size / 2) / kind.size[0] * [1, -1]
        lift = np.where(np.arange(25) == 0, 0, 0.004)[:, None, None] * np.ones((25, 4, 1))
        mesh = bpy.data.meshes.new("seabed chart")
        quads = np.arange(100).reshape(25, 4)
        mesh.from_pydata(np.concatenate([flat, lift], -1).reshape(-1, 3).tolist(), [], quads.tolist())
        for index, light in enumerate(np.concatenate([[[0.02, 0.02, 0.02]], kind.light])):
            look = bpy.data.materials.new(f"patch {index}")
            look.use_nodes = True
            nodes = look.node_tree.nodes
            nodes.clear()
            surface, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
            surface.inputs["Color"].default_value = (*light, 1)
            look.node_tree.links.new(surface.outputs[0], output.inputs[0])
            mesh.materials.append(look)
        mesh.polygons.foreach_set("material_index", np.arange(25))
        x, y = CHART_PLACE
        ground = seabed_height(np.array(x), np.array(y)).item()
        self.place(mesh, Matrix.Translation((x, y, ground + 0.4)) @ Matrix.Rotation(np.radians(55), 4, "X"))

    def _surface(self, x: float, y: float) -> tuple[np.ndarray, np.ndarray] | None:
        """What lies under (x, y), unless something lives there already: point and upward normal."""
        hit, point, normal, _, item, _ = self.scene.ray_cast(self.depsgraph, (x, y, 12), (0, 0, -1))
        normal = np.array(normal)
        return (np.array(point), normal if normal[2] > 0 else -normal) if hit and item.name not in self.living else None

    def _clear(self, point: np.ndarray, size: float) -> bool:
        """Whether something of this size at this point would leave the cameras their view."""
        away = np.linalg.norm(self.path[:, :2] - point[:2], axis=1)
        over = self.path[:, 2] - point[2] - 0.6 * size
        return bool(np.all((away > 1.4 + 0.5 * size) | ((away > 0.7 + 0.5 * size) & (over > 0.1)) | (over > 1.0)))

    def _stand(self, mesh: bpy.types.Mesh, x: float, y: float, size: float, lean: float) -> None:
        """Stand a mesh on whatever is at (x, y), leaning with the surface."""
        spin, height = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(0.85, 1.15)
        surface = self._surface(x, y)
        if surface is None or surface[1][2] < 0.35 or not self._clear(surface[0], size):
            return
        point, normal = surface
        up = Vector((1 - lean) * np.array([0, 0, 1]) + lean * normal)
        turn = up.to_track_quat("Z", "Y").to_matrix().to_4x4() @ Matrix.Rotation(spin, 4, "Z")
        item = self.place(
            mesh,
            Matrix.Translation(point - normal * 0.03) @ turn @ Matrix.Diagonal((size, size, size * height, 1)),
        )
        self.living.add(item.name)

    def _model(self) -> None:
        rng = self.rng
        # Seabed: fine near the wreck, coarse where the water hides it.
        u = np.linspace(-1, 1, 420)
        line = 9 * u + 25 * u**5
        x, y = np.meshgrid(line, line, indexing="ij")
        self.place(self.mesh("seabed", sheet(np.stack([x, y, seabed_height(x, y)], -1)), "sand"), Matrix())

        def ground(x: float, y: float) -> float:
            return seabed_height(np.array(x), np.array(y)).item()

        rocks = [self.mesh(f"rock {k}", rock(rng), "rock") for k in range(5)]

        def boulder(x: float, y: float, size: float) -> None:
            turn = Matrix.Rotation(rng.uniform(0, 6.28), 4, "Z") @ Matrix.Rotation(rng.normal(0, 0.25), 4, "X")
            stretch = Matrix.Diagonal(
                (size * rng.uniform(0.8, 1.3), size * rng.uniform(0.8, 1.3), size * rng.uniform(0.7, 1.2), 1)
            )
            at = Matrix.Translation((x, y, ground(x, y) + 0.05 * size))
            kind = rocks[rng.integers(5)]
            if self._clear(np.array([x, y, ground(x, y)]), size):
                self.place(kind, at @ turn @ stretch)

        for _ in range(70):  # the reef wall behind
            x = rng.uniform(-11, 11)
            boulder(x, 6.2 + 1.2 * np.sin(x * 0.35) + rng.normal(0, 1.4), rng.lognormal(0.2, 0.4))
        for cx, cy, spread, count, size in GARDENS:
            for _ in range(count):
                boulder(cx + rng.normal(0, spread), cy + rng.normal(0, spread * 0.6), size * rng.lognormal(0, 0.3))
        for _ in range(90):  # rubble
            boulder(rng.uniform(-8, 8), rng.uniform(-6, 5), rng.lognormal(-2.3, 0.45))

        # The wreck: heeled towards the cameras, sunk into the sand.
        lie = (
            Matrix.Translation((0, 0.4, -0.42))
            @ Matrix.Rotation(-0.12, 4, "Z")
            @ Matrix.Rotation(0.36, 4, "X")
            @ Matrix.Rotation(0.035, 4, "Y")
        )
        timber, iron = wreck(rng)
        self.place(self.mesh("hull", timber, "wood", smooth=False), lie)
        self.place(self.mesh("hull iron", iron, "rust"), lie)
        fallen = Matrix.Translation((0.5, -0.5, 1.65)) @ Matrix.Rotation(-0.62, 4, "Z") @ Matrix.Rotation(0.29, 4, "Y")
        self.place(self.mesh("mast", mast(), "wood"), fallen)
        self.place(
            self.mesh("anchor", anchor(), "rust"),
            Matrix.Translation((-3.35, -2.25, ground(-3.35, -2.25) + 0.32))
            @ Matrix.Rotation(0.5, 4, "Z")
            @ Matrix.Rotation(-1.22, 4, "Y")
            @ Matrix.Rotation(0.5, 4, "Z"),
        )
        pot = self.mesh("amphora", amphora(), "clay")
        for k in range(20):
            x, y = rng.normal(0.95, 0.85), rng.normal(-2.35, 0.45)
            tilt = Matrix.Rotation(rng.uniform(0, 6.28), 4, "Z") @ Matrix.Rotation(
                rng.normal(1.45, 0.16) if k % 5 else 0.3, 4, "X"
            )
            size = rng.uniform(0.6, 0.85)
            self.place(
                pot,
                Matrix.Translation((x, y, ground(x, y) + (0.12 if k % 5 else -0.15))) @ tilt @ Matrix.Scale(size, 4),
            )
        for x, y, lift, turn in (
            (-1.15, -2.3, 0.2, 0.4),
            (-0.55, -2.95, 0.12, 1.1),
            (-1.0, -2.35, 0.72, 0.9),
            (3.4, -2.5, 0.15, 2.0),
        ):
            at = (
                Matrix.Translation((x, y, ground(x, y) + lift))
                @ Matrix.Rotation(turn, 4, "Z")
                @ Matrix.Rotation(rng.normal(0, 0.12), 4, "X")
            )
            self.place(self.mesh("crate", crate(rng), "wood", smooth=False), at @ Matrix.Scale(0.85, 4))
        loose = [
            self.mesh(f"plank {k}", board([-0.9, 0, 0], [0.9, 0, 0], 0.17, 0.05, rng.random(), 4), "wood", smooth=False)
            for k in range(4)
        ]
        for _ in range(26):
            x, y = rng.uniform(-4.5, 5.5), rng.uniform(-3.8, -1.5)
            at = (
                Matrix.Translation((x, y, ground(x, y) + 0.06))
                @ Matrix.Rotation(rng.uniform(0, 6.28), 4, "Z")
                @ Matrix.Rotation(rng.normal(0, 0.12), 4, "Y")
            )
            self.place(loose[rng.integers(4)], at @ Matrix.Diagonal((rng.uniform(0.4, 1.2), 1, 1, 1)))

        # Life, standing on what is there.
        self.depsgraph = bpy.context.evaluated_depsgraph_get()
        kinds: dict[str, list[bpy.types.Mesh]] = {}
        for name, shape, looks in LIFE:
            kinds[name] = [
                self.mesh(f"{name} {look} {k}", shape(rng), look, name != "grass") for look in looks for k in range(2)
            ]

        def stand(names: list[str], weights: list[float], x: float, y: float, size: float) -> None:
            name = rng.choice(names, p=np.array(weights) / sum(weights))
            lean = {"grass": 0.1, "fan": 0.25, "sponge": 0.3, "table": 0.3}.get(name, 0.7)
            self._stand(kinds[name][rng.integers(len(kinds[name]))], x, y, size, lean)

        hard = ["staghorn", "table", "brain", "sponge", "fan", "fingers", "cups", "anemone", "urchin"]
        weights = [5, 2.5, 3, 3, 2, 4, 3, 1.5, 0.6]
        for _ in range(420):
            x = rng.uniform(-10, 10)
            stand(hard, weights, x, 5.2 + 1.2 * np.sin(x * 0.35) + rng.normal(0, 1.3), rng.lognormal(0.1, 0.25))
        for cx, cy, spread, count, _ in GARDENS:
            for _ in range(count * 9):
                stand(
                    hard,
                    weights,
                    cx + rng.normal(0, spread * 1.1),
                    cy + rng.normal(0, spread * 0.7),
                    rng.lognormal(-0.3, 0.25),
                )
        for _ in range(55):
            stand(
                ["grass", "starfish", "urchin", "fingers", "anemone"],
                [5, 2, 1, 1.5, 1],
                rng.uniform(-7, 7),
                rng.uniform(-5.5, -1.4),
                rng.lognormal(-0.45, 0.25),
            )
        for _ in range(46):  # what has settled on the wreck
            t, s = rng.uniform(-0.95, 0.9), rng.choice([-1.0, 1.0, rng.uniform(-0.8, 0.8)])
            at = lie @ Vector(hull(t, s))
            stand(
                ["sponge", "fan", "fingers", "anemone", "staghorn", "cups"],
                [3, 3, 3, 2, 1.5, 1],
                at.x,
                at.y,
                rng.lognormal(-0.75, 0.25),
            )
        for _ in range(14):  # close to the lower cameras
            angle, radius = rng.uniform(-0.7, 0.7), rng.uniform(4.4, 5.0)
            x, y = radius * np.sin(angle), -radius * np.cos(angle)
            stand(["staghorn", "sponge", "grass"], [2, 1, 1.5], x, y, rng.uniform(0.65, 0.95))


GARDENS = (  # coral heads: x, y, spread, rocks, size
    (-4.9, -2.9, 0.75, 7, 0.5),
    (4.6, -3.1, 0.8, 8, 0.5),
    (-2.3, -4.0, 0.5, 5, 0.34),
    (2.5, -3.9, 0.5, 5, 0.36),
    (0.3, -4.0, 0.4, 4, 0.25),
    (-6.6, 0.8, 1.0, 9, 0.8),
    (6.8, 0.6, 1.0, 9, 0.8),
)

LIFE: tuple[tuple[str, Callable[[np.random.Generator], Mesh], tuple[str, ...]], ...] = (
    ("staghorn", staghorn, ("violet", "cream", "blue")),
    ("table", table, ("olive", "rose")),
    ("brain", brain, ("moss", "honey")),
    ("sponge", sponge, ("yellow", "purple", "orange")),
    ("fan", fan, ("red", "magenta")),
    ("fingers", fingers, ("honey", "lilac", "lime")),
    ("cups", cups, ("rose", "olive")),
    ("anemone", anemone, ("pale", "red")),
    ("grass", grass, ("leaf",)),
    ("urchin", urchin, ("black",)),
    ("starfish", starfish, ("red", "orange")),
)


def _materials() -> dict[str, bpy.types.Material]:
    green, pink, rust = (0.10, 0.16, 0.04), (0.42, 0.13, 0.20), (0.42, 0.14, 0.04)

    def coral(base: tuple, other: tuple, tip: tuple, cells: float = 70) -> dict:
        return {"colors": [base, other], "scale": 5, "tip": tip, "cells": cells, "bump": 0.5}

    looks = {
        "sand": dict(
            colors=[(0.34, 0.27, 0.18), (0.56, 0.47, 0.33), (0.66, 0.57, 0.42)],
            scale=0.7,
            fine=14,
            wave=1.1,
            growth=[((0.16, 0.17, 0.08), 0.55, 0.28), ((0.62, 0.56, 0.5), 9, 0.18), ((0.2, 0.14, 0.1), 14, 0.15)],
            vary=0,
            bump=0.5,
        ),
        "rock": dict(
            colors=[(0.13, 0.11, 0.09), (0.31, 0.25, 0.2), (0.48, 0.4, 0.32)],
            scale=2.2,
            fine=7,
            growth=[
                (pink, 2.4, 0.42),
                (green, 1.6, 0.42),
                ((0.48, 0.24, 0.05), 4.5, 0.24),
                ((0.5, 0.45, 0.4), 11, 0.2),
            ],
            vary=0.02,
            bump=0.7,
        ),
        "wood": dict(
            colors=[(0.10, 0.062, 0.036), (0.27, 0.17, 0.095), (0.44, 0.31, 0.19)],
            scale=1.4,
            stretch=(0.5, 5, 5),
            fine=5,
            tip=(0.36, 0.28, 0.20),
            growth=[(green, 1.5, 0.32), (rust, 2.2, 0.26), (pink, 4, 0.2), ((0.46, 0.42, 0.34), 12, 0.14)],
            vary=0.01,
            bump=0.6,
        ),
        "rust": dict(
            colors=[(0.10, 0.035, 0.018), (0.34, 0.11, 0.03), (0.52, 0.23, 0.06)],
            scale=4,
            fine=6,
            growth=[((0.16, 0.17, 0.12), 3, 0.3), (pink, 5, 0.18)],
            vary=0,
            bump=0.9,
        ),
        "clay": dict(
            colors=[(0.34, 0.13, 0.06), (0.52, 0.23, 0.11), (0.6, 0.34, 0.2)],
            scale=2.5,
            fine=8,
            growth=[(green, 3, 0.3), ((0.55, 0.48, 0.4), 6, 0.28)],
            vary=0.02,
            bump=0.5,
        ),
        "violet": coral((0.22, 0.12, 0.46), (0.34, 0.18, 0.55), (0.78, 0.68, 0.9)),
        "cream": coral((0.5, 0.34, 0.16), (0.62, 0.45, 0.24), (0.88, 0.8, 0.62)),
        "blue": coral((0.08, 0.2, 0.5), (0.12, 0.3, 0.58), (0.6, 0.75, 0.9)),
        "olive": coral((0.25, 0.24, 0.08), (0.38, 0.33, 0.12), (0.72, 0.68, 0.42), 45),
        "rose": coral((0.5, 0.16, 0.16), (0.62, 0.25, 0.2), (0.88, 0.6, 0.55), 45),
        "moss": coral((0.10, 0.17, 0.05), (0.2, 0.26, 0.07), (0.55, 0.58, 0.22), 60),
        "honey": coral((0.42, 0.22, 0.05), (0.56, 0.32, 0.08), (0.85, 0.65, 0.28), 60),
        "lilac": coral((0.4, 0.2, 0.42), (0.5, 0.28, 0.5), (0.85, 0.7, 0.85)),
        "lime": coral((0.25, 0.36, 0.05), (0.35, 0.48, 0.1), (0.75, 0.8, 0.4)),
        "yellow": coral((0.68, 0.42, 0.03), (0.78, 0.55, 0.06), (0.16, 0.09, 0.01), 40),
        "purple": coral((0.32, 0.08, 0.34), (0.45, 0.14, 0.45), (0.08, 0.02, 0.1), 40),
        "orange": coral((0.72, 0.2, 0.03), (0.8, 0.3, 0.05), (0.3, 0.06, 0.01), 40),
        "red": coral((0.55, 0.04, 0.03), (0.66, 0.09, 0.05), (0.82, 0.22, 0.1), 50),
        "magenta": coral((0.5, 0.06, 0.3), (0.6, 0.12, 0.38), (0.82, 0.35, 0.6), 50),
        "pale": coral((0.4, 0.36, 0.25), (0.5, 0.46, 0.34), (0.9, 0.75, 0.8)),
        "leaf": dict(colors=[(0.05, 0.14, 0.02), (0.12, 0.25, 0.04)], scale=6, tip=(0.34, 0.42, 0.1), bump=0.1),
        "black": dict(colors=[(0.02, 0.015, 0.025), (0.06, 0.04, 0.07)], scale=8, tip=(0.12, 0.08, 0.14), bump=0.1),
        "fish": dict(
            colors=[(0.85, 0.3, 0.02), (0.95, 0.55, 0.05)], scale=7, fine=5, tip=(0.1, 0.2, 0.75), vary=0.03, bump=0.1
        ),
    }
    return {name: material(name, **settings) for name, settings in looks.items()}


# ---------------------------------------------------------------------------------------------------- cameras


def camera_path(views: int) -> list[np.ndarray]:
    """world_to_camera (4,4) per view, OpenCV axes: a closed loop, out low over the reef and back higher up.

    A loop has no end, so that every view, held out or not, lies between two others. Fewer views are some of the same.
    """
    poses = []
    for k in range(views):
        phase = k / views + 0.25 / 24
        swing = 4 * abs(phase - 0.5) - 1  # 1 .. -1 .. 1: to one side and back
        angle = np.radians(36) * np.sin(swing * np.pi / 2 * 0.8) / np.sin(np.pi / 2 * 0.8)
        lower = np.sin(phase * 2 * np.pi)
        radius = 6.5 - 0.45 * lower + 0.4 * np.cos(phase * 6 * np.pi)
        centre = np.array([radius * np.sin(angle), -radius * np.cos(angle) * 0.98, 0])
        centre[2] = (
            seabed_height(centre[0], centre[1]).item() * 0.3 + 1.75 - 0.75 * lower + 0.12 * np.sin(phase * 10 * np.pi)
        )
        target = np.array([1.1 * np.sin(angle), 0.6, 0.95 + 0.15 * np.cos(phase * 4 * np.pi)])
        forward = target - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        roll = 0.04 * np.sin(phase * 8 * np.pi)
        down = np.cross(forward, right)
        right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, down, forward])
        pose[:3, 3] = -pose[:3, :3] @ centre
        poses.append(pose)
    return poses


# ---------------------------------------------------------------------------------------------------- rendering


@dataclass
class Passes:
    """What one camera sees without water, linear light, float32. Sizes are the supersampled image's."""

    color: np.ndarray  # (H,W,3) multiplied by alpha
    alpha: np.ndarray  # (H,W) 1 where there is a surface, 0 in open water
    range: np.ndarray  # (H,W) metres from the camera's centre along the ray, inf in open water
    sun_share: np.ndarray  # (H,W) fraction of the light that comes straight from the sun
    fish: np.ndarray  # (H,W) fraction of the pixel that a moving object covers
    label: np.ndarray  # (H,W) uint8, place in LABELS of what is seen, counted from 1


class Renderer:
    """Renders a Model's passes in Cycles on the CPU."""

    def __init__(self, model: Model, width: int, height: int, focal: float, samples: int) -> None:
        """`width`, `height` and `focal` in pixels of what is rendered (supersampled)."""
        self.model, self.width, self.height, self.focal = model, width, height, focal
        scene = model.scene
        lens = bpy.data.cameras.new("camera")
        lens.sensor_fit, lens.sensor_width, lens.lens = "HORIZONTAL", 36, focal * 36 / width
        lens.clip_end, lens.clip_start = 1000, 0.05
        self.camera = bpy.data.objects.new("camera", lens)
        scene.collection.objects.link(self.camera)
        scene.camera = self.camera
        scene.render.engine = "CYCLES"
        scene.render.resolution_x, scene.render.resolution_y = width, height
        scene.render.use_persistent_data = True
        scene.render.film_transparent = True
        scene.view_settings.view_transform = "Standard"
        cycles = scene.cycles
        cycles.samples, cycles.use_adaptive_sampling, cycles.seed = samples, False, 0
        cycles.use_denoising = True
        cycles.denoising_prefilter, cycles.denoising_quality = "FAST", "BALANCED"
        cycles.max_bounces = 0  # sun and sky with their shadows; light from surface to surface costs as much again
        cycles.pixel_filter_type = "BOX"
        layer = scene.view_layers[0]
        layer.use_pass_z = layer.use_pass_object_index = True
        tree = bpy.data.node_groups.new("passes", "CompositorNodeTree")
        scene.compositing_node_group = tree
        layers = tree.nodes.new("CompositorNodeRLayers")
        layers.scene = scene
        self.files = tree.nodes.new("CompositorNodeOutputFile")
        self.files.format.media_type = "IMAGE"
        self.files.format.file_format, self.files.format.color_depth = "OPEN_EXR", "32"
        self.files.file_name = ""
        passes = (("Image", "RGBA"), ("Depth", "FLOAT"), ("Combined_sun", "RGBA"), ("Object Index", "FLOAT"))
        for name, kind in passes:
            self.files.file_output_items.new(kind, name)
            tree.links.new(layers.outputs[name], self.files.inputs[name])

    def _shot(self, world_to_camera: np.ndarray) -> dict[str, np.ndarray]:
        to_world = np.linalg.inv(world_to_camera)
        to_world[:3, 1:3] *= -1  # OpenCV's y down, z forward are Blender's -y, -z
        self.camera.matrix_world = Matrix(to_world.tolist())
        with TemporaryDirectory() as folder:
            self.files.directory = folder
            bpy.ops.render.render()
            return {path.stem: _pixels(path) for path in Path(folder).iterdir()}

    def still(self, world_to_camera: np.ndarray) -> Passes:
        """The scene without its moving objects."""
        return self._passes(world_to_camera, self.model.still)

    def _passes(self, world_to_camera: np.ndarray, shown: bpy.types.Collection) -> Passes:
        for collection in (self.model.still, self.model.moving):
            collection.hide_render = collection != shown
        shot = self._shot(world_to_camera)
        color, alpha = shot["Image"][..., :3].clip(0), shot["Image"][..., 3].clip(0, 1)
        depth = shot["Depth"][..., 0].astype(np.float64)
        # Cycles' depth is along the optical axis; the water lies along the ray.
        x = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal
        y = (np.arange(self.height) + 0.5 - self.height / 2) / self.focal
        distance = depth * np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
        distance[depth > 1e6] = np.inf
        near = distance.copy()  # a pixel that a surface covers in part may have missed it with its one depth sample
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                near = np.minimum(near, np.roll(distance, (dy, dx), (0, 1)))
        distance = np.where(np.isinf(distance) & (alpha > 0), near, distance)
        alpha = np.where(np.isinf(distance), 0, alpha)
        luminance = color.mean(-1)
        share = (shot["Combined_sun"][..., :3].mean(-1) / np.maximum(luminance, 1e-4)).clip(0, 1)
        label = shot["Object Index"][..., 0].round().astype(np.uint8)
        label = np.where(np.isinf(distance), 1, np.maximum(label, 1)).astype(np.uint8)
        color = color * (alpha > 0)[..., None]
        return Passes(color, alpha, distance.astype(np.float32), share, np.zeros_like(alpha), label)

    def with_fish(self, passes: Passes, world_to_camera: np.ndarray, rng: np.random.Generator) -> Passes:
        """`passes` with one to three fish swimming before the camera; they cast no shadow."""
        to_world = np.linalg.inv(world_to_camera)
        shape = bpy.data.meshes.get("fish") or self.model.mesh("fish", fish(), "fish")
        heading = rng.choice([0, np.pi]) + rng.normal(0, 0.4)
        for _ in range(rng.integers(1, 4)):
            z = rng.uniform(1.6, 3.2)
            at = to_world @ [z * rng.uniform(-0.45, 0.45), z * rng.uniform(-0.25, 0.2), z, 1]
            turn = Matrix.Rotation(heading + rng.normal(0, 0.15), 4, "Z") @ Matrix.Rotation(rng.normal(0, 0.1), 4, "Y")
            self.model.place(
                shape, Matrix.Translation(at[:3]) @ turn @ Matrix.Scale(rng.uniform(0.9, 1.3), 4), self.model.moving
            )
        own = self._passes(world_to_camera, self.model.moving)
        for item in list(self.model.moving.objects):
            bpy.data.objects.remove(item)
        front = np.where(own.range < passes.range, own.alpha, 0)
        keep = (1 - front)[..., None]
        return Passes(
            own.color * (front > 0)[..., None] + passes.color * keep,
            front + passes.alpha * (1 - front),
            np.where(front > 0.5, own.range, passes.range),
            np.where(front > 0.5, own.sun_share, passes.sun_share),
            front,
            np.where(front > 0.5, own.label, passes.label),
        )

    def volume(
        self,
        poses: list[np.ndarray],
        supersample: int,
        samples: int,
        absorption: RGB,
        scattering: RGB,
        anisotropy: float,
        surface: float,
        light: float,
    ) -> list[np.ndarray]:
        """The scene in a homogeneous medium up to the height `surface`: linear light (H,W,3) per pose.

        `absorption` and `scattering` per metre, the phase function Henyey-Greenstein's; `light` times the light above
        the water than the clean passes have. Images are `supersample` times smaller than the passes.
        """
        scene = self.model.scene
        scene.render.film_transparent = False
        scene.render.resolution_percentage = round(100 / supersample)
        scene.cycles.samples = samples
        scene.cycles.max_bounces, scene.cycles.volume_bounces, scene.cycles.diffuse_bounces = 3, 3, 0
        bpy.data.lights["sun"].energy *= light
        scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value *= light
        water = bpy.data.materials.new("water")
        water.use_nodes = True
        tree = water.node_tree
        tree.nodes.clear()
        both, output = tree.nodes.new("ShaderNodeAddShader"), tree.nodes.new("ShaderNodeOutputMaterial")
        absorb, scatter = tree.nodes.new("ShaderNodeVolumeAbsorption"), tree.nodes.new("ShaderNodeVolumeScatter")
        # The coefficient is density * (1 - color) in the one, density * color in the other.
        absorb.inputs["Density"].default_value = max(absorption)
        absorb.inputs["Color"].default_value = (*(1 - a / max(absorption) for a in absorption), 1)
        scatter.inputs["Density"].default_value = max(scattering)
        scatter.inputs["Color"].default_value = (*(s / max(scattering) for s in scattering), 1)
        scatter.inputs["Anisotropy"].default_value = anisotropy
        for k, node in enumerate((absorb, scatter)):
            tree.links.new(node.outputs[0], both.inputs[k])
        tree.links.new(both.outputs[0], output.inputs["Volume"])
        bottom = -6.0
        bpy.ops.mesh.primitive_cube_add(
            size=1, location=(0, 0, (surface + bottom) / 2), scale=(120, 120, surface - bottom)
        )
        box = bpy.context.object
        box.data.materials.append(water)
        self.model.still.hide_render, self.model.moving.hide_render = False, True
        images = [self._shot(pose)["Image"][..., :3].clip(0) for pose in poses]
        bpy.data.objects.remove(box)
        return images


def _pixels(path: Path) -> np.ndarray:
    """An EXR's values (H,W,C) float32, top row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, -1)[::-1].copy()
