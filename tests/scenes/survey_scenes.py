"""Surveys of many photos with known truth: a reef under water, a street in air, and a large model without photos.

    python tests/scenes/survey_scenes.py --out DIR --kind reef --images 300
    python tests/scenes/survey_scenes.py --out DIR --kind street --images 300
    python tests/scenes/survey_scenes.py --out DIR --kind model --images 5000 --points 5000000

More images make a longer place, so that each part of it is seen by as many. A reef of 300 images is 60 m long, a street
240 m. The scene model's unit is the metre, z is up, x is along the place.

Files in DIR:
    images/NAME.jpg       the photos
    sparse/0/             the COLMAP model (binary): exact poses, points triangulated from observations with noise
    clean/NAME.webp       what the held-out photos (every eighth) look like without water
    range/NAME.png        their ranges, 16 bit, millimetres, 0 where nothing is
    truth.json            water, gain of each photo, held-out photos

A large model has one photo, to which all its image files are links.
"""

import json
import os
import struct
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.scenes.boxes import Place, passes_of, texture
from tests.scenes.camera_paths import FARTHEST, Floor, Ground, rock
from tests.scenes.effect_scenes import looking
from tests.scenes.make_scene import (
    HELD_OUT,
    JPEG,
    LOSSLESS_WEBP,
    PIXEL_NOISE,
    PNG,
    Settings,
    Water,
    averaged,
    nearest_range,
    photograph,
    srgb,
    to_8bit,
    write_model,
)
from tests.scenes.reef_model import Passes

WIDTH = 320
"""Width of the photos, pixels; their height is three quarters of it."""
FOCAL = 0.8
"""Focal length over the width."""
POINTS_PER_IMAGE = 80
"""Sparse points for each photo of 320 pixels; smaller photos have fewer, as their width has."""
ALTITUDE = 2.8
"""Height of the cameras over the reef, metres."""
REEF_WATER = Water()
AIR = Water((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.35, 0.55, 0.95))
"""Nothing between camera and surface, and the color of the sky behind."""
CORALS = ((0.62, 0.30, 0.12), (0.60, 0.24, 0.34), (0.62, 0.52, 0.16), (0.34, 0.22, 0.48), (0.16, 0.36, 0.12))
"""Colors of corals, linear light."""
CORALS_PER_SQUARE_METRE = 0.8
SUN = np.array([0.4, 0.3, 0.87], np.float32)

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Lanes:
    """Path over a reef: lanes across it, straight down, then rows along both sides that look inwards.

    Attributes:
        per_lane: Photos of a lane.
        spacing: Distance of the lanes, metres.
        side_rows: Number of rows along the sides, 1 or 2.
    """

    per_lane: int = 5
    spacing: float = 1.6
    side_rows: int = 2

    @property
    def width(self) -> float:
        """Length of a lane, metres."""
        return 1.25 * (self.per_lane - 1)

    def counts(self, images: int) -> tuple[int, int]:
        """Number of lanes, and number of photos of the rows along the sides."""
        lanes = round(0.625 * images / self.per_lane)
        return lanes, images - lanes * self.per_lane

    def length(self, images: int) -> float:
        """Length of the reef, metres."""
        return self.spacing * self.counts(images)[0]


SURVEY = Lanes()
TINY = Lanes(per_lane=1, spacing=1.3, side_rows=1)
"""One straight line, and one row beside it: few photos, most of which do not see the same place."""


def reef_poses(images: int, lanes: Lanes = SURVEY) -> list[np.ndarray]:
    """Return world_to_camera (4, 4) of each photo, in the order in which they are taken."""
    count, beside = lanes.counts(images)
    length, half = lanes.length(images), lanes.width / 2
    centres, targets, ups = [], [], []
    for lane in range(count):
        back = 1 if lane % 2 == 0 else -1
        for across in np.linspace(-half, half, lanes.per_lane) if lanes.per_lane > 1 else [0.0]:
            centre = np.array([(lane + 0.5) * lanes.spacing - length / 2, back * across, ALTITUDE])
            centres.append(centre)
            targets.append(centre - [0, 0, ALTITUDE])
            ups.append(np.array([0.0, back, 0.0]) if lanes.per_lane > 1 else np.array([1.0, 0.0, 0.0]))
    for number in range(beside):
        row = number * lanes.side_rows // beside
        first, last = (-(-at * beside // lanes.side_rows) for at in (row, row + 1))
        side = -1 if row == 0 else 1
        along = side * ((number - first + 0.5) / (last - first) - 0.5)
        centre = np.array([-along * length, side * (half + 1.9), 2.3])
        centres.append(centre)
        targets.append(np.array([centre[0], side * (half - 0.9), 0.0]))
        ups.append(UP)
    return [_held(*place, k) for k, place in enumerate(zip(centres, targets, ups, strict=True))]


STREET_LENGTH = 0.8
"""Metres of a street for each image: blocks of a shorter one would nearly all see each other."""


def street_poses(images: int) -> list[np.ndarray]:
    """Return world_to_camera (4, 4) of four passes along a street: to either side, ahead, and back."""
    length, poses = STREET_LENGTH * images, []
    for k in range(images):
        line = k * 4 // images
        first, last = (-(-at * images // 4) for at in (line, line + 1))
        along = ((k - first + 0.5) / (last - first) - 0.5) * (1 if line % 2 == 0 else -1)
        y, ahead, aside, down = ((-2.2, 1, 1.4, 0.1), (2.2, -1, -1.4, 0.1), (-0.8, 1, 0.3, 0.2), (0.8, -1, -0.3, 0.2))[
            line
        ]
        centre = np.array([along * length, y, 1.7])
        poses.append(_held(centre, centre + [ahead, aside, -down], UP, k))
    return poses


def _held(centre: np.ndarray, target: np.ndarray, up: np.ndarray, number: int) -> np.ndarray:
    """Return the pose of a camera that is held by hand: some centimetres and degrees off."""
    sway = np.sin(number * np.array([0.71, 1.13, 0.47]) + [0.3, 1.9, 4.1])
    turn = np.sin(number * np.array([0.83, 0.59, 1.31]) + [2.2, 0.7, 3.3])
    away = np.linalg.norm(target - centre)
    return looking(centre + 0.12 * sway, target + 0.06 * away * turn, up)


def exposure_gains(images: int) -> np.ndarray:
    """Return the gains (N,) of a camera whose exposure drifts from photo to photo: no more than 2 % a photo, and
    some 30 % between parts of the survey."""
    at = np.arange(images)
    return np.exp(0.16 * np.sin(2 * np.pi * at / 170) + 0.07 * np.sin(2 * np.pi * at / 61 + 1))


class Reef(Ground):
    """Sand and rocks with corals of 8 cm to 1 m on them, in five colors."""

    def __init__(self, size: tuple[float, float], texel: float, seed: int) -> None:
        random = np.random.default_rng((seed, 21))
        super().__init__(Floor(size, relief=0.8), random, texel)
        rows, columns = self.heights.shape
        for _ in range(round(CORALS_PER_SQUARE_METRE * size[0] * size[1])):
            radius = 0.08 * (1 / 0.08) ** (random.random() ** 2.5)
            added = rock(radius, random.uniform(0.5, 0.9) * radius**0.8, random)
            reach = len(added) // 2
            row, column = random.integers(0, rows), random.integers(0, columns)
            top, left = max(0, row - reach), max(0, column - reach)
            place = slice(top, row + reach), slice(left, column + reach)
            shown = added[top - row + reach :, left - column + reach :]
            shown = shown[: self.heights[place].shape[0], : self.heights[place].shape[1]]
            self.heights[place] += shown
            self.colors[place][shown > 0] = np.array(CORALS[random.integers(len(CORALS))]) * random.uniform(0.8, 1.2)
        self.heights = np.minimum(self.heights, 0.6 + 0.5 * np.tanh((self.heights - 0.6) / 0.5))
        self.find_slopes()

    def passes(self, pose: np.ndarray, width: int, height: int, focal: float) -> Passes:
        """Return what a camera sees without water; see `boxes.passes_of`."""
        x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
        rays = np.dstack([x, y, np.ones_like(x)])
        rays = (rays / np.linalg.norm(rays, axis=2, keepdims=True)).astype(np.float32) @ pose[:3, :3].astype(np.float32)
        centre = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)
        # Rows apart: those that look down need fewer steps than those that look ahead.
        ranges = np.concatenate([self.hit(centre, rows) for rows in np.array_split(rays, 16)])
        points = centre + rays * ranges[..., None]
        normals = self.sample(self.normals, points[..., 0], points[..., 1])
        facing = np.clip(-(normals * rays).sum(-1), 0.15, 1)
        light = 0.4 + 0.6 * np.clip(normals @ SUN, 0, 1)
        seen = ranges < FARTHEST
        color = self.albedo(points, ranges / focal / np.sqrt(facing)) * (light * seen)[..., None]
        empty = np.zeros(seen.shape, np.float32)
        return Passes(
            color.astype(np.float32),
            seen.astype(np.float32),
            np.where(seen, ranges, np.inf).astype(np.float32),
            empty,
            empty,
            empty.astype(np.uint8),
        )


def street_place(length: float, seed: int) -> Place:
    """Return two rows of houses and what stands between them, without mirrors; x from -length / 2 to length / 2."""
    random = np.random.default_rng((seed, 22))
    paints = [[0.45, 0.16, 0.1], [0.6, 0.5, 0.3], [0.55, 0.53, 0.5], [0.35, 0.4, 0.3], [0.5, 0.32, 0.2]]
    walls = [texture(random, np.array(paint), True) for paint in paints]
    plain = [texture(random, random.uniform(0.05, 0.6, 3), False) for _ in range(4)]
    end = length / 2 + 30
    boxes: list[list[list[float]]] = [[[-end - 40, -60, -1], [end + 40, 60, 0]]]
    textures = [texture(random, np.array([0.2, 0.19, 0.18]), False)]
    for side in (-1, 1):
        x = -end
        while x < end:
            wide, front, tall = random.uniform(6, 11), random.uniform(5, 7.5), random.uniform(4, 10)
            near, far = sorted((side * front, side * (front + 8)))
            boxes.append([[x, near, 0], [x + wide, far, tall]])
            textures.append(walls[random.integers(len(walls))])
            x += wide + random.uniform(0, 2)
    for _ in range(round(0.7 * length)):
        x, size = random.uniform(-length / 2 - 8, length / 2 + 8), random.uniform(0.3, 0.9, 3)
        y = random.choice([-1, 1]) * random.uniform(3.0, 4.6) - size[1] / 2
        boxes.append([[x, y, 0], [x + size[0], y + size[1], 2 * size[2]]])
        textures.append(plain[random.integers(len(plain))])
    return Place(np.array(boxes, float), textures, None, False, 0.0)


def reef(
    folder: Path, images: int = 300, width: int = WIDTH, seed: int = 0, lanes: Lanes = SURVEY, water: Water = REEF_WATER
) -> Path:
    """Write a survey of a reef to a new folder, and return the folder."""
    margin = 8.5
    size = (lanes.length(images) + 2 * margin, lanes.width + 2 * margin)
    ground = Reef(size, 0.6 * ALTITUDE / (FOCAL * width), seed)
    poses = reef_poses(images, lanes)
    return _write(folder, "reef", poses, exposure_gains(images), ground.passes, water, width, seed)


def street(folder: Path, images: int = 300, width: int = WIDTH, seed: int = 0) -> Path:
    """Write a survey of a street to a new folder, and return the folder."""
    place = street_place(STREET_LENGTH * images, seed)

    def passes(pose: np.ndarray, *size: float) -> Passes:
        return passes_of(place, pose, *size)  # type: ignore[arg-type]

    return _write(folder, "street", street_poses(images), np.ones(images), passes, AIR, width, seed)


def tiny_survey(folder: Path, images: int = 20, width: int = 64, seed: int = 0) -> Path:
    """Write a survey of a reef that is made in seconds: one line along it and one beside it, 1.3 m between photos."""
    return reef(folder, images, width, seed, TINY)


def _write(
    folder: Path,
    kind: str,
    poses: list[np.ndarray],
    gains: np.ndarray,
    passes: Callable[[np.ndarray, int, int, float], Passes],
    water: Water,
    width: int,
    seed: int,
) -> Path:
    """Photograph a place from all poses, one after another, and write the scene."""
    height, focal = round(0.75 * width), FOCAL * width
    settings = Settings(folder, views=len(poses), width=width, height=height, seed=seed, water=water)
    factor = settings.supersample
    names = [f"{kind}_{number:04d}.jpg" for number in range(len(poses))]
    for part in ("images", "clean", "range"):
        (folder / part).mkdir(parents=True)
    random = np.random.default_rng((seed, 23))
    images, ranges = [], []
    for number, (name, pose, gain) in enumerate(zip(names, poses, gains, strict=True)):
        seen = passes(pose, width * factor, height * factor, focal * factor)
        images.append(to_8bit(photograph(seen, settings, focal * factor, pose, 0.0, gain, random)))
        ranges.append(nearest_range(seen.range, seen.alpha, factor))
        cv2.imwrite(str(folder / "images" / name), images[-1][..., ::-1], JPEG)
        if number % HELD_OUT == 0:
            clean = to_8bit(srgb(averaged(seen.color, factor)))[..., ::-1]
            cv2.imwrite(str((folder / "clean" / name).with_suffix(".webp")), clean, LOSSLESS_WEBP)
            millimetres = np.where(np.isinf(ranges[-1]), 0, ranges[-1] * 1000).round().clip(0, 65535)
            cv2.imwrite(str((folder / "range" / name).with_suffix(".png")), millimetres.astype(np.uint16), PNG)
    wanted = round(POINTS_PER_IMAGE * len(poses) * width / WIDTH)
    points = write_model(folder / "sparse" / "0", names, poses, focal, images, ranges, wanted, random)
    truth = {
        "water": {**asdict(water), "per": "metre"} if any(water.beta_D) else None,
        "gains": dict(zip(names, gains.tolist(), strict=True)),
        "held_out": names[::HELD_OUT],
        "points": points,
        "observation_noise_px": PIXEL_NOISE,
        "seed": seed,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return folder


# A model without photos


SPACING = (0.78, 0.58)
"""Distance of neighbouring cameras of a large model along x and y, metres: sixteen see a place."""
TRACKS = ((3, 0.4), (4, 0.3), (6, 0.2), (9, 0.1))
"""Lengths of tracks, and the fraction of the points that have each."""


def large_model(folder: Path, images: int = 5000, points: int = 5_000_000, seed: int = 0) -> Path:
    """Write the COLMAP model (binary) of a survey straight down over a floor that is twice as long as wide.

    Args:
        folder: The new folder; its image files are links to one photo.
        images: Number of images.
        points: Number of sparse points.
        seed: Of points and noise.
    """
    random = np.random.default_rng((seed, 24))
    width, height, focal = WIDTH, round(0.75 * WIDTH), FOCAL * WIDTH
    rows = max(4, round(np.sqrt(images * SPACING[0] / SPACING[1] / 2)))
    while 0 < images % rows < 4:  # images of a lane that is too short would see no point
        rows += 1
    columns = -(-images // rows)
    lane = np.arange(images) // rows
    row = np.where(lane % 2 == 0, np.arange(images) % rows, rows - 1 - np.arange(images) % rows)
    number_at = np.full((columns, rows), -1)
    number_at[lane, row] = np.arange(images)
    centres = np.stack([lane * SPACING[0], row * SPACING[1], np.full(images, ALTITUDE)], 1)
    centres += random.normal(0, 0.02, centres.shape)

    # A point lies in the square between four cameras; those that see it are of the four by four around it.
    around = np.stack(np.meshgrid(np.arange(-1, 3), np.arange(-1, 3)), -1).reshape(-1, 2)
    corners = np.stack(np.meshgrid(np.arange(1, columns - 2), np.arange(1, rows - 2)), -1).reshape(-1, 2)
    cells = corners[:, None] + around
    corners = corners[(number_at[cells[..., 0], cells[..., 1]] >= 0).all(1)]
    corner = corners[random.integers(len(corners), size=points)]
    places = np.empty((points, 3))
    places[:, :2] = (corner + random.random((points, 2))) * SPACING
    places[:, 2] = 0.1 * np.sin(0.7 * places[:, 0]) * np.cos(0.9 * places[:, 1]) + random.normal(0, 0.02, points)
    orders = np.array([random.permutation(around) for _ in range(64)])
    lengths = [length for length, _ in TRACKS]
    ends = np.round(np.cumsum([fraction for _, fraction in TRACKS]) * points).astype(int)
    observer, observed = [], []
    for length, begin, end in zip(lengths, [0, *ends[:-1]], ends, strict=True):
        cells = corner[begin:end, None] + orders[random.integers(len(orders), size=end - begin), :length]
        observer.append(number_at[cells[..., 0], cells[..., 1]].astype(np.int32).ravel())
        observed.append(np.repeat(np.arange(begin, end), length))
    image_of, point_of = np.concatenate(observer), np.concatenate(observed)
    order = np.argsort(image_of, kind="stable")
    starts = np.searchsorted(image_of[order], np.arange(images + 1))
    feature = np.empty(len(order), np.int32)
    feature[order] = np.arange(len(order)) - starts[image_of[order]]

    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    lens = struct.pack("<QiiQQ4d", 1, 1, 1, width, height, focal, focal, width / 2, height / 2)
    (model / "cameras.bin").write_bytes(lens)
    names = [f"photo_{number:05d}.jpg" for number in range(images)]
    keypoints = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    with (model / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", images))
        for number, name in enumerate(names):
            own = order[starts[number] : starts[number + 1]]
            local = places[point_of[own]] - centres[number]
            features = np.empty(len(own), keypoints)
            # Straight down: x of the camera is x, y of the camera is -y.
            features["xy"] = local[:, :2] * [1, -1] / -local[:, 2:] * focal + [width / 2, height / 2]
            features["xy"] += random.normal(0, PIXEL_NOISE, features["xy"].shape)
            features["point"] = point_of[own] + 1
            shift = -centres[number] * [1, -1, -1]
            file.write(struct.pack("<i7di", number + 1, 0.0, 1.0, 0.0, 0.0, *shift, 1) + name.encode() + b"\0")
            file.write(struct.pack("<Q", len(own)) + features.tobytes())
    with (model / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", points))
        for record in _point_records(places, lengths, ends, observer, feature, random):
            record.tofile(file)

    photos = folder / "images"
    photos.mkdir()
    shown = random.integers(60, 190, (height // 16, width // 16, 3)).astype(np.uint8)
    shown = cv2.resize(shown, (width, height), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(photos / names[0]), shown, [cv2.IMWRITE_JPEG_QUALITY, 50])
    for name in names[1:]:
        os.link(photos / names[0], photos / name)
    return folder


def _point_records(
    places: np.ndarray,
    lengths: list[int],
    ends: np.ndarray,
    observer: list[np.ndarray],
    feature: np.ndarray,
    random: np.random.Generator,
) -> Iterator[np.ndarray]:
    """Yield the records of points3D.bin, those of tracks of one length together."""
    begin, at = 0, 0
    for length, end, images in zip(lengths, ends, observer, strict=True):
        kind = np.dtype(
            [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
            + [("track", "<i4", (length, 2))]
        )
        record = np.empty(end - begin, kind)
        record["id"] = np.arange(begin, end) + 1
        record["xyz"] = places[begin:end] + random.normal(0, 0.003, (end - begin, 3))
        record["rgb"] = random.integers(40, 200, (end - begin, 3))
        record["error"] = 0.4
        record["length"] = length
        record["track"][..., 0] = images.reshape(-1, length) + 1
        record["track"][..., 1] = feature[at : at + len(images)].reshape(-1, length)
        yield record
        begin, at = int(end), at + len(images)


def main() -> None:
    """Write the survey that the command line asks for."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the new folder")
    parser.add_argument("--kind", choices=["reef", "street", "model"], required=True)
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--points", type=int, default=5_000_000, help="sparse points of --kind model")
    parser.add_argument("--width", type=int, default=WIDTH, help="width of the photos, pixels")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.kind == "model":
        large_model(options.out, options.images, options.points, options.seed)
    else:
        {"reef": reef, "street": street}[options.kind](options.out, options.images, options.width, options.seed)


if __name__ == "__main__":
    main()
