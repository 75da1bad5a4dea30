"""Runs inside the real Blender, with a window: the splats that the viewport draws, as pictures for the caller.

Environment: that of window.py, SWAG_ZIP the extension; in SWAG_OUT the files splats.ply and water.json.
"""

import json
import os
import subprocess
import sys
import weakref

import bpy
import gpu
import numpy as np
from mathutils import Euler, Matrix, Vector

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import OUT, install, photograph, report, start, view3d

MODULE = "bl_ext.user_default.swag_splatting"


def module(name):
    return sys.modules[f"{MODULE}.swag_blender.{name}"]


def owners():
    """Weak references to the objects that own what is on the graphics card: textures, pictures, shaders."""
    drawing = module("viewport").drawing()
    return [weakref.ref(one) for one in (drawing, drawing.store, drawing._shaders, *drawing._views.values())]


def steps():
    install()
    yield 1.0
    window, area, _ = view3d()
    region = next(region for region in area.regions if region.type == "WINDOW")
    space = area.spaces.active
    view = space.region_3d
    # Nothing but the background and the splats, so that the picture can be compared.
    space.overlay.show_overlays = space.show_gizmo = space.show_region_header = space.show_region_toolbar = False
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0.05, 0.1, 0.2)
    pictures = {}

    def rest():
        """Wait until everything is drawn."""
        area.tag_redraw()
        yield 0.6
        while module("viewport").drawing() and module("viewport").drawing().is_waiting():
            yield 0.1
        yield 0.2

    def picture(name, obj=None):
        """Save the viewport as a picture, with what is needed to compute the same one."""
        yield from rest()
        # Blender's own screenshots are black without a graphics card.
        found = subprocess.run(["xdotool", "search", "--onlyvisible", "--class", "blender"], capture_output=True)
        photograph(f"{name}.bmp", found.stdout.split()[-1])
        to_view = np.array(view.view_matrix) @ np.array(obj.matrix_world if obj else Matrix())
        pictures[name] = {"projection": np.array(view.window_matrix).tolist(), "view": to_view.tolist()}

    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.ed.undo_push(message="Start")
        bpy.ops.swag.import_splats("EXEC_DEFAULT", filepath=str(OUT / "splats.ply"))
    obj = bpy.context.object
    report["backend"] = gpu.platform.backend_type_get()
    report["shading"] = space.shading.type
    report["display"] = obj.display_type
    obj.matrix_world = Matrix.Translation((0.3, -0.2, 0.1)) @ Euler((0.3, 0.2, 0.1)).to_matrix().to_4x4()
    view.view_perspective = "PERSP"
    view.view_location, view.view_distance = (0, 0, 0), 9.0
    view.view_rotation = Euler((1.1, 0.0, 0.4)).to_quaternion()
    yield from picture("solid", obj)
    report["region"] = [region.x, region.y, region.width, region.height]
    store = module("viewport").drawing().store

    # A view that turns: only the order, the object's matrix and the depth of the scene go to the card.
    uploaded, frames = store.uploaded, module("viewport").drawing().frames
    view.view_rotation = Euler((1.1, 0.0, 0.6)).to_quaternion()
    yield from picture("turned", obj)
    report["turned"] = {
        "bytes": store.uploaded - uploaded, "frames": module("viewport").drawing().frames - frames,
        "splats": len(obj.data.points), "pixels": region.width * region.height,
    }  # fmt: skip
    frames = module("viewport").drawing().frames
    for _ in range(5):
        area.tag_redraw()
        yield 0.1
    report["frames_at_rest"] = module("viewport").drawing().frames - frames
    view.view_rotation = Euler((1.1, 0.0, 0.4)).to_quaternion()

    space.shading.type = "WIREFRAME"
    yield from picture("wireframe", obj)
    space.shading.type = "SOLID"
    view.view_perspective = "ORTHO"
    yield from picture("orthographic", obj)
    view.view_perspective = "PERSP"

    # A camera with a shifted lens, as photos have.
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.matrix_world = Matrix.Translation((1, -9, 2)) @ Euler((1.4, 0.0, 0.1)).to_matrix().to_4x4()
    camera.data.shift_x, camera.data.shift_y, camera.data.lens = 0.12, -0.08, 40
    camera.data.show_passepartout = False
    camera.hide_set(True)
    bpy.context.scene.camera = camera
    view.view_perspective = "CAMERA"
    space.overlay.show_overlays = False
    yield from picture("camera", obj)
    view.view_perspective = "PERSP"

    water = module("water")
    water.remember_water(obj, json.loads((OUT / "water.json").read_text()), 0.0)
    bpy.context.scene.swag.water = 1.0
    yield from picture("water", obj)
    for name, amount in (("water_0", 0.0), ("water_.001", 0.001)):
        bpy.context.scene.swag.water = amount
        yield from picture(name, obj)
    water.remember_water(obj, json.loads((OUT / "attenuation.json").read_text()), 0.0)
    obj["swag_background"] = (0.3, 0.5, 0.6)
    for name, amount in (("attenuation_0", 0.0), ("attenuation_.001", 0.001), ("attenuation_1", 1.0)):
        bpy.context.scene.swag.water = amount
        yield from picture(name, obj)
    bpy.context.scene.swag.water = 0.0
    water.remember_water(obj, None, 0.0)
    obj["swag_development"] = json.dumps({"auto": json.loads((OUT / "development.json").read_text())})
    yield from picture("color_developed", obj)
    del obj["swag_development"]
    obj.swag_display.background = False
    yield from picture("color_off", obj)
    obj.swag_display.background = True
    del obj["swag_background"]
    bpy.context.scene.swag.haze = 0.5
    yield from picture("haze", obj)
    bpy.context.scene.swag.haze = 0.0

    labels = module("labels")
    count = len(obj.data.points)
    labels.select(obj, np.arange(count) < 1000)
    yield from picture("selected", obj)
    labels.select(obj, np.zeros(count, bool))
    shown = obj.swag_display
    colors = bpy.context.scene.swag_colors
    colors.exposure, colors.temperature, colors.contrast = 1.0, 0.25, 1.2
    yield from picture("adjusted", obj)
    colors.reset()
    obj["swag_development"] = json.dumps({"auto": json.loads((OUT / "development.json").read_text())})
    yield from picture("developed", obj)
    del obj["swag_development"]
    for name, focal in (("trained_wider", 2000), ("trained_narrower", 100)):
        module("nodes.splat_preview").set_input(obj, "Pixel Size", 1 / focal)
        yield from picture(name, obj)
    module("nodes.splat_preview").set_input(obj, "Pixel Size", 0.0)
    shown.sh_degree = 1
    yield from picture("degree_1", obj)
    shown.sh_degree, shown.density = 3, 30.0
    yield from picture("thinned", obj)
    shown.density = 100.0
    box = bpy.data.objects.new("box", None)
    bpy.context.scene.collection.objects.link(box)
    box.matrix_world = obj.matrix_world @ Matrix.Diagonal((1.5, 2.0, 1.0, 1.0))
    box.hide_set(True)
    shown.crop = box
    yield from picture("cropped", obj)
    shown.crop = None
    # As Alt B does: of the four sides of a box in the world, those of large x are clipped here.
    view.use_clip_planes = True
    view.clip_planes = [(-1, 0, 0, 1), (1, 0, 0, 100), (0, 1, 0, 100), (0, -1, 0, 100), (0, 0, 1, 100), (0, 0, -1, 100)]
    yield from picture("clipped", obj)
    report["world"] = np.array(obj.matrix_world).tolist()
    view.use_clip_planes = False

    # The object as an instance of a collection that is not in the scene itself.
    collection = bpy.data.collections.new("reef")
    collection.objects.link(obj)
    home = obj.users_collection[0]
    home.objects.unlink(obj)
    collection.instance_offset = (1, 0, 0)
    instancer = bpy.data.objects.new("instance", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", collection
    instancer.location, instancer.empty_display_size = (1, 0, 0), 0.001
    bpy.context.scene.collection.objects.link(instancer)
    yield from picture("instance", obj)
    bpy.data.objects.remove(instancer)
    home.objects.link(obj)
    bpy.data.collections.remove(collection)
    yield 0.2

    # Two objects of every other splat are blended as the one.
    labels.select(obj, np.arange(count) % 2 == 0)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.ed.undo_push(message="Selected")
        bpy.context.view_layer.objects.active = obj
        bpy.ops.swag.separate_splats("EXEC_DEFAULT")
    part = next(o for o in bpy.data.objects if module("splats").is_splats(o) and o != obj)
    for one in (obj, part):
        labels.select(one, np.zeros(len(one.data.points), bool))
    yield from picture("separated", obj)
    obj.hide_set(True)
    yield from picture("half", part)
    obj.hide_set(False)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.object.select_all(action="DESELECT")
        part.select_set(True)
        bpy.ops.view3d.localview(frame_selected=False)
    yield from picture("local_view", part)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.localview(frame_selected=False)
    part_name, name = part.name, obj.name
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.ed.undo_push(message="Separated")
        bpy.data.objects[part_name].select_set(True)
        bpy.ops.object.delete()
        bpy.ops.ed.undo_push(message="Deleted")
    yield from picture("deleted", bpy.data.objects[name])
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.ed.undo()
    yield from picture("undone", bpy.data.objects[name])
    obj = bpy.data.objects[name]

    # A mesh between the splats hides those behind it and is hidden by those before it.
    cube = bpy.data.meshes.new("wall")
    forward = Vector(view.view_matrix.inverted().col[2][:3])
    cube.from_pydata([(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)], [], [(0, 1, 2, 3)])
    wall = bpy.data.objects.new("wall", cube)
    bpy.context.scene.collection.objects.link(wall)
    wall.matrix_world = forward.to_track_quat("Z", "Y").to_matrix().to_4x4()
    space.shading.light, space.shading.color_type = "FLAT", "SINGLE"
    space.shading.single_color = (0.05, 0.1, 0.2)
    yield from picture("wall", obj)
    report["wall_depth"] = -(view.view_matrix @ Vector((0, 0, 0))).z
    bpy.data.objects.remove(wall)

    # Rendering in between, a second window, undo of nothing: all goes on.
    bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = 16
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.render.render()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.render.opengl(view_context=True)
        bpy.ops.wm.window_new()
    yield from rest()
    report["windows"] = len(bpy.context.window_manager.windows)
    report["views"] = len(module("viewport").drawing()._views)
    second = next(one for one in bpy.context.window_manager.windows if one != window)
    with bpy.context.temp_override(window=second):
        bpy.ops.wm.window_close()
    yield from picture("after", obj)

    del store
    held = owners()
    bpy.ops.preferences.addon_disable(module=MODULE)
    yield 1.0
    report["after_disabling"] = sum(one() is not None for one in held)
    bpy.ops.preferences.addon_enable(module=MODULE)
    yield from picture("enabled", obj)
    held = owners()
    for one in [o for o in bpy.data.objects if module("splats").is_splats(o)]:
        bpy.data.objects.remove(one)
    yield from rest()
    report["after_removing"] = sum(one() is not None for one in held)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.swag.import_splats("EXEC_DEFAULT", filepath=str(OUT / "splats.ply"))
    yield from rest()
    held = owners()
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "saved.blend"))
    bpy.ops.wm.read_homefile(use_empty=True)
    yield 1.0
    report["after_new_file"] = sum(one() is not None for one in held)
    bpy.ops.wm.open_mainfile(filepath=str(OUT / "saved.blend"), load_ui=False)
    yield 1.5
    drawing = module("viewport").drawing()
    report["after_opening"] = drawing is not None and drawing.frames > 0
    report["failed"] = module("viewport")._failed
    report["pictures"] = pictures


start(steps())
