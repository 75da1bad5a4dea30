"""Scenes and files far from their origin, as in UTM or geocentric coordinates, lose nothing to float32."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from swag_engine.base.local_origin import local_origin
from swag_engine.formats.camera_path import PathFrame, frames_near
from swag_engine.formats.cameras import transform_camera
from swag_engine.formats.export import ExportOptions, export_run
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.registry import FORMATS
from swag_engine.georeference.measure import Measurements, scale_scene
from swag_engine.products.map_frame import load_map_scene
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.inspect import describe, inspect_scene
from swag_engine.scene.scene_part import part_of, read_part, write_part
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import concatenate
from swag_engine.splats.transform import transformed
from swag_engine.training.trainer import train
from tests.scenes.small_surveys import random_splats

UTM, GEOCENTRIC = (512345.25, 5431234.5, -30.0), (3912345.25, 812345.5, 4954321.75)
FAR = pytest.mark.parametrize("offset", [UTM, GEOCENTRIC], ids=["UTM", "geocentric"])


def moved(scene, folder, offset):
    """A copy of a scene whose model has larger coordinates."""
    shutil.copytree(scene, folder)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(1, pycolmap.Rotation3d(), np.array(offset)))
    for file in (folder / "sparse" / "0").iterdir():
        file.unlink()
    model.write_binary(str(folder / "sparse" / "0"))
    return folder


def test_an_origin_is_taken_only_where_float32_is_too_coarse():
    near = np.random.default_rng(0).normal(size=(50, 3))
    assert not local_origin(near).any() and not local_origin(near + 90).any() and not local_origin(near[:1]).any()
    for size in (1e-3, 1.0, 1e3):
        origin = local_origin(size * (near + UTM))
        assert np.abs(size * (near + UTM) - origin).max() < 40 * size
        assert (local_origin(size * (near[:49] + UTM)) == origin).all()


@FAR
def test_a_far_scene_is_read_as_the_same_scene_at_its_origin(tiny_scene, tmp_path, offset):
    near, far = load_scene(tiny_scene), load_scene(moved(tiny_scene, tmp_path / "far", offset))
    assert not near.origin.any() and np.allclose(far.points.positions + far.origin, near.points.positions + offset)
    assert np.abs(far.points.positions).max() < 50 and np.allclose(far.up, near.up, atol=1e-6)
    for one, other in zip(near.views, far.views, strict=True):
        pixels = [
            (points.positions @ view.camera.world_to_camera[:3, :3].T + view.camera.world_to_camera[:3, 3]).astype("f4")
            for view, points in ((one, near.points), (other, far.points))
        ]
        assert np.abs(pixels[0] - pixels[1]).max() < 1e-5
    assert "Origin:" in describe(inspect_scene(far)) and "Origin:" not in describe(inspect_scene(near))
    part = part_of(far, far.split)
    write_part(tmp_path / "part.npz", part)
    read = read_part(tmp_path / "part.npz", far.folder)
    assert (read.origin == far.origin).all()
    assert (read.views[0].camera.world_to_camera == far.views[0].camera.world_to_camera).all()


def test_a_far_scene_trains_as_well_and_its_files_say_where_it_lies(tiny_scene, tmp_path):
    settings = TrainSettings(iterations=60, width=64, max_gaussians=400, sh_degree=1)
    scores = []
    for name, offset in (("near", (0, 0, 0)), ("far", GEOCENTRIC)):
        scene = moved(tiny_scene, tmp_path / name, offset)
        scores.append(train(scene, tmp_path / f"{name} run", settings)["metrics"]["psnr"])
    assert scores[1] == pytest.approx(scores[0], abs=0.5) and scores[0] > 15
    run, origin = tmp_path / "far run", load_scene(tmp_path / "far").origin
    splats = read_ply(run / "result.ply")
    assert splats.origin == tuple(origin)
    assert np.abs(np.median(splats.positions, axis=0) + origin - GEOCENTRIC).max() < 1
    made = export_run(run, "ply", tmp_path / "out.ply", ExportOptions(cameras=True, up="z-up", metres_per_unit=2.0))
    assert any("relative to" in note for note in made["notes"])
    exported = read_ply(tmp_path / "out.ply")
    lengths = [np.linalg.norm(each.origin) for each in (exported, splats)]
    assert lengths[0] == pytest.approx(2 * lengths[1])
    path = [PathFrame(load_scene(tmp_path / "far").views[0].camera)]
    moved_path = [PathFrame(transform_camera(path[0].camera, _shift(origin)))]
    for frames in (path, moved_path):
        found = frames_near(frames, origin)[0].camera.world_to_camera
        assert np.allclose(found, path[0].camera.world_to_camera, atol=1e-6)
    counts = []
    for x, y, z in (GEOCENTRIC, np.subtract(GEOCENTRIC, origin).tolist()):
        box = (x - 0.5, y - 0.5, z - 0.5, x + 0.5, y + 0.5, z + 0.5)
        counts.append(export_run(run, "ply", tmp_path / "box.ply", ExportOptions(box=box))["splats"])
    assert counts[0] == counts[1] and 0 < counts[0] < len(splats)
    mapped = load_map_scene(run)
    level = mapped.matrix[:3, :3] @ np.array(GEOCENTRIC)
    assert np.abs(np.median(mapped.splats.positions, axis=0) + mapped.placement.offset - level).max() < 1
    cameras = pycolmap.Reconstruction(str(next(path.parent for path in tmp_path.glob("out*/**/cameras.*"))))
    centres = [cameras.image(number).projection_center() for number in cameras.reg_image_ids()]
    assert np.abs(centres - np.median(exported.positions, axis=0)).max() < 20


def _shift(origin):
    matrix = np.eye(4)
    matrix[:3, 3] = origin
    return matrix


@FAR
@pytest.mark.parametrize("format", list(FORMATS))
def test_every_format_keeps_the_origin_in_doubles(tmp_path, format, offset):
    splats = replace(random_splats(20), origin=offset)
    path = tmp_path / f"splats{FORMATS[format].suffix}"
    up = (0.0, -0.6, 0.8)
    FORMATS[format].write(path, splats, up, ())
    found = FORMATS[format].read(path, up)
    assert np.allclose(found.origin, offset, rtol=0, atol=1e-8)
    assert np.allclose(found.positions, splats.positions, atol=1e-2)
    # Without one, an earlier file of the name tells nothing.
    FORMATS[format].write(path, random_splats(20), up, ())
    assert not any(FORMATS[format].read(path, up).origin)


def test_transforms_and_joins_keep_what_positions_and_origin_are_together():
    first, second = replace(random_splats(5), origin=UTM), random_splats(5, seed=1)
    second.origin = (UTM[0] + 16, UTM[1], UTM[2] - 4)
    joined = concatenate([first, second])
    assert joined.origin == UTM
    assert np.allclose(joined.positions[5:], second.positions + (16, 0, -4), atol=1e-5)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 3 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), (1, 2, 3)
    made = transformed(first, matrix)
    whole = (first.positions + np.array(UTM)) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.allclose(made.positions + np.array(made.origin), whole, atol=1e-5)


def test_a_file_with_double_positions_keeps_them(tmp_path):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", *"0123"]
    names[10:] = ["rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.random.default_rng(0).normal(size=(30, len(names)))
    rows[:, :3] += UTM
    kinds = ["double"] * 3 + ["float"] * (len(names) - 3)
    header = ["ply", "format ascii 1.0", "element vertex 30"]
    header += [f"property {kind} {name}" for kind, name in zip(kinds, names, strict=True)]
    lines = [" ".join(repr(float(value)) for value in row) for row in rows]
    (tmp_path / "far.ply").write_text("\n".join([*header, "end_header", *lines]) + "\n")
    found = read_ply(tmp_path / "far.ply")
    assert np.abs(found.positions + np.array(found.origin) - rows[:, :3]).max() < 1e-5


@pytest.mark.parametrize("comment", ["origin nan 1 2", "origin 1 2", "crs_offset inf 0 0", "crs_offset a b c"])
def test_an_origin_that_cannot_be_used_is_said(tmp_path, caplog, comment):
    write_ply(tmp_path / "a.ply", random_splats(5))
    data = (tmp_path / "a.ply").read_bytes().replace(b"element", f"comment {comment}\nelement".encode(), 1)
    (tmp_path / "a.ply").write_bytes(data)
    found = read_ply(tmp_path / "a.ply")
    assert found.placement is None and not any(found.origin)
    assert f"the comment {comment.split()[0]} is not three usable numbers" in caplog.text


@FAR
def test_a_measured_scale_is_that_of_the_model_and_maps_have_its_coordinates(tiny_scene, tmp_path, offset):
    """Reference points: photos whose places are known in a coordinate reference system."""
    places = {}
    for name, shift in (("near", (0, 0, 0)), ("far", offset)):
        scene = moved(tiny_scene, tmp_path / name, shift)
        views = load_scene(scene).views
        centres = [view.camera.centre + load_scene(scene).origin - shift for view in views]
        table = "".join(
            f"{view.name},{500000 + 2 * c[0]:.6f},{4000000 + 2 * c[2]:.6f},{-2 * c[1]:.6f}\n"
            for view, c in zip(views, centres, strict=True)
        )
        (tmp_path / "points.csv").write_text("name,x,y,z\n" + table)
        scale_scene(scene, Measurements(points=tmp_path / "points.csv", crs="EPSG:32633"))
        stored = json.loads((scene / "scale.json").read_text())
        point = np.array(stored["rotation"]) @ (np.array(shift) + (1, 1, 1)) * stored["metres_per_unit"]
        places[name] = point + stored["translation"] + stored["offset"]
        measured = load_scene(scene).georeference
        assert np.abs(measured.translation).max() < 1e5
        run = tmp_path / f"{name} run"
        train(scene, run, TrainSettings(iterations=5, width=64, max_gaussians=400, sh_degree=0))
        shown = load_map_scene(run)
        assert np.allclose(shown.placement.offset, stored["offset"], rtol=0, atol=1e-6)
        whole = shown.without_offset((499990, 3999990, 500010, 4000010))
        assert np.allclose(whole, shown.without_offset(whole.ravel().tolist()))
        middle = np.median(shown.splats.positions, axis=0) + shown.placement.offset
        assert np.abs(middle - (500000, 4000000, 0)).max() < 10
    assert np.allclose(places["near"], places["far"], atol=1e-3)
    assert np.allclose(places["near"], (500002, 4000002, -2), atol=0.05)
