"""The real Blender, whose window the tests of test_real_window.py and test_real_viewport.py photograph and click."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2

TOOLS = Path(__file__).resolve().parents[2].parent / "shared" / "real-blender"
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
REAL = CACHE / "swag_splatting" / "real-blender"


def new_folder(real_blender, extension_zip, name="test"):
    """An empty folder with the extension inside the real Blender's root, where its path is /gui/NAME."""
    folder = real_blender / "gui" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copy(extension_zip, folder / "extension.zip")
    shutil.copy(Path(__file__).with_name("window.py"), folder)
    return folder


def in_window(script, real_blender, folder, *arguments, size=(1280, 800), **environment):
    """Run a script in the real Blender and return its report; its pictures are in the folder.

    Args:
        script: name of the script, which lies beside this file.
        real_blender: folder of the real Blender.
        folder: made by `new_folder`.
        arguments: for Blender.
        size: width and height of its window, in pixels.
        environment: variables besides those of window.py.
    """
    inside = f"/gui/{folder.name}"
    environment |= {
        "SWAG_ZIP": f"{inside}/extension.zip", "SWAG_OUT": inside, "SWAG_CACHE_DIR": f"{inside}/cache",
        "BLENDER_USER_RESOURCES": f"{inside}/user",
    }  # fmt: skip
    shutil.copy(Path(__file__).with_name(script), folder / "script.py")
    starter = str(Path(__file__).with_name("window.sh"))
    done = subprocess.run(
        ["bash", starter, str(real_blender), folder.name, *map(str, size), *arguments],
        env=os.environ | environment, capture_output=True, text=True,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    assert (folder / "report.json").exists(), printed
    report = json.loads((folder / "report.json").read_text())
    assert "traceback" not in report and "Traceback" not in printed, report.get("traceback", printed)
    return report


def viewport_picture(folder, name, region):
    """A picture (H, W, 3) in 0..1 that a script took, cut to the region of the viewport (x, y, width, height)."""
    x, y, width, height = region
    whole = cv2.imread(str(folder / f"{name}.bmp"))[..., ::-1] / 255
    return whole[len(whole) - y - height : len(whole) - y, x : x + width]
