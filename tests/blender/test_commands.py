"""`blender --background --command swag`: the engine's words, and `import`, which makes a .blend."""

import sys

import pytest

RUN = """
import json, sys, bpy
from bl_ext.user_default.swag_splatting.swag_blender import commands
def run(word, *arguments):
    code = commands.run(list(arguments))
    sys.stdout.flush()
    print(word, json.dumps(code), flush=True)
here = sys.argv[-1]
"""


def test_import_makes_a_blend_of_a_scene_and_of_its_run(blender, tiny_scene, tmp_path):
    printed = blender.run(
        RUN
        + f"""
scene = {str(tiny_scene)!r}
run("SCENE", "import", scene, "--out", here + "/new/scene.blend", "--json")
bpy.ops.wm.open_mainfile(filepath=here + "/new/scene.blend")
kinds = [obj.type for obj in bpy.context.scene.objects]
print("HELD", json.dumps([kinds.count("CAMERA"), bpy.context.scene.swag.scene_path == scene]))
run("TRAINED", "train", scene, "--out", here + "/run", "--iterations", "40", "--width", "64", "--sh-degree", "0")
run("RUN", "import", here + "/run", "--out", here + "/run.blend")
splats = [obj for obj in bpy.context.scene.objects if "swag_run" in obj]
print("SPLATS", json.dumps([len(splats), splats[0].parent is not None, bpy.context.scene.render.engine]))
run("FILE", "import", here + "/run/result.ply", "--out", here + "/file.blend")
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    codes = [blender.json_after(word, printed) for word in ("SCENE", "TRAINED", "RUN", "FILE")]
    assert codes == [0, 0, 0, 0], printed
    assert blender.json_after("HELD", printed) == [10, True]
    assert blender.json_after("SPLATS", printed) == [1, True, "CYCLES"]
    assert f"10 cameras, 2 point clouds: {tmp_path / 'run.blend'}" in printed
    assert f"0 cameras, 1 point clouds: {tmp_path / 'file.blend'}" in printed
    assert "Traceback" not in printed


def test_import_says_what_is_wrong_and_writes_nothing(blender, fake_engine, tmp_path):
    (tmp_path / "stopped").mkdir()
    (tmp_path / "stopped" / "config.json").write_text("{}")
    printed = blender.run(
        RUN
        + """
run("USAGE", "import")
run("NAME", "import", here, "--out", here + "/a.obj")
run("MISSING", "import", here + "/none.ply", "--out", here + "/a.blend")
run("STOPPED", "import", here + "/stopped", "--out", here + "/a.blend", "--json")
run("HELP", "import", "--help")
run("ALL", "--help")
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert [blender.json_after(word, printed) for word in ("USAGE", "NAME", "MISSING", "STOPPED")] == [2] * 4
    assert "a.obj must end in .blend." in printed and "holds no result yet" in printed
    assert "usage: blender --background --command swag import" in printed and blender.json_after("HELP", printed) == 0
    assert "In Blender there is also" in printed and blender.json_after("ALL", printed) == 7
    assert not list(tmp_path.glob("*.blend")) and "Traceback" not in printed


@pytest.mark.main_version
def test_sigterm_is_passed_on_and_keeps_what_exists(blender, tiny_scene, tmp_path):
    printed = blender.run(
        RUN
        + f"""
import os, pathlib, signal, threading, time
def stop():
    while not pathlib.Path(here, "run", "config.json").exists():
        time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=stop).start()
run("ENDED", "train", {str(tiny_scene)!r}, "--out", here + "/run", "--iterations", "100000", "--width", "64")
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    assert blender.json_after("ENDED", printed) == 143
    assert (tmp_path / "run" / "result.ply").exists() and "Traceback" not in printed
