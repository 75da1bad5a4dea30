"""Runs inside the real Blender, with a window: every stage of a user's work, with a screenshot of each for docs/.

Environment as for real_window.py; SWAG_SCENE is the demo scene. Panels are opened and operators called by their names;
real_window.py tests that buttons react to the pointer.
"""

import os
import sys
import time

import bpy

sys.path.insert(0, os.environ["SWAG_OUT"])
import window as blender_window
from window import OUT, install, open_panels, report, start, view3d, write_report

EXTENSION = "bl_ext.user_default.swag_splatting"
LIMIT = 300  # seconds to wait for anything
report["stages"] = []


def call(operator, **options):
    """Call an operator as a button of the sidebar does."""
    window, area, _ = view3d()
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        return operator("INVOKE_DEFAULT", **options)


def photograph(name):
    window, area, region = view3d()
    for _ in range(2):  # until panels have opened or closed
        area.tag_redraw()
        region.tag_redraw()
        yield 2.0
    blender_window.photograph(f"{name}.png")
    report["stages"].append(name)
    write_report()


def until(condition):
    return blender_window.until(condition, LIMIT)


def job(operator, **options):
    """Run an operator to its end, and report its message."""
    status = bpy.context.window_manager.swag
    call(operator, **options)
    yield from until(lambda: not status.job)
    assert not status.failed, status.message
    report[status.jobs[-1].name] = status.message


def scroll(lines):
    """Scroll the sidebar to `lines` below its top, as steps."""
    window, area, region = view3d()
    region.tag_redraw()
    yield 3.0  # its height is known once it was drawn
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view2d.pan(deltay=10_000)
        bpy.ops.view2d.pan(deltay=-22 * lines)


def steps():
    install(viewport_samples=16)
    open_panels("SWAG_PT_effects", "SWAG_PT_labels")
    yield 2.0
    window, area, region = view3d()
    status, swag = bpy.context.window_manager.swag, bpy.context.scene.swag

    # Preferences in the area of the viewport.
    area.type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "SWAG"
    yield 1.0
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.preferences.addon_expand(module=EXTENSION)
        bpy.ops.swag.check_engine("INVOKE_DEFAULT")
    yield from until(lambda: not status.job)
    report["Engine check"] = status.message
    area.tag_redraw()
    yield 2.0
    blender_window.photograph("1-preferences.png")
    area.type = "VIEW_3D"
    area.spaces.active.show_region_ui = True
    yield 1.0
    view3d()[2].active_panel_category = "SWAG"

    yield from job(bpy.ops.swag.import_scene, directory=os.environ["SWAG_SCENE"])
    yield from photograph("2-scene")

    yield from job(bpy.ops.swag.plan)
    report["plan"] = {line.name: line.state for line in swag.plan.lines}
    yield from photograph("3-effects")

    yield from scroll(25)
    yield from job(bpy.ops.swag.forecast)
    yield from photograph("forecast")
    swag.recipe, swag.iterations, swag.width, swag.max_gaussians = "swag", 2000, 480, 40_000
    call(bpy.ops.swag.train)
    clouds = lambda: [o for o in bpy.data.objects if "swag_run" in o]  # noqa: E731
    yield from until(lambda: (clouds() and len(status.find("Training").curve.split()) > 1) or not status.job)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_camera()
    yield from photograph("4-training")
    call(bpy.ops.swag.pause)
    yield 5.0  # events under way arrive
    report["paused_at"] = status.find("Training").iteration
    yield from photograph("5-paused")
    yield 2.0
    report["iteration_after_pause"] = status.find("Training").iteration
    call(bpy.ops.swag.pause)
    yield from until(lambda: status.find("Training").iteration > report["paused_at"])
    bpy.ops.swag.cancel()  # the button asks first
    yield from until(lambda: not status.job)
    report["cancelled"] = [status.message, swag.can_continue, swag.stopped_at]
    yield from photograph("6-stopped")
    yield from job(bpy.ops.swag.train, resume=True)
    report["finished"] = [swag.result_gaussians, swag.result_psnr, swag.can_continue]
    yield from scroll(100)
    yield from photograph("7-result")

    obj = clouds()[0]
    if hasattr(swag, "water"):
        swag.water = 1.0
        yield from photograph("8-water")
        swag.water = 0.0
    if hasattr(bpy.types, "SWAG_OT_label_run"):
        yield from job(bpy.ops.swag.label_run, source="SALIENCY")
        call(bpy.ops.swag.read_labels)
        call(bpy.ops.swag.isolate_label, number=obj.swag_labels.entries[0].number)
        yield from photograph("9-label")
        call(bpy.ops.swag.show_labels)
    with bpy.context.temp_override(window=window, area=area, selected_objects=[obj], active_object=obj):
        bpy.ops.swag.export_splats(filepath=str(OUT / "reef.glb"))
    report["exported"] = (OUT / "reef.glb").stat().st_size

    # An idle Blender uses no processor time once the viewport has drawn all its samples.
    yield 15.0
    before = time.process_time()
    yield 5.0
    report["idle_cpu"] = (time.process_time() - before) / 5


start(steps())
