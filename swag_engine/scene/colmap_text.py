"""COLMAP's text files of any writer, copied to binary ones.

pycolmap takes every second line of images.txt for observations, and loses a photo without a word where one is missing;
it cuts names at the first space. Here each line is recognised by what it holds, and errors name file and line.
"""

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..base.text import text_encoding
from .colmap_binary import NO_POINT, OBSERVATION, PARTS
from .colmap_library import pycolmap

_REPEATED = "the id is that of a line above"


def copy_as_binary(model: Path, to: Path) -> None:
    """Copy a text model as a binary model.

    Args:
        model: Folder of the model; points3D.txt, rigs.txt and frames.txt may be missing.
        to: An empty folder.

    Raises:
        InputError: If a line cannot be understood, or a file was cut short.
    """
    observed = False

    def images(lines: "_Lines") -> Iterator[bytes]:
        nonlocal observed
        head, seen = b"", set[bytes]()
        for fields in lines:
            features = _features(fields)
            if features is None:
                if head:  # its line of observations is missing
                    yield head + bytes(8)
                head = _image(fields)
                if head[:4] in seen:
                    raise ValueError(_REPEATED)
                seen.add(head[:4])
            elif head:
                yield head + struct.pack("<Q", len(features)) + features.tobytes()
                head, observed = b"", observed or bool((features["point"] != NO_POINT).any())
            else:
                raise ValueError("observations that belong to no photo")
        if head:
            yield head + bytes(8)

    def points(lines: "_Lines") -> Iterator[bytes]:
        for fields in lines:
            yield _point(fields, observed)

    def each(record: Callable[[list[str]], bytes]) -> Callable[["_Lines"], Iterator[bytes]]:
        return lambda lines: map(record, lines)

    records = {"cameras": each(_camera), "images": images, "points3D": points, "rigs": each(_rig)}
    for part in PARTS:
        source = model / f"{part}.txt"
        if not source.is_file():
            continue
        lines = _Lines(source)
        count, ids = 0, set[bytes]()
        with open(to / f"{part}.bin", "wb") as file:
            file.write(bytes(8))
            try:
                for data in records.get(part, each(_frame))(lines):
                    ids.add(data[: 8 if part == "points3D" else 4])
                    count += 1
                    if len(ids) < count:
                        raise ValueError(_REPEATED)
                    file.write(data)
            except UnicodeDecodeError as error:
                raise InputError(
                    f"{source} is not a text in UTF-8: rename photos with plain letters, or save it as UTF-8."
                ) from error
            except (ValueError, IndexError, OverflowError, struct.error) as error:
                raise InputError(
                    f"{source}, line {lines.number}, cannot be read ({error}): correct it or export it again."
                ) from error
            file.seek(0)
            file.write(struct.pack("<Q", count))
        if count < lines.announced:
            raise InputError(
                f"{source} was cut short: it has {count} of {lines.announced} entries; export it from COLMAP again."
            )


class _Lines:
    """The fields of the lines of a file that are neither empty nor comments.

    Attributes:
        number: Number of the last line read, from 1.
        announced: Number of entries that COLMAP's header announces, 0 without one.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.number, self.announced = path, 0, 0

    def __iter__(self) -> Iterator[list[str]]:
        with open(self.path, "rb") as file:
            encoding = text_encoding(file.read(4))
        with open(self.path, encoding=encoding) as file:
            for self.number, line in enumerate(file, 1):
                line = line.strip()
                if line.startswith("#"):
                    if found := re.match(r"# Number of \w+: (\d+)", line):
                        self.announced = int(found[1])
                elif line:
                    yield line.split(maxsplit=9) if self.path.stem == "images" else line.split()


def _features(fields: list[str]) -> np.ndarray | None:
    """Return the features (M,) OBSERVATION of a line of images.txt, None where it is the line of a photo."""
    words = [*fields[:9], *" ".join(fields[9:]).split()]
    try:
        values = np.array(words, np.float64)
    except ValueError:
        return None
    if len(values) == 10:  # a photo whose name is a number
        return None
    if len(values) % 3:
        raise ValueError("observations need x, y and the id of a point each")
    features = np.zeros(len(values) // 3, OBSERVATION)
    features["xy"] = values.reshape(-1, 3)[:, :2]
    features["point"] = [int(word) if 0 <= float(word) < 2**63 else NO_POINT for word in words[2::3]]
    return features


def _image(fields: list[str]) -> bytes:
    if len(fields) < 10:
        raise ValueError("a photo needs an id, 4 numbers of its rotation, 3 of its position, a camera and a name")
    return struct.pack("<I7dI", _whole(fields[0]), *map(float, fields[1:8]), _whole(fields[8])) + _name(fields[9])


def _name(name: str) -> bytes:
    return name.encode() + b"\0"


def _camera(fields: list[str]) -> bytes:
    params = [float(word) for word in fields[4:]]
    size = _whole(fields[2]), _whole(fields[3])
    kind = pycolmap.CameraModelId.__members__.get(fields[1])
    if kind is None:
        raise ValueError(f"the camera model {fields[1]} does not exist")
    expected = len(pycolmap.Camera.create_from_model_name(0, fields[1], 1.0, 1, 1).params)
    if len(params) != expected:
        raise ValueError(f"{fields[1]} has {expected} parameters, not {len(params)}")
    return struct.pack(f"<IiQQ{expected}d", _whole(fields[0]), int(kind), *size, *params)


def _point(fields: list[str], with_track: bool) -> bytes:
    if len(fields) == 7:  # without an error
        fields.append("-1")
    xyz, color = map(float, fields[1:4]), (_whole(word) for word in fields[4:7])
    track = np.array(fields[8:], np.float64).reshape(-1, 2).astype("<u4") if with_track else np.zeros((0, 2))
    head = struct.pack("<Q3d3BdQ", _whole(fields[0]), *xyz, *color, float(fields[7]), len(track))
    return head + track.tobytes()


def _rig(fields: list[str]) -> bytes:
    data = struct.pack("<II", _whole(fields[0]), _whole(fields[1]))
    if len(fields) > 2:
        data += _sensor(fields[2:])
    at = 4
    while at < len(fields):
        has_pose = _whole(fields[at + 2])
        data += _sensor(fields[at:]) + struct.pack("<B", has_pose)
        at += 3
        if has_pose:
            data += struct.pack("<7d", *map(float, fields[at : at + 7]))
            at += 7
    return data


def _frame(fields: list[str]) -> bytes:
    data = struct.pack("<II7dI", *map(_whole, fields[:2]), *map(float, fields[2:9]), _whole(fields[9]))
    for at in range(10, len(fields), 3):
        data += _sensor(fields[at:]) + struct.pack("<Q", _whole(fields[at + 2]))
    return data


def _sensor(fields: list[str]) -> bytes:
    return struct.pack("<iI", int(pycolmap.SensorType.__members__[fields[0]]), _whole(fields[1]))


def _whole(text: str) -> int:
    """Return a whole number, which some writers write with a decimal point."""
    if text.isdecimal():
        return int(text)
    value = float(text)
    if not value.is_integer():
        raise ValueError(f"{text} is not a whole number")
    return int(value)
