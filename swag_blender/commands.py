"""`blender --background --command swag ...`: the engine's own command line, in the engine's Python."""

import contextlib
import subprocess
import sys
from typing import Any

import bpy

from . import engine_process

BAD_USAGE = 2
_handle: Any = None


def run(arguments: list[str]) -> int:
    """Run `python -m swag_engine` with the arguments; returns its exit code. Output goes where Blender's goes."""
    try:
        command = [engine_process.engine_python(), "-m", "swag_engine", *arguments]
        # A batch log is one stream in the order of events; with --json stdout carries the document alone.
        errors = None if "--json" in arguments else subprocess.STDOUT
        child = subprocess.Popen(command, env=engine_process.clean_environment(), stderr=errors)
    except (engine_process.EngineError, OSError) as error:
        print(error, file=sys.stderr)
        return BAD_USAGE
    while True:
        # Ctrl-C reaches the child too: it stops in its own time and keeps what exists.
        with contextlib.suppress(KeyboardInterrupt):
            return child.wait()


def register() -> None:
    global _handle
    _handle = bpy.utils.register_cli_command("swag", run)


def unregister() -> None:
    bpy.utils.unregister_cli_command(_handle)
