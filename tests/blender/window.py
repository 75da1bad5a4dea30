"""Shared by scripts inside the real Blender: its window, screenshots, waiting, a report for the caller.

A script is a generator of steps that yields the seconds to wait before the next; window.sh starts it. Environment:
SWAG_OUT is the folder of this file, of screenshots and of report.json.
"""

import contextlib
import json
import os
import subprocess
import time
import traceback
from pathlib import Path

import bpy

# Set before Blender draws for the first time: the first click would only close a splash screen.
bpy.context.preferences.view.show_splash = False
OUT = Path(os.environ["SWAG_OUT"])
PATIENCE = 180
"""Seconds to wait for anything that takes a second or two on a machine with nothing else to do."""
report = {"version": bpy.app.version_string}
_last_row = 0
"""Pixel of the row where the last button was; 0 at first, when the search starts at the top."""


def view3d():
    """Window, area and sidebar of the 3D viewport."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == "UI")


def photograph(file, window="root"):
    """Save a screenshot, taken by the X server: of the screen, or of one window. A .bmp takes little time to write."""
    subprocess.run(["import", "-window", window, str(OUT / file)], check=True)


def press(*keys):
    """Press keys where the pointer is."""
    subprocess.run(["xdotool", "key", *keys], check=True)


def until(condition, seconds=PATIENCE):
    """Wait for the condition, as steps; raise TimeoutError after `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {seconds} s")
        yield 0.05


def press_until(key, condition):
    """Press a key each second until the condition holds, as steps: a dialog may not yet be there to take the first."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        press(key)
        for _ in range(20):
            yield 0.05
            if condition():
                return
    raise TimeoutError(f"pressed {key} for {PATIENCE} s")


def open_sidebar():
    """Open the sidebar and show the extension's tab, as steps: there is one once the sidebar was drawn."""
    _, area, region = view3d()
    area.spaces.active.show_region_ui = True

    def shows_tab():
        with contextlib.suppress(AttributeError):
            region.active_panel_category = "SWAG"
        return region.active_panel_category == "SWAG"

    yield from until(shows_tab)


def click(command, column):
    """Click the button of an operator in the sidebar, as steps; raise LookupError where there is none.

    The pointer searches it, first where the last button was: Blender tells the command of the button below the
    pointer, so that no test depends on where a panel has its buttons.

    Args:
        command: beginning of the button's Python command, such as "bpy.ops.swag.plan(".
        column: where to look, as a fraction of the sidebar's width.
    """
    global _last_row
    window, area, region = view3d()
    # The pointer meets every row of buttons: they are 20 pixels high at least.
    rows = range(region.y + region.height - 30, region.y + 10, -19)
    seen = set()
    for y in sorted(rows, key=lambda y: abs(y - _last_row), reverse=_last_row == 0):
        # The X server counts pixels from above.
        subprocess.run(
            ["xdotool", "mousemove", str(int(region.x + region.width * column)), str(window.height - y)], check=True
        )
        # Blender reads the pointer once in a loop, after its timers: drawing may make one loop long.
        for _ in range(3):
            yield 0.02
        with bpy.context.temp_override(window=window, area=area, region=region):
            if not bpy.ops.ui.copy_python_command_button.poll():
                continue
            bpy.ops.ui.copy_python_command_button()
        seen.add(bpy.context.window_manager.clipboard)
        if bpy.context.window_manager.clipboard.startswith(command):
            _last_row = y
            yield 0.4
            subprocess.run(["xdotool", "click", "1"], check=True)
            yield 0.2
            return
    raise LookupError(f"{command} is not among {sorted(seen)}")


def install(viewport_samples=1):
    """Install the extension SWAG_ZIP without online access, and remove all objects.

    Args:
        viewport_samples: how often EEVEE draws a viewport after each change. Blender's 16 are slow without a graphics
            card.
    """
    bpy.context.scene.eevee.taa_samples = viewport_samples
    bpy.context.preferences.system.use_online_access = False
    bpy.ops.extensions.package_install_files(
        filepath=os.environ["SWAG_ZIP"], repo="user_default", enable_on_install=True, overwrite=True
    )
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])


def open_panels(*names):
    """Let closed panels of the extension be open when the sidebar is drawn for the first time."""
    for name in names:
        cls = getattr(bpy.types, name)
        base = next(kind for kind in cls.__mro__ if kind.__name__ == "SwagPanel")
        # A child that is registered before its parent would be drawn as a panel of its own.
        family = [cls, *(child for child in base.__subclasses__() if getattr(child, "bl_parent_id", "") == name)]
        for one in reversed(family):
            bpy.utils.unregister_class(one)
        cls.bl_options = cls.bl_options - {"DEFAULT_CLOSED"}
        for one in family:
            bpy.utils.register_class(one)


def write_report():
    (OUT / "report.json").write_text(json.dumps(report))


def start(steps):
    """Run the steps from a timer, write the report and quit Blender."""

    def run():
        try:
            return next(steps)
        except StopIteration:
            report["done"] = True
        except Exception:
            report["traceback"] = traceback.format_exc()
            photograph("failed.png")
        write_report()
        bpy.app.timers.register(lambda: bpy.ops.wm.quit_blender() and None)
        return None

    bpy.app.timers.register(run, first_interval=0.5, persistent=True)
