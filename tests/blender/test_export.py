"""Splat files out of Blender and into it, through the operators."""

import sys

import numpy as np
import pytest

from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import covariances, sh_basis, transformed

SETUP = """
import json, sys
from pathlib import Path
from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats

bpy.ops.wm.read_homefile(use_empty=True)
folder = Path(sys.argv[1])

def opened(name, **options):
    assert bpy.ops.swag.import_splats(filepath=str(folder / name), **options) == {"FINISHED"}
    return bpy.context.active_object

def refused(operator, **options):
    # A report of an error becomes an exception for a script; a traceback would name a file.
    try:
        operator(**options)
    except RuntimeError as error:
        assert "Traceback" not in str(error), error
        return str(error).removeprefix("Error: ").strip()
    raise AssertionError("nothing was said")

def imported_scene():
    # Without the engine: a root as scene_import makes it, tilted and off the origin.
    import numpy as np
    root = bpy.data.objects.new("reef", None)
    root[scene_import.ROOT_KEY] = "/data/reef"
    root.matrix_world = scene_import.colmap_to_blender(np.array([0.48, -0.8, 0.36]), np.array([[1.0, 2.0, 3.0]]))
    bpy.context.scene.collection.objects.link(root)
    bpy.context.view_layer.update()
    return root
"""


def some_splats(count=200, degree=3, seed=0):
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    return Splats(
        random.normal(size=(count, 3)).astype(np.float32),
        rotations.astype(np.float32),
        np.exp(random.uniform(-5, -1, (count, 3))).astype(np.float32),
        random.uniform(0.01, 0.99, count).astype(np.float32),
        random.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        {"label": random.integers(0, 9, count).astype(np.int32)},
    )


def assert_same(a, b, tolerance=2e-5):
    """The same splats whatever signs their quaternions have and in whatever order their axes come."""
    assert len(a) == len(b) and a.sh.shape == b.sh.shape
    assert np.allclose(a.positions, b.positions, atol=tolerance)
    scale = np.abs(covariances(b)).max()
    assert np.allclose(covariances(a), covariances(b), atol=tolerance * scale)
    assert np.allclose(a.opacities, b.opacities, atol=1e-6)
    assert np.allclose(a.sh, b.sh, atol=tolerance)
    assert np.array_equal(a.extras["label"], b.extras["label"])


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_in_and_out_is_the_same_file(blender, tmp_path, suffix):
    """Upright, in the scene, and across both formats; the object's transform counts."""
    made = some_splats()
    write_ply(tmp_path / "Riff ä.ply", made)
    blender.run(
        SETUP
        + """
suffix = sys.argv[2]
obj = opened("Riff ä.ply")
assert obj.name == "Riff ä" and splats.is_splats(obj)
assert bpy.ops.swag.export_splats(filepath=str(folder / f"upright.{suffix}")) == {"FINISHED"}
again = opened(f"upright.{suffix}")
assert again is not obj and len(bpy.context.selected_objects) == 1
assert bpy.ops.swag.export_splats(filepath=str(folder / f"twice.{suffix}")) == {"FINISHED"}

root = imported_scene()
obj = opened("Riff ä.ply", frame="SCENE")
assert obj.parent == root
assert bpy.ops.swag.export_splats(filepath=str(folder / f"scene.{suffix}"), frame="SCENE") == {"FINISHED"}
obj = opened(f"scene.{suffix}", frame="SCENE")
assert bpy.ops.swag.export_splats(filepath=str(folder / "scene.ply"), frame="SCENE") == {"FINISHED"}
obj.select_set(True)
again.select_set(True)
assert bpy.ops.swag.export_splats(filepath=str(folder / f"both.{suffix}")) == {"FINISHED"}
        """,
        tmp_path,
        suffix,
    )
    # A GLB that nobody turned further holds y-up data: read with its default it is in the PLY's frame.
    read = read_ply if suffix == "ply" else read_glb
    assert_same(read(tmp_path / f"upright.{suffix}"), made)
    assert_same(read(tmp_path / f"twice.{suffix}"), made)
    assert_same(read_ply(tmp_path / "scene.ply"), made)
    assert len(read(tmp_path / f"both.{suffix}")) == 400


def test_transforms_are_applied_rightly(blender, tmp_path):
    """Moved, turned and scaled in Blender under a turned root: what a camera saw it sees from the moved place."""
    made = some_splats()
    write_ply(tmp_path / "reef.ply", made)
    printed = blender.run(
        SETUP
        + """
root = imported_scene()
obj = opened("reef.ply", frame="SCENE")
obj.location, obj.rotation_euler, obj.scale = (1, 2, 3), (0.3, 0.5, 0.7), (2, 2, 2)
assert bpy.ops.swag.export_splats(filepath=str(folder / "moved.ply")) == {"FINISHED"}
bpy.context.view_layer.update()
print("MATRIX", json.dumps([list(row) for row in splats.FILE_FRAME.inverted() @ obj.matrix_world]))
        """,
        tmp_path,
    )
    matrix = np.array(blender.json_after("MATRIX", printed))
    moved = read_ply(tmp_path / "moved.ply")
    assert_same(moved, transformed(made, matrix))
    # And without the function under use: positions, sizes, and colours seen along turned directions.
    turn = matrix[:3, :3] / 2
    assert np.allclose(moved.positions, made.positions @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-4)
    assert np.allclose(np.prod(moved.scales, axis=1), 8 * np.prod(made.scales, axis=1), rtol=1e-3)
    direction = np.array([[0.36, 0.48, 0.8]])
    before = np.einsum("mk,nkc->nc", sh_basis(direction, 3), made.sh)
    after = np.einsum("mk,nkc->nc", sh_basis(direction @ turn.T, 3), moved.sh)
    assert np.allclose(before, after, atol=1e-4)


def test_upright_is_blenders_up(blender, tmp_path):
    """A point two units above Blender's ground: y is -2 in the PLY (viewers turn it over), +2 in the GLB."""
    one = some_splats(1, 0)
    one.positions[:] = 0
    write_ply(tmp_path / "one.ply", one)
    blender.run(
        SETUP
        + """
obj = opened("one.ply")
obj.location.z = 2
bpy.ops.swag.export_splats(filepath=str(folder / "up.ply"))
bpy.ops.swag.export_splats(filepath=str(folder / "up.glb"))
        """,
        tmp_path,
    )
    assert np.allclose(read_ply(tmp_path / "up.ply").positions, (0, -2, 0), atol=1e-6)
    assert np.allclose(read_glb(tmp_path / "up.glb", up=(0, 1, 0)).positions, (0, 2, 0), atol=1e-6)


def test_fewer_harmonics_and_several_files(blender, tmp_path):
    write_ply(tmp_path / "a.ply", some_splats(30))
    write_ply(tmp_path / "b.PLY", some_splats(40, 1))
    (tmp_path / "broken.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:2000])
    printed = blender.run(
        SETUP
        + """
files = [{"name": "a.ply"}, {"name": "b.PLY"}]
assert bpy.ops.swag.import_splats(directory=str(folder), files=files, sh_degree=1) == {"FINISHED"}
assert [len(obj.data.points) for obj in bpy.context.selected_objects] == [30, 40]
assert all(splats.read_splats(obj).sh.shape[1] == 4 for obj in bpy.context.selected_objects)
said = refused(bpy.ops.swag.import_splats, directory=str(folder), files=[*files, {"name": "broken.ply"}])
assert len(bpy.data.pointclouds) == 4, "the good files are there"
handler = bpy.types.SWAG_FH_splats
print("SAID", json.dumps([said, handler.bl_file_extensions, handler.bl_import_operator]))
        """,
        tmp_path,
    )
    said, extensions, operator = blender.json_after("SAID", printed)
    assert "broken.ply" in said and "\n" not in said
    assert extensions == ".ply;.glb" and operator == "swag.import_splats"


def test_refusals_are_one_sentence(blender, tmp_path):
    write_ply(tmp_path / "a.ply", some_splats(5))
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "occupied").write_text("a file, not a folder")
    printed = blender.run(
        SETUP
        + """
save, load = bpy.ops.swag.export_splats, bpy.ops.swag.import_splats
said = {"nothing": refused(save, filepath=str(folder / "x.ply"))}
said["not there"] = refused(load, filepath=str(folder / "nowhere.ply"))
said["no name"] = refused(load)
said["format"] = refused(load, filepath=str(folder / "occupied"))
said["damaged"] = refused(load, filepath=str(folder / "text.ply"))
said["no scene"] = refused(load, filepath=str(folder / "a.ply"), frame="SCENE")
opened("a.ply")
said["suffix"] = refused(save, filepath=str(folder / "x.obj"))
said["unwritable"] = refused(save, filepath=str(folder / "occupied" / "x.ply"))
said["full"] = refused(save, filepath="/dev/full/x.glb")
said["no root"] = refused(save, filepath=str(folder / "x.ply"), frame="SCENE")
print("SAID", json.dumps(said))
        """,
        tmp_path,
    )
    said = blender.json_after("SAID", printed)
    print(said)
    named = {"not there": "nowhere.ply", "damaged": "text.ply", "unwritable": "x.ply", "full": "x.glb"}
    for case, sentence in said.items():
        assert sentence.endswith(".") and "\n" not in sentence and named.get(case, "") in sentence, (case, sentence)
    assert "select" in said["nothing"] and not list(tmp_path.glob("x.*"))


def test_a_scene_that_cannot_be_read_is_refused_in_one_sentence(blender, tmp_path):
    printed = blender.run(
        SETUP
        + """
said = [refused(bpy.ops.swag.import_scene), refused(bpy.ops.swag.import_scene, directory=str(folder / "not here"))]
assert not bpy.data.collections and not bpy.context.window_manager.swag.job
print("SAID", json.dumps(said))
        """,
        tmp_path,
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    said = blender.json_after("SAID", printed)
    print(said)
    assert all(sentence.endswith(".") and "\n" not in sentence for sentence in said) and "not here" in said[1]
