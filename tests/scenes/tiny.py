"""A COLMAP scene that trains in seconds: a wall of colored discs, seen from an arc of cameras."""

from pathlib import Path

import cv2
import numpy as np


def make_tiny_scene(folder: Path, views: int = 10, width: int = 64, height: int = 48, points: int = 300) -> Path:
    """Write `views` images and a COLMAP text model (PINHOLE) of a wall of colored discs to `folder`; return it."""
    random = np.random.default_rng(5)
    positions = np.column_stack([random.uniform(-2, 2, (points, 2)), random.uniform(-0.3, 0.3, points)])
    colors = random.integers(30, 226, (points, 3))
    focal = 0.9 * width
    images, model = folder / "images", folder / "sparse" / "0"
    images.mkdir(parents=True)
    model.mkdir(parents=True)
    lines = []
    for index in range(views):
        angle = np.radians(-20 + 40 * index / max(1, views - 1))
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        translation = np.array([0, 0, 4.0])
        in_camera = positions @ rotation.T + translation
        pixels = np.full((height, width, 3), (90, 70, 40), np.uint8)
        for p in np.argsort(-in_camera[:, 2]):
            x, y = focal * in_camera[p, :2] / in_camera[p, 2] + (width / 2, height / 2)
            radius = focal * 0.12 / in_camera[p, 2]
            center = (round((x - 0.5) * 16), round((y - 0.5) * 16))
            cv2.circle(pixels, center, round(radius * 16), colors[p, ::-1].tolist(), -1, cv2.LINE_AA, shift=4)
        cv2.imwrite(str(images / f"view_{index:02d}.png"), pixels)
        half = angle / 2
        pose = (np.cos(half), 0, np.sin(half), 0, *translation)
        lines.append(f"{index + 1} {' '.join(map(repr, map(float, pose)))} 1 view_{index:02d}.png\n\n")
    (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text(
        "".join(
            f"{i + 1} {p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]} 0.5\n"
            for i, (p, c) in enumerate(zip(positions, colors, strict=True))
        )
    )
    return folder
