"""Blender as a long-lived process that runs one function of a script after another.

Started as `server.py ZIP NODES` with a Python that finds bpy; ZIP is the extension, NODES a .blend file that the first
process of a version writes, and BLENDER_USER_RESOURCES names an empty folder. Each line of standard input is a request,
a JSON object: `script` (a module of scripts/), `function`, `arguments` (a list) and `environment` (variables for this
request alone). Each line of standard output is an answer: `result`, what the function returned, or `error`, the
traceback. Whatever is printed goes to standard error.
"""

import atexit
import compileall
import contextlib
import ctypes
import importlib
import json
import os
import shutil
import sys
import traceback
from pathlib import Path

import bpy

# isort: split
import addon_utils  # found once bpy is imported

EXTENSION = "bl_ext.user_default.swag_splatting"
SCRIPTS = Path(__file__).with_name("scripts")
USER = Path(os.environ["BLENDER_USER_RESOURCES"])


def handler_lists():
    named = ((name, getattr(bpy.app.handlers, name)) for name in dir(bpy.app.handlers))
    return {name: handlers for name, handlers in named if isinstance(handlers, list)}


def properties_of_types():
    return {cls: set(dir(cls)) for cls in bpy.types.ID.__subclasses__()}


class Blank:
    """The state before the first script, and the way back to it."""

    def __init__(self, nodes):
        self.nodes = str(nodes)
        if not nodes.exists():
            self._write_nodes(nodes)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.environment = dict(os.environ)
        self.path = list(sys.path)
        self.handlers = {name: list(handlers) for name, handlers in handler_lists().items()}
        self.properties = properties_of_types()

    def _write_nodes(self, nodes):
        """Write a .blend of the nodes that every object with splats uses: to build them takes Blender two seconds."""
        bpy.ops.wm.read_factory_settings(use_empty=True)
        assert addon_utils.enable(EXTENSION)
        preview = importlib.import_module(f"{EXTENSION}.swag_blender.nodes.splat_preview")
        for native in {False, preview.HAS_NATIVE}:
            preview.node_group(native)
        own = USER / "nodes.blend"
        bpy.data.libraries.write(str(own), {*bpy.data.node_groups, *bpy.data.materials}, fake_user=True)
        own.replace(nodes)  # whole at once: another process may look for it
        addon_utils.disable(EXTENSION)

    def restore(self):
        """Load factory settings with no objects but the splats' nodes, and register a fresh import of the extension."""
        addon_utils.disable(EXTENSION)
        for name, module in list(sys.modules.items()):
            if name.startswith(EXTENSION) or str(getattr(module, "__file__", "")).startswith(str(SCRIPTS)):
                del sys.modules[name]
        for name, handlers in handler_lists().items():
            handlers[:] = self.handlers[name]
        for cls, names in properties_of_types().items():
            for name in names - self.properties.get(cls, names):
                delattr(cls, name)
        os.environ.clear()
        os.environ.update(self.environment)
        sys.path[:] = self.path
        os.chdir(USER)
        written = [folder for folder in USER.iterdir() if folder.name != "extensions"]
        for folder in (*written, USER / "extensions" / ".user", bpy.app.tempdir):
            shutil.rmtree(folder, ignore_errors=True)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        assert addon_utils.enable(EXTENSION, default_set=True)
        with bpy.data.libraries.load(self.nodes) as (there, here):
            here.node_groups, here.materials = there.node_groups, there.materials


def answer(request, blank):
    try:
        blank.restore()
        os.environ.update(request["environment"])
        function = getattr(importlib.import_module(request["script"]), request["function"])
        return {"result": function(*request["arguments"])}
    except BaseException:  # a script may also call sys.exit
        return {"error": traceback.format_exc()}


def main():
    # Child processes and Blender itself write to 1 and read from 0: both are kept apart from the conversation.
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    sys.path.insert(0, str(SCRIPTS))
    addon_utils.enable("bl_pkg")
    bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=False)
    for folder in (SCRIPTS, USER / "extensions"):  # which every call imports anew
        compileall.compile_dir(folder, quiet=1)
    blank = Blank(Path(sys.argv[2]))
    for line in requests:
        answered = json.dumps(answer(json.loads(line), blank))
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        ctypes.CDLL(None).fflush(None)
        print(answered, file=answers, flush=True)
    # What the end of Blender runs. After it, Blender 4.5 can wait forever for its thread that closes .blend files.
    atexit._run_exitfuncs()
    os._exit(0)


main()
