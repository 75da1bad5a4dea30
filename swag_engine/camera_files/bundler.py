"""Bundler: bundle.out with the list of its images.

Source: Bundler's README, "Output format". The camera is x right, y up, looking along -z; pixels count from the middle
of the image, y up, and x/-z is scaled by f (1 + k1 r^2 + k2 r^4).
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..scene.image_files import IMAGE_SUFFIXES
from ..scene.lenses import Lens
from .camera_file import OPENGL_AXES, Calibration, CameraFile, FileCamera, FilePoints, photos_are, reading, rigid
from .source import Source

PROGRAM = "Bundler"
_LISTS = ("list.txt", "bundle.txt", "list_tmp.txt", "pmvs_options.txt.list")
_ENTRY = re.compile(r"(.+?)(\s+\d+\s+[\d.eE+-]+)?")
"""Line of a list: a name, which may have spaces, and Bundler's 0 and focal length."""


def recognise(source: Source) -> bool:
    """Return whether the first line is that of a bundle file."""
    return source.text[:60].lstrip().lower().startswith("# bundle file")


def read(source: Source) -> CameraFile:
    """Read cameras, points and the observations of the points.

    Raises:
        ValueError: When the file is cut short or the list of images is not beside it.
    """
    lines = [line for line in source.text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    words: Iterator[str] = (word for line in lines for word in line.split())
    try:
        return _read(source, words)
    except StopIteration:
        raise ValueError("it was cut short: export it again") from None


def _read(source: Source, words: Iterator[str]) -> CameraFile:
    def floats(count: int) -> np.ndarray:
        return np.array([float(next(words)) for _ in range(count)])

    camera_count, point_count = int(next(words)), int(next(words))
    names = _names(source, camera_count)
    cameras: list[FileCamera] = []
    index: dict[int, int] = {}
    for number in range(camera_count):
        focal, k1, k2 = floats(3)
        rotation, translation = floats(9).reshape(3, 3), floats(3)
        if focal == 0 and not rotation.any():
            continue  # an image without a pose is written as zeros
        index[number] = len(cameras)
        with reading(names[number]):
            pose = rigid(OPENGL_AXES @ rotation, OPENGL_AXES @ translation)
        cameras.append(FileCamera(names[number], _calibration(focal, k1, k2), pose))
    positions, colors, observations = np.zeros((point_count, 3)), np.zeros((point_count, 3), np.uint8), []
    for number in range(point_count):
        positions[number] = floats(3)
        colors[number] = np.clip(floats(3), 0, 255)
        seen = []
        for _ in range(int(next(words))):
            camera, _, x, y = int(next(words)), next(words), float(next(words)), float(next(words))
            if camera in index:
                seen.append((index[camera], x, -y))
        observations.append(seen)
    warnings = []
    if len(cameras) < camera_count:
        warnings.append(f"{photos_are(camera_count - len(cameras))} left out, without a pose in {source.path.name}.")
    points = FilePoints(positions, colors, observations) if point_count else None
    return CameraFile(PROGRAM, tuple(cameras), points, warnings=warnings)


def _calibration(focal: float, k1: float, k2: float) -> Calibration:
    return Calibration(
        lambda width, height: (
            Lens("RADIAL", width, height, (focal, width / 2, height / 2, k1, k2))
            if k1 or k2
            else Lens("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))
        )
    )


def _names(source: Source, count: int) -> list[str]:
    """Return the names of the images, from the list beside the file."""
    candidates = [source.path.with_suffix(".txt"), source.path.with_name(f"{source.path.name}.list.txt")]
    candidates += [folder / name for folder in (source.path.parent, source.path.parent.parent) for name in _LISTS]
    for path in candidates:
        if path.is_file() and len(names := _entries(path)) == count:
            return names
    others = [path for path in source.path.parent.iterdir() if path.suffix.lower() in (".lst", ".txt")]
    lists = [names for path in sorted(others) if len(names := _entries(path)) == count and all(map(_is_photo, names))]
    if lists and lists.count(lists[0]) == len(lists):
        return lists[0]
    raise ValueError(
        f"{'several lists' if lists else 'no list'} of its {count} images {'were' if lists else 'was'} found: put "
        f"list.txt, one name a line, beside {source.path.name}"
    )


def _entries(path: Path) -> list[str]:
    """Return the names of a list, with forward slashes."""
    found = [_ENTRY.fullmatch(line.strip()) for line in Source(path).text.splitlines()]
    return [match[1].replace("\\", "/") for match in found if match]


def _is_photo(name: str) -> bool:
    return Path(name).suffix.lower() in IMAGE_SUFFIXES
