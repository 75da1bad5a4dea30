"""Measure frames of Blender's viewport with 50 000, 200 000 and a million splats, without a graphics card.

Run: `python benchmarks/viewport.py ROOT` (ROOT: the folder of a real Blender, see tests/blender/test_real_window.py)
Results: benchmarks/results/viewport.json

Times are processor time of Blender in milliseconds, medians of five: on software GL the processor draws. Compare them
with each other; an absolute time says little about another machine. A frame without splats draws the same viewport with
the splats hidden. While the view moves, only the splats of the largest contribution are drawn.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

COUNTS = (50_000, 200_000, 1_000_000)
"""Numbers of splats."""
REPEATS = 5
"""Frames of each kind."""


def steps():
    """Yield the waits (seconds) between the steps inside Blender."""
    import bpy
    import numpy as np
    from mathutils import Quaternion
    from window import install, report, view3d

    install(viewport_samples=16)
    yield 1.0
    from bl_ext.user_default.swag_splatting.swag_blender import splats, viewport
    from bl_ext.user_default.swag_splatting.swag_blender.viewport.depth_order import back_to_front
    from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

    window, area, _ = view3d()
    view = area.spaces.active.region_3d
    view.view_location, view.view_distance = (0, 0, 0), 9.0

    def frame() -> float:
        """Draw a frame; returns its processor time in milliseconds."""
        started = time.process_time()
        area.tag_redraw()
        with bpy.context.temp_override(window=window, area=area):
            bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        return 1000 * (time.process_time() - started)

    def median(change) -> float:
        times = []
        for _ in range(REPEATS):
            change()
            times.append(frame())
        return round(statistics.median(times), 1)

    def rest():
        area.tag_redraw()
        yield 0.6
        while viewport.drawing() is None or viewport.drawing().is_waiting():
            yield 0.1

    def turn():
        view.view_rotation = Quaternion((0, 0, 1), 0.02) @ view.view_rotation

    def anew():
        for known in viewport.drawing()._views.values():
            known.picture_key = None

    report["counts"] = []
    for count in COUNTS:
        random = np.random.default_rng(0)
        rotations = random.normal(size=(count, 4)).astype(np.float32)
        made = Splats(
            positions=random.uniform(-3, 3, (count, 3)).astype(np.float32),
            rotations=rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
            # The same area is covered whatever the number.
            scales=(random.uniform(0.01, 0.04, (count, 3)) * (50_000 / count) ** 0.5).astype(np.float32),
            opacities=random.uniform(0.3, 1, count).astype(np.float32),
            sh=random.uniform(-1, 1, (count, 16, 3)).astype(np.float32) * 0.3,
        )
        obj = splats.new_splat_object("splats", made, bpy.context.scene.collection)
        yield from rest()
        drawing = viewport.drawing()
        found = {"splats": count, "megabytes_uploaded": round(drawing.store.uploaded / 1e6, 1)}
        part = drawing.store.part(obj)
        row = np.array([0.1, 0.2, 0.97, 9.0])
        for name, exact in (("sort", False), ("sort_exact", True)):
            times = []
            for _ in range(REPEATS):
                started = time.thread_time()
                back_to_front([part], [row], near=0.01, exact=exact)
                times.append(1000 * (time.thread_time() - started))
            found[name] = round(statistics.median(times), 1)
        found["resting"] = median(lambda: None)
        found["all_drawn_anew"] = median(anew)
        uploaded, frames = drawing.store.uploaded, drawing.frames
        found["moving"] = median(turn)
        moved = max(1, drawing.frames - frames)
        found["megabytes_a_moving_frame"] = round((drawing.store.uploaded - uploaded) / moved / 1e6, 2)
        obj.hide_set(True)
        frame()
        found["without_splats"] = median(lambda: None)
        report["counts"].append(found)
        bpy.data.objects.remove(obj)
        yield 0.5
    import gpu

    report["renderer"] = gpu.platform.renderer_get()
    region = next(region for region in area.regions if region.type == "WINDOW")
    report["pixels"] = region.width * region.height


def main(root: Path) -> None:
    """Run the steps in the Blender of `root` and write the results."""
    project = Path(__file__).resolve().parents[1]
    sys.path.insert(0, str(project))
    from benchmarks.common import machine, write_results

    folder = root / "gui" / "benchmark"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    subprocess.run([sys.executable, str(project / ".ci" / "build_extension.py"), str(folder)], check=True)
    next(folder.glob("*.zip")).rename(folder / "extension.zip")
    shutil.copy(project / "tests" / "blender" / "window.py", folder)
    shutil.copy(__file__, folder / "script.py")
    start = project / "tests" / "blender" / "window.sh"
    environment = {
        "SWAG_ZIP": "/gui/benchmark/extension.zip",
        "SWAG_OUT": "/gui/benchmark",
        "BLENDER_USER_RESOURCES": "/gui/benchmark/user",
    }
    subprocess.run(
        ["bash", str(start), str(root), folder.name, "1280", "800"], env=os.environ | environment, check=True
    )
    report = json.loads((folder / "report.json").read_text())
    if "traceback" in report:
        raise SystemExit(report["traceback"])
    write_results("viewport", {"machine": machine()} | {k: v for k, v in report.items() if k != "done"})


if __name__ == "__main__":
    if "SWAG_OUT" in os.environ:
        sys.path.insert(0, os.environ["SWAG_OUT"])
        from window import start

        start(steps())
    else:
        main(Path(sys.argv[1]))
