"""`blender --background --command swag`, called as Blender calls it."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import commands


def run(*arguments):
    """The exit code of the command."""
    code = commands.run(list(arguments))
    sys.stdout.flush()
    return code


def import_scene_and_run(scene, folder):
    codes = [run("import", scene, "--out", folder + "/new/scene.blend", "--json")]
    bpy.ops.wm.open_mainfile(filepath=folder + "/new/scene.blend")
    kinds = [obj.type for obj in bpy.context.scene.objects]
    cameras, path = kinds.count("CAMERA"), bpy.context.scene.swag.scene_path
    size = ("--iterations", "40", "--width", "64", "--sh-degree", "0")
    codes.append(run("train", scene, "--out", folder + "/run", *size))
    codes.append(run("import", folder + "/run", "--out", folder + "/run.blend"))
    splats = [obj for obj in bpy.context.scene.objects if "swag_run" in obj]
    trained = {"objects": len(splats), "has parent": splats[0].parent is not None}
    trained["renderer"] = bpy.context.scene.render.engine
    codes.append(run("import", folder + "/run/result.ply", "--out", folder + "/file.blend"))
    return {"codes": codes, "cameras": cameras, "path": path, "trained": trained}


def wrong_imports(folder):
    """Exit codes of wrong uses of `import`, and of the two help pages."""
    wrong = [
        run("import"),
        run("import", folder, "--out", folder + "/a.obj"),
        run("import", folder + "/none.ply", "--out", folder + "/a.blend"),
        run("import", folder + "/stopped", "--out", folder + "/a.blend", "--json"),
    ]
    return {"wrong": wrong, "import help": run("import", "--help"), "help": run("--help")}


def train_and_terminate(scene, folder):
    """The exit code of a training during which this process gets a SIGTERM."""

    def terminate():
        while not Path(folder, "run", "metrics.jsonl").exists():  # the first iterations are done
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=terminate).start()
    return run("train", scene, "--out", folder + "/run", "--iterations", "3000", "--width", "64")
