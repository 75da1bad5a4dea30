"""Make, describe and remove the Python environment that trains, in the extension's user folder."""

import json
import shutil
import sys
from typing import Any

import bpy

from ..swag_blender import engine_process
from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job, nothing_runs
from ..swag_blender.preferences import preferences


class _Environment(Job):
    """Mixin of what make_environment.py does."""

    look_only = False

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run_waiting(context) if bpy.app.background else self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        own = preferences()
        wheels = bpy.path.abspath(own.wheels_folder)
        if not wheels and not bpy.app.online_access:
            raise EngineError(
                "Online access is off: allow it in Preferences > System > Network, or name a folder of wheels or a "
                "Python with the engine."
            )
        task = {
            "folder": bpy.utils.extension_path_user(engine_process.EXTENSION, path="engine", create=True),
            "root": str(engine_process.ROOT),
            "index": own.package_index,
            "wheels": wheels,
            "look_only": self.look_only,
        }
        script = engine_process.ROOT / "swag_blender" / "make_environment.py"
        return Engine([sys.executable, str(script), json.dumps(task)])


class SWAG_OT_look_up_engine(_Environment, bpy.types.Operator):
    """Say which build of torch the engine would get and how much would be downloaded, without downloading it"""

    bl_idname = "swag.look_up_engine"
    bl_label = "Look Up Size of Engine"
    job = "Look-up"
    look_only = True

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        left = max(0, event["bytes"] - event["present"]) / 1e6
        return (
            f"torch {event['torch']} and {event['packages'] - 1} other packages, {event['bytes'] / 1e6:.0f} MB; "
            f"{left:.0f} MB of them are to be downloaded."
        )


class SWAG_OT_install_engine(_Environment, bpy.types.Operator):
    """Download the packages that training needs into a Python environment of their own"""

    bl_idname = "swag.install_engine"
    bl_label = "Install Engine"
    job = "Installation"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        where = "Installs from the folder of wheels" if preferences().wheels_folder else "Downloads the packages"
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Install Engine",
            message=f"{where} into {engine_process.environment_folder()}",
            confirm_text="Install",
        )

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        found = event["doctor"]
        context.window_manager.swag.doctor = json.dumps(found)
        return f"The engine is installed: Python {found['python']}, torch {found['packages']['torch']}."


class SWAG_OT_check_engine(Job, bpy.types.Operator):
    """Say what the engine's Python has: packages with versions, processor, graphics card"""

    bl_idname = "swag.check_engine"
    bl_label = "Check Engine"
    job = "Engine check"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run_waiting(context) if bpy.app.background else self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        return Engine([engine_process.engine_python(), "-m", "swag_engine.app.doctor"])

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        del event["event"]
        context.window_manager.swag.doctor = json.dumps(event)
        missing = [name for name, version in event["packages"].items() if version is None]
        if missing:
            raise EngineError(f"This Python lacks {', '.join(missing)}: install them, or use Install Engine.")
        return f"The engine is ready: torch {event['packages']['torch']}, training takes {event['auto']}."


class SWAG_OT_remove_engine(bpy.types.Operator):
    """Delete the engine's Python environment with all its packages; runs and splats stay"""

    bl_idname = "swag.remove_engine"
    bl_label = "Remove Engine"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not nothing_runs(cls, context):
            return False
        cls.poll_message_set("No environment has been made")
        return engine_process.environment_folder().exists()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(
            self, event, message=f"Deletes {engine_process.environment_folder()}", confirm_text="Remove"
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        folder = engine_process.environment_folder()
        # Half a removal must not look whole either.
        (folder / "installed.json").unlink(missing_ok=True)
        try:
            shutil.rmtree(folder)
        except OSError as error:
            self.report(
                {"ERROR"}, f"{folder} could not be removed: {error.strerror}. Close what uses it and try again."
            )
            return {"CANCELLED"}
        context.window_manager.swag.doctor = ""
        self.report({"INFO"}, "The engine is removed.")
        return {"FINISHED"}


CLASSES = (SWAG_OT_look_up_engine, SWAG_OT_install_engine, SWAG_OT_check_engine, SWAG_OT_remove_engine)
