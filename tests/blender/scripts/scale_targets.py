"""Scale from Targets, import of a measured scene, and georeferenced files."""

import json
from typing import Any

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import georeference, scale, scale_panel, scene_import
from files import export_splats, import_splats, refusal

scene, swag = bpy.context.scene, bpy.context.scene.swag
status = bpy.context.window_manager.swag


def place(root):
    """The matrix of a root, the sizes of its cameras' near clipping, and what is stored with it."""
    bpy.context.view_layer.update()
    cameras = [obj.data for obj in root.children_recursive if obj.type == "CAMERA"]
    return {
        "matrix": np.array(root.matrix_world, float).tolist(),
        "scale": root.matrix_world.median_scale,
        "clip": [camera.clip_start for camera in cameras],
        "metres": root.get(georeference.METRES_KEY),
        "water": scale.metres_per_unit(root),
        "setting": swag.metres_per_unit,
        "units": [scene.unit_settings.system, scene.unit_settings.scale_length],
        "message": status.message,
    }


def from_targets(folder, size):
    """What Scale from Targets does with an imported scene."""
    assert not bpy.ops.swag.scale_from_targets.poll()
    assert bpy.ops.swag.import_scene(directory=folder) == {"FINISHED"}
    root = scene_import.active_root(bpy.context)
    before, drawn_before = place(root), panel_texts()
    swag.metres_per_unit = 7.0
    assert bpy.ops.swag.scale_from_targets(family="aruco_4x4_50", size=size) == {"FINISHED"}
    after = place(root)
    drawn = panel_texts()
    refused = refusal(lambda: bpy.ops.swag.scale_from_targets(family="apriltag_36h11", size=size))
    return {
        "before": before,
        "after": after,
        "drawn before": drawn_before,
        "drawn": drawn,
        "refused": refused,
        "kept": place(root)["metres"],
    }


def import_measured(folder):
    """An imported scene that was measured before, in a Blender scene whose unit is a centimetre."""
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 0.01
    assert bpy.ops.swag.import_scene(directory=folder) == {"FINISHED"}
    root = scene_import.active_root(bpy.context)
    bpy.context.view_layer.update()
    cameras = {obj.name: list(obj.matrix_world.translation) for obj in root.children_recursive if obj.type == "CAMERA"}
    return place(root) | {"cameras": cameras, "drawn": panel_texts()}


class Layout:
    """Stands in for the layout of a panel and keeps the texts and operators that it is given."""

    def __init__(self):
        self.texts = []

    def __getattr__(self, name):
        return lambda *arguments, **options: self

    def __setattr__(self, name, value):
        if name == "texts":
            object.__setattr__(self, name, value)

    def label(self, text="", **options):
        self.texts.append(text)

    def operator(self, name, **options):
        self.texts.append(name)


class Panel:
    """Stands in for the panel, as Blender draws none without a window."""

    def __init__(self):
        self.layout = Layout()


class Context:
    """The context with a region of the width of a sidebar."""

    region = type("Region", (), {"width": 2000})

    def __getattr__(self, name):
        return getattr(bpy.context, name)


def panel_texts():
    panel: Any = Panel()
    context: Any = Context()
    assert scale_panel.SWAG_PT_scale.poll(context)
    scale_panel.SWAG_PT_scale.draw(panel, context)
    return panel.layout.texts


def georeferenced_files(folder, measured):
    """Export reef.* georeferenced from a measured scene; open and export them again, alone and in the scene."""
    root = bpy.data.objects.new("scene", None)
    scene.collection.objects.link(root)
    root[scene_import.ROOT_KEY] = folder
    georeference.apply_georeference(root, scene, measured)
    root.location.x += 5.0  # the user moved the scene: its coordinates are the same
    bpy.context.view_layer.update()
    import_splats(folder + "/reef.ply", frame="SCENE")
    bpy.context.view_layer.update()
    for suffix in ("ply", "glb", "spz"):
        export_splats(f"{folder}/placed.{suffix}", frame="GEOREFERENCED")
    matrices = {}
    for suffix in ("ply", "glb", "spz"):
        obj = import_splats(f"{folder}/placed.{suffix}")
        bpy.context.view_layer.update()
        matrices[suffix] = np.array(obj.matrix_world, float).tolist()
        obj.location.z += 1.0  # moved in Blender, not in the file
        bpy.context.view_layer.update()
        export_splats(f"{folder}/again.{suffix}", frame="GEOREFERENCED")
    bpy.context.view_layer.objects.active = root
    obj = import_splats(f"{folder}/placed.ply", frame="SCENE")
    bpy.context.view_layer.update()
    export_splats(f"{folder}/in_scene.ply", frame="SCENE")
    del root[georeference.GEOREFERENCE_KEY]
    elsewhere = refusal(lambda: export_splats(f"{folder}/no.ply", frame="GEOREFERENCED"))
    return {"matrices": matrices, "elsewhere": elsewhere, "stored": json.loads(obj.get("swag_placement", "null"))}


def import_refused(folder):
    return refusal(lambda: bpy.ops.swag.import_scene(directory=folder))
