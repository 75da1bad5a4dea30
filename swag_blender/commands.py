"""`blender --background --command swag ...`: the engine's own command line, in the engine's Python; and `import`, which
makes a .blend in this one."""

import argparse
import contextlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.registry import SUFFIXES
from ..swag_engine.formats.run_folder import RunFolder, read_json
from . import engine_process, runs

BAD_USAGE = 2
PROG = "blender --background --command swag"
_handle: Any = None


def run(arguments: list[str]) -> int:
    """Run one command; returns its exit code. Output goes where Blender's goes."""
    if arguments[:1] == ["import"]:
        return import_(arguments[1:])
    try:
        command = [engine_process.engine_python(), "-m", "swag_engine", *arguments]
        # A batch log is one stream in the order of events; with --json stdout carries the document alone.
        errors = None if "--json" in arguments else subprocess.STDOUT
        environment = engine_process.clean_environment() | {"SWAG_PROG": PROG}
        child = subprocess.Popen(command, env=environment, stderr=errors)
    except (engine_process.EngineError, OSError) as error:
        print(error, file=sys.stderr)
        return BAD_USAGE
    while True:
        # Ctrl-C reaches the child too: it stops in its own time and keeps what exists.
        with contextlib.suppress(KeyboardInterrupt):
            code = child.wait()
            if arguments in ([], ["-h"], ["--help"]):
                print(f"In Blender there is also\n  import  {import_parser().description}")
            return code


def import_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"{PROG} import", description="Make a .blend of a COLMAP scene, of a training run, or of a splat file."
    )
    what = f"folder of a scene or run, or {' or '.join(SUFFIXES)}"
    parser.add_argument("path", metavar="SCENE|RUN|FILE", type=Path, help=what)
    parser.add_argument("--out", metavar="FILE.blend", type=Path, required=True, help="file to write")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout, behind Blender's own lines")
    return parser


def import_(arguments: list[str]) -> int:
    """Make a .blend. Exit codes as the engine's: 0 done, 2 bad input or usage."""
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
        # An operator's report comes as a RuntimeError with "Error: " before it.
        sentence = str(error).strip().removeprefix("Error: ")
        if asked.json:
            print(json.dumps({"error": sentence}))
        print(sentence, file=sys.stderr)
        return BAD_USAGE
    kinds = [obj.type for obj in bpy.context.scene.objects]
    made = {"out": str(asked.out), "cameras": kinds.count("CAMERA"), "clouds": kinds.count("POINTCLOUD")}
    if asked.json:
        print(json.dumps(made))
    else:
        print(f"{made['cameras']} cameras, {made['clouds']} point clouds: {asked.out}")
    return 0


def bring_in(path: Path) -> None:
    """What the path holds into the open scene. Raises InputError, or RuntimeError with an operator's report."""
    run = RunFolder(path.absolute())
    if path.suffix.lower() in SUFFIXES:
        bpy.ops.swag.import_splats(filepath=str(path.absolute()))
    elif not run.config.exists():
        bpy.ops.swag.import_scene(directory=str(path.absolute()))
    else:
        scene = bpy.context.scene
        metrics = read_json(run.metrics, f"{path} holds no result yet: train it to an end first.")
        photographs = str(run.read_config()[0])
        bpy.ops.swag.import_scene(directory=photographs)
        obj = runs.show_splats(scene, read_ply(run.ply), str(run.path), photographs)
        runs.remember_training(obj, run, metrics)
        bpy.ops.swag.prepare_render()


def register() -> None:
    global _handle
    _handle = bpy.utils.register_cli_command("swag", run)


def unregister() -> None:
    bpy.utils.unregister_cli_command(_handle)
