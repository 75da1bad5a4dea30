"""Splat files out of Blender and into it."""

from pathlib import Path

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import splats
from bl_ext.user_default.swag_splatting.swag_blender.splat_export import ExportSettings, expected_size
from files import add_imported_scene, export_splats, import_splats, matrix_in_file_frame, refusal


def there_and_back(folder, suffix):
    """Export upright.*, twice.*, scene.ply (from scene.*) and both.* of "Riff ä.ply"."""
    obj = import_splats(f"{folder}/Riff ä.ply")
    assert obj.name == "Riff ä" and splats.is_splats(obj)
    export_splats(f"{folder}/upright.{suffix}")
    again = import_splats(f"{folder}/upright.{suffix}")
    assert again is not obj and len(bpy.context.selected_objects) == 1
    export_splats(f"{folder}/twice.{suffix}")

    root = add_imported_scene()
    obj = import_splats(f"{folder}/Riff ä.ply", frame="SCENE")
    assert obj.parent == root
    export_splats(f"{folder}/scene.{suffix}", frame="SCENE")
    obj = import_splats(f"{folder}/scene.{suffix}", frame="SCENE")
    export_splats(f"{folder}/scene.ply", frame="SCENE")
    obj.select_set(True)
    again.select_set(True)
    export_splats(f"{folder}/both.{suffix}")


def transform(folder):
    """Export moved.ply of an object under a rotated root; returns the object's matrix."""
    add_imported_scene()
    obj = import_splats(folder + "/reef.ply", frame="SCENE")
    obj.location, obj.rotation_euler, obj.scale = (1, 2, 3), (0.3, 0.5, 0.7), (2, 2, 2)
    export_splats(folder + "/moved.ply")
    bpy.context.view_layer.update()
    return matrix_in_file_frame(obj.matrix_world)


def raise_by_two_units(folder):
    obj = import_splats(folder + "/one.ply")
    obj.location.z = 2
    export_splats(folder + "/up.ply")
    export_splats(folder + "/up.glb")
    export_splats(folder + "/up.spz")


def spz_there_and_back(folder):
    """Export reef.spz of reef.ply, and back.ply of that; returns the expected size."""
    import_splats(folder + "/reef.ply")
    expected = expected_size(bpy.context, Path("reef.spz"), ExportSettings())
    export_splats(folder + "/reef.spz")
    import_splats(folder + "/reef.spz")
    export_splats(folder + "/back.ply")
    return expected


def import_several(folder):
    """Import several files with fewer harmonics, then again with a damaged one; returns what that one says."""
    files = [{"name": "a.ply"}, {"name": "b.PLY"}]
    assert bpy.ops.swag.import_splats(directory=folder, files=files, sh_degree=1) == {"FINISHED"}
    assert [len(obj.data.points) for obj in bpy.context.selected_objects] == [30, 40]
    assert all(splats.read_splats(obj).sh.shape[1] == 4 for obj in bpy.context.selected_objects)
    message = refusal(bpy.ops.swag.import_splats, directory=folder, files=[*files, {"name": "broken.ply"}])
    assert len(bpy.data.pointclouds) == 4, "the undamaged files are imported"
    handler = bpy.types.SWAG_FH_splats
    return {"message": message, "extensions": handler.bl_file_extensions, "operator": handler.bl_import_operator}


def refusals(folder):
    save, load = bpy.ops.swag.export_splats, bpy.ops.swag.import_splats
    folder = Path(folder)
    messages = {
        "nothing": refusal(save, filepath=str(folder / "x.ply")),
        "not there": refusal(load, filepath=str(folder / "nowhere.ply")),
        "no name": refusal(load),
        "format": refusal(load, filepath=str(folder / "occupied")),
        "foreign": refusal(load, filepath=str(folder / "a.ksplat")),
        "project": refusal(load, filepath=str(folder / "a.psx")),
        "damaged": refusal(load, filepath=str(folder / "text.ply")),
        "no scene": refusal(load, filepath=str(folder / "a.ply"), frame="SCENE"),
    }
    import_splats(folder / "a.ply")
    return messages | {
        "suffix": refusal(save, filepath=str(folder / "x.obj")),
        "unwritable": refusal(save, filepath=str(folder / "occupied" / "x.ply")),
        "full": refusal(save, filepath="/dev/full/x.glb"),
        "no folder": refusal(save, filepath=str(folder / "typo" / "x.ply")),
        "no root": refusal(save, filepath=str(folder / "x.ply"), frame="SCENE"),
    }


def refused_scenes(folder):
    import_scene = bpy.ops.swag.import_scene
    messages = [refusal(import_scene), refusal(import_scene, directory=folder + "/not here")]
    assert not bpy.data.collections and not bpy.context.window_manager.swag.job
    return messages
