"""Options of the export, and what modifiers and edit mode change in it."""

import json
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import labels, splats
from bl_ext.user_default.swag_splatting.swag_blender.splat_export import ExportOptions, ExportSettings, expected_size
from files import add_imported_scene, export_splats, import_splats, matrix_in_file_frame, refusal


def add_nodes_modifier(obj, node, **inputs):
    """Add a modifier with one node before the preview; returns its tree and the node."""
    tree = bpy.data.node_groups.new(node, "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, middle, end = (tree.nodes.new(n) for n in ("NodeGroupInput", node, "NodeGroupOutput"))
    tree.links.new(start.outputs[0], middle.inputs[0])
    tree.links.new(middle.outputs[0], end.inputs[0])
    for name, value in inputs.items():
        middle.inputs[name].default_value = value
    modifier = obj.modifiers.new(node, "NODES")
    modifier.node_group = tree
    obj.modifiers.move(len(obj.modifiers) - 1, 0)
    return tree, middle


def move_and_cut(folder, suffix):
    """Export moved.* of a transformed object without the splats beyond x = 0.3; returns the object's matrix."""
    obj = import_splats(folder + "/heap.ply")
    obj.location, obj.rotation_euler, obj.scale = (1, 2, 3), (0.3, 0.5, 0.7), (1.6, 1.6, 1.6)
    tree, delete = add_nodes_modifier(obj, "GeometryNodeDeleteGeometry")
    kinds = ("GeometryNodeInputPosition", "ShaderNodeSeparateXYZ", "FunctionNodeCompare")
    position, split, compare = (tree.nodes.new(kind) for kind in kinds)
    compare.inputs["B"].default_value = 0.3
    tree.links.new(position.outputs[0], split.inputs[0])
    tree.links.new(split.outputs["X"], compare.inputs["A"])
    tree.links.new(compare.outputs[0], delete.inputs["Selection"])
    export_splats(f"{folder}/moved.{suffix}")
    assert all(modifier.show_viewport for modifier in obj.modifiers)
    return matrix_in_file_frame(obj.matrix_world)


def moving_modifier(folder):
    """Export moved.ply with a modifier that moves points, and off.ply with it switched off."""
    obj = import_splats(folder + "/heap.ply")
    add_nodes_modifier(obj, "GeometryNodeSetPosition", Offset=(1, 2, 3))
    export_splats(folder + "/moved.ply")
    obj.modifiers[0].show_viewport = False
    export_splats(folder + "/off.ply")


def delete_in_edit_mode(folder):
    """Delete the first 30 points; export edited.ply in edit mode and cut.ply after it."""
    obj = import_splats(folder + "/heap.ply")
    selected = obj.data.attributes.new(".selection", "BOOLEAN", "POINT")
    selected.data.foreach_set("value", [i < 30 for i in range(100)])
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.pointcloud.delete()
    export_splats(folder + "/edited.ply")
    bpy.ops.object.mode_set(mode="OBJECT")
    export_splats(folder + "/cut.ply")


def options(folder):
    """Export a file per option; returns the crop box, expected sizes and messages of refusals."""
    path = Path(folder)

    def refused(**arguments):
        return refusal(bpy.ops.swag.export_splats, filepath=str(path / "refused.ply"), **arguments)

    first, second, third = (import_splats(path / "heap.ply") for _ in range(3))
    second.hide_set(True)
    third.location.x = 100
    bpy.ops.object.select_all(action="DESELECT")
    first.select_set(True)
    export_splats(path / "selected.ply")
    export_splats(path / "visible.ply", use="VISIBLE")
    first["swag_run"] = folder
    export_splats(path / "coral.ply", labels="Coral, 3")
    box = bpy.data.objects.new("box", None)
    box.empty_display_size = 0.5
    box.rotation_euler, box.location = (0, 0, 0.5), (0.2, 0, 0)
    bpy.context.scene.collection.objects.link(box)
    flat = bpy.data.objects.new("flat", None)
    flat.scale.z = 0
    bpy.context.scene.collection.objects.link(flat)
    bpy.context.view_layer.update()
    export_splats(path / "cropped.ply", crop_object="box")
    export_splats(path / "plain.ply", min_opacity=0.5, sh_degree=1, extras=False)
    export_splats(path / "metres.ply", metres_per_unit=3.0, frame="Z_UP")
    export_splats(path / "y_up.ply", frame="Y_UP")

    options = ExportOptions(min_opacity=0.5, sh_degree=1, extras=False)
    sizes = [
        expected_size(bpy.context, Path(name), ExportSettings(options=chosen))
        for name, chosen in (("plain.ply", options), ("plain.glb", replace(options, min_opacity=1.0)))
    ]
    messages = {
        "no label named kelp": refused(labels="kelp"),
        "no object gone": refused(crop_object="gone"),
        "flat has a scale of 0": refused(crop_object="flat"),
        "No splat is left": refused(min_opacity=1.0),
        "no imported scene": refused(water=0.5),
        "no cameras": refused(cameras=True),
    }
    first.select_set(False)
    second.hide_set(False)
    second.select_set(True)
    second.hide_set(True)
    messages["select"] = refused()
    to_box = [list(row) for row in box.matrix_world.inverted() @ splats.FILE_FRAME]
    return {"to_box": to_box, "expected sizes": sizes, "messages": messages}


def parts(folder):
    """Export all, visible, shown (by default), cropped and selected splats of two objects; returns messages.

    Label 2 alone is shown, label 1 and the first 50 splats are selected, and an empty crops the first object.
    """
    path = Path(folder)
    first, second = (import_splats(path / "heap.ply") for _ in range(2))
    messages = {}

    def refused(**arguments):
        return refusal(bpy.ops.swag.export_splats, filepath=str(path / "refused.ply"), **arguments)

    messages["No splats are selected"] = refused(part="SELECTED")
    for obj in (first, second):
        obj.select_set(True)
        labels.read_labels(obj, "")
        labels.isolate(obj, 2)
    export_splats(path / "visible.ply")
    second.select_set(False)
    numbers = labels.attribute(first, labels.LABEL)
    labels.select(first, (numbers == 1) | (np.arange(len(numbers)) < 50))
    first.location.x = 7
    add_nodes_modifier(first, "GeometryNodeSetPosition", Offset=(1, 0, 0))
    export_splats(path / "selected.ply", part="SELECTED")
    export_splats(path / "all.ply", part="ALL")

    box = bpy.data.objects.new("box", None)
    box.empty_display_size, box.scale.z, box.location.x = 0.5, 4, 8
    bpy.context.scene.collection.objects.link(box)
    first.swag_display.crop = box
    export_splats(path / "cropped.ply")
    box.scale.z = 0
    export_splats(path / "flat.ply")
    box.scale.z, box.location.y = 4, 100
    messages["No splats are visible"] = refused()
    settings = ExportSettings()
    bpy.context.view_layer.update()
    messages["move the crop box"] = expected_size(bpy.context, path / "refused.ply", settings)
    export_splats(path / "outside.ply", part="ALL")
    return messages


def water_and_cameras(folder, suffix):
    """Export out.* with water and cameras from a scene that was moved and scaled."""
    root = add_imported_scene(json.loads(Path(folder, "cameras.json").read_text()))
    root.location, root.scale = (5, -2, 1), (2, 2, 2)
    obj = import_splats(folder + "/heap.ply", frame="SCENE")
    obj["swag_run"] = folder
    export_splats(f"{folder}/out.{suffix}", water=0.7, cameras=True)
