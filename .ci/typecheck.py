"""Check the types of the extension, then of the tests, with mypy.

Links in a temporary folder give mypy every module under the name by which it is imported: the extension's as Blender
installs it, and what tests import without a package.
"""

import subprocess
import sys
from pathlib import Path

from contracts import ROOT, package_folder

LINKED = (
    "tests", "benchmarks", "swag_engine", "swag_blender",
    # What scripts import by its name alone, since they run inside Blender without a package.
    "tests/blender/window.py", "tests/blender/scripts/files.py", "tests/blender/scripts/pictures.py",
    "tests/blender/scripts/labels.py", "tests/blender/scripts/panels.py",
)  # fmt: skip
UNTYPED = "from typing import Any\n\ndef __getattr__(name: str) -> Any: ...\n"


def start(folder: str, package: str, cache: str) -> subprocess.Popen[bytes]:
    """Start mypy in a folder of links."""
    command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), "--package", package]
    return subprocess.Popen([*command, "--cache-dir", str(ROOT / ".mypy_cache" / cache)], cwd=folder)


def main() -> int:
    with package_folder("bl_ext/user_default") as extension, package_folder("bl_ext/user_default") as tests:
        for path in LINKED:
            Path(tests, Path(path).name).symlink_to(ROOT / path)
        # In tests Blender's own modules have no types: fake-bpy-module knows neither the operators and properties that
        # the extension registers nor which kind of node, socket or data a script has just made.
        for name in ("addon_utils", "bpy", "bpy/types", "bpy_extras", "mathutils"):
            stub = Path(tests, name, "__init__.pyi")
            stub.parent.mkdir()
            stub.write_text(UNTYPED)
        running = [
            start(extension, "bl_ext.user_default.swag_splatting", "extension"),
            start(tests, "tests", "tests"),
        ]
        return max(process.wait() for process in running)


if __name__ == "__main__":
    sys.exit(main())
