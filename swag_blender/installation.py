"""The engine's Python environment: how it is made, described and removed."""

import json
import shutil
import sys
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from . import EXTENSION, engine_process
from .engine_process import Engine
from .job import Job, may_start
from .preferences import CPU_INDEX, expected_download, package_index, preferences
from .properties import status_of


def start_installer(context: bpy.types.Context, look_only: bool) -> Engine:
    """Start make_environment.py with the user's preferences.

    Args:
        context: Blender's context.
        look_only: only look up what would be downloaded.

    Raises:
        InputError: online access is off and no folder of wheels is set.
        EngineError: the process cannot be started.
    """
    own = preferences()
    wheels = bpy.path.abspath(own.wheels_folder)
    if not wheels and not bpy.app.online_access:
        raise InputError(
            "Online access is off: allow it in Preferences > System > Network, or set a folder of wheels or a Python "
            "with the engine."
        )
    task = {
        "folder": bpy.utils.extension_path_user(EXTENSION, path="engine", create=True),
        "root": str(engine_process.ROOT),
        "index": package_index(),
        "wheels": wheels,
        "look_only": look_only,
        # Once the user has been told of its size, torch with CUDA may be installed.
        "without_cuda": not wheels and package_index() == CPU_INDEX and not status_of(context).cuda_instead,
    }
    script = engine_process.ROOT / "swag_blender" / "make_environment.py"
    return Engine([sys.executable, str(script), json.dumps(task)])


def can_install(operator: type[Job], context: bpy.types.Context) -> bool:
    """Whether packages can be had and the job may start, for its `poll`."""
    if not may_start(operator, context):
        return False
    if not (bpy.app.online_access or preferences().wheels_folder):
        operator.poll_message_set("Allow online access in Preferences > System > Network, or set a folder of wheels")
        return False
    return True


def remember_download(context: bpy.types.Context, found: dict[str, Any]) -> int:
    """Store what the installer looked up, for `expected_download`; returns how many bytes would be downloaded."""
    status = status_of(context)
    left = max(0, found["bytes"] - found["present"])
    status.download_mb = max(1, round(left / 1e6))
    status.packages_mb = max(1, round(found["bytes"] / 1e6))
    status.cuda_instead = found["cuda"] and package_index() == CPU_INDEX and not preferences().wheels_folder
    return left


def refuse_larger_download(context: bpy.types.Context, found: dict[str, Any]) -> None:
    """Keep what a look-up found where it is larger than was stated before the start.

    Raises:
        InputError: always; it says how much there would be to download.
    """
    remember_download(context, found)
    raise InputError(
        f"Nothing was downloaded. {expected_download(context)}. Press Install Engine again to install it, or when the "
        "internet connection is mended."
    )


def remember_doctor(context: bpy.types.Context, found: dict[str, Any]) -> None:
    """Store what `swag_engine.app.doctor` found, for the preferences to show.

    Raises InputError when packages are missing.
    """
    status_of(context).doctor = json.dumps(found)
    missing = [name for name, version in found["packages"].items() if version is None]
    if missing:
        raise InputError(f"This Python lacks {', '.join(missing)}: install them, or use Install Engine.")


def remove_environment(context: bpy.types.Context) -> None:
    """Delete the environment. Raises InputError when a file of it cannot be deleted."""
    folder = engine_process.environment_folder()
    # First, so that a removal that fails leaves no environment that looks complete.
    (folder / "installed.json").unlink(missing_ok=True)
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise InputError(
            f"{folder} could not be removed: {error.strerror}. Close the programs that use it and try again."
        ) from error
    status = status_of(context)
    status.doctor = ""
    # How jobs ended is about an engine that is gone.
    for job in [job.name for job in status.jobs]:
        status.forget(job)
