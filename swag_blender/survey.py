"""A survey in a Blender scene: its settings, where its objects are placed, and its splats.

The splats of a survey are one object. It holds tiles of several levels of detail that cover each place once; the point
attribute `survey_tile` (INT) of a splat is the number of its tile in tiles.json. Tiles that stay loaded keep what the
user did to their splats.
"""

import itertools
import json
import os
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
import numpy as np
from bpy.props import IntProperty, PointerProperty, StringProperty
from bpy.types import PropertyGroup

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from ..swag_engine.base.text import command_text
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.survey_detail import finest_level, refine
from ..swag_engine.formats.survey_folder import Box, Survey, SurveyFolder
from ..swag_engine.formats.survey_tiles import Tile, Tiles
from ..swag_engine.splats.splats import Splats, concatenate
from . import background, colors, crop_box, framing, labels, scene_import, splats, water
from .blender_types import present, with_properties
from .nodes import splat_preview
from .properties import swag_of
from .runs import SURVEY_KEY
from .visibility import View

TILE = "survey_tile"
"""Point attribute: number of the splat's tile in tiles.json. Not an extra of the splats, so it is not exported."""
TILES_KEY = "swag_survey_tiles"
"""Property of the object with the tiles of a survey: checksum of the tiles.json that they are numbered by."""
LEVELS_KEY = "swag_survey_levels"
"""Property of that object: number of tiles of each level, as JSON."""
FINEST_SPACING = 1.0
"""Distance in pixels between neighbouring splats on the screen below which a tile is fine enough for a view."""


@with_properties
class SwagSurvey(PropertyGroup):
    """`scene.swag_survey`: the survey that the scene works on."""

    folder: Annotated[
        str,
        StringProperty(
            name="Survey",
            description="Folder of the survey; empty: the folder swag_survey beside the photos",
            subtype="DIR_PATH",
        ),
    ]
    block_images: Annotated[
        int,
        IntProperty(
            name="Photos per Block",
            description="A block is divided until it has at most this number of photos",
            default=300,
            min=10,
            soft_max=1500,
            max=100_000,
        ),
    ]
    budget: Annotated[
        int,
        IntProperty(
            name="Splats",
            description="Largest number of splats of the survey that are loaded at a time",
            default=500_000,
            min=1000,
            soft_max=3_000_000,
            max=100_000_000,
            step=100_000,
        ),
    ]
    box: Annotated[
        bpy.types.Object | None,
        PointerProperty(
            type=bpy.types.Object,
            name="Box Object",
            description="Object in whose bounds Load Box loads the finest tiles; empty: the crop box of the splats",
            poll=lambda self, obj: obj.type in {"EMPTY", "MESH"} and not obj.get(SURVEY_KEY),
        ),
    ]


def survey_of(scene: bpy.types.Scene | None) -> SwagSurvey:
    """Settings of the survey of a scene."""
    return cast(Any, scene).swag_survey


def survey_path(scene: bpy.types.Scene) -> str:
    """Absolute path of the folder of the scene's survey, which need not exist; "" without it and without photos."""
    folder, photos = survey_of(scene).folder, swag_of(scene).scene_path
    if folder:
        return os.path.abspath(bpy.path.abspath(folder))
    return os.path.join(photos, "swag_survey") if photos else ""


def chosen_survey(scene: bpy.types.Scene) -> SurveyFolder | None:
    """The survey of a scene; None where its folder holds none."""
    path = survey_path(scene)
    folder = SurveyFolder(Path(path))
    return folder if path and folder.survey.is_file() else None


def find_survey(path: Path) -> SurveyFolder:
    """The survey of a folder, or of a file in it such as survey.json. Raises InputError where there is none."""
    folder = SurveyFolder((path if path.is_dir() else path.parent).absolute())
    if not folder.survey.is_file():
        raise InputError(f"{folder.path} is not the folder of a survey: choose the one that has survey.json.")
    return folder


def plan_request(context: bpy.types.Context) -> dict[str, Any]:
    """The engine's request to plan a survey of the chosen photos, without the folder of the photos.

    Raises:
        InputError: the folder holds a survey already, or the folder that it lies in does not exist.
    """
    scene = present(context.scene)
    if (known := chosen_survey(scene)) is not None:
        raise InputError(f"{known.path} holds a survey already: choose another folder in Survey.")
    return {
        "request": "plan_survey",
        "out": str(require_parent(Path(survey_path(scene)))),
        "settings": swag_of(scene).train_settings(),
        "block_images": survey_of(scene).block_images,
    }


def run_command(folder: str, blender: bool) -> str:
    """The command that trains a survey in a terminal.

    Args:
        folder: of the survey.
        blender: whether this Blender runs it, with the engine of the extension; otherwise any Python with the engine.
    """
    program = [bpy.app.binary_path or "blender", "--background", "--command", "swag"] if blender else None
    return command_text([*(program or ["swag"]), "survey", "run", folder])


# -- objects ----------------------------------------------------------------------------------------------------------


def objects_of(scene: bpy.types.Scene, folder: SurveyFolder) -> list[bpy.types.Object]:
    """The splats and the map of a survey in a scene."""
    return [obj for obj in scene.objects if obj.get(SURVEY_KEY) == str(folder.path)]


def splats_of_survey(scene: bpy.types.Scene, folder: SurveyFolder) -> bpy.types.Object | None:
    """The splats of a survey in a scene; None where there are none."""
    return next((obj for obj in objects_of(scene, folder) if holds_tiles(obj)), None)


def holds_tiles(obj: bpy.types.Object | None) -> bool:
    """Whether an object is the splats of a survey; a part that was separated from them is not."""
    return obj is not None and splats.is_splats(obj) and obj.get(TILES_KEY) is not None


def root_of(scene: bpy.types.Scene, survey: Survey) -> bpy.types.Object | None:
    """The root of the imported scene of the photos of a survey."""
    for root in scene_import.roots(scene):
        if Path(root[scene_import.ROOT_KEY]).resolve() == survey.scene.resolve():
            return root
    return None


def place(obj: bpy.types.Object, scene: bpy.types.Scene, folder: SurveyFolder, survey: Survey) -> None:
    """Place a new object in the coordinates of the scene of a survey where its cameras or other objects are.

    Without any the survey is upright, with its ground at height 0 and the middle of its bounds above the origin.
    """
    obj[SURVEY_KEY] = str(folder.path)
    others = [other for other in objects_of(scene, folder) if other != obj]
    if (root := root_of(scene, survey)) is not None:
        obj.parent = root
    elif others:
        obj.parent = others[0].parent
        obj.matrix_basis = others[0].matrix_basis.copy()
    else:
        up = np.array(survey.ground.axes[2])
        obj.matrix_world = scene_import.colmap_to_blender(up, corners_on_ground(survey, survey.bounds))


def corners_on_ground(survey: Survey, box: Box) -> np.ndarray:
    """Corners (4, 3) of a box on the ground in the coordinates of the scene, counterclockwise seen from above."""
    left, bottom, right, top = box
    on_ground = np.array([(left, bottom, 0.0), (right, bottom, 0.0), (right, top, 0.0), (left, top, 0.0)])
    return on_ground @ np.array(survey.ground.axes) + np.array(survey.ground.origin)


def adopt_surveys(root: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Put the splats and maps of surveys of a scene that was just imported below its root."""
    for obj in list(scene.objects):
        if not obj.get(SURVEY_KEY) or obj.parent is not None:
            continue
        folder = SurveyFolder(Path(obj[SURVEY_KEY]))
        try:
            survey = folder.read()
            if root_of(scene, survey) == root:
                obj.parent = root
                obj.matrix_parent_inverse.identity()
                obj.matrix_basis.identity()
                if splats.is_splats(obj):
                    _know_survey(obj, folder, survey, read_tiles(folder))
                    scene_import.hide_sparse_points(root)
        except InputError:
            continue


def _hide_map(scene: bpy.types.Scene, folder: SurveyFolder) -> None:
    """Hide the map of a survey in viewports, for splats that are shown in its place; Show Blocks makes a new one."""
    for obj in objects_of(scene, folder):
        if not splats.is_splats(obj):
            for one in (obj, *obj.children_recursive):
                one.hide_viewport = True


# -- tiles ------------------------------------------------------------------------------------------------------------


def open_survey(context: bpy.types.Context, path: Path) -> tuple[bpy.types.Object, str]:
    """Show a merged survey in the scene by the finest level that fits the number of splats, and select it.

    Args:
        context: where the splats go: its scene.
        path: the folder of the survey, or a file in it.

    Returns:
        The splat object, and what to tell the user.

    Raises:
        InputError: there is no survey, it is not merged, or a file of it is damaged.
    """
    folder = find_survey(path)
    survey, tiles = folder.read(), read_tiles(folder)
    scene = present(context.scene)
    wanted = finest_level(tiles, survey_of(scene).budget)
    obj = splats_of_survey(scene, folder)
    if obj is None:
        root = root_of(scene, survey)
        collection = root.users_collection[0] if root else scene.collection
        obj = splats.new_splat_object(f"{folder.path.name} Survey", _read(tiles, wanted), collection)
        place(obj, scene, folder, survey)
        _write_numbers(obj, folder, np.concatenate(_numbers(tiles, wanted)), wanted)
        scene_import.hide_sparse_points(root)
        _hide_map(scene, folder)
    else:
        exchange_tiles(obj, folder, tiles, wanted)
    _know_survey(obj, folder, survey, tiles)
    survey_of(scene).folder = str(folder.path)
    if survey.scene.is_dir():
        swag_of(scene).scene_folder = str(survey.scene)
    if context.mode == "OBJECT" and present(context.view_layer).objects.get(obj.name):
        splats.select_only(context, [obj])
    framing.frame_first_splats(context, [obj])
    return obj, describe(obj)


def read_tiles(folder: SurveyFolder) -> Tiles:
    """The tiles of a merged survey. Raises InputError where it is not merged or the file is damaged."""
    tiles = Tiles.read(folder.merged)
    if not tiles.levels or not tiles.tiles:
        raise InputError(f"{folder.merged / 'tiles.json'} lists no tiles: merge the survey again.")
    return tiles


def load_overview(context: bpy.types.Context, obj: bpy.types.Object) -> str:
    """Load the finest level that fits the number of splats in place of all tiles; returns what to tell the user.

    Raises:
        InputError: a file is missing or damaged, or no level fits.
    """
    folder, tiles = _survey_of(obj)
    exchange_tiles(obj, folder, tiles, finest_level(tiles, survey_of(context.scene).budget))
    return describe(obj)


def load_view(context: bpy.types.Context, obj: bpy.types.Object, view: View) -> str:
    """Load finer tiles for what a view shows, and the coarsest ones elsewhere; returns what to tell the user.

    Raises:
        InputError: a file is missing or damaged, or not even the coarsest level fits.
    """
    present(context.view_layer).update()
    folder, tiles = _survey_of(obj)
    exchange_tiles(obj, folder, tiles, refine(tiles, survey_of(context.scene).budget, _spacing_in(view, obj)))
    return describe(obj)


def load_box(context: bpy.types.Context, obj: bpy.types.Object) -> str:
    """Load the finest tiles in the bounds of the chosen box, and the coarsest elsewhere; returns what to tell the user.

    Raises:
        InputError: there is no box, a file is missing or damaged, or not even the coarsest level fits.
    """
    box = survey_of(context.scene).box or crop_box.crop_of(obj)
    if box is None:
        raise InputError("There is no box: choose a Box Object, or add a crop box to the splats.")
    present(context.view_layer).update()
    folder, tiles = _survey_of(obj)
    low, high = _bounds(box, obj)
    inside = {tile.file for level in tiles.levels for tile in tiles.in_box(level.level, low, high)}
    if not inside:
        raise InputError(f"No tiles of the survey are in the bounds of {box.name}: move it over the splats.")
    wanted = refine(
        tiles,
        survey_of(context.scene).budget,
        lambda tile: _spacing(tile) if tile.level and tile.file in inside else 0.0,
    )
    exchange_tiles(obj, folder, tiles, wanted)
    finest = all(tile.level == 0 for tile in wanted if tile.file in inside)
    sentence = describe(obj)
    return sentence if finest else f"{sentence} The box has more splats than may be loaded: raise Splats, or shrink it."


def exchange_tiles(obj: bpy.types.Object, folder: SurveyFolder, tiles: Tiles, wanted: Sequence[Tile]) -> None:
    """Let the splats of a survey be those of other tiles. Tiles that it has already keep their splats as they are.

    Args:
        obj: the splats of the survey.
        folder: the survey.
        tiles: its tiles.
        wanted: those to show.

    Raises:
        InputError: a tile cannot be read, or the object has other splats too; it is then unchanged.
    """
    have = labels.attribute(obj, TILE)
    if have is None:
        raise InputError(f"The splats of {obj.name} were merged with others: open the survey again.")
    number_of = {tile.file: number for number, tile in enumerate(tiles.tiles)}
    numbers = np.array([number_of[tile.file] for tile in wanted])
    same_numbers = obj.get(TILES_KEY) == _checksum(folder)
    kept = np.isin(have, numbers) if same_numbers else np.zeros(len(have), bool)
    missing = [tile for tile, there in zip(wanted, np.isin(numbers, have[kept]), strict=True) if not there]
    if not missing and kept.all():
        return
    splats.exchange_splats(obj, kept, _read(tiles, missing) if missing else None)
    _write_numbers(obj, folder, np.concatenate([have[kept], *_numbers(tiles, missing)]), wanted)
    labels.list_again(obj)


def describe(obj: bpy.types.Object) -> str:
    """A sentence about which tiles of a survey an object was given last."""
    levels = json.loads(obj[LEVELS_KEY])
    tiles = ", ".join(f"{count} of level {level}" for level, count in levels.items())
    return f"{splats.count(obj):,} splats of the survey in {obj[SURVEY_KEY]}; tiles: {tiles}."


def _survey_of(obj: bpy.types.Object) -> tuple[SurveyFolder, Tiles]:
    folder = find_survey(Path(bpy.path.abspath(obj[SURVEY_KEY])))
    return folder, read_tiles(folder)


def _know_survey(obj: bpy.types.Object, folder: SurveyFolder, survey: Survey, tiles: Tiles) -> None:
    """Give splats what the survey knows of them: water, development, background, pixel size, names of labels."""
    root = scene_import.find_root(obj)
    width = scene_import.pixel_size(root, survey.settings.width) if root else 0.0
    splat_preview.remember_training(obj, width, tiles.background)
    water.remember_water(obj, folder.coarse.read_water(), survey.settings.metres_per_unit)
    colors.remember_developments(obj, folder.coarse.read_developments())
    background.update_worlds()
    if labels.attribute(obj, labels.LABEL) is not None:
        named = (folder.merged / labels.TABLE).is_file()
        labels.read_labels(obj, str(folder.merged if named else folder.coarse.path))


def _read(tiles: Tiles, wanted: Sequence[Tile]) -> Splats:
    """The splats of tiles in their order. Raises InputError where a file is missing, damaged or another one."""
    parts = []
    for tile in wanted:
        part = read_ply(tiles.path(tile))
        if len(part) != tile.splats:
            raise InputError(
                f"{tiles.path(tile)} has {len(part)} splats and not {tile.splats}: merge the survey again."
            )
        parts.append(part)
    return concatenate(parts)


def _numbers(tiles: Tiles, wanted: Sequence[Tile]) -> list[np.ndarray]:
    """The number of its tile for each splat that `_read` gives, an array a tile."""
    number_of = {tile.file: number for number, tile in enumerate(tiles.tiles)}
    return [np.full(tile.splats, number_of[tile.file], np.int32) for tile in wanted]


def _write_numbers(obj: bpy.types.Object, folder: SurveyFolder, numbers: np.ndarray, wanted: Sequence[Tile]) -> None:
    """Store the tile (N,) of each splat, and how many tiles there are of each level."""
    labels.set_attribute(obj, TILE, "INT", numbers)
    obj[TILES_KEY] = _checksum(folder)
    obj[LEVELS_KEY] = json.dumps(dict(sorted(Counter(tile.level for tile in wanted).items())))


def _checksum(folder: SurveyFolder) -> str:
    """Checksum of tiles.json: after another merge its tiles have other numbers."""
    return f"{zlib.crc32((folder.merged / 'tiles.json').read_bytes()):08x}"


def _spacing(tile: Tile) -> float:
    """About the distance between neighbouring splats of a tile, which lie on a surface, in scene units."""
    extent = float(np.max(np.array(tile.high) - np.array(tile.low)))
    return max(extent, 1e-9) / max(tile.splats, 1) ** 0.5


def _spacing_in(view: View, obj: bpy.types.Object) -> Callable[[Tile], float]:
    """The distance between the splats of a tile in pixels of a view; 0 outside of it, and where it is small."""
    placement = np.array(obj.matrix_world, np.float64)
    scale = float(np.cbrt(abs(np.linalg.det(placement[:3, :3]))))
    to_clip = view.matrix @ placement
    row = to_clip[3 if view.is_perspective else 2]

    def spacing(tile: Tile) -> float:
        corners = np.array(list(itertools.product(*zip(tile.low, tile.high, strict=True))))
        clip = corners @ to_clip[:, :3].T + to_clip[:, 3]
        w = clip[:, 3:]
        if (clip[:, :3] > w).all(axis=0).any() or (clip[:, :3] < -w).all(axis=0).any():
            return 0.0
        depths = (corners @ row[:3] + row[3]) / np.linalg.norm(view.matrix[3 if view.is_perspective else 2, :3])
        nearest = max(float(depths.min()), scale * _spacing(tile))  # the viewer may be in the tile
        pixels = _spacing(tile) * scale * float(view.pixels_per_unit(np.array([nearest]))[0])
        return pixels if pixels > FINEST_SPACING else 0.0

    return spacing


def _bounds(box: bpy.types.Object, obj: bpy.types.Object) -> tuple[list[float], list[float]]:
    """Least and largest corner (3,) of the bounds of an object in the own space of splats."""
    corners = np.array(box.bound_box, np.float64)
    if box.type == "EMPTY":
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * box.empty_display_size
    to_own = np.array(obj.matrix_world.inverted() @ box.matrix_world, np.float64)
    corners = corners @ to_own[:3, :3].T + to_own[:3, 3]
    return corners.min(axis=0).tolist(), corners.max(axis=0).tolist()


def register() -> None:
    """Register the settings with scenes."""
    bpy.utils.register_class(SwagSurvey)
    cast(Any, bpy.types.Scene).swag_survey = PointerProperty(type=SwagSurvey)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_survey
    bpy.utils.unregister_class(SwagSurvey)
