"""The extension registers, unregisters, and has the engine's defaults."""

import sys
import threading

import addon_utils
import bpy

EXTENSION = "bl_ext.user_default.swag_splatting"


def state():
    """Everything that an extension can leave in Blender."""
    handlers = {
        name: [handler for handler in getattr(bpy.app.handlers, name) if "swag" in handler.__module__]
        for name in dir(bpy.app.handlers)
        if isinstance(getattr(bpy.app.handlers, name), list)
    }
    menus = {
        name: len(getattr(getattr(bpy.types, name).draw, "_draw_funcs", ()))
        for name in dir(bpy.types)
        if name.startswith(("TOPBAR_MT_file_", "VIEW3D_MT_"))
    }
    keymaps = bpy.context.window_manager.keyconfigs.addon.keymaps
    return {
        "classes": [name for name in dir(bpy.types) if "swag" in name.lower()],
        "operators": dir(bpy.ops.swag),
        "properties": [cls.__name__ for cls in (bpy.types.Scene, bpy.types.WindowManager) if hasattr(cls, "swag")],
        "handlers": {name: found for name, found in handlers.items() if found},
        "menus": menus,
        "threads": threading.active_count(),
        "keys": [item.idname for keymap in keymaps for item in keymap.keymap_items if item.idname.startswith("swag.")],
        "attributes": [
            f"{cls.__name__}.{name}"
            for cls in bpy.types.ID.__subclasses__()
            for name in dir(cls)
            if name.startswith("swag")
        ],
    }


def register_twice():
    addon_utils.disable(EXTENSION)
    before = state()
    empty = ("classes", "operators", "properties", "handlers", "keys", "attributes")
    assert not any(before[name] for name in empty), before
    for _ in range(2):
        assert addon_utils.enable(EXTENSION)
        during = state()
        assert "SWAG_OT_train" in during["classes"] and "SWAG_PT_train" in during["classes"]
        assert during["properties"] == ["Scene", "WindowManager"]
        addon_utils.disable(EXTENSION)
        assert state() == before, (before, state())
    # Blender prints a warning here if a command of this name is still registered.
    bpy.utils.unregister_cli_command(bpy.utils.register_cli_command("swag", print))


def default_settings():
    return bpy.context.scene.swag.train_settings()


def heavy_modules(folder):
    """Modules that only the engine needs, of those that were imported when splats were read and shown."""
    bpy.ops.swag.import_splats(filepath=folder + "/splats.ply")
    assert len(bpy.data.pointclouds) == 1
    return [name for name in ("torch", "pycolmap", "cv2", "onnxruntime") if name in sys.modules]
