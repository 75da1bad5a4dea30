"""Preferences of the extension: which Python trains, and the button that makes one."""

import bpy
from bpy.props import StringProperty

from . import EXTENSION, engine_process
from .panels import draw_job, draw_wrapped


class SwagPreferences(bpy.types.AddonPreferences):
    bl_idname = EXTENSION

    engine_python: StringProperty(
        name="Python",
        description="A Python that has the engine's packages; left empty: the environment of Install Engine",
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.label(text="Training runs in a Python of its own; opening, showing and exporting splats needs none.")
        try:
            layout.label(text=f"Engine: {engine_process.engine_python()}", icon="CHECKMARK")
        except engine_process.EngineError as error:
            draw_wrapped(layout, str(error), context.region.width, icon="ERROR")
        layout.prop(self, "engine_python")
        status = context.window_manager.swag
        if status.job == "Installation":
            draw_job(layout, context)
            return
        if status.last_job == "Installation":
            draw_wrapped(layout, status.message, context.region.width, icon="ERROR" if status.failed else "CHECKMARK")
        row = layout.row()
        row.enabled = bpy.app.online_access
        installed = engine_process.environment_is_whole()
        row.operator(
            "swag.install_engine", text="Install Engine Again" if installed else "Install Engine", icon="IMPORT"
        )
        if not bpy.app.online_access:
            layout.label(
                text="Installing needs online access: Preferences > System > Network.", icon="INTERNET_OFFLINE"
            )
        layout.label(text=f"Downloads one to three gigabytes into {engine_process.environment_folder()}")


def register() -> None:
    bpy.utils.register_class(SwagPreferences)


def unregister() -> None:
    bpy.utils.unregister_class(SwagPreferences)
