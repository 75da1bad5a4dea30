"""Check the import contracts of .importlinter.

Blender loads the project as one package whose parts import one another relatively; import-linter needs that package
under one name, so the code is copied to a temporary folder as `swag_splatting`.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("swag_engine", "swag_blender", "operators")


def copied(folder: Path) -> None:
    """Copy the Python files of the extension to folder/swag_splatting."""
    package = folder / "swag_splatting"
    package.mkdir()
    shutil.copy(ROOT / "__init__.py", package)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, package / name, ignore=shutil.ignore_patterns("lib", "__pycache__"))


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        copied(Path(folder))
        command = [
            str(Path(sys.executable).with_name("lint-imports")),
            "--config",
            str(ROOT / ".importlinter"),
            "--no-cache",
        ]
        return subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": folder}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
