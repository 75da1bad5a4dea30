"""The result of a run as files that other programs read."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..base.errors import InputError
from ..scene.cameras import Camera
from ..splats.splats import Splats
from ..splats.transform import transformed
from . import water
from .cameras import Photograph, moved, write_cameras
from .gltf import glb_size, turn_to_y_up, write_glb
from .ply import ply_size, read_ply, write_ply
from .run_folder import RunFolder, write_json
from .select import Choice, box_between, label_ids, something

if TYPE_CHECKING:
    from ..scene.colmap import Scene

Up = Literal["scene", "y-down", "y-up", "z-up"]
# From y up.
TURNS = {"y-up": np.eye(3), "y-down": np.diag([1.0, -1, -1]), "z-up": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}


@dataclass(frozen=True)
class ExportOptions:
    """What a user chooses about an exported file. Raises InputError for a value that makes no sense."""

    water: float = 0.0
    """How much water the colours show, from 0 (taken away) to 1, as each splat looked from where it was photographed;
    from elsewhere it is not right, and the open water behind the splats is not in the file."""
    labels: tuple[str, ...] = ()
    """Only splats with these labels, by name or number; all without it."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Only splats in the box between two corners x y z x y z, in coordinates of the scene."""
    min_opacity: float = 0.0
    """Only splats of at least this opacity, 0 to 1."""
    sh_degree: int = 3
    """Most spherical harmonics: 0 keeps colours that do not change with the view, and makes the smallest file."""
    extras: bool = True
    """Keep further properties of the splats, such as labels."""
    up: Up = "scene"
    """Axes of a PLY: as the scene has them, or turned upright (viewers show y-down upright). A GLB always has y up."""
    metres_per_unit: float | None = None
    """Scale to metres by the length of one unit of the scene; what the run knows without it, else unscaled."""
    cameras: bool = False
    """Write the cameras too: in a GLB, and beside the file to NAME_cameras as COLMAP text, transforms.json and, where
    the run has a water, water.json, all in the file's axes and scale."""
    forecast: bool = False
    """Write nothing, only say how large the file would be."""

    def __post_init__(self) -> None:
        for name, most in (("water", 1), ("min_opacity", 1), ("sh_degree", 3)):
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"The {name.replace('_', ' ')} must be from 0 to {most}, not {getattr(self, name)}.")
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise InputError(f"The metres per unit must be more than 0, not {self.metres_per_unit}.")


def export_run(folder: Path, format: str, out: Path, options: ExportOptions | None = None) -> dict[str, Any]:
    """Write the result of the run `folder` to `out` as "ply" (3DGS) or "glb" (KHR_gaussian_splatting, Y up).

    Returns `out`, `splats` (their number), `bytes`, `files` (all that were written) and `notes` (sentences for the
    user). Raises InputError when the folder is no run or has no result yet, when nothing is left to write, or when
    `out` cannot be written.
    """
    options = options or ExportOptions()
    run = RunFolder(folder)
    scene_folder, settings, up = run.read_config()
    if not run.ply.exists():
        raise InputError(f"The run {folder} has no result yet; continue it with train --resume.")
    scene = None
    if options.cameras or options.water:
        from ..scene.colmap import load_scene

        scene = load_scene(scene_folder)
    choice = Choice(
        labels=label_ids(options.labels, folder / "labels.json") if options.labels else None,
        box=box_between(options.box[:3], options.box[3:]) if options.box else None,
        min_opacity=options.min_opacity,
        sh_degree=options.sh_degree,
        extras=options.extras,
    )
    splats = something(choice.of(read_ply(run.ply)))
    medium = run.read_water()
    if options.water and scene:
        splats = with_water(splats, medium, [v.camera for v in scene.views], options.water, settings.metres_per_unit)
    metres = options.metres_per_unit or settings.metres_per_unit
    place = np.diag([metres or 1.0] * 3 + [1.0])
    turn = np.eye(3)
    if format == "glb" or options.up != "scene":
        turn = (TURNS["y-up"] if format == "glb" else TURNS[options.up]) @ turn_to_y_up(up)
    whole = place.copy()
    whole[:3, :3] = turn @ place[:3, :3]
    # A GLB's own node turns its splats.
    splats = apply(splats, place if format == "glb" else whole)
    inside = [moved(view.camera, place) for view in scene.views] if scene and options.cameras else []
    result: dict[str, Any] = {"out": str(out), "splats": len(splats), "files": [], "notes": []}
    result["bytes"] = ply_size(out, splats) if format == "ply" else glb_size(out, splats, up, inside)
    if options.forecast:
        return result
    if format == "ply":
        write_ply(out, splats)
    else:
        write_glb(out, splats, up, inside)
    files = [out]
    if options.cameras and scene:
        beside = cameras_folder(out)
        points = scene.points.positions @ whole[:3, :3].T
        photographs = _photographs(scene, whole, beside)
        written, result["notes"] = write_cameras(beside, photographs, points, scene.points.colors)
        files += written
        if medium:
            sea = water.placed(medium, turn, metres or 1.0, settings.metres_per_unit, bool(metres))
            write_json(beside / "water.json", sea)
            files.append(beside / "water.json")
    result["files"] = [str(path) for path in files]
    return result


def with_water(
    splats: Splats, medium: dict[str, Any] | None, cameras: Sequence[Camera], amount: float, metres_per_unit: float
) -> Splats:
    """The splats with that much of a run's water (the contents of water.json, None where it has none).

    metres_per_unit: the run's setting. Raises InputError when there is no water to add, unless all of it is asked for:
    it is in the colours then.
    """
    if medium:
        return water.baked(splats, medium, cameras, amount, metres_per_unit)
    if amount == 1:
        return splats
    raise InputError("The run took no water away, so its colours hold all of it: export it with water 1 or 0.")


def apply(splats: Splats, matrix: np.ndarray) -> Splats:
    """The transformed splats; themselves, bit for bit, where the matrix (4, 4) changes nothing."""
    return splats if np.array_equal(matrix, np.eye(4)) else transformed(splats, matrix)


def cameras_folder(out: Path) -> Path:
    """Where the cameras of an exported file go."""
    return out.with_name(f"{out.stem}_cameras")


def describe(result: dict[str, Any]) -> str:
    """The lines that `export RUN` prints."""
    size = f"{result['splats']} splats, {result['bytes'] / 1e6:.1f} MB"
    if not result["files"]:
        return f"{result['out']} would have {size}."
    return "\n".join([f"{result['files'][0]}: {size}", *result["files"][1:], *result["notes"]])


def _photographs(scene: "Scene", matrix: np.ndarray, folder: Path) -> list[Photograph]:
    """The scene's photographs as they are on disk, named from `folder`."""

    def named(path: Path) -> str:
        try:
            return Path(os.path.relpath(path, folder)).as_posix()
        except ValueError:  # another drive
            return path.as_posix()

    return [
        Photograph(
            moved(view.camera, matrix), view.lens.model, view.lens.width, view.lens.height, view.lens.params,
            named(view.path),
        )
        for view in scene.views
    ]  # fmt: skip
