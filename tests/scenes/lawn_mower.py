"""COLMAP models of surveys: a camera that looks down and goes there and back over an uneven floor.

Models are written directly, as pycolmap takes long to make large ones. All photos are links to one.
"""

import os
import struct
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 160, 120, 120.0
ABOVE = 2.0
"""Height of the camera above the floor: photos show 2.67 by 2 units."""
STEPS = 0.6, 0.9
"""Distances between neighboring photos of a row, and between rows."""
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
ELEMENT = np.dtype([("image", "<u4"), ("row", "<u4")])
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def write_lawn_mower(
    folder: Path,
    columns: int,
    rows: int,
    points: int,
    matched: float = 0.65,
    unmatched: int = 0,
    places: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
    seed: int = 0,
) -> Path:
    """Write photos and a binary model to `folder`; return it.

    Args:
        folder: The folder of the scene.
        columns: Photos of a row, along x.
        rows: Rows of a place.
        points: Sparse points of a place.
        matched: Probability that a photo observes a point in its frame.
        unmatched: Features of a photo that are no points.
        places: Offsets (x, y) of places like this, between which no photo sees a point of both.
        seed: Seed of the points.
    """
    random = np.random.default_rng(seed)
    width, depth = (columns - 1) * STEPS[0], (rows - 1) * STEPS[1]
    positions, centres, seen = [], [], []
    for number, offset in enumerate(places):
        place = random.uniform((-1.3, -1.0), (width + 1.3, depth + 1.0), (points, 2)) + offset
        place = place[np.argsort(place[:, 1])]
        relief = 0.2 * np.sin(place[:, 0]) * np.cos(1.3 * place[:, 1])
        positions.append(np.column_stack([place, relief]))
        for row in range(rows):
            y = row * STEPS[1] + offset[1]
            strip = slice(*np.searchsorted(place[:, 1], (y - 1.5, y + 1.5)))
            order = np.argsort(place[strip, 0]) + strip.start
            for column in range(columns):
                x = (column if row % 2 == 0 else columns - 1 - column) * STEPS[0] + offset[0]
                near = order[slice(*np.searchsorted(place[order, 0], (x - 1.8, x + 1.8)))]
                local = (positions[-1][near] - (x, y, ABOVE)) * (1, -1, -1)
                pixels = FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)
                within = ((pixels >= 0) & (pixels < (WIDTH, HEIGHT))).all(1) & (random.random(len(near)) < matched)
                centres.append((x, y, ABOVE))
                seen.append((near[within] + number * points, pixels[within]))
    _write(folder, np.concatenate(positions), np.array(centres), seen, unmatched)
    return folder


def _write(folder: Path, positions: np.ndarray, centres: np.ndarray, seen: list, unmatched: int) -> None:
    images, model = folder / "images", folder / "sparse" / "0"
    images.mkdir(parents=True)
    model.mkdir(parents=True)
    photo = images / "00001.jpg"
    cv2.imwrite(str(photo), np.random.default_rng(1).integers(60, 200, (HEIGHT, WIDTH, 3), np.uint8))
    camera = (1, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (model / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, *camera))
    counts = np.zeros(len(positions), np.int64)
    with open(model / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(centres)))
        for number, (centre, (rows, pixels)) in enumerate(zip(centres, seen, strict=True), 1):
            name = f"{number:05d}.jpg"
            if number > 1:
                os.link(photo, images / name)
            # Half a turn about x: the camera looks down, and its image's top is where y grows.
            translation = -centre * (1, -1, -1)
            file.write(struct.pack("<I7dI", number, 0, 1, 0, 0, *translation, 1) + name.encode() + b"\0")
            features = np.zeros(len(rows) + unmatched, OBSERVATION)
            features["xy"][: len(rows)], features["point"][: len(rows)] = pixels, rows + 1
            features["point"][len(rows) :] = 2**64 - 1
            file.write(struct.pack("<Q", len(features)) + features.tobytes())
            counts[rows] += 1
    ends = np.cumsum(counts)
    elements, filled = np.zeros(counts.sum(), ELEMENT), ends - counts
    for number, (rows, _) in enumerate(seen, 1):
        elements["image"][filled[rows]], elements["row"][filled[rows]] = number, np.arange(len(rows))
        filled[rows] += 1
    kept = np.flatnonzero(counts)  # COLMAP has no points without a track
    head = np.zeros(len(kept), POINT)
    head["id"], head["xyz"], head["color"], head["error"] = kept + 1, positions[kept], (120, 130, 90), 0.5
    head["track"] = counts[kept]
    with open(model / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(kept)))
        records, bounds = head.tobytes(), zip((ends - counts)[kept], ends[kept], strict=True)
        for number, (start, end) in enumerate(bounds):
            file.write(records[number * POINT.itemsize : (number + 1) * POINT.itemsize])
            file.write(elements[start:end].tobytes())
