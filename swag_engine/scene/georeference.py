"""Scale, axes and coordinates of a scene: the file scale.json, and where local coordinates lie on the Earth.

numpy only, Blender imports it.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeGuard, get_args

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path, read_text
from ..base.strict_json import from_json, to_json

Axes = Literal["estimated", "up", "full"]
"""What was measured: nothing (up is estimated from cameras and points), the up direction, or all directions."""
FILE_NAME = "scale.json"
"""Name of the file in the folder of a scene."""
FAR_FROM_ZERO = 1e4
"""Coordinate in metres beyond which float32 is too coarse for a map."""
Origin = Sequence[float] | np.ndarray
"""Three doubles that were subtracted from coordinates."""
OFFSET_SIZE = 1e12
"""Largest coordinate of an offset, metres; anything on Earth is within 1e8."""


@dataclass(frozen=True)
class Placement:
    """Where a local frame (metres, z up) lies in a coordinate reference system: its coordinates are local + offset.

    Attributes:
        crs: Name of the coordinate reference system, such as EPSG:32633; None where it is not known.
        offset: What was subtracted from its coordinates, three doubles, metres.
    """

    crs: str | None
    offset: tuple[float, float, float]

    def to_json(self) -> dict[str, Any]:
        """Return a plain dict that `from_json` reads."""
        return {"crs": self.crs, "offset": list(self.offset)}

    def file_json(self, turn: np.ndarray) -> dict[str, Any]:
        """Return the document beside a file whose axes are those of the local frame turned by `turn` (3, 3).

        It is that of `to_json` with `rotation` (3, 3): coordinates = rotation @ position in the file + offset.
        """
        return self.to_json() | {"rotation": (turn.T + 0.0).tolist()}

    @classmethod
    def from_json(cls, document: Any) -> "Placement":
        """Read a plain dict.

        Raises:
            ValueError: When it is not what `to_json` writes.
        """
        if not isinstance(document, dict) or not isinstance(document.get("crs"), str | None):
            raise ValueError("no coordinate reference system")
        x, y, z = _array(document.get("offset"), (3,), OFFSET_SIZE).tolist()
        return cls(document["crs"], (x, y, z))


@dataclass(frozen=True, eq=False)
class Georeference:
    """Similarity from a scene's coordinates to a local frame in metres with z up.

    local = metres_per_unit * rotation @ scene + translation. With all axes measured, x is east and y north, or those
    of the reference points.

    Attributes:
        metres_per_unit: Metres in one unit of the scene.
        error: Relative standard error of `metres_per_unit`, None where it cannot be determined.
        method: How the scale was measured: targets, points, gps or depths.
        axes: Which directions were measured.
        rotation: Rotation (3, 3).
        translation: Translation (3,), metres.
        placement: Where the local frame lies, None where that was not measured.
        residuals: What each measurement disagrees with the result by, metres, by its name.
        notes: Sentences for the user.
    """

    metres_per_unit: float
    error: float | None
    method: str
    axes: Axes
    rotation: np.ndarray
    translation: np.ndarray
    placement: Placement | None = None
    residuals: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def matrix(self) -> np.ndarray:
        """The similarity (4, 4) from scene to local frame."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.metres_per_unit * self.rotation, self.translation
        return matrix

    @property
    def up(self) -> np.ndarray:
        """Up direction (3,) in the scene's coordinates, unit length."""
        return self.rotation[2]

    def for_origin(self, origin: "Origin") -> "Georeference":
        """Return the similarity for coordinates of the scene from which an origin (3,) was subtracted.

        A local frame that is then still far from its zero is moved, and its placement tells by how much.
        """
        if not np.any(origin):
            return self
        translation = self.translation + self.metres_per_unit * self.rotation @ np.asarray(origin, np.float64)
        placement = self.placement
        if np.abs(translation).max() > FAR_FROM_ZERO:
            known = placement or Placement(None, (0.0, 0.0, 0.0))
            whole = np.round(translation)
            x, y, z = (np.array(known.offset) + whole).tolist()
            translation, placement = translation - whole, Placement(known.crs, (x, y, z))
        return replace(self, translation=translation, placement=placement)

    def for_model(self, origin: "Origin") -> "Georeference":
        """Return the similarity for the coordinates from which `origin` (3,) was subtracted: that of scale.json."""
        shift = self.metres_per_unit * self.rotation @ np.asarray(origin, np.float64)
        return replace(self, translation=self.translation - shift)

    def to_json(self) -> dict[str, Any]:
        """Return the document of scale.json, which `from_json` reads."""
        document = asdict(self)
        document |= {"rotation": self.rotation.tolist(), "translation": self.translation.tolist()}
        del document["placement"]
        placement = self.placement.to_json() if self.placement else {"crs": None, "offset": None}
        return document | placement | {"notes": list(self.notes)}

    @classmethod
    def from_json(cls, document: Any) -> "Georeference":
        """Read the document of scale.json.

        Raises:
            ValueError: When it is not what `to_json` writes.
        """
        if not isinstance(document, dict):
            raise ValueError("it holds no JSON object")
        metres: Any = document.get("metres_per_unit")
        error: Any = document.get("error")
        if not _is_number(metres) or not 1e-9 <= metres <= 1e9:
            raise ValueError(f"metres_per_unit is {metres!r}")
        if error is not None and not (_is_number(error) and error >= 0):
            raise ValueError(f"error is {error!r}")
        axes: Any = document.get("axes")
        method, notes = document.get("method"), document.get("notes", [])
        if not isinstance(method, str) or axes not in get_args(Axes):
            raise ValueError(f"method and axes are {method!r} and {axes!r}")
        rotation = _array(document.get("rotation"), (3, 3), 1.1)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError("rotation is not a rotation")
        residuals = document.get("residuals", {})
        if not isinstance(residuals, dict) or not all(map(_is_number, residuals.values())):
            raise ValueError("residuals are not numbers by name")
        if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
            raise ValueError("notes are not sentences")
        return cls(
            metres_per_unit=float(metres),
            error=None if error is None else float(error),
            method=method,
            axes=axes,
            rotation=rotation,
            translation=_array(document.get("translation"), (3,), OFFSET_SIZE),
            placement=None if document.get("offset") is None else Placement.from_json(document),
            residuals={name: float(value) for name, value in residuals.items()},
            notes=tuple(notes),
        )


def read_georeference(scene: Path, origin: Origin = (0.0, 0.0, 0.0)) -> Georeference | None:
    """Read scale.json of a scene.

    Args:
        scene: Folder of the scene.
        origin: (3,) `Scene.origin`: what was subtracted from the coordinates that the result is for.

    Returns:
        The scale, None without the file.

    Raises:
        InputError: When the file is damaged.
    """
    path = scene / FILE_NAME
    try:
        return Georeference.from_json(from_json(read_text(path))).for_origin(origin)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read ({error}): measure the scale again with the command scale, or remove the file."
        ) from error


def write_georeference(scene: Path, georeference: Georeference) -> Path:
    """Write scale.json, which is for the coordinates of the COLMAP model, to the folder of a scene; return its path.

    The file is whole or as it was.

    Raises:
        InputError: If the file cannot be written.
    """
    path = scene / FILE_NAME
    with atomic_path(path) as temporary:
        temporary.write_text(to_json(georeference.to_json(), indent=2) + "\n", encoding="utf-8")
    return path


def describe_scale(document: dict[str, Any]) -> str:
    """Say the scale in one line, such as "1 unit = 0.4821 m ± 0.3 % (targets), up measured".

    Args:
        document: What `Georeference.to_json` returned.
    """
    error = document["error"]
    accuracy = "error unknown" if error is None else f"± {100 * error:.2g} %"
    axes = {"estimated": "up estimated", "up": "up measured", "full": "all axes measured"}[document["axes"]]
    text = f"1 unit = {document['metres_per_unit']:.5g} m, {accuracy} ({document['method']}), {axes}"
    if document["offset"]:
        text += f", offset {' '.join(f'{value:.15g}' for value in document['offset'])}"
        text += f" ({document['crs']})" if document["crs"] else ""
    return text


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _array(values: Any, shape: tuple[int, ...], most: float) -> np.ndarray:
    """Convert nested lists to finite float64 of a shape, none beyond `most`; raise ValueError otherwise."""
    try:
        array = np.array(values, np.float64)
    except TypeError as error:
        raise ValueError("numbers are missing") from error
    if array.shape != shape or not (np.abs(array) <= most).all():
        raise ValueError(f"numbers of shape {shape} are expected")
    return array
