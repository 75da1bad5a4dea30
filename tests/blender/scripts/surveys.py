"""Surveys: opened, their tiles exchanged, planned, watched and merged."""

import json
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import (
    colors,
    film,
    labels,
    scene_import,
    splats,
    survey,
    survey_map,
    survey_watch,
    water,
)
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_colors, splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from bl_ext.user_default.swag_splatting.swag_engine.formats.survey_folder import SurveyFolder
from files import export_splats, refusal
from mathutils import Matrix, Vector
from panels import context_of_a_sidebar, draw_all

swag, status = bpy.context.scene.swag, bpy.context.window_manager.swag


def opened(folder, budget=500_000):
    """The splats of a survey."""
    bpy.context.scene.swag_survey.budget = budget
    assert bpy.ops.swag.open_survey(directory=folder) == {"FINISHED"}
    bpy.context.view_layer.update()
    return bpy.context.active_object


def tiles_of(obj):
    """Files of the tiles that an object holds, without folder and ending, and how many splats it has."""
    tiles = json.loads(Path(obj["swag_survey"], "merged", "tiles.json").read_text())["tiles"]
    numbers = np.unique(labels.attribute(obj, survey.TILE)).tolist()
    return [sorted(tiles[number]["file"][6:-4] for number in numbers), splats.count(obj)]


def state_of(obj):
    view = colors.color_view(bpy.context.scene, obj)
    up = Vector(json.loads(Path(obj["swag_survey"], "survey.json").read_text())["ground"]["axes"][2])
    return {
        "tiles": tiles_of(obj),
        "water": water.water_of(obj) is not None,
        "background": [round(value, 3) for value in obj["swag_background"]],
        "exposure": view.restored.exposure,
        "labels": [[entry.name, entry.count] for entry in labels.labels_of(obj).entries],
        "up": [round(value, 4) + 0.0 for value in obj.matrix_world.to_3x3() @ up],
        "folders": [Path(swag.scene_folder).name, Path(bpy.context.scene.swag_survey.folder).name],
        "degree": splats.read_splats(obj).degree,
        "run": obj.get("swag_run", ""),
        "described": survey.describe(obj),
    }


def open_levels(folder):
    """The state of a survey that was opened with a large and a small number of splats, and the number of objects."""
    found = {
        "whole": state_of(opened(folder)),
        "small": state_of(opened(folder, 1000)),
        "objects": len(bpy.data.objects),
    }
    return found


def view_from(position, target):
    """Matrix and size of a perspective view of 640 x 480 pixels."""
    camera = bpy.data.objects.new("view", bpy.data.cameras.new("view"))
    bpy.context.scene.collection.objects.link(camera)
    camera.matrix_world = (
        Matrix.Translation(position) @ (target - position).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    )
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    matrix = camera.calc_matrix_camera(depsgraph, x=640, y=480) @ camera.matrix_world.inverted()
    bpy.data.objects.remove(camera)
    return {"matrix": np.array(matrix).ravel().tolist(), "size": (640, 480)}


def load_view_box_overview(folder):
    """The tiles after each way to choose them; and the message of each."""
    obj = opened(folder, 1000)
    found = {"opened": tiles_of(obj)}
    to_world = obj.matrix_world
    corner = to_world @ Vector((1.0, -0.1, 1.0))
    near = view_from(corner + to_world.to_3x3() @ Vector((0, -1.0, 0)), corner)
    assert bpy.ops.swag.load_view(**near) == {"FINISHED"}
    found["near"] = tiles_of(obj)
    far = view_from(corner + to_world.to_3x3() @ Vector((0, -5000.0, 0)), corner)
    assert bpy.ops.swag.load_view(**far) == {"FINISHED"}
    found["far"] = tiles_of(obj)
    away = view_from(
        corner + to_world.to_3x3() @ Vector((0, -1.0, 0)), corner + to_world.to_3x3() @ Vector((0, -5.0, 0))
    )
    assert bpy.ops.swag.load_view(**away) == {"FINISHED"}
    found["away"] = tiles_of(obj)
    box = bpy.data.objects.new("box", None)
    bpy.context.scene.collection.objects.link(box)
    box.empty_display_type, box.empty_display_size = "CUBE", 0.5
    box.matrix_world = to_world @ Matrix.Translation((7.0, -0.1, 7.0))
    found["no box"] = refusal(bpy.ops.swag.load_box)
    bpy.context.scene.swag_survey.box = box
    assert bpy.ops.swag.load_box() == {"FINISHED"}
    found["box"] = tiles_of(obj)
    box.matrix_world = to_world @ Matrix.Translation((70.0, -0.1, 7.0))
    found["box elsewhere"] = refusal(bpy.ops.swag.load_box)
    assert bpy.ops.swag.load_overview() == {"FINISHED"}
    found["overview"] = tiles_of(obj)
    return found


def budgets(folder):
    """The tiles of the box of everything with several numbers of splats."""
    obj = opened(folder, 1000)
    box = bpy.data.objects.new("box", None)
    bpy.context.scene.collection.objects.link(box)
    box.empty_display_type, box.empty_display_size = "CUBE", 100.0
    bpy.context.scene.swag_survey.box = box
    bpy.context.view_layer.update()
    found: dict[object, list] = {}
    for budget in (1000, 1024, 100_000):
        bpy.context.scene.swag_survey.budget = budget
        found[budget] = [survey.load_box(bpy.context, obj), *tiles_of(obj)]
    bpy.context.scene.swag_survey["budget"] = 10  # below what the panel offers
    found["too few"] = [refusal(bpy.ops.swag.load_box), refusal(bpy.ops.swag.load_overview), tiles_of(obj)[1]]
    return found


def edits(folder, out):
    """What stays of edits when other tiles are loaded: splats deleted, hidden, named by a mask, and undo."""
    obj = opened(folder, 1000)
    box = bpy.data.objects.new("box", None)
    bpy.context.scene.collection.objects.link(box)
    box.empty_display_type, box.empty_display_size = "CUBE", 0.5
    box.matrix_world = obj.matrix_world @ Matrix.Translation((7.0, -0.1, 7.0))
    bpy.context.scene.swag_survey.box = box
    assert bpy.ops.swag.load_box() == {"FINISHED"}
    found = {"loaded": tiles_of(obj)}
    # In the coarse tile 1/0-0, which stays: some are masked, some saved as a mask, one is deleted.
    kept = labels.attribute(obj, survey.TILE) == number_of(folder, "1/0-0-0")
    hidden, named = np.zeros(len(kept), bool), np.zeros(len(kept), bool)
    hidden[np.flatnonzero(kept)[:5]] = True
    named[np.flatnonzero(kept)[5:12]] = True
    labels.set_attribute(obj, labels.MASKED, "BOOLEAN", hidden)
    labels.set_attribute(obj, "mask:mine", "BOOLEAN", named)
    gone = np.zeros(len(kept), bool)
    gone[np.flatnonzero(kept)[20]] = True
    splats.keep_splats(obj, ~gone)
    labels.show(obj)
    bpy.ops.ed.undo_push(message="Edit")
    box.matrix_world = obj.matrix_world @ Matrix.Translation((7.0, -0.1, 1.0))
    bpy.ops.ed.undo_push(message="Move")
    assert bpy.ops.swag.load_box() == {"FINISHED"}
    bpy.ops.ed.undo_push(message="Load Box")
    found["other box"] = tiles_of(obj)
    found["kept"] = {
        "hidden": int(labels.mask_of(obj, "swag:hidden").sum()),
        "named": int(labels.mask_of(obj, "mask:mine").sum()),
        "of its tile": int((labels.attribute(obj, survey.TILE) == number_of(folder, "1/0-0-0")).sum()),
        "entries": [[entry.name, entry.count] for entry in labels.labels_of(obj).entries],
    }
    name = obj.name
    bpy.ops.ed.undo()
    found["undone"] = tiles_of(bpy.data.objects[name])
    found["undone description"] = survey.describe(bpy.data.objects[name])
    bpy.ops.ed.redo()
    obj = bpy.data.objects[name]
    found["redone"] = tiles_of(obj)
    assert bpy.ops.swag.select_label(number=2) == {"FINISHED"}
    found["selected"] = int(labels.mask_of(obj, labels.SELECTED).sum())
    export_splats(out, part="SELECTED", frame="UPRIGHT")
    written = read_ply(Path(out))
    found["exported"] = [len(written), sorted(written.extras), np.unique(written.extras["label"]).tolist()]
    found["water file"] = SurveyFolder(Path(folder)).coarse.water.is_file()
    assert bpy.ops.swag.separate_splats() == {"FINISHED"}
    found["parts"] = [
        [one.name, survey.holds_tiles(one), splats.count(one), water.water_of(one) is not None]
        for one in sorted(bpy.data.objects, key=lambda one: one.name) if splats.is_splats(one)
    ]  # fmt: skip
    splats.select_only(bpy.context, [obj])
    found["label run"] = refusal(bpy.ops.swag.label_run)
    found["orthomosaic"] = refusal(bpy.ops.swag.make_orthomosaic)
    return found


def number_of(folder, file):
    tiles = json.loads(Path(folder, "merged", "tiles.json").read_text())["tiles"]
    return next(number for number, tile in enumerate(tiles) if file in tile["file"])


def refusals(folder, run):
    """Messages for what cannot be opened or loaded; and the object's tiles after them."""
    found = {"run": refusal(bpy.ops.swag.open_survey, directory=run)}
    tiles = Path(folder, "merged", "tiles.json")
    kept = tiles.read_text()
    tiles.unlink()
    found["not merged"] = refusal(bpy.ops.swag.open_survey, directory=folder)
    tiles.write_text(kept)
    obj = opened(folder, 1000)
    first = Path(folder, "merged", json.loads(kept)["tiles"][0]["file"])
    whole = first.read_bytes()
    bpy.context.scene.swag_survey.budget = 100_000
    first.unlink()
    found["missing"] = refusal(bpy.ops.swag.load_overview)
    first.write_bytes(whole[: len(whole) // 2])
    found["half"] = refusal(bpy.ops.swag.load_overview)
    first.write_bytes(whole)
    found["after"] = tiles_of(obj)
    document = json.loads(kept)
    document["tiles"][0]["splats"] = 63
    tiles.write_text(json.dumps(document))
    found["other"] = refusal(bpy.ops.swag.load_overview)
    tiles.write_text(json.dumps(document | {"tiles": [], "levels": []}))
    found["empty"] = refusal(bpy.ops.swag.load_overview)
    # After another merge the tiles have other numbers: none of the old splats is taken for one of another tile.
    document = json.loads(kept)
    document["tiles"].reverse()
    tiles.write_text(json.dumps(document))
    assert bpy.ops.swag.load_overview() == {"FINISHED"}
    found["merged again"] = tiles_of(obj)
    Path(folder, "survey.json").write_text("{")
    found["damaged"] = refusal(bpy.ops.swag.open_survey, directory=folder)
    return found


def adopt(folder, scene):
    """Parents and places of splats and map after the survey's scene is imported."""
    obj = opened(folder)
    assert bpy.ops.swag.show_blocks() == {"FINISHED"}
    made = survey_map.map_of(bpy.context.scene, SurveyFolder(Path(folder)))
    bpy.context.view_layer.update()
    same = np.allclose(np.array(obj.matrix_world), np.array(made.matrix_world))
    corners = np.array([list(vertex.co) for vertex in made.data.vertices])
    above = splats.positions(obj)[:, [0, 2]]
    same &= bool((above > corners.min(0)[[0, 2]]).all() and (above < corners.max(0)[[0, 2]]).all())
    root = bpy.data.objects.new("reef", None)
    root[scene_import.ROOT_KEY] = scene
    root.location = (1.0, 2.0, 3.0)
    bpy.context.scene.collection.objects.link(root)
    survey.adopt_surveys(root, bpy.context.scene)
    bpy.context.view_layer.update()
    return [same, *([one.parent == root, list(one.matrix_world.translation)] for one in (obj, made))]


def faces_of(made):
    """Each block's state, PSNR, material, text, and its middle and width in Blender's world."""
    bpy.context.view_layer.update()
    found = {}
    for number, name in enumerate(json.loads(made[survey_map.MAP_KEY])):
        face = made.data.polygons[number]
        corners = np.array([list(made.matrix_world @ made.data.vertices[v].co) for v in face.vertices])
        text = next(child for child in made.children_recursive if child.get(survey_map.MAP_KEY) == name)
        found[name] = {
            "state": made.data.attributes["state"].data[number].value,
            "psnr": round(made.data.attributes["psnr"].data[number].value, 2),
            "material": made.data.materials[face.material_index].name,
            "text": text.data.body,
            "middle": [round(value, 3) + 0.0 for value in corners.mean(0)],
            "size": [round(value, 3) + 0.0 for value in np.ptp(corners, axis=0)],
            "text is there": bool(np.abs(np.array(text.matrix_world.translation) - corners.mean(0)).max() < 0.1),
            "up": [round(value, 3) + 0.0 for value in (made.matrix_world.to_3x3() @ face.normal)],
        }
    return found


def watch(folder, changes):
    """The map and the list of jobs before and after files of the survey are written."""
    bpy.context.scene.swag_survey.folder = folder
    assert bpy.ops.swag.show_blocks() == {"FINISHED"}
    survey_folder = SurveyFolder(Path(folder))
    made = survey_map.map_of(bpy.context.scene, survey_folder)
    found = {"before": faces_of(made), "jobs before": listed(), "objects": len(bpy.data.objects)}
    for path, text in changes.items():
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(text)
    survey_watch.refresh(bpy.context, survey_folder)
    found["after"], found["jobs after"] = faces_of(made), listed()
    found["panel"] = draw_all(context_of_a_sidebar())["SWAG_PT_survey"]
    assert bpy.ops.swag.show_blocks() == {"FINISHED"}  # again: in place of the first map
    found["objects again"] = len(bpy.data.objects)
    found["meshes"], found["fonts"] = len(bpy.data.meshes), len(bpy.data.curves)
    return found


def beats(folder):
    """States of a job whose claim stands still, and beats again, by the local clock."""
    survey_folder = SurveyFolder(Path(folder))
    claim = survey_folder.claim("B-001")
    claim.write_text('{"host": "elsewhere", "pid": 7, "beat": 3}')
    found, reading = [], None
    for now in (0.0, 19.0, 21.0):
        reading = survey_watch.read_survey(survey_folder, reading, now)
        found.append(reading.statuses["B-001"].state)
    claim.write_text('{"host": "elsewhere", "pid": 7, "beat": 4}')
    found.append(survey_watch.read_survey(survey_folder, reading, 22.0).statuses["B-001"].state)
    return found


def show_water(folder, scene, out):
    """Colors that are exported without and with water, the run that a film takes its water from, and the slider."""
    root = bpy.data.objects.new("reef", None)
    root[scene_import.ROOT_KEY] = scene
    bpy.context.scene.collection.objects.link(root)
    size = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], (-4, 4, 9)
    camera = {"name": "a.jpg", **size, "world_to_camera": pose.tolist(), "image": ""}
    scene_import.camera_object(camera, root, bpy.context.scene.collection)
    obj = opened(folder)
    found = {"below root": obj.parent == root, "film": str(film._run_of(obj))}
    for amount in (0.0, 1.0):
        path = Path(out, f"{amount}.ply")
        export_splats(path, frame="SCENE", water=amount, develop=False)
        found[str(amount)] = read_ply(path).sh[:, 0].mean(0).tolist()
    swag.water = 0.25
    bpy.context.view_layer.update()
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    owner, name, _ = splat_preview._input(evaluated, splat_colors.WATER)
    found["slider"] = owner.value if name == "value" else owner[name]
    return found


def listed():
    jobs = survey_watch.jobs_of(bpy.context).jobs
    return {job.name: [job.state, round(job.psnr, 2), round(job.fraction, 3), job.problem] for job in jobs}


def plan_and_merge(photos):
    """A survey planned and merged by the engine, with what the panel draws at each stage."""
    found = {"no survey": draw_all(context_of_a_sidebar())["SWAG_PT_survey"]}
    found["refused"] = [bpy.ops.swag.plan_survey.poll(), bpy.ops.swag.merge_survey.poll()]
    swag.scene_folder = photos
    bpy.context.scene.swag_survey.block_images = 40
    found["photos"] = draw_all(context_of_a_sidebar())["SWAG_PT_survey"]
    assert bpy.ops.swag.plan_survey() == {"FINISHED"}
    found["planned"] = [status.message, status.failed, listed()]
    folder = survey.survey_path(bpy.context.scene)
    found["request"] = json.loads(Path(folder, "request.json").read_text())
    found["waiting"] = draw_all(context_of_a_sidebar())["SWAG_PT_survey"]
    found["again"] = refusal(bpy.ops.swag.plan_survey)
    found["command"] = survey.run_command(folder, blender=False)
    assert bpy.ops.swag.copy_survey_command() == {"FINISHED"}
    assert bpy.ops.swag.merge_survey() == {"FINISHED"}
    found["merged"] = [status.message, status.failed, tiles_of(bpy.context.active_object)]
    survey_watch.refresh(bpy.context, SurveyFolder(Path(folder)))
    found["drawn"] = draw_all(context_of_a_sidebar())
    return found


def plan_with_the_engine(photos):
    swag.scene_folder, swag.iterations, swag.width, swag.max_gaussians = photos, 40, 64, 20_000
    bpy.context.scene.swag_survey.block_images = 12
    assert bpy.ops.swag.plan_survey() == {"FINISHED"}, status.message
    made = survey_map.map_of(bpy.context.scene, survey.chosen_survey(bpy.context.scene))
    states = [each["state"] for each in faces_of(made).values()]
    return {"message": status.message, "failed": status.failed, "faces": states}


def merge_with_the_engine(folder, partial):
    """The message, and what is shown of the blocks and of the result, where there is one."""
    bpy.context.scene.swag_survey.folder = folder
    assert bpy.ops.swag.show_blocks() == {"FINISHED"}
    faces = faces_of(survey_map.map_of(bpy.context.scene, SurveyFolder(Path(folder)))).values()
    found: dict[str, object] = {"faces": [each["state"] for each in faces], "psnr": [each["psnr"] for each in faces]}
    try:
        bpy.ops.swag.merge_survey(partial=partial)
        found["splats"] = splats.count(bpy.context.active_object)
    except RuntimeError:
        pass
    return found | {"message": status.message, "failed": status.failed}
