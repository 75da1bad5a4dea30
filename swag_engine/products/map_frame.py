"""Splats in the frame of a map: x right, y to the top, z towards the viewer, in metres where the scale is known."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, continue_run, remedy
from ..formats.export import FROM_Y_UP, with_water
from ..formats.ply import read_ply
from ..formats.run_folder import RunFolder
from ..scene.colmap import load_scene
from ..scene.georeference import Georeference, Placement, read_georeference
from ..splats.development import NO_DEVELOPMENT, Development
from ..splats.splats import Splats
from ..splats.transform import rotation_to_y_up, transformed
from .grid import MapGrid, make_grid
from .tiles import SEEN

PLANE_HELP = "up, fit, or a direction as in 0,0,1"
BESIDE_BACKGROUND = 0.1
"""Least alpha of a pixel that shows something in a run with a background color: training leaves ground of that color
more transparent, since the color behind it is right."""
SOLID = 0.5
"""Least opacity of splats that a plane is fitted to."""
FIT_ROUNDS = 10
"""Rounds in which splats farther than 2 standard deviations from the plane lose their weight."""
STEEP = 0.5
"""Vertical part of a plane's normal below which it is steep: 60 degrees."""
LEAST_TOP = 1e-6
"""Least relative length of the up direction within the plane for it to point to the top of the map."""


@dataclass(frozen=True, eq=False)
class MapScene:
    """Splats in the frame of a map.

    Attributes:
        splats: Splats whose z axis points to the viewer.
        unit: "m", or "units" where the scale is not known.
        placement: What is added to x and y, and the coordinate reference system; None without.
        scale_error: Relative standard error of the scale; None where it is not known.
        north: Whether y points to the north.
        development: What is done to rendered colors.
        matrix: (4, 4) from the scene's coordinates to those of the map, without the placement.
        labels: Names of the labels by number.
        gains: Factors on the coverage of labels by number (semantics/label_gains.py); 1 for others.
        notes: Sentences for the user.
        seen: Least alpha of a pixel that shows something.
        run: Folder of the run; None for a splat file.
    """

    splats: Splats
    unit: str
    placement: Placement | None
    scale_error: float | None
    north: bool
    development: Development
    matrix: np.ndarray
    labels: dict[int, str] = field(default_factory=dict)
    gains: dict[int, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seen: float = SEEN
    run: Path | None = None

    def without_offset(self, places: Sequence[float]) -> np.ndarray:
        """Return places in the frame of the map.

        Args:
            places: x and y of each place one after another, with or without the offset of the placement: what lies
                nearer to the splats counts.

        Returns:
            (M, 2) without the offset.
        """
        given = np.reshape(np.array(places, np.float64), (-1, 2))
        offset = np.array(self.placement.offset[:2] if self.placement else (0.0, 0.0))
        middle = given.mean(axis=0)
        return given - offset if np.linalg.norm(middle - offset) < np.linalg.norm(middle) else given

    def grid(self, pixel: float, box: tuple[float, float, float, float] | None, taglab: bool = False) -> MapGrid:
        """Lay a grid over the splats, as `make_grid`, in a box with or without the offset of the placement."""
        left, bottom, right, top = self.without_offset(box).ravel().tolist() if box else (0.0,) * 4
        return make_grid(self.splats, pixel, (left, bottom, right, top) if box else None, taglab)

    def refuse_own(self, *outputs: Path) -> None:
        """Refuse to replace files of the run or of its scene; see `RunFolder.refuse_own`."""
        if self.run:
            RunFolder(self.run).refuse_own(*outputs)


def load_map_scene(source: Path, plane: str = "up", water: float = 0.0, develop: str = "auto") -> MapScene:
    """Read a run or a splat PLY and turn it to the frame of a map.

    Args:
        source: Folder of a run with a result, or a PLY file.
        plane: Where the viewer is: `up` (straight above), `fit` (perpendicular to the plane that fits the splats, on
            the side of the cameras; for walls) or a direction x,y,z in the scene's coordinates.
        water: How much water the colors show, from 0 (restored) to 1 (as photographed); a PLY has colors of its own.
        develop: Development as `RunFolder.color_view`; a PLY is not developed.

    Returns:
        The splats and what is known of their frame.

    Raises:
        InputError: If there is no run and no PLY, or an option is not valid.
    """
    if not 0 <= water <= 1:
        raise InputError(f"The amount of water must be from 0 to 1, not {water:g}.")
    direction = _parse_plane(plane)
    if source.is_dir():
        return _load_run(source, plane, direction, water, develop)
    if not source.exists():
        raise InputError(f"{source} does not exist: give the folder of a run or a PLY file of splats.")
    splats = read_ply(source)
    notes: list[str] = []
    if splats.placement is None and direction is None:
        raise InputError(
            f"{source} does not say which direction is up: "
            + remedy(
                "give it with --plane as in --plane 0,-1,0, or export the file with --georeferenced.",
                "choose another one in Seen From.",
            )
        )
    up = np.array([0.0, 0.0, 1.0])
    rotation = np.eye(3) if direction is None else _rotation_to_view(direction, up)
    unit = "m" if splats.placement else "units"
    if unit == "units":
        notes.append(f"The scale of {source.name} is not known: lengths are in its own units.")
    placement = splats.placement if direction is None else None
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    placed = transformed(splats, matrix)
    return MapScene(
        placed, unit, placement or _origin_of(placed), None, placement is not None, NO_DEVELOPMENT, matrix,
        notes=tuple(notes),
    )  # fmt: skip


def _load_run(folder: Path, plane: str, direction: np.ndarray | None, water: float, develop: str) -> MapScene:
    run = RunFolder(folder)
    scene_folder, settings, up_of_run = run.read_config()
    if not run.ply.exists():
        raise InputError(f"The run {folder} has no result yet; {continue_run()}.")
    splats = read_ply(run.ply)
    development = run.color_view(develop).at(water)
    measured = read_georeference(scene_folder, splats.origin)
    if water or plane == "fit":
        cameras = [view.camera for view in load_scene(scene_folder).views]
    if water:
        splats = with_water(splats, run.read_water(), cameras, water, settings.metres_per_unit)
    metres = measured.metres_per_unit if measured else settings.metres_per_unit
    up = measured.up if measured else np.asarray(up_of_run, np.float64)
    notes = []
    if not metres:
        notes.append(
            f"The scale of {scene_folder.name} was not measured: lengths are in units of the scene. Measure it with "
            "the command scale; nothing has to be trained again."
        )
    placement, north = None, False
    if plane == "up" and measured:
        matrix, placement, north = measured.matrix, measured.placement, measured.axes == "full"
        splats.origin = (0.0, 0.0, 0.0)  # the measured frame is for coordinates after it
    else:
        if plane == "fit":
            direction = _fitted_normal(splats, np.mean([camera.centre for camera in cameras], axis=0))
        level = FROM_Y_UP["z-up"] @ rotation_to_y_up(up)
        rotation = level if direction is None else _rotation_to_view(direction, up)
        matrix = np.eye(4)
        matrix[:3, :3] = (metres or 1.0) * rotation
    if measured and measured.axes == "estimated" and plane == "up":
        notes.append("The up direction is estimated from cameras and points, not measured.")
    placed = transformed(splats, matrix)
    if plane == "up" and _is_steep(placed):
        notes.append(
            f"{scene_folder.name} is mostly steep: for a wall, map it from its side with "
            f"{remedy('--plane fit', 'Fitted Plane in Seen From')}."
        )
    table = _label_table(run)
    return MapScene(
        placed, "m" if metres else "units", placement or _origin_of(placed), _scale_error(measured), north, development,
        matrix, {entry["id"]: entry["name"] for entry in table}, {entry["id"]: entry["gain"] for entry in table},
        tuple(notes), BESIDE_BACKGROUND if run.has_background_color() else SEEN, folder,
    )  # fmt: skip


def _origin_of(splats: Splats) -> Placement | None:
    """Return where splats with an origin lie: in no known coordinate reference system."""
    return Placement(None, splats.origin) if any(splats.origin) else None


def _scale_error(measured: Georeference | None) -> float | None:
    return measured.error if measured else None


def _label_table(run: RunFolder) -> list[dict[str, Any]]:
    from ..semantics.labels import TABLE, read_labels

    if not (run.path / TABLE).exists():
        return []
    return read_labels(run.path)


def _parse_plane(plane: str) -> np.ndarray | None:
    """Return the direction (3,) that a user gave, None for `up` and `fit`."""
    if plane in ("up", "fit"):
        return None
    try:
        direction = np.array([float(value) for value in plane.split(",")])
    except ValueError:
        direction = np.zeros(0)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
        raise InputError(f"The plane is {plane}: it must be {PLANE_HELP}.")
    return direction / np.linalg.norm(direction)


def _rotation_to_view(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) to a frame with z along `direction`, and `up` to the top unless it points to the viewer."""
    top = up - (up @ direction) * direction
    if np.linalg.norm(top) < LEAST_TOP * np.linalg.norm(up):
        top = np.eye(3)[np.argmin(np.abs(direction))]
        top = top - (top @ direction) * direction
    top /= np.linalg.norm(top)
    return np.stack([np.cross(top, direction), top, direction])


def _is_steep(splats: Splats) -> bool:
    """Whether the plane that fits splats in the frame of a map is nearer to vertical than to level."""
    points = splats.positions[splats.opacities >= SOLID].astype(np.float64)
    return len(points) >= 3 and abs(float(_plane(points)[0][2])) < STEEP


def _fitted_normal(splats: Splats, viewpoint: np.ndarray) -> np.ndarray:
    """Fit a plane to solid splats by reweighted least squares; the normal (3,) points to the viewpoint."""
    points = splats.positions[splats.opacities >= SOLID].astype(np.float64)
    if len(points) < 3:
        raise InputError(
            "There are too few solid splats to fit a plane: "
            f"{remedy('give its direction, as in --plane 0,0,1', 'choose another one in Seen From')}."
        )
    normal, middle = _plane(points)
    return normal if normal @ (viewpoint - middle) >= 0 else -normal


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal (3,) of the plane that fits points (N, 3), and their middle (3,)."""
    weights = np.ones(len(points))
    for _ in range(FIT_ROUNDS):
        middle = np.average(points, axis=0, weights=weights)
        centred = points - middle
        _, axes = np.linalg.eigh((centred * weights[:, None]).T @ centred)
        distances = np.abs(centred @ axes[:, 0])
        limit = 2 * 1.4826 * np.median(distances)
        weights = np.maximum((distances <= limit).astype(np.float64), 1e-9)
    return axes[:, 0], middle
