"""Install Engine, Check Engine and Remove Engine in the preferences."""

import json
import sys
from pathlib import Path
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import engine_process, installation
from bl_ext.user_default.swag_splatting.swag_blender import preferences as preferences_module

preferences = bpy.context.preferences.addons["bl_ext.user_default.swag_splatting"].preferences
status = bpy.context.window_manager.swag
# Blender's own Python has torch here; with this it counts as having no engine.
engine_process.PACKAGES = ("no_such_package",)

# As Any: scripts replace what is in them.
patched: Any = preferences_module
patched_installation: Any = installation


def message_of(operator):
    try:
        operator()
    except RuntimeError as error:
        return str(error)
    return status.message


def install_check_and_remove(wheels):
    found = {"offline": message_of(bpy.ops.swag.install_engine)}
    preferences.wheels_folder = wheels
    found["look up"] = message_of(bpy.ops.swag.look_up_engine)
    found["complete after look-up"] = engine_process.environment_is_whole()
    found["install"] = message_of(bpy.ops.swag.install_engine)
    found["complete"] = engine_process.environment_is_whole()
    found["python"] = engine_process.engine_python()
    found["doctor"] = status.doctor
    found["check"] = message_of(bpy.ops.swag.check_engine)
    status.begin("Installation")
    status.end("Installation", "An old error", True)
    bpy.ops.swag.remove_engine()
    found["outcome after removal"] = (status.message, status.failed)
    found["exists after removal"] = engine_process.environment_folder().exists()
    found["check after removal"] = message_of(bpy.ops.swag.check_engine)
    return found


def install_from(folder):
    """What an installation from a folder without wheels says; the log that the user can open."""
    preferences.wheels_folder = folder
    message = message_of(bpy.ops.swag.install_engine)
    bpy.ops.swag.show_log()
    return {
        "message": message,
        "log": bpy.data.texts["SWAG Log"].as_string(),
        "complete": engine_process.environment_is_whole(),
        "check": message_of(bpy.ops.swag.check_engine),
    }


def complete_with_a_dead_link():
    """Whether an environment counts as complete whose Python links to a Blender that was removed."""
    python = engine_process.environment_python()
    python.parent.mkdir(parents=True)
    python.symlink_to("/no/such/blender/python")
    installed = {"doctor": {"python": ".".join(map(str, sys.version_info[:3]))}}
    (engine_process.environment_folder() / "installed.json").write_text(json.dumps(installed))
    return engine_process.environment_is_whole()


def complete_with_version(version):
    """Whether an environment counts as complete that was installed with a version of Python; "" for Blender's."""
    python = engine_process.environment_python()
    python.parent.mkdir(parents=True, exist_ok=True)
    python.touch()
    installed = {"doctor": {"python": version or ".".join(map(str, sys.version_info[:3]))}}
    (engine_process.environment_folder() / "installed.json").write_text(json.dumps(installed))
    return engine_process.environment_is_whole()


def check(python):
    preferences.engine_python = python
    return message_of(bpy.ops.swag.check_engine)


def install_where_only_cuda_is_found():
    """What is stated before and after an installation that the look-up stops; the task of this and the next one."""
    patched.has_nvidia_card = lambda: False
    tasks = []
    found = {"event": "result", "torch": "2", "cuda": True, "packages": 9, "bytes": 2_940_000_000, "present": 0}

    def start(command):
        tasks.append(json.loads(command[-1]))
        return Engine([sys.executable, "-c", f"print({json.dumps(found)!r})"])

    Engine, patched_installation.Engine = installation.Engine, start
    bpy.context.preferences.system.use_online_access = True
    before = preferences_module.expected_download(bpy.context)
    message = message_of(bpy.ops.swag.install_engine)
    after = preferences_module.expected_download(bpy.context)
    message_of(bpy.ops.swag.install_engine)
    return {
        "before": before, "message": message, "after": after, "without CUDA": [task["without_cuda"] for task in tasks]
    }  # fmt: skip


def cards(folder):
    """What has_nvidia_card and package_index say of faked systems."""
    card, system = preferences_module.has_nvidia_card.__wrapped__, sys.platform
    paths = {
        "none": "", "/proc": "proc/driver/nvidia/gpus/0000:01:00.0", "/dev": "dev/nvidia0", "control only":
        "dev/nvidiactl", "wsl": "usr/lib/wsl/lib/libcuda.so.1",
    }  # fmt: skip
    found: dict[str, Any] = {}
    for number, (name, path) in enumerate(paths.items()):
        root = Path(folder) / str(number)
        (root / path).mkdir(parents=True)
        patched.Path = lambda given, root=root: root / given.lstrip("/")
        found[name] = card()
    for name, has, platform in (
        ("without card", False, "linux"), ("with card", True, "linux"), ("on macOS", False, "darwin")
    ):  # fmt: skip
        patched.has_nvidia_card = lambda has=has: has
        vars(sys)["platform"] = platform
        found[f"index {name}"] = preferences_module.package_index().rpartition("/")[2]
    vars(sys)["platform"] = system
    preferences.package_index = "own"
    return found | {"own index": preferences_module.package_index()}
