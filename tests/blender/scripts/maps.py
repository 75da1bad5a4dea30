"""Maps and measurements of a run: what is sent to the engine, and what is shown."""

import json
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import maps, splats
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from files import refusal
from mathutils import Vector

scene, status = bpy.context.scene, bpy.context.window_manager.swag


def opened(run):
    """The splats of a run, below a parent that is moved, turned and scaled."""
    root = bpy.data.objects.new("root", None)
    scene.collection.objects.link(root)
    root.location, root.rotation_euler, root.scale = (3, -2, 1), (0.3, 0.1, 2.0), (0.5, 0.5, 0.5)
    obj = splats.new_splat_object("reef", read_ply(Path(run, "result.ply")), scene.collection, root)
    obj["swag_run"] = run
    splats.select_only(bpy.context, [obj])
    bpy.context.view_layer.update()
    return obj


def shown(obj):
    """Object, image and world corners of each map."""
    bpy.context.view_layer.update()
    found = {}
    for child in maps.shown_maps(obj):
        data, to_world = child.data, np.array(child.matrix_world)
        entry = {"lines": json.loads(child[maps.LINES_KEY]), "file": child[maps.FILE_KEY]}
        if child.type == "EMPTY":  # whose image is drawn around its centre, the longer side as long as the empty
            half = np.array([*data.size, 0]) / max(data.size) * child.empty_display_size / 2
            corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * half
            entry["corners"] = (corners @ to_world[:3, :3].T + to_world[:3, 3]).tolist()
            entry["image"] = list(data.size)
        else:
            points = np.array([point.co[:3] for point in data.splines[0].points])
            entry["points"] = (points @ to_world[:3, :3].T + to_world[:3, 3]).tolist()
        found[child[maps.MAP_KEY]] = entry
    return found


def make_all(run, later, ends):
    """Make every map, the orthomosaic twice; `ends` are points in the own space of the splats."""
    obj = opened(run)
    settings = scene.swag_maps
    settings.pixel, settings.later, settings.derived = 0.04, later, {"slope"}
    ends = [list(obj.matrix_world @ Vector(end)) for end in ends]
    messages = []
    for operator, options in (
        ("make_orthomosaic", {}), ("make_orthomosaic", {}), ("make_heights", {}), ("make_areas", {}),
        ("make_profile", {"first": ends[0], "second": ends[1]}), ("make_change", {}),
    ):  # fmt: skip
        assert getattr(bpy.ops.swag, operator)(**options) == {"FINISHED"}, status.message
        messages.append(status.message)
    return {
        "maps": shown(obj), "messages": messages, "matrix": np.array(obj.matrix_world).tolist(),
        "objects": len(scene.objects), "ends": ends,
    }  # fmt: skip


def refusals(run):
    """Sentences of maps that cannot be made, and how many maps are shown after them."""
    obj = opened(run)
    settings, operators = scene.swag_maps, bpy.ops.swag
    found = {"change": refusal(operators.make_change), "profile": refusal(operators.make_profile)}
    found["areas"] = refusal(operators.make_areas)
    settings.plane = "VIEW"
    found["view"] = refusal(operators.make_heights)
    settings.plane, settings.output = "UP", f"{run}/typo/maps"
    found["no folder"] = refusal(operators.make_heights)
    settings.output = f"{run}/config.json"
    found["folder"] = refusal(operators.make_heights)
    obj["swag_run"] = "/elsewhere"
    found["run"] = refusal(operators.make_orthomosaic)
    found["failed"], found["shown"] = status.failed, len(maps.shown_maps(obj))
    return found
