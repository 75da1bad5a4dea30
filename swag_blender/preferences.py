"""Preferences of the extension: the engine's Python, the buttons that install it, and what it has."""

import contextlib
import functools
import json
import os
import platform
import sys
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
from bpy.props import StringProperty

from . import EXTENSION, assets, engine_process
from .blender_types import present, set_button, with_properties
from .make_environment import unpacked_size
from .properties import status_of
from .sidebar import draw_job, draw_outcome, draw_wrapped

JOBS = ("Installation", "Look-up", "Engine check")
"""Names of the jobs whose progress the preferences show."""
MEGABITS = 50
"""Speed of the internet connection that the shown time assumes, Mbit/s."""
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""PyTorch's package index of builds without CUDA."""
CUDA_INSTEAD = (
    "PyTorch's package index cannot be reached, or lacks this version: torch comes with CUDA, for NVIDIA cards."
)
"""Why the download is large on a computer without an NVIDIA card."""
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
        if draw_job(layout, context, *JOBS):
            pass
        elif problem:
            self.draw_install(layout, context)
        else:
            layout.label(text="The engine is installed: you can train.", icon="CHECKMARK")
            layout.operator("swag.check_engine", icon="VIEWZOOM")
        draw_outcome(layout, context, *JOBS)
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
            draw_wrapped(layout, expected_download(context), width, icon="IMPORT")
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


@functools.cache
def has_nvidia_card() -> bool:
    """Whether this computer has an NVIDIA card with a driver."""
    if sys.platform == "win32":
        return (Path(os.environ.get("SYSTEMROOT", r"C:\Windows")) / "System32" / "nvcuda.dll").exists()
    cards = (*Path("/proc/driver/nvidia").glob("gpus/*"), *Path("/dev").glob("nvidia[0-9]*"))
    return bool(cards) or Path("/usr/lib/wsl/lib/libcuda.so.1").exists()  # Linux in Windows has no such files


def package_index() -> str:
    """Address of the additional package index; "" for none.

    The usual build of torch for Linux has CUDA in it, seven times the download; those for Windows and macOS do not.
    """
    without_cuda = sys.platform == "linux" and not has_nvidia_card()
    return preferences().package_index or (CPU_INDEX if without_cuda else "")


def expected_download(context: bpy.types.Context) -> str:
    """What Install Engine downloads, its time and its disk space: as looked up, else as usual on this system.

    It says why when torch with CUDA is downloaded although there is no NVIDIA card.
    """
    looked_up = status_of(context).download_mb
    with_cuda = sys.platform == "linux" and platform.machine() == "x86_64" and not package_index()
    usual = 2950 if with_cuda else 410
    megabytes = looked_up or usual
    minutes = megabytes * 8 / MEGABITS / 60 + megabytes * UNPACK_SECONDS / 60
    size = f"{megabytes / 1000:.1f} GB" if megabytes >= 100 else f"{megabytes} MB"
    all_wheels = (status_of(context).packages_mb or usual) * 1e6
    after = unpacked_size(int(all_wheels)) / 1e9
    why = CUDA_INSTEAD + " " if status_of(context).cuda_instead else ""
    # The wheels stay until all is unpacked.
    return (
        f"{why}Downloads {'' if looked_up else 'about '}{size}: {max(1, round(minutes))} minutes at {MEGABITS} Mbit/s. "
        f"Takes about {after:.1f} GB of disk, and {after + all_wheels / 1e9:.1f} GB while it installs"
    )


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
    if card := next((backend for backend in (cuda, wgpu) if backend["runs"]), None):
        column.label(text=f"Graphics card: {card['device']}, {card['memory_gb']} GB")
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
