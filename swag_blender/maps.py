"""Maps and measurements of a run: settings, requests to the engine, and how their pictures are shown."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, PointerProperty, StringProperty
from bpy.types import PropertyGroup
from mathutils import Matrix, Vector

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from . import colors
from .blender_types import present, with_properties
from .runs import RUN_KEY

JOB = "Map"
"""Name of the jobs that make maps."""
FILES = {
    "ortho": "orthomosaic.tif",
    "dem": "heights.tif",
    "areas": "areas",
    "profile": "profile.csv",
    "change": "change",
}
"""File or folder of each kind of map in the output folder."""
TITLES = {"ortho": "Orthomosaic", "dem": "Heights", "areas": "Areas by Label", "profile": "Profile", "change": "Change"}
MAP_KEY = "swag_map"
"""Property of an object that shows a map: its kind, a key of FILES."""
LINES_KEY = "swag_map_lines"
"""Property of such an object: what was measured, as JSON: a list of lines, each a list of texts."""
FILE_KEY = "swag_map_file"
"""Property of such an object: the file or folder of the map."""
MOST_LINES = 12
"""Lines of a table that the panel shows."""
CURVE_THICKNESS = 1 / 400
"""Radius of the curve of a profile, relative to its length."""


@with_properties
class SwagMaps(PropertyGroup):
    """`scene.swag_maps`: how maps and measurements are made."""

    output: Annotated[
        str,
        StringProperty(
            name="Folder",
            description="Folder of the maps; empty: the folder maps in the folder of the run",
            subtype="DIR_PATH",
        ),
    ]
    pixel: Annotated[
        float,
        FloatProperty(
            name="Pixel Size (m)",
            description="Edge of a pixel in metres, or in units without a scale; 0: the size of the splats",
            min=0.0,
            soft_max=1.0,
            precision=4,
            step=0.1,
        ),
    ]
    plane: Annotated[
        str,
        EnumProperty(
            name="Seen From",
            description="Direction that maps are seen from",
            items=[
                ("UP", "From Above", "Straight from above"),
                ("FIT", "Fitted Plane", "Perpendicular to the plane that fits the splats, as for a wall"),
                ("VIEW", "3D Viewport", "As the 3D viewport looks now"),
            ],
        ),
    ]
    taglab: Annotated[
        bool,
        BoolProperty(
            name="For TagLab", description="Write an orthomosaic without alpha, and a file with the pixel size"
        ),
    ]
    derived: Annotated[
        set[str],
        EnumProperty(
            name="Further Maps",
            description="Maps that are made from the heights",
            items=[
                ("hillshade", "Hillshade", "Heights shaded by light from the upper left"),
                ("slope", "Slope", "Steepness in degrees"),
                ("rugosity", "Rugosity", "Surface over planar area in windows of a metre"),
            ],
            options={"ENUM_FLAG"},
        ),
    ]
    corrected: Annotated[
        str,
        StringProperty(
            name="Corrected Labels",
            description="Corrected copy of labels.tif; its labels go to the splats, and the areas are made again",
            subtype="FILE_PATH",
        ),
    ]
    later: Annotated[
        str, StringProperty(name="Later Run", description="Folder of a later run of the same place", subtype="DIR_PATH")
    ]
    free_scale: Annotated[
        bool,
        BoolProperty(
            name="Find Scale",
            description="Find the scale of the later run by the alignment, where it was not measured",
        ),
    ]


def maps_of(scene: bpy.types.Scene) -> SwagMaps:
    """Settings of the maps of a scene."""
    return cast(Any, scene).swag_maps


def make_request(context: bpy.types.Context, kind: str) -> dict[str, Any]:
    """The engine's request for a map of the run of the active object; a profile needs its line, too.

    Args:
        context: its active object is the splats of a run, and its scene has the settings.
        kind: a key of FILES.

    Raises:
        InputError: the splats are from no run on this machine, a setting is missing, or the folder that the maps'
            folder lies in does not exist.
    """
    scene, obj = present(context.scene), present(context.active_object)
    settings, run = maps_of(scene), bpy.path.abspath(obj.get(RUN_KEY, ""))
    if not run or not os.path.isdir(run):
        raise InputError(f"The splats of {obj.name} are from no run on this machine: open the run folder first.")
    chosen = os.path.abspath(bpy.path.abspath(settings.output)) if settings.output else ""
    folder = require_parent(Path(chosen)) if chosen else Path(run, "maps")
    request: dict[str, Any] = {"request": kind, "run": run, "out": str(folder / FILES[kind]), "pixel": settings.pixel}
    request["plane"] = _viewing_direction(context, obj) if settings.plane == "VIEW" else settings.plane.lower()
    if kind == "ortho":
        request |= {"water": colors.shown_water(scene, obj), "develop": colors.colors_of(scene).develop}
        request["taglab"] = settings.taglab
    elif kind == "dem" and settings.derived:
        request["derived"] = ",".join(sorted(settings.derived))
    elif kind == "areas" and settings.corrected:
        request["corrected"] = os.path.abspath(bpy.path.abspath(settings.corrected))
    elif kind == "change":
        if not settings.later:
            raise InputError("There is no later run to compare with: choose its folder in Later Run.")
        request["later"] = os.path.abspath(bpy.path.abspath(settings.later))
        request["free_scale"] = settings.free_scale
    return request


def line_between(obj: bpy.types.Object, ends: Sequence[Vector]) -> list[float]:
    """Coordinates of two points of Blender's world in the own space of splats, as the request for a profile has them.

    Raises:
        InputError: they are not two points.
    """
    if len(ends) != 2:
        raise InputError("A profile needs two points: use Pick Profile, or select two objects beside the splats.")
    to_scene = obj.matrix_world.inverted()
    return [value for end in ends for value in (to_scene @ end).to_tuple()]


def show_map(name: str, event: dict[str, Any]) -> str:
    """Show the map of a `result` event below the splat object `name`; returns what to tell the user.

    Raises:
        InputError: the object was removed.
    """
    obj, kind = bpy.data.objects.get(name), event["request"]
    if obj is None:
        raise InputError(f"{name} was removed; the files are in {event['out']}.")
    shown = next((child for child in obj.children if child.get(MAP_KEY) == kind), None)
    if shown is not None:
        _remove(shown)
    title = f"{obj.name} {TITLES[kind]}"
    if kind == "profile":
        shown = bpy.data.objects.new(title, _curve(event, title))
        shown.matrix_basis = Matrix(event["to_map"]).inverted()
    else:
        shown = bpy.data.objects.new(title, None)
        _show_picture(shown, event)
    for collection in obj.users_collection:
        collection.objects.link(shown)
    shown.parent, shown.hide_render = obj, True
    lines = lines_of_result(event)
    shown[MAP_KEY], shown[FILE_KEY], shown[LINES_KEY] = kind, event["out"], json.dumps(lines)
    return " ".join([f"{TITLES[kind]}: {event['out']}.", *event["notes"]])


def lines_of_result(event: dict[str, Any]) -> list[list[str]]:
    """What a `result` event has measured, in lines of texts for the panel."""
    unit, kind = event["unit"], event["request"]
    lines = []
    if kind != "profile":
        lines.append([f"{event['width']} x {event['height']}", f"{event['pixel']:.3g} {unit}"])
    if kind in ("dem", "profile") and event["heights"]:
        low, high = event["heights"]
        lines.append([bpy.app.translations.pgettext_iface("Height"), f"{low:.4g} .. {high:.4g} {unit}"])
        if event["rugosity"]:
            lines.append([bpy.app.translations.pgettext_iface("Rugosity"), f"{event['rugosity']:.3f}"])
    if kind == "profile":
        lines.append([bpy.app.translations.pgettext_iface("Length"), f"{event['length']:.4g} {unit}"])
    if kind == "areas":
        lines += [
            [row["name"], f"{row['planar_area']:.3g} {unit}²", f"{row['cover_percent']:.1f} %"]
            for row in event["labels"]
        ]
    if kind == "change":
        lines += [
            [item["change"], f"{item['area']:.3g} {unit}²", f"{item['height_change']:+.3g} {unit}"]
            for item in event["objects"]
        ]
    if len(lines) > MOST_LINES:
        lines = [*lines[:MOST_LINES], ["..."]]
    return lines


def shown_maps(obj: bpy.types.Object | None) -> list[bpy.types.Object]:
    """The objects that show the maps of a splat object."""
    return [child for child in obj.children if child.get(MAP_KEY)] if obj is not None else []


def _viewing_direction(context: bpy.types.Context, obj: bpy.types.Object) -> str:
    """Direction from what the 3D viewport shows to the viewer, in the own space of splats, as the engine reads it."""
    region: Any = context.region_data
    if region is None:
        raise InputError("There is no 3D viewport to see the map from: choose another direction in Seen From.")
    towards = region.view_matrix.inverted().to_3x3() @ Vector((0.0, 0.0, 1.0))
    direction = obj.matrix_world.to_3x3().inverted() @ towards
    return ",".join(f"{value:.9g}" for value in direction.normalized())


def _show_picture(obj: bpy.types.Object, event: dict[str, Any]) -> None:
    """Make an empty show the picture of a map above the splats; viewports draw it in every shading, Solid too."""
    image = _image(event["preview"])
    obj.empty_display_type, obj.empty_display_size, obj.use_empty_image_alpha = "IMAGE", 1.0, True
    obj.data = cast(Any, image)
    left, bottom, right, top = event["extent"]
    # The longer side of the image is drawn one unit long.
    width, height = (int(side) for side in cast(Any, image.size))
    longer = max(width, height, 1)
    sides = (right - left) * longer / max(width, 1), (top - bottom) * longer / max(height, 1), 1.0, 1.0
    centre = Matrix.Translation(((left + right) / 2, (bottom + top) / 2, event["top"]))
    obj.matrix_basis = Matrix(event["to_map"]).inverted() @ centre @ Matrix.Diagonal(sides)


def _curve(event: dict[str, Any], name: str) -> bpy.types.Curve:
    """The line of a profile along the surface, in the frame of the map; its diagram is an image of the file."""
    _image(event["files"][1])
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", CURVE_THICKNESS * event["length"]
    if event["curve"]:
        spline = curve.splines.new("POLY")
        spline.points.add(len(event["curve"]) - 1)
        spline.points.foreach_set("co", [value for point in event["curve"] for value in (*point, 1.0)])
    return curve


def _image(path: str) -> bpy.types.Image:
    """The image of a file as it is now."""
    image = bpy.data.images.load(path, check_existing=True)
    image.reload()
    image.use_fake_user = True
    return image


def _remove(obj: bpy.types.Object) -> None:
    """Remove an object that shows a map, and what it shows."""
    data = obj.data
    bpy.data.objects.remove(obj)
    if isinstance(data, bpy.types.Curve):  # the image of a file is used again
        bpy.data.curves.remove(data)


def register() -> None:
    """Register the settings with scenes."""
    bpy.utils.register_class(SwagMaps)
    cast(Any, bpy.types.Scene).swag_maps = PointerProperty(type=SwagMaps)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_maps
    bpy.utils.unregister_class(SwagMaps)
