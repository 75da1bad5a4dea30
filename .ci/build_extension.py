"""Validate the extension and build its zip into dist/, with the command line tool inside Blender's Python package."""

import importlib.util
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def build(out: Path) -> Path:
    """Write the zip to the folder `out`, validate source and zip, and return its path."""
    package = importlib.util.find_spec("bpy")
    assert package and package.origin, "bpy is not installed"
    tool = next(Path(package.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))

    def run(*arguments: str) -> None:
        subprocess.run([sys.executable, str(tool), *arguments], check=True)

    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("swag_splatting-*.zip"):
        old.unlink()
    run("validate", str(ROOT))
    run("build", "--source-dir", str(ROOT), "--output-dir", str(out))
    built = next(out.glob("swag_splatting-*.zip"))
    run("validate", str(built))
    return built


if __name__ == "__main__":
    print(build(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "dist"))
