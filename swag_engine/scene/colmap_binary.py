"""COLMAP's binary files, read record by record with little memory: models of surveys have gigabytes of observations.

pycolmap fills the rest of a truncated file with arbitrary values, so each file is followed to its end here. Layouts are
those of colmap/scene/reconstruction_io_binary.cc.
"""

import os
import shutil
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..base.errors import InputError
from ..base.files import read_bytes, regular
from .colmap_library import pycolmap

PARTS = ("cameras", "images", "points3D", "rigs", "frames")
"""Names of the files of a model; there are rigs and frames from COLMAP 4 on."""
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track_length", "<u8")])
"""Record of a point, before the elements of its track."""
ELEMENT = np.dtype([("image", "<u4"), ("feature", "<u4")])
"""Element of a point's track: the id of an image, and which of its features."""
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
"""Feature of an image, with the id of its point."""
NO_POINT = 2**64 - 1
"""Id of the point of a feature that is none."""
CHUNK = 1 << 24
"""Bytes that are read at a time."""
HEADER = 4096
"""Bytes that are read at a time of what precedes the features of an image."""


def check_file(path: Path) -> None:
    """Raise InputError unless a file of a model holds all records that it announces."""
    if path.stem == "images":
        records: Iterator[object] = image_records(path)
    elif path.stem == "points3D":
        records = point_records(path)
    else:
        _check_small(path)
        return
    for _ in records:
        pass


def point_records(path: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Read the points of points3D.bin.

    Args:
        path: The file.

    Yields:
        Some points at a time, (N,) POINT, in the order of the file; and the elements of their tracks one after another,
        (M,) ELEMENT.

    Raises:
        InputError: If the file is damaged.
    """
    track_length = struct.Struct("<Q").unpack_from
    head, element = POINT.itemsize, ELEMENT.itemsize
    with open(path, "rb", opener=regular) as file:
        left, size = _count(file, path), os.fstat(file.fileno()).st_size
        start, wanted = 8, head
        while left:
            file.seek(start)
            data = file.read(max(CHUNK, wanted))
            at, available, starts = 0, len(data), []
            for _ in range(left):
                end = at + head
                if end <= available:
                    end += element * track_length(data, end - 8)[0]
                if end > available:
                    wanted = end - at
                    break
                starts.append(at)
                at = end
            left -= len(starts)
            start += at
            if left and start + wanted > size:
                raise _damaged(path)
            raw = np.frombuffer(data, np.uint8)[:at]
            heads = np.array(starts, np.int64)[:, None] + np.arange(head)
            in_track = np.ones(at, bool)
            in_track[heads] = False
            yield raw[heads].view(POINT)[:, 0], raw[in_track].view(ELEMENT)


def image_records(path: Path) -> Iterator[tuple[bytes, np.ndarray]]:
    """Read the images of images.bin.

    Args:
        path: The file.

    Yields:
        What precedes the features of an image: its id (uint32), pose, camera and name; and the id of the point of each
        feature (M,) uint64, NO_POINT for none.

    Raises:
        InputError: If the file is damaged.
    """
    with open(path, "rb", opener=regular) as file:
        count, size = _count(file, path), os.fstat(file.fileno()).st_size
        for _ in range(count):
            start = file.tell()
            head = file.read(HEADER)
            while (end := head.find(b"\0", 64)) < 0 or len(head) < end + 9:
                more = file.read(len(head))
                if not more:
                    raise _damaged(path)
                head += more
            (features,) = struct.unpack_from("<Q", head, end + 1)
            first = start + end + 9
            if features > (size - first) // OBSERVATION.itemsize:
                raise _damaged(path)
            file.seek(first)
            found = np.frombuffer(file.read(OBSERVATION.itemsize * features), OBSERVATION)
            yield head[: end + 1], found["point"].copy()


def copy_without_points(model: Path, to: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Copy a model without its points and its features, which pycolmap then reads quickly.

    Args:
        model: Folder of the model.
        to: An empty folder.

    Yields:
        Id of each image, and the id of the point of each of its features (M,) uint64, NO_POINT for none. The copy is
        whole after the last.

    Raises:
        InputError: If a file is damaged.
    """
    for part in PARTS:
        source = model / f"{part}.bin"
        if part not in ("images", "points3D") and source.is_file():
            check_file(source)
            shutil.copyfile(source, to / source.name)
    (to / "points3D.bin").write_bytes(bytes(8))
    count = 0
    with open(to / "images.bin", "wb") as copy:
        copy.write(bytes(8))
        for head, points in image_records(model / "images.bin"):
            copy.write(head + bytes(8))
            count += 1
            yield struct.unpack_from("<I", head)[0], points
        copy.seek(0)
        copy.write(struct.pack("<Q", count))


@dataclass(frozen=True, eq=False)
class Features:
    """The features of all images of a model, one image after another.

    Attributes:
        images: Ids (V,) uint32 of the images, ascending.
        starts: Where the features of each image begin in `points`, (V + 1,) int64 with the end of the last.
        points: Ids (F,) uint64 of the points of all features, NO_POINT for none.
    """

    images: np.ndarray
    starts: np.ndarray
    points: np.ndarray

    @classmethod
    def of(cls, by_image: Mapping[int, np.ndarray]) -> "Features":
        """Join the features that each image has by its id."""
        images = np.array(sorted(by_image), np.uint32)
        parts = [by_image[image] for image in images]
        starts = np.cumsum([0, *map(len, parts)])
        return cls(images, starts, np.concatenate([np.zeros(0, np.uint64), *parts]))

    def by_image(self) -> dict[int, np.ndarray]:
        """Return the ids of the points of each image's features, by the image's id."""
        pairs = zip(self.starts[:-1], self.starts[1:], strict=True)
        return {int(image): self.points[start:end] for image, (start, end) in zip(self.images, pairs, strict=True)}

    def check(self, heads: np.ndarray, tracks: np.ndarray) -> None:
        """Check that the features in the tracks of points are those of these points, as pycolmap does.

        Args:
            heads: Points (N,) POINT.
            tracks: Elements of their tracks (M,) ELEMENT, one track after another.

        Raises:
            ValueError: If an image or feature does not exist, or is that of another point.
        """
        at = np.searchsorted(self.images, tracks["image"])
        if (at == len(self.images)).any() or (self.images[at] != tracks["image"]).any():
            raise ValueError("A track has an image that does not exist.")
        feature = self.starts[at] + tracks["feature"]
        if (feature >= self.starts[at + 1]).any():
            raise ValueError("A track has a feature that does not exist.")
        if (self.points[feature] != np.repeat(heads["id"], heads["track_length"].astype(np.int64))).any():
            raise ValueError("A feature is that of another point.")


def _damaged(path: Path) -> InputError:
    return InputError(f"{path} is damaged or was cut short: copy it or export it from COLMAP again.")


def _count(file: BinaryIO, path: Path) -> int:
    data = file.read(8)
    if len(data) < 8:
        raise _damaged(path)
    return int(struct.unpack("<Q", data)[0])


# Each function returns where the record that starts at `at` ends.


def _after_camera(data: bytes, at: int) -> int:
    (model,) = struct.unpack_from("<i", data, at + 4)
    camera = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return at + 24 + 8 * len(camera.params)


def _after_rig(data: bytes, at: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 8 + (8 if sensors else 0)
    for _ in range(1, sensors):
        (has_pose,) = struct.unpack_from("<B", data, at + 8)
        at += 9 + (56 if has_pose else 0)
    return at


def _after_frame(data: bytes, at: int) -> int:
    (count,) = struct.unpack_from("<I", data, at + 64)
    return at + 68 + 16 * count


_RECORDS: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _after_camera,
    "rigs": _after_rig,
    "frames": _after_frame,
}


def _check_small(path: Path) -> None:
    data = read_bytes(path)
    after = _RECORDS[path.stem]
    try:
        (count,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(count):
            at = after(data, at)
        whole = at <= len(data)
    except (struct.error, ValueError, OverflowError):
        whole = False
    if not whole:
        raise _damaged(path)
