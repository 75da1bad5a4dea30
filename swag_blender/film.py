"""Films: the camera animation of the scene, rendered by the engine's rasteriser. Settings, request, result."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, PointerProperty, StringProperty
from bpy.types import PropertyGroup

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from ..swag_engine.formats.camera_path import PathFrame, write_camera_path
from ..swag_engine.formats.cameras import transform_camera
from ..swag_engine.formats.ply import write_ply
from ..swag_engine.formats.run_folder import write_json
from ..swag_engine.splats.splats import concatenate
from ..swag_engine.splats.transform import transformed
from . import background, colors, splats, water
from .blender_types import present, with_properties
from .cameras import camera_of, render_size
from .engine_process import Engine
from .nodes import splat_preview
from .properties import swag_of
from .runs import water_run
from .splat_parts import part_of

VIDEO = "film.mp4"
"""Name of a video in the output folder."""
SAME_PLACE = 1e-4
"""How far the matrix of an object may change during a film."""


@with_properties
class SwagFilm(PropertyGroup):
    """`scene.swag_film`: where films go and what they are; the rest is in Blender's own output properties."""

    output: Annotated[
        str,
        StringProperty(
            name="Folder",
            description="Folder of the film; empty: the folder film in the folder of the run",
            subtype="DIR_PATH",
        ),
    ]
    kind: Annotated[
        str,
        EnumProperty(
            name="Format",
            description="Files that the film is written to",
            items=[
                (
                    "IMAGES",
                    "Image Sequence",
                    "A PNG file for each frame, without loss; a stopped film can be continued",
                ),
                ("VIDEO", "Video", "film.mp4 (MPEG-4), to look at; it is written when all frames are done"),
            ],
        ),
    ]
    depth: Annotated[
        bool,
        BoolProperty(
            name="Depth",
            description="Write the distance along the camera's axis in Blender units to an OpenEXR file for each frame",
        ),
    ]


def film_of(scene: bpy.types.Scene) -> SwagFilm:
    """Film settings of a scene."""
    return cast(Any, scene).swag_film


class FilmEngine(Engine):
    """The engine at work on the film of a scene; the files that it reads are removed when it ends.

    Raises:
        EngineError: it cannot be started.
        InputError: as `film_request` does.
    """

    def __init__(self, context: bpy.types.Context) -> None:
        super().__init__()
        self._files = tempfile.TemporaryDirectory(prefix="swag-film-")
        try:
            self.send(film_request(context, Path(self._files.name)))
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the child and remove its files."""
        super().stop()
        self._files.cleanup()


def film_request(context: bpy.types.Context, folder: Path) -> dict[str, Any]:
    """Write splats, water and cameras of a film for the engine, and return the request.

    What is rendered: the splats that are shown, as they are in the first frame, with the amount of water of each frame,
    and developed as the scene's colors are now.
    Water, lamp and background are those of the run of the splats; where the run is not on this machine, those that the
    object remembers. The cameras stay in the output folder, for the command `film`.

    Args:
        context: its scene has the frame range, the camera and the output properties.
        folder: for files that only the engine needs.

    Raises:
        InputError: no splats, no camera, a camera or a placement that cannot be rendered, or no output folder.
    """
    scene = present(context.scene)
    objects = shown_objects(context)
    if not objects:
        raise InputError("There are no splats to film: show some in the viewport and enable them in renders.")
    # The frame of the first object is that of its run, in which its water is known.
    first = background.find(objects, context.active_object)
    objects.sort(key=lambda obj: obj != first)
    source, render = objects[0], scene.render
    out = output_folder(scene, source)
    splats_file, cameras_file = folder / "splats.ply", out / "cameras.json"
    with _previews_off(objects), _frame_kept(scene):
        scene.frame_set(scene.frame_start)
        placements = _placements(context, objects)
        parts = [part_of(obj, np.array(obj.matrix_world, np.float64), "VISIBLE") for obj in objects]
        parts = [
            part if np.array_equal(matrix, np.eye(4)) else transformed(part, matrix)
            for part, matrix in zip(parts, placements, strict=True)
        ]
        frames = [
            _path_frame(context, objects, placements, number)
            for number in range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        ]
        unit = float(np.cbrt(np.linalg.det(_matrix(context, source)[:3, :3])))
    joined = concatenate(parts)
    if not len(joined):
        raise InputError("There are no splats to film: all of them are hidden or cropped.")
    write_ply(splats_file, joined)
    write_camera_path(cameras_file, frames)
    request: dict[str, Any] = {
        "request": "film",
        "cameras": str(cameras_file),
        "splats": str(splats_file),
        "out": str(out / VIDEO if film_of(scene).kind == "VIDEO" else out),
        "alpha": render.film_transparent,
        "depth": film_of(scene).depth,
        "overwrite": render.use_overwrite,
        "fps": render.fps / render.fps_base,
        "unit": unit,
        "colors": colors.color_view(scene, colors.find(scene, context.active_object)).to_json(),
    }
    run = _run_of(source)
    if run is not None and list(run.glob("checkpoint-*.safetensors")):
        return request | {"run": str(run)}
    request["background"] = background.color_behind(source) or (0.0, 0.0, 0.0)
    if (values := water.water_of(source)) is not None:
        write_json(folder / "water.json", values.to_json())
        request["water"] = str(folder / "water.json")
    return request


def output_folder(scene: bpy.types.Scene, obj: bpy.types.Object) -> Path:
    """The absolute path of the film folder of a scene whose splats are those of `obj`.

    Raises:
        InputError: none is chosen and the splats are from no run on this machine, or the folder that it lies in does
            not exist.
    """
    chosen, run = film_of(scene).output, _run_of(obj)
    if chosen:
        return require_parent(Path(os.path.abspath(bpy.path.abspath(chosen))))
    if run is None:
        raise InputError("Choose the folder of the film first: the splats are from no run on this machine.")
    return run / "film"


def shown_objects(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The splat objects that are visible in the viewport and enabled in renders."""
    return [
        obj
        for obj in context.visible_objects
        if splats.is_splats(obj)
        and not obj.hide_render
        and not any(collection.hide_render for collection in obj.users_collection)
    ]


def _path_frame(
    context: bpy.types.Context, objects: list[bpy.types.Object], placements: list[np.ndarray], number: int
) -> PathFrame:
    """The camera of a frame in the frame of the first object. Raises InputError for what cannot be rendered."""
    scene = present(context.scene)
    scene.frame_set(number)
    moved = [
        obj
        for obj, now, first in zip(objects, _placements(context, objects), placements, strict=True)
        if not np.allclose(now, first, rtol=SAME_PLACE, atol=SAME_PLACE)
    ]
    if moved:
        raise InputError(
            f"{moved[0].name} moves relative to {objects[0].name} in frame {number}, which a film cannot show: remove "
            "its animation, or render with Cycles."
        )
    camera = scene.camera
    if camera is None:
        raise InputError("The scene has no camera: add one, such as a turntable.")
    if not isinstance(camera.data, bpy.types.Camera) or camera.data.type != "PERSP":
        raise InputError(f"{camera.name} is no perspective camera: change its lens type to Perspective.")
    in_world = camera_of(camera, context.evaluated_depsgraph_get(), *render_size(scene))
    into_source = np.linalg.inv(_matrix(context, objects[0]))
    named = replace(transform_camera(in_world, into_source), name=f"{number:04d}")
    return PathFrame(named, swag_of(scene).water, swag_of(scene).haze)


def _placements(context: bpy.types.Context, objects: list[bpy.types.Object]) -> list[np.ndarray]:
    """Matrix (4, 4) from each object to the first one. Raises InputError as `_matrix` does."""
    into_first = np.linalg.inv(_matrix(context, objects[0]))
    return [np.eye(4), *(into_first @ _matrix(context, obj) for obj in objects[1:])]


def _matrix(context: bpy.types.Context, obj: bpy.types.Object) -> np.ndarray:
    """Matrix (4, 4) float64 of an object with parents, constraints and animation.

    Raises:
        InputError: it is no rotation with one scale, so that splats are no splats after it.
    """
    matrix = np.array(obj.evaluated_get(context.evaluated_depsgraph_get()).matrix_world, np.float64)
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    if scale <= 0 or not np.allclose(linear.T @ linear / scale**2, np.eye(3), atol=1e-3):
        raise InputError(f"{obj.name} is mirrored or not scaled equally along its axes: give it one scale above 0.")
    return matrix


def _run_of(obj: bpy.types.Object) -> Path | None:
    """The folder of the run that the water of a splat object is from, None where it is not on this machine."""
    run = water_run(obj)
    return run.path if run is not None and run.config.exists() else None


@contextlib.contextmanager
def _previews_off(objects: list[bpy.types.Object]) -> Iterator[None]:
    """Turn the previews of splat objects off: Blender would compute them anew for the camera of each frame."""
    shown = [m for m in map(splat_preview.modifier_of, objects) if m is not None and m.show_viewport]
    for modifier in shown:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in shown:
            modifier.show_viewport = True


@contextlib.contextmanager
def _frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Go back to the current frame at the end, and to its camera, which markers may have changed."""
    number, subframe, camera = scene.frame_current, scene.frame_subframe, scene.camera
    try:
        yield
    finally:
        scene.frame_set(number, subframe=subframe)
        scene.camera = camera


def register() -> None:
    """Register the settings with scenes."""
    bpy.utils.register_class(SwagFilm)
    cast(Any, bpy.types.Scene).swag_film = PointerProperty(type=SwagFilm)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_film
    bpy.utils.unregister_class(SwagFilm)
