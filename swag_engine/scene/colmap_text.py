"""COLMAP's text files of any writer, copied to binary ones.

pycolmap takes every second line of images.txt for observations, so that a missing line loses a photo, and cuts names at
spaces. Here each line is recognised by its content.
"""

import re
import struct
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..base.files import regular
from ..base.text import text_encoding
from .colmap_binary import NO_POINT, OBSERVATION, PARTS
from .colmap_library import pycolmap


def copy_as_binary(model: Path, to: Path) -> None:
    """Copy a text model as a binary model; tracks are left out where no photo has observations.

    Args:
        model: Folder of the model; points3D.txt, rigs.txt and frames.txt may be missing.
        to: An empty folder.

    Raises:
        InputError: If a line cannot be understood, or a file was cut short.
    """
    with_tracks = False
    for part in PARTS:
        if not (source := model / f"{part}.txt").is_file():
            continue
        records: dict[bytes, tuple[bytes, np.ndarray | None]] = {}
        last, number, announced = b"", 0, 0
        try:
            with open(source, "rb", opener=regular) as file:
                encoding = text_encoding(file.read(4))
            with open(source, encoding=encoding, opener=regular) as lines:
                for number, text in enumerate(lines, 1):  # noqa: B007 (named where reading fails)
                    line = text.strip()
                    if line.startswith("#"):
                        if found := re.match(r"# Number of \w+: (\d+)", line):
                            announced = int(found[1])
                        continue
                    words = line.split()
                    if not words:
                        continue
                    features = _features(words) if part == "images" else None
                    if features is not None:
                        if not last or records[last][1] is not None:
                            raise ValueError("observations that belong to no photo")
                        records[last] = records[last][0], features
                        with_tracks |= bool((features["point"] != NO_POINT).any())
                        continue
                    if part == "images":
                        data = _image(line)
                    elif part == "points3D":
                        data = _point(words, with_tracks)
                    else:
                        data = {"cameras": _camera, "rigs": _rig, "frames": _frame}[part](words)
                    last = data[: 8 if part == "points3D" else 4]
                    if last in records:
                        raise ValueError("the id is that of a line above")
                    records[last] = data, None
        except UnicodeDecodeError as error:
            raise InputError(f"{source} is not a text in UTF-8: save it as UTF-8.") from error
        except (ValueError, LookupError, OverflowError, struct.error) as error:
            raise InputError(
                f"{source}, line {number}, cannot be read ({error}): correct it or export it again."
            ) from error
        if len(records) < announced:
            raise InputError(
                f"{source} was cut short: it has {len(records)} of {announced} entries; export it from COLMAP again."
            )
        with open(to / f"{part}.bin", "wb") as binary:
            binary.write(struct.pack("<Q", len(records)))
            for data, features in records.values():
                binary.write(data)
                if part == "images":
                    binary.write(struct.pack("<Q", 0) if features is None else _counted(features))


def _counted(features: np.ndarray) -> bytes:
    return struct.pack("<Q", len(features)) + features.tobytes()


def _features(words: list[str]) -> np.ndarray | None:
    """Return the features (M,) OBSERVATION of a line of images.txt, None where it is the line of a photo."""
    try:
        values = np.array(words, np.float64)
    except ValueError:
        return None
    if len(values) == 10:  # a photo whose name is a number
        return None
    if len(values) % 3:
        raise ValueError("observations need x, y and the id of a point each")
    features = np.zeros(len(values) // 3, OBSERVATION)
    features["xy"], ids = values.reshape(-1, 3)[:, :2], values[2::3]
    if (ids != np.round(ids)).any():  # the line of a photo without its name
        raise ValueError("the id of a point is not a whole number")
    features["point"] = np.where((ids >= 0) & (ids < 2**63), ids, 0).astype(np.uint64)
    features["point"][(ids < 0) | (ids >= 2**63)] = NO_POINT
    return features


def _image(line: str) -> bytes:
    words = line.split(maxsplit=9)
    if len(words) < 10:
        raise ValueError("a photo needs an id, 4 numbers of its rotation, 3 of its position, a camera and a name")
    return struct.pack("<I7dI", _whole(words[0]), *map(float, words[1:8]), _whole(words[8])) + words[9].encode() + b"\0"


def _camera(words: list[str]) -> bytes:
    number, model, width, height, *params = words
    if model not in pycolmap.CameraModelId.__members__:
        raise ValueError(f"the camera model {model} does not exist")
    count = len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)
    if len(params) != count:
        raise ValueError(f"{model} has {count} parameters, not {len(params)}")
    kind = int(pycolmap.CameraModelId.__members__[model])
    return struct.pack(f"<IiQQ{count}d", _whole(number), kind, _whole(width), _whole(height), *map(float, params))


def _point(words: list[str], with_track: bool) -> bytes:
    if len(words) < 7:
        raise ValueError("a point needs an id, x, y, z, red, green and blue")
    number, *place = words[:4]
    if not all(word.isdecimal() and int(word) < 256 for word in words[4:7]):
        raise ValueError("a color is three whole numbers from 0 to 255")
    color, error = map(_whole, words[4:7]), float(words[7]) if len(words) > 7 else -1.0
    track = np.array(words[8:], np.float64).reshape(-1, 2).astype("<u4")[: None if with_track else 0]
    return struct.pack("<Q3d3BdQ", _whole(number), *map(float, place), *color, error, len(track)) + track.tobytes()


def _rig(words: list[str]) -> bytes:
    data = struct.pack("<II", *map(_whole, words[:2])) + (_sensor(words[2:]) if len(words) > 2 else b"")
    at = 4
    while at < len(words):
        poses = 7 * _whole(words[at + 2])
        data += _sensor(words[at:]) + struct.pack(f"<?{poses}d", poses, *map(float, words[at + 3 : at + 3 + poses]))
        at += 3 + poses
    return data


def _frame(words: list[str]) -> bytes:
    data = struct.pack("<II7dI", *map(_whole, words[:2]), *map(float, words[2:9]), _whole(words[9]))
    return data + b"".join(
        _sensor(words[at:]) + struct.pack("<Q", _whole(words[at + 2])) for at in range(10, len(words), 3)
    )


def _sensor(words: list[str]) -> bytes:
    return struct.pack("<iI", int(pycolmap.SensorType.__members__[words[0]]), _whole(words[1]))


def _whole(text: str) -> int:
    """Return a whole number, which some writers write with a decimal point."""
    if text.isdecimal():
        return int(text)
    if not float(text).is_integer():
        raise ValueError(f"{text} is not a whole number")
    return int(float(text))
