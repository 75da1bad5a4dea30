"""Films: cameras that move, the request to the engine, and frames rendered by it."""

import itertools
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import film, render_setup, runs, scene_import, splats, water
from bl_ext.user_default.swag_splatting.swag_blender.splat_parts import part_of
from bl_ext.user_default.swag_splatting.swag_engine.formats.camera_path import read_camera_path
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from bl_ext.user_default.swag_splatting.swag_engine.formats.run_folder import RunFolder
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from pictures import linked, new_camera, random_splats

scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y = 64, 48


def active(*objects):
    splats.select_only(bpy.context, list(objects))
    bpy.context.view_layer.update()


def refusal(operator, **arguments):
    """The error report of an operator."""
    try:
        operator(**arguments)
    except RuntimeError as error:
        return str(error).strip().removeprefix("Error: ")
    raise AssertionError(f"{operator} raised no error")


def photo(name, location, rotation, lens=40.0, shift=0.0):
    camera = linked(name, bpy.data.cameras.new(name))
    camera.location, camera.rotation_euler = location, rotation
    camera.data.lens, camera.data.shift_x = lens, shift
    return camera


# -- camera moves ------------------------------------------------------------------------------------------------------


def turntable():
    """The camera keeps its distance and height, sees the middle in its middle, and repeats without a seam."""
    obj = splats.new_splat_object("reef", random_splats(500, 1), scene.collection)
    obj.location = (3, -2, 1)
    active(obj)
    scene.frame_start = 11
    bpy.ops.swag.add_turntable(frames=60, elevation=math.radians(30))
    camera = scene.camera
    assert (scene.frame_start, scene.frame_end, camera.name) == (11, 70, "Turntable")
    centre = np.median(splats.read_splats(obj).positions, axis=0) + (3, -2, 1)
    places = []
    for number in (11, 26, 41, 56, 71):
        scene.frame_set(number)
        places.append(np.array(camera.matrix_world.translation) - centre)
        seen = world_to_camera_view(scene, camera, Vector(centre))
        assert abs(seen.x - 0.5) < 1e-4 and abs(seen.y - 0.5) < 1e-4, seen
    places = np.array(places)
    assert np.allclose(np.linalg.norm(places, axis=1), np.linalg.norm(places[0]), rtol=1e-4)
    assert np.allclose(places[:, 2], np.linalg.norm(places[0]) / 2, rtol=1e-3), "30 degrees above the horizon"
    assert np.allclose(places[2, :2], -places[0, :2], atol=1e-3), "half way it is on the other side"
    assert np.allclose(places[4], places[0], atol=1e-3), "the frame after the last one is the first one"
    assert np.allclose(places[1, :2], (-places[0, 1], places[0, 0]), atol=1e-3), "after a quarter it went a quarter"
    # Nearly all splats are in the image.
    scene.frame_set(11)
    seen = [
        world_to_camera_view(scene, camera, obj.matrix_world @ Vector(p)) for p in splats.read_splats(obj).positions
    ]
    inside = np.mean([0 < p.x < 1 and 0 < p.y < 1 and p.z > 0 for p in seen])
    assert 0.9 < inside < 1, inside


def partial_turntable():
    """A sweep stays on the side of the photos."""
    obj = splats.new_splat_object("reef", random_splats(100, 1), scene.collection)
    for x in (-1, 0, 1):
        photo(f"photo {x}", (x, 5, 0), (0, 0, 0))[scene_import.SIZE_KEY] = (64.0, 48.0, 1.0)
    active(obj)
    bpy.ops.swag.add_turntable(frames=11, angle=math.radians(90), elevation=0)
    angles = []
    for number in (1, 6, 11):
        scene.frame_set(number)
        place = scene.camera.matrix_world.translation - scene.camera.parent.location
        angles.append(math.degrees(math.atan2(place.y, place.x)))
    centre = np.median(splats.read_splats(obj).positions, axis=0)
    middle = math.degrees(math.atan2(5 - centre[1], -centre[0]))
    assert np.allclose(angles, (middle - 45, middle, middle + 45), atol=0.1), (angles, middle)
    far = [obj for obj in scene.objects if obj.type == "CAMERA"]
    active(*far)
    assert "Turntable" in scene.camera.name
    bpy.ops.swag.add_turntable(frames=2)  # of cameras alone it goes around the splats


def turntable_of_selected_splats():
    obj = splats.new_splat_object("reef", random_splats(1000, 1), scene.collection)
    positions = splats.read_splats(obj).positions
    chosen = positions[:, 0] > 0.5
    attribute = obj.data.attributes.new("swag:selected", "BOOLEAN", "POINT")
    attribute.data.foreach_set("value", chosen)
    active(obj)
    bpy.ops.swag.add_turntable(frames=4)
    middle = np.array(scene.camera.parent.location)
    assert np.allclose(middle, np.median(positions[chosen], axis=0), atol=1e-5)


def camera_path():
    """At each photo the camera is that of the photo, between them it is between, in the order of their names."""
    root = linked("root")
    root[scene_import.ROOT_KEY] = "/photos"
    root.matrix_world = Matrix.Rotation(0.5, 4, "X") @ Matrix.Translation((1, 2, 3))
    stops = [
        photo("view 10", (9, 1, 0), (1.2, 0, 3.5), 50.0, 0.02),
        photo("view 2", (4, 0, 0), (1.4, 0.1, 0.5), 35.0),
        photo("view 1", (0, 0, 0), (1.5, 0, 0), 35.0),
    ]
    for camera in stops:
        camera.parent = root
        camera[scene_import.SIZE_KEY] = (320.0, 200.0, 1.0)
    active(*stops)
    bpy.ops.swag.camera_path(frames=101)
    camera = scene.camera
    assert camera.parent == root and scene_import.SIZE_KEY not in camera, "it is no photo"
    assert (scene.frame_end, scene.render.resolution_x, scene.render.resolution_y) == (101, 320, 200)
    way = 4 + math.sqrt(26)
    for number, stop in ((1.0, stops[2]), (1 + 100 * 4 / way, stops[1]), (101.0, stops[0])):
        scene.frame_set(int(number), subframe=number % 1)
        difference = np.array(camera.matrix_world) - np.array(stop.matrix_world)
        assert np.abs(difference).max() < 1e-4, (number, difference)
        assert abs(camera.data.lens - stop.data.lens) < 1e-3 and abs(camera.data.shift_x - stop.data.shift_x) < 1e-5
    places, looks = [], []
    for number in range(1, 102):
        scene.frame_set(number)
        places.append(camera.matrix_world.translation.copy())
        looks.append(camera.matrix_world.to_quaternion())
    steps = np.linalg.norm(np.diff(np.array(places), axis=0), axis=1)
    turns = [a.rotation_difference(b).angle for a, b in itertools.pairwise(looks)]
    turns = [min(turn, math.tau - turn) for turn in turns]
    assert steps.max() < 3 * way / 100 and np.abs(np.diff(steps)).max() < 0.02, "no jump and no sudden stop"
    # By 0.5 and by 3 radians.
    assert max(turns) < 0.12 and sum(turns) < 4.5, (max(turns), sum(turns))


def path_without_photos():
    """Cameras at one place still have different times; one camera is no path."""
    stops = [photo(name, (0, 0, 0), (1, 0, turn)) for name, turn in (("a", 0), ("b", 0.4), ("c", 0.8))]
    active(*stops)
    bpy.ops.swag.camera_path(frames=21)
    scene.frame_set(11)
    assert abs(scene.camera.rotation_quaternion.to_euler().z - 0.4) < 1e-3
    active(stops[0])
    assert not bpy.ops.swag.camera_path.poll()


# -- what is sent to the engine ----------------------------------------------------------------------------------------


def request():
    """The request of a film, with its camera path and splats."""
    with tempfile.TemporaryDirectory() as folder:
        sent = film.film_request(bpy.context, Path(folder))
        water_file = Path(sent["water"]) if "water" in sent else None
        return (
            sent,
            read_camera_path(Path(sent["cameras"])),
            read_ply(Path(sent["splats"])),
            json.loads(water_file.read_text()) if water_file else None,
        )


def request_of_scene(out):
    """Splats below a turned and scaled root, a camera with a shifted lens, water that is animated."""
    root = linked("root")
    root.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.7, 4, "Y") @ Matrix.Scale(2.5, 4)
    made = random_splats(50, 4)
    obj = splats.new_splat_object("reef", made, scene.collection, root)
    hidden = obj.data.attributes.new("swag:hidden", "BOOLEAN", "POINT")
    hidden.data.foreach_set("value", np.arange(50) < 20)
    medium: dict[str, Any] = {
        "beta_D": [0.5, 0.2, 0.1],
        "beta_B": [0.3, 0.2, 0.1],
        "background_sh": [[-100] * 3] + [[0.0] * 3] * 8,
        "light": "srgb",
    }
    water.remember_water(obj, medium | {"per": "unit"}, 0.0)
    obj["swag_background"] = [0.1, 0.2, 0.3]
    camera = new_camera()
    camera.data.lens, camera.data.shift_x, camera.data.shift_y = 30, 0.1, -0.05
    camera.data.clip_start, camera.data.clip_end = 100, 200
    camera.location.z = 5
    for number, x in ((1, 0.0), (3, 2.0)):
        camera.location.x = x
        camera.keyframe_insert("location", frame=number)
        scene.swag.water = (number - 1) / 2
        scene.swag.haze = 1 - scene.swag.water
        scene.swag.keyframe_insert("water", frame=number)
        scene.swag.keyframe_insert("haze", frame=number)
    scene.frame_start, scene.frame_end = 1, 3
    scene.frame_set(2)
    scene.swag_film.output, scene.render.film_transparent, scene.swag_film.depth = out, True, True
    active(obj)
    shown = [modifier.show_viewport for modifier in obj.modifiers]
    sent, frames, sent_splats, sent_water = request()
    assert scene.frame_current == 2 and [modifier.show_viewport for modifier in obj.modifiers] == shown
    assert sent["out"] == out and sent["alpha"] and sent["depth"] and sent["overwrite"] and "run" not in sent
    assert abs(sent["unit"] - 2.5) < 1e-5 and np.allclose(sent["background"], (0.1, 0.2, 0.3))
    assert np.array_equal(sent_splats.positions, made.positions[20:]), "hidden splats are not filmed"
    assert np.allclose(sent_water["beta_D"], medium["beta_D"]) and sent_water["light"] == "srgb"
    assert [frame.camera.name for frame in frames] == ["0001", "0002", "0003"]
    assert np.allclose([frame.water for frame in frames], [0, 0.5, 1], atol=0.01)
    assert np.allclose([frame.haze for frame in frames], [1, 0.5, 0], atol=0.01)
    # The pixels are those of Blender's own projection.
    for number, frame in enumerate(frames, 1):
        scene.frame_set(number)
        for point in made.positions[:20]:
            seen = world_to_camera_view(scene, camera, obj.matrix_world @ Vector(point))
            x, y, z = frame.camera.world_to_camera[:3, :3] @ point + frame.camera.world_to_camera[:3, 3]
            own = (frame.camera.fx * x / z + frame.camera.cx, frame.camera.fy * y / z + frame.camera.cy)
            assert np.allclose(own, (seen.x * 64, (1 - seen.y) * 48), atol=1e-2), (own, seen)
            assert abs(z * 2.5 - seen.z) < 1e-3
    scene.swag_film.kind = "VIDEO"
    assert request()[0]["out"] == os.path.join(out, "film.mp4")


def several_objects(out):
    """All splats are in the frame of the object with water, as they stand in the scene."""
    first = splats.new_splat_object("first", random_splats(10, 4), scene.collection)
    second = splats.new_splat_object("second", random_splats(20, 1, seed=1), scene.collection)
    first.location, second.location, second.rotation_euler.z = (1, 0, 0), (0, 5, 0), 0.5
    linked_to_nothing = splats.new_splat_object("off", random_splats(5, 1), scene.collection)
    linked_to_nothing.hide_render = True
    eye = splats.new_splat_object("closed eye", random_splats(5, 1), scene.collection)
    eye.hide_set(True)
    new_camera()
    scene.frame_end = 1
    scene.swag_film.output = out
    medium = {
        "beta_D": [0.5] * 3,
        "beta_B": [0.3] * 3,
        "background_sh": [[0.1] * 3] * 9,
        "light": "srgb",
        "per": "unit",
    }
    water.remember_water(second, medium, 0.0)
    active(first)
    _, frames, sent, _ = request()
    assert len(sent) == 30 and sent.degree == 1
    assert np.array_equal(sent.positions[:20], splats.read_splats(second).positions)
    world = np.array(second.matrix_world) @ np.c_[sent.positions[20:], np.ones(10)].T
    assert np.allclose(world[:3].T, splats.read_splats(first).positions + (1, 0, 0), atol=1e-5)


def cropped_splats():
    """Splats outside of the crop box of their object are not filmed."""
    obj = splats.new_splat_object("reef", random_splats(200, 1), scene.collection)
    obj.location.x = 3
    box = linked("box")
    box.location, box.scale.y, box.empty_display_size = (3.2, 0, 0), 2.0, 0.5
    obj.swag_display.crop = box
    active(obj)
    positions = splats.read_splats(obj).positions
    inside = (np.abs(positions - (0.2, 0, 0)) <= (0.5, 1.0, 0.5)).all(axis=1)
    assert 5 < inside.sum() < 100 and np.array_equal(
        part_of(obj, np.array(obj.matrix_world), "VISIBLE").positions, positions[inside]
    )


def refusals(out):
    """What cannot be filmed is refused in one sentence."""
    assert not bpy.ops.swag.render_film.poll()
    obj = splats.new_splat_object("reef", random_splats(10, 1), scene.collection)
    assert not bpy.ops.swag.render_film.poll(), "there is no camera"
    camera = new_camera()
    scene.frame_end = 2
    active(obj)
    found = {"no folder": refusal(bpy.ops.swag.render_film)}
    scene.swag_film.output = f"{out}/typo"
    found["typo"] = refusal(bpy.ops.swag.render_film)
    scene.swag_film.output = out
    camera.data.type = "ORTHO"
    found["lens"] = refusal(bpy.ops.swag.render_film)
    camera.data.type = "PERSP"
    obj.scale = (1, 2, 1)
    found["scale"] = refusal(bpy.ops.swag.render_film)
    obj.scale = (1, 1, 1)
    hidden = obj.data.attributes.new("swag:hidden", "BOOLEAN", "POINT")
    hidden.data.foreach_set("value", np.ones(10, bool))
    found["hidden"] = refusal(bpy.ops.swag.render_film)
    obj.data.attributes.remove(obj.data.attributes["swag:hidden"])
    other = splats.new_splat_object("other", random_splats(10, 1), scene.collection)
    for number in (1, 2):
        other.location.x = number
        other.keyframe_insert("location", frame=number)
    found["moves"] = refusal(bpy.ops.swag.render_film)
    assert not bpy.context.window_manager.swag.job and Path(out).exists() is False
    return found


def set_up_render():
    """Few samples by default, for both engines."""
    splats.new_splat_object("reef", random_splats(10, 1), scene.collection)
    bpy.ops.swag.prepare_render()
    assert (scene.render.engine, scene.cycles.samples, scene.eevee.taa_render_samples) == ("CYCLES", 32, 32)
    bpy.ops.swag.prepare_render(engine="EEVEE", samples=16)
    assert scene.render.engine != "CYCLES" and (scene.cycles.samples, scene.eevee.taa_render_samples) == (16, 16)
    warning = render_setup.eevee_warning(scene, 16)
    assert not warning or "16 samples" in warning, "what draws is not known before this process has drawn"


# -- frames of the engine ----------------------------------------------------------------------------------------------


def film_of_run(folder, images, out):
    """Import a scene and its run, and film two frames through imported cameras; returns their names."""
    bpy.ops.swag.import_scene(directory=images)
    run = RunFolder(Path(folder))
    obj = runs.show_splats(scene, read_ply(run.ply), folder, str(run.read_config()[0]))
    runs.remember_training(obj, run, json.loads(run.metrics.read_text()))
    root = scene_import.find_root(obj)
    root.matrix_world = (
        Matrix.Translation((5, 0, 1)) @ Matrix.Rotation(1, 4, "Z") @ Matrix.Scale(3, 4) @ root.matrix_world
    )
    bpy.context.view_layer.update()
    names = [camera.name for camera in root.children_recursive if scene_import.SIZE_KEY in camera][:2]
    scene.frame_start, scene.frame_end = 1, len(names)
    for number, name in enumerate(names, 1):
        scene.timeline_markers.new(name, frame=number).camera = bpy.data.objects[name]
    scene_import.look_through(scene, bpy.data.objects[names[0]])
    scene.swag.water = 1.0
    scene.swag_film.output, scene.swag_film.depth = out, True
    tempfile.tempdir = bpy.app.tempdir
    scene.frame_set(2)
    assert bpy.ops.swag.render_film() == {"FINISHED"}
    tempfile.tempdir = None
    assert not [name for name in os.listdir(bpy.app.tempdir) if name.startswith("swag-film-")]
    assert scene.frame_current == 2 and scene.camera.name == names[1]
    message = bpy.context.window_manager.swag.message
    depth = bpy.data.images.load(os.path.join(out, "depth", "0001.exr"))
    pixels = np.empty(depth.size[0] * depth.size[1] * 4, "f4")
    depth.pixels.foreach_get(pixels)
    wall = pixels.reshape(-1, 4)[:, 0]
    depth = float(np.median(wall[wall < 1e9]))
    return {"names": names, "message": message, "depth": depth / root.matrix_world.median_scale}
