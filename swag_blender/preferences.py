"""Preferences of the extension: the engine's Python, the buttons that install it, and what it has."""

import contextlib
import json
import platform
import sys
from typing import Annotated, Any, cast

import bpy
from bpy.props import StringProperty

from . import EXTENSION, assets, engine_process
from .blender_types import present, set_button, with_properties
from .properties import status_of
from .sidebar import draw_job, draw_outcome, draw_wrapped

JOBS = ("Installation", "Look-up", "Engine check")
"""Names of the jobs whose progress the preferences show."""
MEGABITS = 50
"""Speed of the internet connection that the shown time assumes, Mbit/s."""
UNPACK_SECONDS = 0.05
"""Time to unpack a megabyte of packages, assumed: 2.5 minutes for 3 GB."""


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
        problem = engine_process.engine_problem()
        if status.job in JOBS:
            draw_job(layout, context)
        elif problem:
            self.draw_install(layout, context)
        else:
            layout.label(text="The engine is installed: you can train.", icon="CHECKMARK")
            layout.operator("swag.check_engine", icon="VIEWZOOM")
        if not status.job and status.last_job in JOBS:
            draw_outcome(layout, context)
        if status.doctor:
            draw_doctor(layout.box(), json.loads(status.doctor))
        header, body = layout.panel("swag_advanced", default_closed=True)
        header.label(text="Advanced")
        if body:
            if problem:
                draw_wrapped(body, problem, width, icon="INFO")
            self.draw_advanced(body)

    def draw_install(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        """Draw the button that installs the engine, below what it takes."""
        width = present(context.region).width
        draw_wrapped(
            layout,
            "Training needs the engine, a Python of its own. Opening, showing and exporting splats works without it.",
            width,
            icon="INFO",
        )
        if self.wheels_folder:
            layout.label(text="Installs from your folder of wheels, without internet; about 3 minutes.")
        else:
            layout.label(text=expected_download(context), icon="IMPORT")
        row = layout.row()
        row.scale_y = 1.6
        row.operator("swag.install_engine", icon="IMPORT")
        if not bpy.app.online_access and not self.wheels_folder:
            row = layout.row()
            row.label(text="Blender has no online access.", icon="INTERNET_OFFLINE")
            row.prop(present(context.preferences).system, "use_online_access", text="Allow Online Access")

    def draw_advanced(self, layout: bpy.types.UILayout) -> None:
        """Draw what most users never need: a Python of their own, other packages, the asset library."""
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.prop(self, "engine_python")
        column.prop(self, "package_index")
        column.prop(self, "wheels_folder")
        row = layout.row()
        row.operator("swag.look_up_engine", text="Look Up Size", icon="VIEWZOOM")
        if engine_process.environment_is_whole():
            row.operator("swag.install_engine", text="Install Engine Again", icon="IMPORT")
        row.operator("swag.remove_engine", icon="TRASH")
        with contextlib.suppress(engine_process.EngineError):
            layout.label(text=engine_process.engine_python(), icon="FILE_SCRIPT", translate=False)
        layout.label(text=str(engine_process.environment_folder()), icon="FILE_FOLDER", translate=False)
        row = layout.row()
        set_button(row.operator("swag.node_assets", icon="ASSET_MANAGER"), remove=False)
        if assets.folder().exists():
            set_button(row.operator("swag.node_assets", text="Remove", icon="TRASH"), remove=True)


def expected_download(context: bpy.types.Context) -> str:
    """How much Install Engine downloads, and how long that takes: as looked up, else as usual on this system."""
    looked_up = status_of(context).download_mb
    # PyTorch's usual build for Linux on x86 has CUDA in it.
    usual = 3000 if sys.platform == "linux" and platform.machine() == "x86_64" else 500
    megabytes = looked_up or usual
    minutes = megabytes * 8 / MEGABITS / 60 + megabytes * UNPACK_SECONDS / 60
    size = f"{megabytes / 1000:.1f} GB" if megabytes >= 100 else f"{megabytes} MB"
    return f"Downloads {'' if looked_up else 'about '}{size}: {max(1, round(minutes))} minutes at {MEGABITS} Mbit/s"


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
    cuda, wgpu = backends["cuda"], backends["wgpu"]
    if cuda["runs"]:
        column.label(text=f"Graphics card: {cuda['device']}, {cuda['memory_gb']} GB")
    elif wgpu["runs"]:
        column.label(text=f"Graphics card: {wgpu['device']}")
    else:
        column.label(text=f"No graphics card is used: {wgpu['reason']} CUDA: {cuda['reason']}")
    for adapter in wgpu["adapters"]:
        if adapter["refused"]:
            column.label(text=f"{adapter['name']}: {adapter['refused']}")
    column.label(text=f"Training uses {found['auto']}.")


def register() -> None:
    """Register the preferences."""
    bpy.utils.register_class(SwagPreferences)


def unregister() -> None:
    """Undo `register`."""
    bpy.utils.unregister_class(SwagPreferences)
