"""The map of a survey: an object with one face a block, colored by its state, and a text on each.

Attributes of the faces, for geometry nodes: `state` (INT, its number in STATES) and `psnr` (FLOAT, dB, 0 until it is
measured). The mesh has the coordinates of the survey's scene.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.formats.survey_folder import Block, Box, Survey, SurveyFolder
from ..swag_engine.formats.survey_state import Progress
from .nodes import block_material
from .survey import corners_on_ground, objects_of, place, root_of

MAP_KEY = "swag_survey_blocks"
"""Property of the object that shows the blocks of a survey: their names in the order of the faces, as JSON; of a text:
the name of its block."""
GAP = 0.01
"""Distance from the edge of a block to its face, as a fraction of its shorter side: neighbours stay apart."""
ALPHA = 0.6
"""Opacity of the faces."""
TEXT_COLUMNS, TEXT_ROWS = 9, 5
"""Times that the height of the letters fits into a block's width, and into its depth."""
TEXT_COLOR = (0.9, 0.9, 0.9)
"""Linear light."""
TEXT_HEIGHT = 0.01
"""Height of the texts above the faces, as a fraction of the size of the letters."""


@dataclass(frozen=True)
class Shown:
    """How a state is shown.

    Attributes:
        title: Its name in the interface.
        color: Of the faces, linear light.
        icon: In the list of blocks.
    """

    title: str
    color: block_material.Color
    icon: Any


STATES: dict[str, Shown] = {
    "waiting": Shown("Waiting", (0.15, 0.15, 0.15), "RADIOBUT_OFF"),
    "begun": Shown("Stopped", (0.4, 0.25, 0.02), "PAUSE"),
    "running": Shown("Running", (0.02, 0.13, 0.5), "PLAY"),
    "failed": Shown("Failed", (0.5, 0.02, 0.02), "ERROR"),
    "done": Shown("Finished", (0.02, 0.25, 0.05), "CHECKMARK"),
}
"""The states of a job in the order of the materials."""


def map_of(scene: bpy.types.Scene, folder: SurveyFolder) -> bpy.types.Object | None:
    """The map of a survey in a scene; None where there is none."""
    return next((obj for obj in objects_of(scene, folder) if obj.get(MAP_KEY) is not None), None)


def make_map(scene: bpy.types.Scene, folder: SurveyFolder, survey: Survey, blocks: Sequence[Block]) -> bpy.types.Object:
    """Make the map of a survey in place of the one that there is; `color_map` then colors it.

    Args:
        scene: the Blender scene.
        folder: the survey.
        survey: what is in survey.json.
        blocks: its blocks.
    """
    if (old := map_of(scene, folder)) is not None:
        _remove(old)
    faces = [clipped(block.core, survey.bounds) for block in blocks]
    corners = np.concatenate([corners_on_ground(survey, _with_gap(face)) for face in faces])
    name = f"{folder.path.name} Blocks"
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 4).tolist())
    for state in STATES.values():
        mesh.materials.append(block_material.material(f"SWAG Block {state.title}", state.color, ALPHA))
    attributes: Any = mesh.attributes
    attributes.new("state", "INT", "FACE")
    attributes.new("psnr", "FLOAT", "FACE")
    root = root_of(scene, survey)
    collection = bpy.data.collections.new(name)
    (root.users_collection[0] if root else scene.collection).children.link(collection)
    obj = bpy.data.objects.new(name, mesh)
    collection.objects.link(obj)
    place(obj, scene, folder, survey)
    obj[MAP_KEY] = json.dumps([block.name for block in blocks])
    obj.hide_render = True
    # Viewports draw a line from an object to its parent, unless that is hidden.
    parent = bpy.data.objects.new(f"{name} Texts", None)
    parent.parent, parent.hide_viewport = obj, True
    collection.objects.link(parent)
    for block, face in zip(blocks, faces, strict=True):
        _add_text(block.name, face, survey, parent, collection)
    return obj


def color_map(obj: bpy.types.Object, statuses: Mapping[str, Progress]) -> None:
    """Give the faces and texts of a map the states of their blocks; what is shown already is not written again.

    Args:
        obj: the map.
        statuses: the state of each block by its name.
    """
    mesh = cast(bpy.types.Mesh, obj.data)
    known = [statuses.get(name) for name in json.loads(obj[MAP_KEY])]
    states = np.array([list(STATES).index(status.state if status else "waiting") for status in known], np.int32)
    psnr = np.array([(status.psnr if status else None) or 0.0 for status in known], np.float32)
    shown_states, shown_psnr = np.empty_like(states), np.empty_like(psnr)
    attributes: Any = mesh.attributes
    attributes["state"].data.foreach_get("value", shown_states)
    attributes["psnr"].data.foreach_get("value", shown_psnr)
    if not (np.array_equal(states, shown_states) and np.array_equal(psnr, shown_psnr)):
        mesh.polygons.foreach_set("material_index", cast(Any, states))
        attributes["state"].data.foreach_set("value", states)
        attributes["psnr"].data.foreach_set("value", psnr)
        mesh.update()
    for text in obj.children_recursive:
        if isinstance(text.data, bpy.types.TextCurve) and text.get(MAP_KEY) in statuses:
            name = text[MAP_KEY]
            body = "\n".join((name, *texts_of(statuses[name])))
            if text.data.body != body:
                text.data.body = body


def texts_of(status: Progress) -> list[str]:
    """State of a block, and its PSNR where there is one, in the language of the interface."""
    state = bpy.app.translations.pgettext_iface(STATES[status.state].title)
    return [state, f"{status.psnr:.1f} dB"] if status.psnr is not None else [state]


def clipped(core: Box, bounds: Box) -> Box:
    """The part of a core box that is in the bounds of the survey."""
    (left, bottom, right, top), (west, south, east, north) = core, bounds
    return max(left, west), max(bottom, south), min(right, east), min(top, north)


def _with_gap(box: Box) -> Box:
    left, bottom, right, top = box
    gap = GAP * min(right - left, top - bottom)
    return left + gap, bottom + gap, right - gap, top - gap


def _add_text(name: str, face: Box, survey: Survey, parent: bpy.types.Object, collection: bpy.types.Collection) -> None:
    left, bottom, right, top = face
    curve = cast(bpy.types.TextCurve, bpy.data.curves.new(name, "FONT"))
    curve.body, curve.align_x, curve.align_y = name, "CENTER", "CENTER"
    curve.size = min((right - left) / TEXT_COLUMNS, (top - bottom) / TEXT_ROWS)
    curve.materials.append(block_material.material("SWAG Block Text", TEXT_COLOR, 1.0))
    text = bpy.data.objects.new(name, curve)
    collection.objects.link(text)
    text.parent, text[MAP_KEY], text.hide_render, text.hide_select = parent, name, True, True
    axes = np.array(survey.ground.axes)
    matrix = np.eye(4)
    matrix[:3, :3] = axes.T
    middle = np.array([(left + right) / 2, (bottom + top) / 2, TEXT_HEIGHT * curve.size])
    matrix[:3, 3] = middle @ axes + np.array(survey.ground.origin)
    text.matrix_basis = Matrix(matrix.tolist())


def _remove(obj: bpy.types.Object) -> None:
    """Remove a map, its texts and its collection."""
    collection = obj.users_collection[0] if obj.users_collection else None
    objects = [obj, *obj.children_recursive]
    used: list[Any] = [one.data for one in objects if one.data is not None]
    bpy.data.batch_remove([*objects, *used])
    if collection is not None and not collection.all_objects and collection.name in bpy.data.collections:
        bpy.data.collections.remove(collection)
