"""Photos of textured panels in dim water, from a camera that moves sideways: a COLMAP model of them takes seconds."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

SIZE = (320, 240)


def panels() -> list[tuple[np.ndarray, np.ndarray]]:
    """Textured rectangles in space, far to near: (texture, four corners (4, 3) in the world)."""
    random = np.random.default_rng(7)
    places = [(0, 0, 7.0, 9, 6)] + [(x, y, z, 0.8, 0.8) for z in (6, 5, 4.5) for x in (-3, -1, 1, 3) for y in (-1, 1)]
    result = []
    for x, y, z, half_width, half_height in places:
        x, y = x + random.uniform(-0.4, 0.4), y + random.uniform(-0.3, 0.3)
        rows, columns = int(60 * half_height), int(60 * half_width)
        texture = sum(
            cv2.resize(
                random.normal(0, 28, (rows // k, columns // k, 3)), (columns, rows), interpolation=cv2.INTER_CUBIC
            )
            for k in (2, 5, 12)
        )
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [half_width, half_height, 0] + [x, y, z]
        result.append((np.clip(texture + 110, 0, 255).astype(np.uint8), corners))
    return result


PANELS = panels()


def render(x: float, yaw: float = 0, zoom: float = 1) -> np.ndarray:
    """The panels from (x, 0, 0), looking along z with a focal length of 1.1 widths, through dim blue-green water.

    `yaw` turns the camera to the right, in radians; `zoom` lengthens the focal length.
    """
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for texture, corners in PANELS:
        seen = (corners - [x, 0.1 * np.sin(2 * x), 0]) @ cv2.Rodrigues(np.array([0, yaw, 0.0]))[0]
        pixels = 1.1 * zoom * SIZE[0] * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2
        rows, columns = texture.shape[:2]
        source = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float32)
        warp = cv2.getPerspectiveTransform(source - 0.5, pixels.astype(np.float32) - 0.5)
        cv2.warpPerspective(texture, warp, SIZE, picture, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return (picture * [0.45, 0.4, 0.2] + [40, 35, 5]).astype(np.uint8)


def write_photos(folder: Path, places: Iterable[float]) -> Path:
    """Write a photo, 0.png, 1.png and so on, from each x of `places` to a folder; return it."""
    folder.mkdir(parents=True)
    for index, x in enumerate(places):
        (folder / f"{index}.png").write_bytes(cv2.imencode(".png", render(x))[1].tobytes())
    return folder
