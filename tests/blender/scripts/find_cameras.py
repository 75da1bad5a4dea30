"""Find Cameras without a window."""

from pathlib import Path
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import engine_process, find_cameras, scene_import, web_page
from panels import context_of_a_sidebar

swag, status = bpy.context.scene.swag, bpy.context.window_manager.swag


def find(**options):
    """The error message of the operator, or "" after it finished. No worker and no job may be left."""
    message = ""
    try:
        assert bpy.ops.swag.find_cameras(**options) == {"FINISHED"}
    except RuntimeError as error:
        message = str(error)
    assert not engine_process._running and not status.job
    return message


def find_and_import(photos, scene_folder=""):
    """What is in the scene after the cameras of photos were found."""
    assert find(filepath=photos, scene_folder=scene_folder) == ""
    root = scene_import.active_root(bpy.context)
    return {
        "folder": swag.scene_folder,
        "found": swag.found.splitlines(),
        "message": status.message,
        "failed": status.failed,
        "cameras": sum(obj.type == "CAMERA" for obj in root.children_recursive),
        "points": len(scene_import.sparse_points(root).data.points),
        "page": open_page(),
    }


def picture_sizes(paths):
    """Width and height of pictures as Blender shows them behind a camera."""
    return [list(bpy.data.images.load(path).size) for path in paths]


def refuse(photos):
    """The error messages of a search without photos and of one that fails; what it leaves in the scene."""
    messages = [find(), find(filepath=photos)]
    return {"messages": messages, "objects": len(bpy.data.objects), "folder": swag.scene_folder}


def cancel(photos):
    """The error message of a search that Ctrl-C stops while photos are matched; what it leaves in the scene."""
    engine: Any = engine_process.Engine
    poll = engine.poll
    pressed: list[bool] = []

    def poll_and_press(engine):
        events = poll(engine)
        if not pressed and any(event.get("stage") == "Matching photos" for event in events):
            pressed.append(True)
            raise KeyboardInterrupt
        return events

    engine.poll = poll_and_press
    try:
        message = find(filepath=photos)
    finally:
        engine.poll = poll
    return {"message": message, "objects": len(bpy.data.objects), "folder": swag.scene_folder, "pressed": pressed}


def requests(choices):
    return [find_cameras.make_request(*choice) for choice in choices]


class RecordingLayout:
    """Stands in for the layout of a panel; its buttons have their text and the properties that are set.

    Labels are left out.
    """

    def __init__(self):
        self.drawn = []

    def operator(self, name, text="", icon=""):
        self.drawn.append({"operator": name, "text": text})
        return type("Button", (), {"__setattr__": lambda _, key, value: self.drawn[-1].update({key: value})})()

    def prop(self, owner, name, text="", **options):
        self.drawn.append({"prop": name, "text": text})

    def label(self, **options):
        pass

    def row(self, **options):
        return self

    column = row


def buttons(no_model):
    """What the panel offers at first, after Import refused photos without a model, and with a scene with points."""
    drawn = []

    def draw():
        layout: Any = RecordingLayout()
        context = context_of_a_sidebar()
        find_cameras.draw_photos(layout, context)
        find_cameras.draw_shown(layout, context)
        drawn.append(layout.drawn)

    draw()
    swag.scene_folder = no_model
    messages = []
    for call in (lambda: bpy.ops.swag.import_scene(directory=no_model), bpy.ops.swag.inspect_scene):
        try:
            call()
        except RuntimeError as error:
            messages.append(str(error))
        draw()
    assert find(filepath=str(Path(no_model).with_name("photos"))) == ""
    draw()
    return {"messages": messages, "drawn": drawn}


def open_photos(photos, with_cameras):
    """The jobs that Photos or Video did for photos without cameras and for folders with some; the scenes chosen."""
    done = []
    for chosen in (photos, *with_cameras):
        assert bpy.ops.swag.open_photos(filepath=chosen) == {"FINISHED"}
        done.append([status.jobs[-1].name, swag.scene_folder])
    return done


def hide_cameras(scene):
    """Places of an imported camera in the world before the cameras are hidden, and after the scene was moved."""
    bpy.ops.swag.import_scene(directory=scene)
    root, own = scene_import.active_root(bpy.context), bpy.data.objects.new("Own", bpy.data.cameras.new("Own"))
    bpy.context.scene.collection.objects.link(own)
    camera = next(obj for obj in root.children_recursive if obj.get(scene_import.SIZE_KEY) is not None)
    layer = scene_import.layer_of_cameras(root, bpy.context.view_layer)
    bpy.context.view_layer.update()
    places = [camera.matrix_world.translation[:]]
    layer.hide_viewport = True
    root.location.x += 5
    bpy.context.view_layer.update()
    places.append(camera.matrix_world.translation[:])
    return {"visible": [camera.visible_get(), own.visible_get(), root.visible_get()], "places": places}


def open_page():
    """Addresses that the button for the page about the cameras opens, and how often the panel shows the button."""
    opened: list[str] = []

    def record(address):
        opened.append(address)
        return True

    browser: Any = web_page.webbrowser
    browser.open = record
    layout: Any = RecordingLayout()
    find_cameras.draw_camera_page(layout, bpy.context)
    if bpy.ops.swag.open_camera_page.poll():
        bpy.ops.swag.open_camera_page()
    return {"opened": opened, "drawn": len(layout.drawn)}
