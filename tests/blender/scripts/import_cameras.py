"""Import Cameras without a window."""

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import camera_import, engine_process, scene_import

swag, status = bpy.context.scene.swag, bpy.context.window_manager.swag


def import_cameras(**options):
    """The error message of the operator, or "" after it finished. No worker and no job may be left."""
    message = ""
    try:
        assert bpy.ops.swag.import_cameras(**options) == {"FINISHED"}
    except RuntimeError as error:
        message = str(error)
    assert not engine_process._running and not status.job
    return message


def import_and_look(file, photos, out=""):
    """What is in the scene after the import."""
    message = import_cameras(filepath=file, photos_folder=photos, scene_folder=out)
    root = scene_import.active_root(bpy.context)
    return {
        "error": message,
        "folder": swag.scene_folder,
        "message": status.message,
        "cameras": sum(obj.type == "CAMERA" for obj in root.children_recursive) if root else 0,
        "points": len(scene_import.sparse_points(root).data.points) if root else 0,
    }


def requests(choices):
    return [camera_import.make_request(*choice) for choice in choices]


def refuse(file):
    """The error messages without a file and of one that is refused, and what they leave in the scene."""
    return {"messages": [import_cameras(), import_cameras(filepath=file)], "objects": len(bpy.data.objects)}


def menu_and_panel():
    """What File > Import and the panel offer: operators and fields, and the files that the button gets."""
    drawn = []

    class Layout:
        def operator(self, name, text="", icon="", translate=True):
            drawn.append(name)
            return type("Button", (), {"__setattr__": lambda _, key, value: drawn.append([key, value])})()

        def column(self):
            return self

        def prop(self, owner, name):
            assert hasattr(owner, name)
            drawn.append(name)

    swag.cameras_file, swag.cameras_photos = "/a/cameras.xml", "/a/photos"
    camera_import.draw_import_cameras(Layout(), bpy.context)
    panel = list(drawn)
    menu = type("Menu", (), {"layout": Layout()})()
    for function in bpy.types.TOPBAR_MT_file_import.draw._draw_funcs:
        if "swag" in function.__module__:
            function(menu, bpy.context)
    return {"panel": panel, "menu": drawn[len(panel) :].count("swag.import_cameras")}
