"""`blender --background --command swag ...`: the engine's command line, and `import`, which makes a .blend."""

import argparse
import contextlib
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.registry import SUFFIXES
from ..swag_engine.formats.run_folder import RunFolder
from . import engine_process
from .blender_types import call_operator, present
from .render_setup import prepare_render

BAD_USAGE = 2
PROG = "blender --background --command swag"
_handle: Any = None


def run(arguments: list[str]) -> int:
    """Run one command; returns its exit code. Output goes where Blender's goes."""
    if arguments[:1] == ["import"]:
        return import_(arguments[1:])
    try:
        command = [engine_process.engine_python(), "-m", "swag_engine", *arguments]
        # One stream keeps the order of the lines in a log file; with --json stdout has the document alone.
        errors = None if "--json" in arguments else subprocess.STDOUT
        environment = engine_process.clean_environment() | {"SWAG_PROG": PROG}
        child = subprocess.Popen(command, env=environment, stderr=errors)
        # A service may stop Blender alone; the child then keeps what exists, and its exit code becomes Blender's.
        signal.signal(signal.SIGTERM, lambda number, frame: child.terminate())
    except (engine_process.EngineError, OSError) as error:
        print(error, file=sys.stderr)
        return BAD_USAGE
    while True:
        # Ctrl-C reaches the child too, which then stops and keeps its result so far.
        with contextlib.suppress(KeyboardInterrupt):
            code = child.wait()
            if arguments in ([], ["-h"], ["--help"]):
                print(f"In Blender there is also\n  import  {import_parser().description}")
            return code


def import_parser() -> argparse.ArgumentParser:
    """Parser of the command `import`."""
    parser = argparse.ArgumentParser(
        prog=f"{PROG} import", description="Make a .blend from a COLMAP scene, a training run or a splat file."
    )
    what = f"folder of a scene or run, or {' or '.join(SUFFIXES)}"
    parser.add_argument("path", metavar="SCENE|RUN|FILE", type=Path, help=what)
    parser.add_argument("--out", metavar="FILE.blend", type=Path, required=True, help="file to write")
    parser.add_argument(
        "--json", action="store_true", help="print one JSON document to stdout, after Blender's own lines"
    )
    return parser


def import_(arguments: list[str]) -> int:
    """Make a .blend; returns the exit code: 0 done, 2 wrong input or usage."""
    try:
        asked = import_parser().parse_args(arguments)
    except SystemExit as leave:
        return int(leave.code or 0)
    bpy.ops.wm.read_homefile(use_empty=True)
    try:
        if asked.out.suffix != ".blend":
            raise InputError(f"{asked.out} must end in .blend.")
        bring_in(asked.path)
        asked.out.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(asked.out.absolute()))
    except (InputError, RuntimeError, OSError) as error:
        # A RuntimeError has the report of an operator after "Error: ".
        sentence = str(error).strip().removeprefix("Error: ")
        if asked.json:
            print(json.dumps({"error": sentence}))
        print(sentence, file=sys.stderr)
        return BAD_USAGE
    kinds = [obj.type for obj in present(bpy.context.scene).objects]
    made = {"out": str(asked.out), "cameras": kinds.count("CAMERA"), "clouds": kinds.count("POINTCLOUD")}
    if asked.json:
        print(json.dumps(made))
    else:
        print(f"{made['cameras']} cameras, {made['clouds']} point clouds: {asked.out}")
    return 0


def bring_in(path: Path) -> None:
    """Import a scene, a run or a splat file to the open Blender scene.

    Raises InputError, or RuntimeError with an operator's report.
    """
    run = RunFolder(path.absolute())
    if path.suffix.lower() in SUFFIXES:
        call_operator("import_splats", filepath=str(path.absolute()))
    elif not run.config.exists():
        call_operator("import_scene", directory=str(path.absolute()))
    else:
        call_operator("open_run", directory=str(run.path))
        prepare_render(present(bpy.context.scene), display_values=False, engine="CYCLES")


def register() -> None:
    """Register the command."""
    global _handle
    _handle = bpy.utils.register_cli_command("swag", run)


def unregister() -> None:
    """Remove the command."""
    bpy.utils.unregister_cli_command(_handle)
