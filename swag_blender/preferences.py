"""Preferences of the extension: the engine's Python, the buttons that install it, and what it has."""

import json
from typing import Annotated, Any, cast

import bpy
from bpy.props import StringProperty

from . import EXTENSION, assets, engine_process
from .blender_types import present, set_button, with_properties
from .properties import status_of
from .sidebar import draw_job, draw_outcome, draw_wrapped

JOBS = ("Installation", "Look-up", "Engine check")
"""Names of the jobs whose progress the preferences show."""


def preferences() -> "SwagPreferences":
    """The preferences of the extension."""
    return cast(SwagPreferences, present(bpy.context.preferences).addons[EXTENSION].preferences)


@with_properties
class SwagPreferences(bpy.types.AddonPreferences):
    """Preferences of the extension."""

    bl_idname = EXTENSION

    engine_python: Annotated[
        str,
        StringProperty(
            name="Python",
            description="A Python that has the engine's packages; empty: the environment of Install Engine",
            subtype="FILE_PATH",
        ),
    ]
    package_index: Annotated[
        str,
        StringProperty(
            name="Package Index",
            description="Address of an additional package index, for another build of torch than the usual one: "
            "PyTorch's own has builds without CUDA and for each version of CUDA (pytorch.org, Get Started)",
        ),
    ]
    wheels_folder: Annotated[
        str,
        StringProperty(
            name="Folder of Wheels",
            description="Install from the wheels in this folder, without internet. On a computer with internet, pip "
            "download -r requirements.txt -c constraints.txt fills it",
            subtype="DIR_PATH",
        ),
    ]

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the preferences; Blender calls this."""
        layout, status, width = present(self.layout), status_of(context), present(context.region).width
        layout.label(text="Training runs in a separate Python; opening, showing and exporting splats needs none.")
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
        set_button(row.operator("swag.node_assets", icon="ASSET_MANAGER"), remove=False)
        if assets.folder().exists():
            set_button(row.operator("swag.node_assets", text="Remove", icon="TRASH"), remove=True)

        header, body = layout.panel("swag_install", default_closed=bool(ready))
        header.label(text="Install Engine")
        if body:
            self.draw_install(body)

    def draw_install(self, layout: bpy.types.UILayout) -> None:
        """Draw the part that installs the engine."""
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.label(text="Choose a Python that has the packages of requirements.txt:")
        layout.prop(self, "engine_python")
        layout.label(text="or install one in the extension's own folder (0.5 GB, with CUDA 3 GB):")
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
    """Draw what the engine's Python has, as swag_engine.app.doctor found it."""
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
    """Register the preferences."""
    bpy.utils.register_class(SwagPreferences)


def unregister() -> None:
    """Undo `register`."""
    bpy.utils.unregister_class(SwagPreferences)
