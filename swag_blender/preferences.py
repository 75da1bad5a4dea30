"""Preferences of the extension: which Python trains, the buttons that make one, and what it has."""

import json
from typing import Any

import bpy
from bpy.props import StringProperty

from . import EXTENSION, assets, engine_process
from .panels import draw_job, draw_outcome, draw_wrapped

JOBS = ("Installation", "Look-up", "Engine check")


def preferences() -> "SwagPreferences":
    return bpy.context.preferences.addons[EXTENSION].preferences


class SwagPreferences(bpy.types.AddonPreferences):
    bl_idname = EXTENSION

    engine_python: StringProperty(
        name="Python",
        description="A Python that has the engine's packages; left empty: the environment of Install Engine",
        subtype="FILE_PATH",
    )
    package_index: StringProperty(
        name="Package Index",
        description="Address of a further package index, for another build of torch than the usual one: PyTorch's own "
        "has builds for processors alone and for each version of CUDA (pytorch.org, Get Started)",
    )
    wheels_folder: StringProperty(
        name="Folder of Wheels",
        description="Install from wheels in this folder, without internet; elsewhere, pip download -r requirements.txt "
        "-c constraints.txt fills it",
        subtype="DIR_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout, status, width = self.layout, context.window_manager.swag, context.region.width
        layout.label(text="Training runs in a Python of its own; opening, showing and exporting splats needs none.")
        try:
            ready = f"Engine: {engine_process.engine_python()}"
            layout.label(text=ready, icon="CHECKMARK")
        except engine_process.EngineError as error:
            ready = ""
            draw_wrapped(layout, str(error), width, icon="ERROR")
        if status.doctor:
            draw_doctor(layout.box(), json.loads(status.doctor))
        if status.job in JOBS:
            draw_job(layout, context)
            return
        if status.last_job in JOBS:
            draw_outcome(layout, context)
        row = layout.row()
        row.enabled = bool(ready)
        row.operator("swag.check_engine", icon="VIEWZOOM")

        row = layout.row()
        row.operator("swag.node_assets", icon="ASSET_MANAGER").remove = False
        if assets.folder().exists():
            row.operator("swag.node_assets", text="Remove", icon="TRASH").remove = True

        header, body = layout.panel("swag_install", default_closed=bool(ready))
        header.label(text="Install Engine")
        if body:
            self.draw_install(body)

    def draw_install(self, layout: bpy.types.UILayout) -> None:
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.label(text="Either name a Python that has the packages of requirements.txt:")
        layout.prop(self, "engine_python")
        layout.label(text="or make one, into the extension's own folder; half a gigabyte, with CUDA three:")
        column = layout.column()
        column.prop(self, "package_index")
        column.prop(self, "wheels_folder")
        can_fetch = bpy.app.online_access or bool(self.wheels_folder)
        row = layout.row()
        row.enabled = can_fetch
        row.operator("swag.look_up_engine", text="Look Up Size", icon="VIEWZOOM")
        row.operator(
            "swag.install_engine",
            text="Install Engine Again" if engine_process.environment_is_whole() else "Install Engine",
            icon="IMPORT",
        )
        layout.operator("swag.remove_engine", icon="TRASH")
        if not can_fetch:
            layout.label(
                text="Installing needs online access (Preferences > System > Network) or a folder of wheels.",
                icon="INTERNET_OFFLINE",
            )
        layout.label(text=str(engine_process.environment_folder()), icon="FILE_FOLDER")


def draw_doctor(layout: bpy.types.UILayout, found: dict[str, Any]) -> None:
    """What the engine's Python has, as swag_engine.app.doctor tells it."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    column.label(text=f"{found['system']}, {found['cores']} processor cores, Python {found['python']}")
    grid = column.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
    for name, version in found["packages"].items():
        grid.label(text=f"{name} {version or 'is missing'}", icon="CHECKMARK" if version else "ERROR")
    backends = found.get("backends")
    if not backends:
        return
    card = backends["cuda"]
    if card["runs"]:
        column.label(text=f"Graphics card: {card['device']}, {card['memory_gb']} GB")
    else:
        column.label(text=f"No graphics card is used: {card['reason']}")
    column.label(text=f"Training uses {found['auto']}.")


def register() -> None:
    bpy.utils.register_class(SwagPreferences)


def unregister() -> None:
    bpy.utils.unregister_class(SwagPreferences)
