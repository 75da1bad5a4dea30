"""Parts of a scene, and the files in which they are kept: what a job needs of a scene too large to be read whole."""

import json
import os
import zipfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path, inside, regular
from ..base.text import first_names
from .cameras import Camera
from .colmap import Points, Scene, View
from .georeference import read_georeference
from .lenses import Lens
from .split import Split


def part_of(scene: Scene, split: Split) -> Scene:
    """Return the part of a scene that some of its views show.

    Args:
        scene: The scene.
        split: The views of the part, by what they are for.

    Returns:
        The part: these views, and the points that they observe.
    """
    wanted = {*split.train, *split.validation, *split.test}
    views = [view for view in scene.views if view.name in wanted]
    observed = np.unique(np.concatenate([view.point_indices for view in views]))
    row = np.full(len(scene.points.positions), -1)
    row[observed] = np.arange(len(observed))
    points = scene.points
    return replace(
        scene,
        views=tuple(replace(view, point_indices=row[view.point_indices]) for view in views),
        points=Points(
            points.positions[observed], points.colors[observed], points.errors[observed], points.track_lengths[observed]
        ),
        image_count=len(views),
        missing=(),
        warnings=(),
        split_of_whole=split,
    )


def without_points(scene: Scene) -> Scene:
    """Return the views of a scene with their split, without the sparse points."""
    none = np.zeros(0, np.int64)
    return replace(
        scene,
        views=tuple(replace(view, point_indices=none) for view in scene.views),
        points=Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, np.int32)),
        split_of_whole=scene.split,
    )


def write_part(path: Path, part: Scene) -> None:
    """Write a part of a scene to a file. Images are named relative to the folder of the scene where they lie in it.

    Args:
        path: The file (.npz).
        part: The part.

    Raises:
        InputError: If the file cannot be written.
    """
    assert part.split_of_whole
    split = part.split_of_whole
    cameras, ends = [view.camera for view in part.views], np.cumsum([len(view.point_indices) for view in part.views])
    lenses = list(dict.fromkeys(view.lens for view in part.views))
    about = {
        "names": [camera.name for camera in cameras],
        "paths": [_relative(view.path, part.folder) for view in part.views],
        "images": _relative(part.image_folder, part.folder),
        "model": _relative(part.model_folder, part.folder),
        "lenses": [[lens.model, lens.width, lens.height, list(lens.params)] for lens in lenses],
        "split": [split.train, split.validation, split.test],
        "up": part.up.tolist(),
        "origin": part.origin.tolist(),
    }
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            about=np.frombuffer(json.dumps(about).encode(), np.uint8),
            sizes=np.array([[camera.width, camera.height] for camera in cameras]),
            intrinsics=np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras]),
            poses=np.stack([camera.world_to_camera for camera in cameras]),
            lens_of=np.array([lenses.index(view.lens) for view in part.views]),
            point_ends=ends,
            point_indices=np.concatenate([view.point_indices for view in part.views]),
            positions=part.points.positions,
            colors=part.points.colors,
            errors=part.points.errors,
            track_lengths=part.points.track_lengths,
        )


def read_part(path: Path, scene_folder: Path) -> Scene:
    """Read a part of a scene.

    Args:
        path: The file.
        scene_folder: Folder of the scene.

    Returns:
        The part.

    Raises:
        InputError: If the file or one of its images is missing, or the file is damaged.
    """
    try:
        # A zip file: its checksums tell when it is corrupt.
        with open(path, "rb", opener=regular) as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        about = json.loads(arrays["about"].tobytes())
        if any(name != inside(name) for name in about["names"]):
            raise ValueError("the name of a photo leads out of its folder")
        lenses = [Lens(model, width, height, tuple(params)) for model, width, height, params in about["lenses"]]
        starts = np.concatenate([[0], arrays["point_ends"][:-1]])
        views = tuple(
            View(
                Camera(name, int(width), int(height), float(fx), float(fy), float(cx), float(cy), pose),
                lenses[lens],
                scene_folder / file,
                arrays["point_indices"][start:end],
            )
            for name, file, (width, height), (fx, fy, cx, cy), pose, lens, start, end in zip(
                about["names"], about["paths"], arrays["sizes"], arrays["intrinsics"], arrays["poses"],
                arrays["lens_of"], starts, arrays["point_ends"], strict=True,
            )
        )  # fmt: skip
        points = Points(*(arrays[name] for name in ("positions", "colors", "errors", "track_lengths")))
        split = Split(*(tuple(names) for names in about["split"]))
        up, origin = np.array(about["up"]), np.array(about["origin"])
        images, model = scene_folder / about["images"], scene_folder / about["model"]
    except FileNotFoundError as error:
        raise InputError(f"{path} is missing: plan the survey again to a new folder.") from error
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        AttributeError,
        EOFError,
        zipfile.BadZipFile,
    ) as error:
        raise InputError(f"{path} is damaged ({error}): plan the survey again to a new folder.") from error
    _check_images(views, scene_folder)
    measured = read_georeference(scene_folder, origin)
    return Scene(scene_folder, images, model, views, points, len(views), (), (), up, measured, split, origin)


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix() if path.is_relative_to(folder) else str(path)


def _check_images(views: Iterable[View], scene_folder: Path) -> None:
    missing = [str(view.path) for view in views if not view.path.is_file()]
    if missing:
        raise InputError(
            f"The scene {scene_folder} is not whole on this machine; photos that are missing ({len(missing)} in all): "
            f"{first_names(missing)}. Copy them to it, or make the folder available under the same path."
        )
