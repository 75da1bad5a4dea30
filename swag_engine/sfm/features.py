"""Features of the images and their matches, in COLMAP's database."""

import math
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..scene.colmap_library import pycolmap
from ..scene.images import read_image
from .pairs import COARSE_FEATURES, choose_pairs
from .photos import copy_name, reader_options

FEATURE_PIXELS = 2000
"""Longest side in pixels at which features are detected: water blurs finer detail."""
_DOUBLED_BELOW = 800
"""Longest side in pixels below which images are doubled to detect features, because small ones have too few. Larger
ones would take four times as long, and no more of their cameras would be placed."""
FEATURES = 4096
"""Features of an image, at most: the time to match a pair grows with their square."""
_GOOD_MATCHES = 100
"""Matches that fit the geometry of a pair, at least, for its other matches to count as moving objects."""
_PROCESS_BYTES = 150e6
"""Memory of a process that has loaded COLMAP (measured)."""
_PIXEL_BYTES = 100
"""Memory per pixel of an image while its features are detected: the scale space and its gradients (measured: 85)."""
_FEATURE_BYTES = 1200
"""Memory per feature of all images in mapping: matches, tracks and bundle adjustment (measured: 1200 at 40 images)."""
_EARTH_RADIUS = 6_371_000.0
"""Metres."""


@dataclass(frozen=True)
class ImageData:
    """What the file of an image says about it.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_length: From EXIF, in pixels, None without.
        position: Latitude and longitude in degrees, from EXIF, NaN without.
        time: Modification time of the file, seconds; the time of exposure unless the file was edited or copied.
    """

    width: int
    height: int
    focal_length: float | None
    position: tuple[float, float]
    time: float

    @classmethod
    def read(cls, path: Path) -> "ImageData":
        """Read the data of a file, without its EXIF data where COLMAP cannot read the file."""
        picture = pycolmap.Bitmap.read(str(path), as_rgb=False)
        if picture is None:
            height, width = read_image(path)[0].shape[:2]
            return cls(width, height, None, (math.nan, math.nan), path.stat().st_mtime)
        latitude, longitude = picture.exif_latitude(), picture.exif_longitude()
        position = (math.nan, math.nan) if latitude is None or longitude is None else (latitude, longitude)
        return cls(picture.width, picture.height, picture.exif_focal_length(), position, path.stat().st_mtime)


def camera_groups(images: list[ImageData]) -> list[list[int]]:
    """Return groups of images of the same size and focal length. They share a camera, so that it is more certain."""
    groups: dict[tuple[int, int, float | None], list[int]] = {}
    for number, image in enumerate(images):
        groups.setdefault((image.width, image.height, image.focal_length), []).append(number)
    return list(groups.values())


def extraction_options(width: int, height: int) -> pycolmap.FeatureExtractionOptions:
    """Return the options of feature detection in images of a width and a height in pixels."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = FEATURE_PIXELS
    options.sift.max_num_features = FEATURES
    options.sift.first_octave = -1 if _is_doubled(width, height) else 0
    return options


def estimate_memory(images: list[ImageData]) -> int:
    """Estimate the peak memory in bytes that features, matching and mapping need, from the sizes of the images."""
    threads = min(os.cpu_count() or 1, len(images))
    pixels = []
    for image in images:
        longest = max(image.width, image.height)
        scale = 2.0 if _is_doubled(image.width, image.height) else min(1.0, FEATURE_PIXELS / longest)
        pixels.append(image.width * image.height * scale**2)
    detection = _PIXEL_BYTES * sum(sorted(pixels)[-threads:])
    return int(_PROCESS_BYTES + max(detection, _FEATURE_BYTES * FEATURES * len(images)))


def _is_doubled(width: int, height: int) -> bool:
    return max(width, height) < _DOUBLED_BELOW


def extract_features(database: Path, pictures: Path, images: list[ImageData]) -> None:
    """Detect features in the grey copies of the images and write them to the database.

    Images are entered in their order first: detection enters each when its features are done, so that its id, and with
    it the order of all further steps, would depend on which thread is faster.

    Args:
        database: COLMAP's database, which is made.
        pictures: Folder of the grey copies (see `photos.equalise`).
        images: Data of the images.
    """
    with pycolmap.Database.open(str(database)):
        pass  # makes the file
    for group in camera_groups(images):
        first = images[group[0]]
        known = first.focal_length
        params = f"{known},{first.width / 2},{first.height / 2},0" if known else ""
        names = [copy_name(number) for number in group]
        mode = pycolmap.CameraMode.SINGLE
        reader = reader_options(pictures, "SIMPLE_RADIAL", params)
        pycolmap.import_images(str(database), str(pictures), mode, names, reader)
        pycolmap.extract_features(
            str(database), str(pictures), names, mode, reader, extraction_options(first.width, first.height)
        )


def match_features(database: Path, images: list[ImageData], say_pairs: Callable[[int], None]) -> int:
    """Match the features of pairs of images that probably overlap (see `pairs.choose_pairs`).

    Args:
        database: COLMAP's database with the features.
        images: Data of the images.
        say_pairs: Called with the number of pairs before they are matched.

    Returns:
        The number of pairs.
    """
    count = len(images)
    with pycolmap.Database.open(str(database)) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        coarse = [_coarse_descriptors(opened, ids[copy_name(number)]) for number in range(count)]
    by_time = sorted(range(count), key=lambda number: (images[number].time, number))
    pairs = choose_pairs(coarse, (range(count), by_time), _metres(np.array([image.position for image in images])))
    say_pairs(len(pairs))
    match_pairs(database, pairs)
    return len(pairs)


def match_pairs(database: Path, pairs: Iterable[tuple[int, int]]) -> None:
    """Match the features of pairs of images, given by their numbers, and verify the matches."""
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{copy_name(a)} {copy_name(b)}\n" for a, b in pairs), encoding="ascii")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.match_image_pairs(
        str(database),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(listed)),
        verification_options=verification,
    )


def _coarse_descriptors(database: pycolmap.Database, image_id: int) -> np.ndarray:
    """Return the descriptors (M, 128) of the largest features of an image."""
    keypoints = database.read_keypoints(image_id).reshape(-1, 6)  # x, y and an affine shape (a11, a12, a21, a22)
    largest = np.argsort(-np.hypot(keypoints[:, 2], keypoints[:, 4]), kind="stable")[:COARSE_FEATURES]
    return np.asarray(database.read_descriptors(image_id).data).reshape(-1, 128)[largest]


def _metres(positions: np.ndarray) -> np.ndarray:
    """Return latitudes and longitudes (N, 2) as metres north and east (N, 2) on a plane, good for short distances."""
    radians = np.radians(positions)
    return _EARTH_RADIUS * radians * np.stack([np.ones(len(radians)), np.cos(radians[:, 0])], -1)


def contradicting_share(database: Path) -> float:
    """Return the fraction (0..1) of matches that contradict the geometry of their pair of images, over good pairs.

    Without moving objects it is small: 0.02 to 0.04 in two real scenes.
    """
    with pycolmap.Database.open(str(database)) as opened:
        matched = dict(zip(*opened.read_num_matches(), strict=True))
        fitting = dict(zip(*opened.read_two_view_geometry_num_inliers(), strict=True))
    good = [pair for pair, count in fitting.items() if count >= _GOOD_MATCHES]
    total = sum(matched[pair] for pair in good)
    return 1 - sum(fitting[pair] for pair in good) / total if total else 0.0
