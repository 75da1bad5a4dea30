"""The extension as a zip: it builds, validates, installs, enables, and leaves nothing behind."""

import zipfile

REGISTER_TWICE = """
import threading, bpy, addon_utils

def state():
    handlers = {name: [h for h in getattr(bpy.app.handlers, name) if "swag" in h.__module__]
                for name in dir(bpy.app.handlers) if isinstance(getattr(bpy.app.handlers, name), list)}
    menus = {name: len(getattr(getattr(bpy.types, name).draw, "_draw_funcs", ()))
             for name in dir(bpy.types) if name.startswith(("TOPBAR_MT_file_", "VIEW3D_MT_"))}
    return {
        "classes": [name for name in dir(bpy.types) if "swag" in name.lower()],
        "operators": dir(bpy.ops.swag),
        "properties": [cls.__name__ for cls in (bpy.types.Scene, bpy.types.WindowManager) if hasattr(cls, "swag")],
        "handlers": {name: kept for name, kept in handlers.items() if kept},
        "menus": menus,
        "threads": threading.active_count(),
        "keys": [item.idname for keymap in bpy.context.window_manager.keyconfigs.addon.keymaps
                 for item in keymap.keymap_items if item.idname.startswith("swag.")],
        "attributes": [f"{cls.__name__}.{name}" for cls in bpy.types.ID.__subclasses__() for name in dir(cls)
                       if name.startswith("swag")],
    }

addon_utils.disable(EXTENSION)
before = state()
assert not before["classes"] and not before["operators"] and not before["properties"] and not before["handlers"], before
for _ in range(2):
    assert addon_utils.enable(EXTENSION)
    during = state()
    assert "SWAG_OT_train" in during["classes"] and "SWAG_PT_train" in during["classes"]
    assert during["properties"] == ["Scene", "WindowManager"]
    addon_utils.disable(EXTENSION)
    assert state() == before, (before, state())
bpy.utils.unregister_cli_command(bpy.utils.register_cli_command("swag", print))
print("CLEAN")
"""


def test_zip_holds_what_runs_and_nothing_else(extension_zip):
    with zipfile.ZipFile(extension_zip) as archive:
        names = archive.namelist()
    for needed in ("__init__.py", "blender_manifest.toml", "LICENSE", "constraints.txt", "requirements.txt",
                   "swag_engine/app/worker.py", "swag_blender/panels.py", "operators/train.py"):  # fmt: skip
        assert needed in names
    assert any(name.startswith("swag_engine/kernels/lib/") for name in names)
    tops = {name.split("/")[0] for name in names}
    assert not tops & {"tests", "demo", "benchmarks", "dist", "docs", ".venv", ".git", ".ci", "Makefile"}
    assert not [name for name in names if "__pycache__" in name or "/." in name]


def test_registers_and_unregisters_twice_without_leftovers(blender):
    printed = blender.run(REGISTER_TWICE)
    # Blender warns of a command that is registered while an older one of its name is still there.
    assert "CLEAN" in printed and "duplicate command" not in printed


def test_defaults_are_the_engines(blender):
    from swag_engine.settings.settings import TrainSettings

    printed = blender.run("import json; print('SETTINGS', json.dumps(bpy.context.scene.swag.train_settings()))")
    assert blender.json_after("SETTINGS", printed) == TrainSettings().to_json()


def test_panels_draw_nothing_heavy(blender):
    """Blender's process never imports what only the engine needs."""
    printed = blender.run(
        "import sys, json; print('HEAVY', json.dumps([m for m in ('torch', 'pycolmap', 'cv2') if m in sys.modules]))"
    )
    assert blender.json_after("HEAVY", printed) == []


def test_command_runs_the_engine_with_the_same_words_and_exit_code(blender, fake_engine):
    printed = blender.run(
        """
        from bl_ext.user_default.swag_splatting.swag_blender import commands
        print("CODE", commands.run(["train", "a folder", "--out", "räumlich"]), flush=True)
        """,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("arguments", printed) == ["train", "a folder", "--out", "räumlich"]
    assert blender.json_after("CODE", printed) == 7


def test_command_without_an_engine_says_so(blender):
    printed = blender.run(
        """
        from bl_ext.user_default.swag_splatting.swag_blender import commands
        print("CODE", commands.run(["doctor"]), flush=True)
        """,
        SWAG_ENGINE_PYTHON="/no/such/python",
    )
    assert "/no/such/python cannot be run" in printed and "Traceback" not in printed
    assert blender.json_after("CODE", printed) == 2
