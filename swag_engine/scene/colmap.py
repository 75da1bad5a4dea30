"""Reading of a COLMAP scene: images, poses, lenses and sparse points."""

import itertools
import os
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..base.errors import InputError, program, remedy
from ..base.files import inside
from ..base.foreign_files import refuse_foreign
from ..base.local_origin import local_origin
from ..base.text import first_names
from .cameras import Camera
from .colmap_binary import PARTS, Features, check_file, copy_without_points, point_records
from .colmap_library import pycolmap
from .colmap_text import copy_as_binary
from .georeference import Georeference, read_georeference
from .image_files import PHOTO_FOLDERS, FoundMasks, file_key, find_masks, image_files_below
from .lenses import Lens
from .model_folders import folders_of_models, model_suffix, points_beside, scene_of
from .model_quality import FEW_REGISTERED
from .ply_points import FEWEST_VISIBLE, read_points, visible_fraction
from .split import Split, split_views

T = TypeVar("T")

FARTHEST_CAMERA = 1e4
"""Distance of a camera from the points, over their size, beyond which its position must be wrong."""


@dataclass(frozen=True, eq=False)
class View:
    """One registered image.

    Attributes:
        camera: Camera of the undistorted image at full size.
        lens: Lens of the image file.
        path: The image file.
        point_indices: Rows (M,) int64 of `Scene.points` that COLMAP observed in the image, each once.
    """

    camera: Camera
    lens: Lens
    path: Path
    point_indices: np.ndarray

    @property
    def name(self) -> str:
        """Name of the image."""
        return self.camera.name


@dataclass(frozen=True, eq=False)
class Points:
    """The sparse points.

    Attributes:
        positions: Positions (P, 3) float64, scene units.
        colors: Display colors (P, 3) uint8 sRGB.
        errors: Reprojection errors (P,) float32, pixels; -1 where unknown.
        track_lengths: Numbers of images (P,) int32 that observe each point.
    """

    positions: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    track_lengths: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A COLMAP scene.

    Attributes:
        folder: Folder of the scene.
        image_folder: Folder of the images.
        model_folder: Folder of the COLMAP model.
        views: Views sorted by name, at least two.
        points: Sparse points, at least one.
        image_count: Number of image files in `image_folder`.
        missing: Names of the registered images that are not there.
        warnings: Sentences for the user.
        up: Unit vector (3,) float64 in the world, that of `georeference` where it was measured (see `up_direction`).
        georeference: Scale, axes and coordinates, None where they were not measured.
        split_of_whole: Split of the views of a part of a larger scene; None for a whole scene.
        origin: (3,) float64: what was subtracted from the coordinates of the model, such as those of UTM. All poses,
            positions and `georeference` are for coordinates after that.
    """

    folder: Path
    image_folder: Path
    model_folder: Path
    views: tuple[View, ...]
    points: Points
    image_count: int
    missing: tuple[str, ...]
    warnings: tuple[str, ...]
    up: np.ndarray
    georeference: Georeference | None = None
    split_of_whole: Split | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def split(self) -> Split:
        """Which views are trained on, and which are held out."""
        return self.split_of_whole or split_views(view.name for view in self.views)

    @cached_property
    def masks(self) -> FoundMasks:
        """Masks of the image files."""
        return find_masks(
            image_files_below(self.image_folder), self.image_folder, (self.folder, self.image_folder.parent)
        )

    def training_cameras(self, width: int) -> list[Camera]:
        """Return the cameras of the training images, which are at most `width` pixels wide."""
        names = set(self.split.train)
        cameras = [view.camera for view in self.views if view.name in names]
        return [camera.resized(min(width, camera.width)) for camera in cameras]

    @property
    def metres_per_unit(self) -> float:
        """Length of one scene unit in metres, 0 where it was not measured."""
        return self.georeference.metres_per_unit if self.georeference else 0.0


def load_scene(folder: Path, read_scale: bool = True) -> Scene:
    """Read a scene.

    Models are searched in the folder itself, in sparse/ and colmap/sparse/, and in the folders in them; the one with
    the most registered images is used.

    Args:
        folder: Folder of a scene, or of one COLMAP model.
        read_scale: Whether to read scale.json of the scene, too.

    Returns:
        The scene.

    Raises:
        InputError: For anything that cannot be used.
    """
    folder = Path(folder).expanduser().absolute()
    if not folder.exists():
        raise InputError(
            f"There is no folder {folder}: if the photos were moved, give their new folder, or for a run write it "
            'under "scene" in config.json of the run.'
        )
    if not folder.is_dir():
        refuse_foreign(folder)
        raise InputError(f"{folder} is not a folder.")
    warnings: list[str] = []
    model_folder, tables = _largest_model(folder, warnings)

    model = tables.cameras
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    names = _image_names(model_folder, images)
    scene_folder = scene_of(folder)
    image_folder, paths, image_count = _find_images(scene_folder, list(names.values()), warnings)
    if not len(tables.ids):
        tables = _with_ply(tables, model_folder, image_folder, scene_folder, warnings)
    points, index_of = _usable_points(tables, model_folder, warnings)
    origin = local_origin(points.positions)
    points = replace(points, positions=points.positions - origin)

    lenses = {camera_id: _lens(camera) for camera_id, camera in model.cameras.items()}
    views = [
        _view(
            image,
            names[image.image_id],
            paths[names[image.image_id]],
            lenses[image.camera_id],
            index_of(tables.observed[image.image_id]),
            origin,
        )
        for image in images
        if names[image.image_id] in paths
    ]
    missing = tuple(sorted(set(names.values()) - set(paths)))
    if len(views) < 2:
        if missing:
            raise InputError(
                f"Only {len(views)} of the {len(names)} photos of the COLMAP model {model_folder} were found in "
                f"{image_folder} ({missing[0]} is missing): put the photos into {scene_folder / 'images'}."
            )
        raise InputError(f"{model_folder} has {len(views)} registered photo(s), and a scene needs at least two.")
    if missing:
        warnings.append(
            f"{len(missing)} of the {len(names)} registered photos are not in {image_folder} and are not used: "
            f"{first_names(missing)}."
        )
    if len(names) < FEW_REGISTERED * image_count:
        warnings.append(
            f"Only {len(names)} of the {image_count} photos in {image_folder} have a pose: more overlap between "
            "neighbouring photos would help."
        )

    views.sort(key=lambda view: view.name)
    _refuse_far_cameras(views, points.positions)
    georeference = read_georeference(scene_folder, origin) if read_scale else None
    if georeference and georeference.axes != "estimated":
        up = georeference.up
    else:
        up = up_direction(np.stack([view.camera.world_to_camera for view in views]), points.positions)
    return Scene(
        folder=scene_folder,
        image_folder=image_folder,
        model_folder=model_folder,
        views=tuple(views),
        points=points,
        image_count=image_count,
        missing=missing,
        warnings=tuple(warnings),
        up=up,
        georeference=georeference,
        origin=origin,
    )


def _refuse_far_cameras(views: list[View], positions: np.ndarray) -> None:
    """Raise InputError where a camera is so far from the points (P, 3) that its position must be wrong."""
    middle = np.median(positions, axis=0)
    size = float(np.percentile(np.abs(positions - middle).max(axis=1), 90))
    far = [view.name for view in views if not np.abs(view.camera.centre - middle).max() <= FARTHEST_CAMERA * size]
    if far and size:
        raise InputError(
            f"The COLMAP model places {first_names(far)} more than {FARTHEST_CAMERA:.0e} times the size of the scene "
            "away from its points, which is impossible: correct the pose or reconstruct the scene again."
        )


def read_posed_images(model_folder: Path) -> tuple[list[tuple[str, Lens, np.ndarray]], Points]:
    """Read a model without looking for its images.

    Args:
        model_folder: Folder of the model, whose points may be missing.

    Returns:
        Name, lens and pose (3, 4) float64 from the world to the camera of each registered image; and the points.

    Raises:
        InputError: When it cannot be read.
    """
    tables = _readable(model_folder, _read_binary)
    images = [tables.cameras.image(image_id) for image_id in tables.cameras.reg_image_ids()]
    names = _image_names(model_folder, images)
    return [
        (names[image.image_id], _lens(tables.cameras.camera(image.camera_id)), image.cam_from_world().matrix())
        for image in images
    ], tables.points


def read_model(scene: Scene) -> pycolmap.Reconstruction:
    """Read the COLMAP model of a scene, with the image names of the scene.

    Raises:
        InputError: When it has changed since and cannot be read.
    """
    model = _readable(scene.model_folder, _read_with_points)
    names = _image_names(scene.model_folder, [model.image(image_id) for image_id in model.reg_image_ids()])
    for image_id, name in names.items():
        model.image(image_id).name = name
    return model


def up_direction(world_to_camera: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Estimate the up direction of a COLMAP world, whose axes are arbitrary.

    Where the points are flat, they are taken for the sea floor and up is their normal: cameras that look down, straight
    (surveys) or at an angle (remote vehicles), do not show the vertical by themselves. (A flat wall seen from the front
    is taken for a floor, too.) Otherwise the cameras are taken to be level: up is at right angles to all their x axes
    if they turn enough, else the mean of their -y axes. The sign is that of the cameras' -y axes, or, if these lie
    along the floor, towards the cameras.

    Args:
        world_to_camera: Poses (V, 4, 4).
        positions: Sparse points (P, 3).

    Returns:
        Unit vector (3,) float64.
    """
    rotations = world_to_camera[:, :3, :3]
    mean_up = -rotations[:, 1].mean(0)
    centres = -np.einsum("vji,vj->vi", rotations, world_to_camera[:, :3, 3])
    middle = np.median(positions, axis=0)
    offsets = positions - middle
    distances = np.linalg.norm(offsets, axis=1)
    offsets = offsets[distances <= np.quantile(distances, 0.9)]
    spread, axes = np.linalg.eigh(offsets.T @ offsets)
    flat = len(offsets) >= 10 and spread[0] < 0.3**2 * spread[1]
    turning, right_axes = np.linalg.eigh(np.einsum("vi,vj->ij", rotations[:, 0], rotations[:, 0]) / len(rotations))
    if flat and turning[1] > 0.1:
        up = axes[:, 0]
    elif flat:
        up = axes[:, 0] - (axes[:, 0] @ right_axes[:, 2]) * right_axes[:, 2]
    elif turning[1] > 0.1:
        up = right_axes[:, 0]
    else:
        up = mean_up
    reference = mean_up if abs(up @ mean_up) > 0.3 * np.linalg.norm(up) else (centres - middle).mean(0)
    up = up if up @ reference >= 0 else -up
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-9 else np.array([0.0, -1.0, 0.0])


# Models ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Model:
    """What is read of a COLMAP model.

    Attributes:
        cameras: Its cameras and images.
        ids: Ids (P,) uint64 of the points, ascending.
        points: The points, in this order.
        observed: Ids (M,) uint64 of the points that each image observes, by the image's id; those of other features
            are NO_POINT.
    """

    cameras: pycolmap.Reconstruction
    ids: np.ndarray
    points: Points
    observed: Mapping[int, np.ndarray]


def _largest_model(folder: Path, warnings: list[str]) -> tuple[Path, _Model]:
    """Find and read the model with the most registered images; return its folder, too."""
    folders = folders_of_models(folder)
    models = [candidate for candidate in folders if model_suffix(candidate)]
    if not models:
        for candidate in folders:
            for suffix in (".bin", ".txt"):
                parts = [f"{part}{suffix}" for part in ("cameras", "images", "points3D")]
                absent = [part for part in parts if not (candidate / part).is_file()]
                if len(absent) < 3:
                    raise InputError(
                        f"The COLMAP model in {candidate} is incomplete, as {' and '.join(absent)} is missing: copy it"
                        + (f", or {_find_points(candidate)}." if absent == [f"points3D{suffix}"] else ".")
                    )
        refuse_foreign(folder)
        raise InputError(
            f"No COLMAP model was found in {folder}, its sparse or its colmap/sparse: make one from the photos with "
            f"{remedy(f'`{program()} sfm PHOTOS --out SCENE`', 'Find Cameras')}."
        )
    read = [_readable(model, _read_binary) for model in models]
    counts = [model.cameras.num_reg_images() for model in read]
    best = int(np.argmax(counts))
    if len(models) > 1:
        warnings.append(
            f"{len(models)} COLMAP models were found, and the largest is used: {models[best].relative_to(folder)} with "
            f"{counts[best]} photos; the others have {', '.join(map(str, counts[:best] + counts[best + 1 :]))}."
        )
    return models[best], read[best]


def _read_binary(folder: Path) -> _Model:
    """Read a binary model. pycolmap reads cameras and poses: a survey's points would take it minutes and gigabytes."""
    model = pycolmap.Reconstruction()
    with tempfile.TemporaryDirectory() as temporary:
        observed = dict(copy_without_points(folder, Path(temporary)))
        model.read_binary(temporary)
    for image_id in model.reg_image_ids():  # raises where frames name images that are not there
        model.image(image_id).cam_from_world()
    _normalise_rotations(model)
    features = Features.of(observed)
    del observed
    chunks = []
    for heads, tracks in _point_records(folder):
        features.check(heads, tracks)
        chunks.append(heads)
    ids = np.concatenate([np.zeros(0, np.uint64), *(chunk["id"] for chunk in chunks)])
    order = np.argsort(ids, kind="stable")
    ids = ids[order]
    if (ids[1:] == ids[:-1]).any():
        raise ValueError("Two points have the same id.")

    def column(name: str, kind: type, *shape: int) -> np.ndarray:
        empty: np.ndarray = np.zeros((0, *shape), kind)
        return np.concatenate([empty, *(chunk[name].astype(kind) for chunk in chunks)])[order]

    points = Points(
        positions=column("xyz", np.float64, 3),
        colors=column("color", np.uint8, 3),
        errors=column("error", np.float32),
        track_lengths=column("track_length", np.int32),
    )
    return _Model(model, ids, points, features.by_image())


def _read_with_points(folder: Path) -> pycolmap.Reconstruction:
    """Read a binary model as pycolmap has it."""
    model = pycolmap.Reconstruction()
    for part in PARTS:
        if (folder / f"{part}.bin").is_file():
            check_file(folder / f"{part}.bin")
    if any(len(heads) for heads, _ in _point_records(folder)):
        model.read_binary(str(folder))
    else:  # images may still observe points that are not there
        with tempfile.TemporaryDirectory() as temporary:
            for _ in copy_without_points(folder, Path(temporary)):
                pass
            model.read_binary(temporary)
    _normalise_rotations(model)
    return model


def _point_records(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Read the points of a binary model, none where it has no file of them."""
    path = folder / "points3D.bin"
    return point_records(path) if path.is_file() else iter(())


def _normalise_rotations(model: pycolmap.Reconstruction) -> None:
    """Normalise the quaternions of poses, which pycolmap reads as they are and other writers round.

    Raises:
        InputError: Where one is zero.
    """

    def normalised(pose: pycolmap.Rigid3d) -> pycolmap.Rigid3d | None:
        length = np.linalg.norm(pose.rotation.quat)
        return (
            None
            if length < 1e-6
            else pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation.quat / length), pose.translation)
        )

    for frame in model.frames.values():
        if frame.has_pose():
            if (pose := normalised(frame.rig_from_world)) is None:
                name = ", ".join(model.image(data.id).name for data in frame.image_ids)
                raise InputError(
                    f"The rotation of {name} in the COLMAP model is zero: correct it or reconstruct again."
                )
            frame.rig_from_world = pose
    for rig in model.rigs.values():
        for sensor, of_sensor in rig.non_ref_sensors.items():
            if of_sensor is not None:
                if (pose := normalised(of_sensor)) is None:
                    raise InputError(f"The rotation of camera {sensor.id} in its rig is zero: reconstruct again.")
                rig.set_sensor_from_rig(sensor, pose)


def _readable(folder: Path, read: Callable[[Path], T]) -> T:
    """Return what `read` returns of the model as a binary one.

    Raises:
        InputError: Where the files of the model cannot be read or disagree.
    """
    try:
        if model_suffix(folder) == ".bin" or not (folder / "images.txt").is_file():
            return read(folder)
        with tempfile.TemporaryDirectory() as temporary:
            copy_as_binary(folder, Path(temporary))
            return read(Path(temporary))
    except OSError as error:
        raise InputError(f"Cannot read {error.filename or folder}: {error.strerror or error}.") from error
    except (ValueError, IndexError, RuntimeError, MemoryError) as error:
        raise InputError(
            f"The COLMAP model in {folder} is damaged, as its files do not fit together: export it from COLMAP again."
        ) from error


def _image_names(model_folder: Path, images: list[pycolmap.Image]) -> dict[int, str]:
    """Return COLMAP's image names by image id, with forward slashes."""
    try:
        cleaned = {image.image_id: inside(image.name) for image in images}
    except UnicodeDecodeError as error:
        raise InputError(
            f"The COLMAP model {model_folder} has image names that are not UTF-8: rename the photos with plain "
            "letters and reconstruct the scene again."
        ) from error
    if len(set(cleaned.values())) < len(cleaned):
        raise InputError(f"The COLMAP model {model_folder} gives two photos the same name: reconstruct it again.")
    return cleaned


def _find_points(model: Path, images: str = "PHOTOS", out: str = "SCENE") -> str:
    """Return how to find points for a model that has none."""
    command = f'`{program()} import-cameras "{model}" --photos {images} --out {out}`'
    return f"find points in the photos with {remedy(command, 'Import Cameras')}"


def _with_ply(model: _Model, model_folder: Path, images: Path, scene: Path, warnings: list[str]) -> _Model:
    """Return a model without points with those of the PLY file beside it, which no photo is known to observe."""
    find_them = _find_points(model_folder, f'"{images}"', f'"{scene}_points"')
    ply = points_beside(model_folder)
    if ply is None:
        raise InputError(f"The COLMAP model in {model_folder} has no points: {find_them}.")
    positions, colors = read_points(ply)
    cameras = [
        (image.cam_from_world().matrix(), _lens(model.cameras.camera(image.camera_id)))
        for image in map(model.cameras.image, model.cameras.reg_image_ids())
    ]
    visible = visible_fraction(positions, cameras)
    if visible < FEWEST_VISIBLE:
        raise InputError(
            f"Only {visible:.0%} of the points of {ply} are in front of the cameras of the COLMAP model, which has no "
            f"points itself: remove the file, and {find_them}."
        )
    warnings.append(f"The COLMAP model in {model_folder} has no points: those of {ply} are used.")
    points = Points(
        positions,
        colors if len(colors) else np.full((len(positions), 3), 128, np.uint8),
        np.full(len(positions), -1, np.float32),
        np.zeros(len(positions), np.int32),
    )
    nothing = dict.fromkeys(model.observed, np.zeros(0, np.uint64))
    return replace(model, ids=np.arange(len(positions), dtype=np.uint64), points=points, observed=nothing)


def _lens(camera: pycolmap.Camera) -> Lens:
    return Lens(camera.model.name, camera.width, camera.height, tuple(float(value) for value in camera.params))


def _usable_points(
    model: _Model, model_folder: Path, warnings: list[str]
) -> tuple[Points, Callable[[np.ndarray], np.ndarray]]:
    """Return the points with finite positions, and a function from COLMAP's ids to their rows, each once, ascending."""
    ids, points = model.ids, model.points
    with np.errstate(over="ignore"):  # Gaussians and Blender take float32
        finite = np.isfinite(points.positions.astype(np.float32)).all(1)
    if not finite.all():
        warnings.append(
            f"{np.count_nonzero(~finite)} points of {model_folder} have no finite position and are not used."
        )
        ids = ids[finite]
        points = Points(**{name: values[finite] for name, values in vars(points).items()})
        if not len(ids):
            raise InputError(f"No point of the COLMAP model in {model_folder} has a finite position.")

    def rows(wanted: np.ndarray) -> np.ndarray:
        wanted = np.unique(wanted)
        at = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
        return at[ids[at] == wanted]

    return points, rows


def _view(
    image: pycolmap.Image, name: str, path: Path, lens: Lens, point_indices: np.ndarray, origin: np.ndarray
) -> View:
    world_to_camera = np.eye(4)
    world_to_camera[:3] = image.cam_from_world().matrix()
    if not np.isfinite(world_to_camera).all():
        raise InputError(f"The COLMAP model's pose of {name} is not finite: reconstruct the scene again.")
    if lens.fault:
        raise InputError(
            f"Camera {image.camera_id} ({lens.model}) of the COLMAP model, that of {name}, is impossible, as "
            f"{lens.fault}: correct it or reconstruct the scene again."
        )
    world_to_camera[:3, 3] += world_to_camera[:3, :3] @ origin
    pinhole = lens.pinhole
    return View(
        camera=Camera(
            name, pinhole.width, pinhole.height, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, world_to_camera
        ),
        lens=lens,
        path=path,
        point_indices=point_indices,
    )


# Images ---------------------------------------------------------------------------------------------------------------


def _key(name: str, extension: bool = True) -> str:
    return file_key(name if extension else os.path.splitext(name)[0])


def _converted(
    names: list[str], found: dict[str, Path], files: list[Path], folder: Path, by_basename: bool
) -> dict[str, Path]:
    """Return the file of each name that is not found, where both alone have that name without extension."""
    of_key: dict[str, list[Path]] = defaultdict(list)
    for path in files:
        of_key[_key(path.relative_to(folder).as_posix(), False)].append(path)
    keys = {name: _key(name.rsplit("/", 1)[-1] if by_basename else name, False) for name in names}
    count = Counter(keys.values())
    return {
        name: of_key[key][0]
        for name, key in keys.items()
        if name not in found and count[key] == 1 and len(of_key.get(key, ())) == 1
    }


def _find_images(scene: Path, names: list[str], warnings: list[str]) -> tuple[Path, dict[str, Path], int]:
    """Find the folder of the images, the file of each name, and the number of image files in the folder.

    All come from one folder: the one with the most of the names, images/ and input/ before others. Case does not
    matter. If no folder holds any of the names, they are compared without their folders, then without extensions. Last,
    images/ and input/ beside the scene are tried, as the folder of a model may have been given as the scene.
    """
    for root in (scene, scene.parent / "images", scene.parent / "input"):
        files = image_files_below(root) if root.is_dir() else []
        for extension, by_basename in itertools.product((True, False), (False, True)):
            wanted = {_key(name.rsplit("/", 1)[-1] if by_basename else name, extension): name for name in names}
            hits: dict[tuple[str, ...], dict[str, Path]] = {}
            for path in files:
                parts = path.relative_to(root).parts
                for depth in [len(parts) - 1] if by_basename else range(len(parts)):
                    name = wanted.get(_key("/".join(parts[depth:]), extension))
                    if name is not None:
                        found = hits.setdefault(parts[:depth], {})
                        if name not in found or path.name == name.rsplit("/", 1)[-1]:  # prefer the same case
                            found[name] = path
            if not hits:
                continue
            best = min(
                hits,
                key=lambda parts: (
                    -len(hits[parts]),
                    PHOTO_FOLDERS.index(parts[-1].lower()) if parts and parts[-1].lower() in PHOTO_FOLDERS else 2,
                    len(parts),
                    parts,
                ),
            )
            folder = root.joinpath(*best)
            inside = [path for path in files if path.is_relative_to(folder)]
            found = hits[best] if extension else {}
            converted = _converted(names, found, inside, folder, by_basename)
            if not extension and not converted:
                continue
            if by_basename:
                warnings.append(f"The photos in {folder} were matched by file name, without folders.")
            if converted:
                pairs = [f"{path.name} for {name}" for name, path in sorted(converted.items())]
                warnings.append(
                    f"{len(pairs)} photos have other extensions than in the COLMAP model and were taken by their names "
                    f"without extension: {first_names(pairs)}."
                )
            return folder, found | converted, len(inside)
    example = sorted(names)[0] if names else "any"
    raise InputError(
        f"None of the {len(names)} photos of the COLMAP model ({example} ...) was found in {scene}: put them into "
        f"{scene / 'images'}."
    )
