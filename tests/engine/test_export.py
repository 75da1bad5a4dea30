"""Exports of a run: selected splats, formats, water, axes, sizes, and cameras."""

import json
import re
import shutil
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pycolmap
import pytest
import torch

from swag_engine.app.cli import main
from swag_engine.app.protocol import ExportRequest, parse_request
from swag_engine.base.errors import InputError
from swag_engine.formats import water
from swag_engine.formats.cameras import PosedImage, transform_camera, write_cameras
from swag_engine.formats.export import ExportOptions, export_run
from swag_engine.formats.export_format import Option
from swag_engine.formats.gltf import glb_size, read_glb, write_glb
from swag_engine.formats.ply import ply_size, read_ply, write_ply
from swag_engine.formats.registry import FORMATS, find_format
from swag_engine.formats.run_folder import RunFolder, write_json
from swag_engine.formats.select import SplatSelection, box_between, label_ids
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.georeference import Georeference, Placement, write_georeference
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.develop_splats import undo_development
from swag_engine.splats.development import Development, SplatDevelopment
from swag_engine.splats.splats import Splats, concatenate
from swag_engine.splats.transform import rotation_matrices, sh_basis, transformed
from swag_engine.water.medium import Medium, through_water
from swag_engine.water.network import WaterNetwork
from tests.scenes.clouds import draw_splats, random_splats

UP = [0.1, -0.9, 0.3]


def some_splats(count=400, degree=3, seed=0):
    """A wall of splats around the origin, where the tiny scene's cameras look."""
    return random_splats(count, [2, 2, 0.5], (-4, -1), degree, seed)


def some_medium(light="linear"):
    medium = Medium.starting(
        4.0, light, torch.tensor([0.2, 0.09, 0.05]), torch.tensor([0.1, 0.08, 0.07]), torch.tensor([0.05, 0.2, 0.3])
    )
    medium.background_sh[1:] = torch.randn(8, 3, generator=torch.Generator().manual_seed(0)) * 0.5
    return medium


@pytest.fixture(scope="module")
def run(tiny_scene, tmp_path_factory):
    """A run folder as training and labelling leave it."""
    folder = RunFolder(tmp_path_factory.mktemp("run") / "Lauf 1")
    folder.write_config(tiny_scene, TrainSettings(), UP)
    write_ply(folder.ply, some_splats())
    write_json(folder.water, some_medium().to_json())
    names = [{"id": 0, "name": "sand"}, {"id": 2, "name": "Coral"}, {"id": 3, "name": "wreck"}]
    write_json(folder.path / "labels.json", {"labels": names})
    return folder.path


def psnr(a, b):
    return float(-10 * torch.log10(torch.mean((a - b) ** 2)))


# ------------------------------------------------------------------------------------------------ which splats


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("extras", [False, True])
def test_the_forecast_is_the_size(run, tmp_path, kind, extras):
    options = {"sh_degree": 2, "extras": extras, "min_opacity": 0.3, "cameras": True}
    foreseen = export_run(run, kind, tmp_path / "out", ExportOptions(**options, forecast=True))
    assert not list(tmp_path.iterdir()) and not foreseen["files"]
    result = export_run(run, kind, tmp_path / "out", ExportOptions(**options))
    assert foreseen["bytes"] == result["bytes"] == (tmp_path / "out").stat().st_size
    assert foreseen["splats"] == result["splats"] < 400
    read = FORMATS[kind].read(tmp_path / "out", UP)
    kept = extras and "extras" in FORMATS[kind].options
    assert read.degree == 2 and bool(read.extras) == kept and read.opacities.min() >= 0.3 - 1 / 255
    lost = [note for note in result["notes"] if "left out: label" in note]
    assert bool(lost) == (extras and not kept) and all(note.endswith(".") for note in lost)


def test_sizes_of_odd_extras(tmp_path):
    splats = some_splats(50, 1)
    splats.extras |= {"far": np.arange(50) * 1000, "score": np.linspace(0, 1, 50), "chosen": np.arange(50) % 2 == 0}
    write_ply(tmp_path / "a.ply", splats)
    write_glb(tmp_path / "a.glb", splats)
    assert ply_size(tmp_path / "a.ply", splats) == (tmp_path / "a.ply").stat().st_size
    assert glb_size(tmp_path / "a.glb", splats) == (tmp_path / "a.glb").stat().st_size


def test_only_what_is_chosen_leaves(run, tmp_path):
    whole, out = some_splats(), tmp_path / "out.ply"
    lower, upper = (-1.0, -2.0, -0.4), (1.5, 0.5, 0.3)
    inside = ((whole.positions >= lower) & (whole.positions <= upper)).all(axis=1)
    labelled = np.isin(whole.extras["label"], [1, 2])
    cases = [
        (ExportOptions(), np.ones(400, bool)),
        (ExportOptions(min_opacity=0.5), whole.opacities >= 0.5),
        (ExportOptions(labels=("coral", "1")), labelled),
        (ExportOptions(box=(*lower, *upper)), inside),
        (ExportOptions(box=(*lower, *upper), labels=("CORAL", "1"), min_opacity=0.5),
         inside & labelled & (whole.opacities >= 0.5)),
    ]  # fmt: skip
    for options, kept in cases:
        assert 0 < export_run(run, "ply", out, options)["splats"] == kept.sum()
        np.testing.assert_array_equal(read_ply(out).positions, whole.positions[kept])
        np.testing.assert_array_equal(read_ply(out).extras["label"], whole.extras["label"][kept])


def test_a_turned_box(tmp_path):
    splats = some_splats()
    turn = rotation_matrices(np.array([0.9, 0.1, 0.3, np.sqrt(1 - 0.91)]))
    box = np.eye(4)
    box[:3, :3] = np.diag([1, 2, 0.5]) @ turn.T
    kept = SplatSelection(box=box).apply(splats)
    inside = (np.abs(splats.positions @ turn * (1, 2, 0.5)) <= 1).all(axis=1)
    np.testing.assert_array_equal(kept.positions, splats.positions[inside])


def test_what_cannot_be_chosen_is_said(run, tmp_path):
    out = tmp_path / "out.ply"
    cases: list[tuple[dict[str, Any], str]] = [
        ({"labels": ("kelp",)}, "no label named kelp; there are sand, coral, wreck"),
        ({"labels": ("7",)}, "No splat is left"),
        ({"min_opacity": 1.0}, "No splat is left"),
        ({"box": (0, 0, 0, 1, 1, 0)}, "corner of the box"),
        ({"min_opacity": 1.5}, "min opacity must be a number from 0 to 1, not 1.5"),
        ({"water": -1}, "water must be a number from 0 to 1"),
        ({"sh_degree": 4}, "sh degree must be a whole number from 0 to 3"),
        ({"labels": "coral"}, "labels must be a tuple"),
        ({"up": "x-up"}, "up must be one of scene, y-down"),
        ({"metres_per_unit": -1.0}, "metres per unit"),
        ({"metres_per_unit": float("nan")}, "metres per unit"),
    ]
    for options, sentence in cases:
        with pytest.raises(InputError, match=sentence):
            export_run(run, "ply", out, ExportOptions(**options))
    with pytest.raises(InputError, match="label them first"):
        unlabelled = Splats(*[getattr(some_splats(), n) for n in Splats.__annotations__][:5])
        SplatSelection(labels=frozenset([1])).apply(unlabelled)
    for damaged in ("{}", "[1]", '{"labels": 7}', '{"labels": [{"id": "x", "name": "y"}]}', "nothing"):
        (tmp_path / "labels.json").write_text(damaged)
        with pytest.raises(InputError, match="labels.json"):
            label_ids(["sand"], tmp_path / "labels.json")
    assert not out.exists()


def test_the_command_line(run, tmp_path, capsys):
    out = tmp_path / "reef.glb"
    given = ["export", str(run), "--format", "glb", "--out", str(out), "--labels", "coral", "wreck", "--water", "0.5"]
    assert main([*given, "--cameras", "--metres-per-unit", "0.5", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["files"][0] == str(out) and result["bytes"] == out.stat().st_size
    assert {path.name for path in (tmp_path / "reef_cameras").rglob("*.*")} == {
        "cameras.txt", "images.txt", "points3D.txt", "transforms.json", "water.json",
    }  # fmt: skip
    assert main([*given, "--forecast"]) == 0
    assert "would have" in capsys.readouterr().out
    assert main([*given, "--sh-degree", "9"]) == 2
    assert main([*given, "--box", "0", "0", "0", "1", "1", "-1"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 2


# ------------------------------------------------------------------------------------------------ formats


@pytest.mark.parametrize("name", FORMATS)
def test_a_registered_format_is_read_back_as_it_was_written(tmp_path, name):
    format, splats = FORMATS[name], some_splats(50)
    path = tmp_path / f"cloud{format.suffix}"
    size = format.size(path, splats, UP, ())
    assert find_format(path) is find_format(path.with_suffix(format.suffix.upper())) is format
    assert format.name == name and format.title and format.description and format.options <= set(get_args(Option))
    format.write(path, splats, UP, ())
    assert path.stat().st_size == size
    read = format.read(path, UP)
    exact = "extras" in format.options
    np.testing.assert_allclose(read.positions, splats.positions, atol=1e-5 if exact else 1e-3)
    for field in ("scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(read, field), getattr(splats, field), atol=1e-5 if exact else 0.15)
    np.testing.assert_allclose(np.abs((read.rotations * splats.rotations).sum(axis=1)), 1, atol=1e-5)
    np.testing.assert_array_equal(read.extras.get("label", ()), splats.extras["label"] if exact else ())


def test_a_run_has_its_result_in_every_format_that_leaves_nothing_out(tmp_path):
    run = RunFolder(tmp_path)
    run.write_result(some_splats(50), UP)
    assert {path.name for path in tmp_path.iterdir()} == {"result.ply", "result.glb"}
    for name, path in run.results.items():
        np.testing.assert_allclose(FORMATS[name].read(path, UP).positions, some_splats(50).positions, atol=1e-5)


def test_the_command_line_and_the_worker_offer_the_registered_formats(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    assert re.search(r"--format \{(.*?)\}", capsys.readouterr().out).group(1).split(",") == list(FORMATS)
    request = {"request": "export", "run": "run", "out": "file"}
    for name in FORMATS:
        parsed = parse_request(json.dumps(request | {"format": name}))
        assert isinstance(parsed, ExportRequest) and parsed.format == name
    with pytest.raises(InputError, match=f"one of {', '.join(FORMATS)}"):
        parse_request(json.dumps(request | {"format": "obj"}))
    with pytest.raises(InputError, match=r"reef.obj is not a splat file: choose a name that ends in .ply or .glb"):
        find_format(tmp_path / "reef.obj")


# ------------------------------------------------------------------------------------------------ water


@pytest.mark.parametrize("light", ["linear", "srgb"])
@pytest.mark.parametrize("amount", [1.0, 0.4])
def test_baked_water_is_the_engines_from_where_it_was_photographed(light, amount):
    splats, medium = some_splats(), some_medium(light)
    camera = Camera("only", 64, 48, 58.0, 58.0, 32.0, 24.0, np.eye(4))
    camera.world_to_camera[:3, 3] = 0.3, -0.2, 5
    baked = water.bake_water(splats, medium.to_json(), [camera], amount)
    offsets = torch.from_numpy((splats.positions - camera.centre).astype(np.float32))
    directions = (offsets / offsets.norm(dim=1, keepdim=True)).numpy()
    own, seen = (np.einsum("nk,nkc->nc", sh_basis(directions, 3), s.sh) + 0.5 for s in (splats, baked))
    expected = through_water(torch.from_numpy(own).float().clamp(min=0), offsets, medium, amount=amount).numpy()
    np.testing.assert_allclose(seen, expected, atol=2e-4)
    assert np.abs(seen - own).mean() > 0.03
    # A glance from the side, the water left as it is: wrong by little against what the color changes.
    turned = directions + np.random.default_rng(1).normal(size=(400, 3)) * 0.1
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    own_there, seen_there = (np.einsum("nk,nkc->nc", sh_basis(turned, 3), s.sh) + 0.5 for s in (splats, baked))
    expected_there = through_water(torch.from_numpy(own_there).float(), offsets, medium, amount=amount).numpy()
    bright = (own > 0.1) & (own_there > 0.1)
    change = np.abs(expected_there - expected)[bright].mean()
    assert np.abs(seen_there - expected_there)[bright].mean() < 0.1 * change


# ------------------------------------------------------------------------------------------------ development

DEVELOPMENT = Development(0.5, (1.2, 1.0, 0.8), 1.1, ((1.1, -0.1, 0.0), (0.0, 1.0, 0.0), (0.0, 0.05, 0.95)), 0.8)


@pytest.mark.parametrize("kind", [name for name, format in FORMATS.items() if "extras" in format.options])
def test_a_file_names_the_development_of_its_colors(kind, run, tmp_path):
    developed = RunFolder(shutil.copytree(run, tmp_path / "run"))
    developed.write_development(DEVELOPMENT.to_json() | {"note": ""})
    splats = some_splats()
    splats.sh[:, 0] += 2.0  # above black, where undoing is exact
    write_ply(developed.ply, splats)

    def export(**options):
        result = export_run(developed.path, kind, tmp_path / "out", ExportOptions(**options))
        assert result["bytes"] == (tmp_path / "out").stat().st_size
        return FORMATS[kind].read(tmp_path / "out", UP)

    applied, restored = export(), export(develop="none")
    assert applied.development == SplatDevelopment(DEVELOPMENT, applied=True)
    rolled = export(develop="knee=0.7")
    assert rolled.development == SplatDevelopment(Development(knee=0.7), applied=False), "only pictures are rolled off"
    np.testing.assert_array_equal(rolled.sh, splats.sh)
    assert restored.development == SplatDevelopment(DEVELOPMENT, applied=False)
    assert np.abs(applied.sh - splats.sh).max() > 0.1
    for read in (undo_development(applied), undo_development(restored)):
        np.testing.assert_allclose(read.sh, splats.sh, atol=1e-4)
        assert read.development == restored.development
    assert applied.subset(np.arange(3)).development == concatenate([applied, applied]).development
    assert concatenate([applied, restored]).development is None
    assert export(develop="none", water=1.0).development is None, "the colors as photographed have no development"


@pytest.mark.parametrize("values", ["exposure 1", "applied 1", "applied yes", "applied"])
def test_comments_of_other_programs_are_no_development(values, tmp_path):
    write_ply(tmp_path / "a.ply", some_splats(3))
    comment = f"comment development_{values}\nelement vertex".encode()
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"element vertex", comment))
    assert read_ply(tmp_path / "a.ply").development is None


PLACEMENT = Placement("EPSG:32633", (500_000.123456789, 6_540_000.000123, -0.1))


@pytest.mark.parametrize("kind", FORMATS)
def test_splats_keep_where_they_lie(kind, tmp_path):
    """UTM coordinates of millions of metres come back to the millimetre."""
    splats = replace(some_splats(), placement=PLACEMENT)
    coordinates = splats.positions.astype(np.float64) + PLACEMENT.offset
    path = tmp_path / f"Riff ü{FORMATS[kind].suffix}"
    FORMATS[kind].write(path, splats, UP, ())
    read = FORMATS[kind].read(path, UP)
    assert read.placement == PLACEMENT  # the doubles to the bit
    assert np.abs(read.positions.astype(np.float64) + read.placement.offset - coordinates).max() < 1e-3
    if kind != "spz":
        assert FORMATS[kind].size(path, splats, UP, ()) == path.stat().st_size
    moved = transformed(read, np.diag([2.0, 2, 2, 1]))
    assert moved.placement is None and read.subset(np.arange(3)).placement == PLACEMENT
    FORMATS[kind].write(path, moved, UP, ())
    assert FORMATS[kind].read(path, UP).placement is None
    nowhere = replace(splats, placement=Placement(None, (0.0, 0.0, 0.0)))
    FORMATS[kind].write(path, nowhere, UP, ())
    assert FORMATS[kind].read(path, UP).placement == nowhere.placement


@pytest.mark.parametrize("comment", ["crs_offset 1 2", "crs_offset a b c", "crs_offset nan 0 0", "crs EPSG:1", "crs"])
def test_comments_of_other_programs_are_no_placement(comment, tmp_path):
    write_ply(tmp_path / "a.ply", some_splats(3))
    data = (tmp_path / "a.ply").read_bytes().replace(b"element vertex", f"comment {comment}\nelement vertex".encode())
    (tmp_path / "a.ply").write_bytes(data)
    assert read_ply(tmp_path / "a.ply").placement is None


@pytest.mark.parametrize("kind", FORMATS)
def test_a_georeferenced_file_is_in_the_measured_frame(kind, run, tiny_scene, tmp_path):
    folder, scene, splats = tmp_path / "run", tmp_path / "scene", read_ply(run / "result.ply")
    shutil.copytree(run, folder)
    shutil.copytree(tiny_scene, scene)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"scene": str(scene)}))
    out = tmp_path / f"out{FORMATS[kind].suffix}"
    options = ExportOptions(georeferenced=True, cameras=True)
    with pytest.raises(InputError, match="The scale of .* was not measured"):
        export_run(folder, kind, out, options)
    rotation = rotation_matrices(np.array([0.5, 0.5, -0.5, 0.5]))
    measured = Georeference(0.4, 0.01, "gps", "full", rotation, np.array([3.0, -4.0, -12.5]), PLACEMENT)
    write_georeference(scene, measured)
    result = export_run(folder, kind, out, options)
    read = FORMATS[kind].read(out, (0.0, -1.0, 0.0))
    wanted = splats.positions.astype(np.float64) @ measured.matrix[:3, :3].T + measured.translation
    assert np.abs(read.positions - wanted).max() < 1e-3 and read.placement == PLACEMENT
    beside = tmp_path / "out_cameras"
    written = json.loads((beside / "georeference.json").read_text())
    assert kind != "spz" or written == json.loads((tmp_path / "out.scale.json").read_text())
    rotation = np.array(written.pop("rotation"))
    assert written == PLACEMENT.to_json()
    assert str(beside / "georeference.json") in result["files"]
    model = pycolmap.Reconstruction()
    model.read_text(str(beside / "sparse" / "0"))
    view = load_scene(scene).views[0]
    image = next(image for image in model.images.values() if image.name.endswith(view.name))
    centre = measured.matrix[:3, :3] @ view.camera.centre + measured.translation
    if kind != "ply":
        centre = np.array([centre[0], centre[2], -centre[1]])  # y up
    assert np.abs(image.projection_center() - centre).max() < 1e-6
    centre = measured.matrix[:3, :3] @ view.camera.centre + measured.translation
    np.testing.assert_allclose(rotation @ image.projection_center(), centre, atol=1e-6)
    plain = export_run(folder, "ply", tmp_path / "plain.ply")
    assert plain["splats"] == len(splats)  # in metres, as the scene was measured, with its own axes
    scaled = read_ply(tmp_path / "plain.ply")
    assert np.abs(scaled.positions - 0.4 * splats.positions).max() < 1e-5 and scaled.placement is None


@pytest.mark.parametrize("more", [{"up": "y-up"}, {"metres_per_unit": 2.0}])
def test_a_georeferenced_file_has_its_own_axes_and_unit(more):
    with pytest.raises(InputError, match="in metres with z up"):
        ExportOptions(georeferenced=True, **more)


def test_baked_water_of_a_network():
    """Its water.json is a table: right where it has a range, between them close."""
    network = WaterNetwork.starting(4.0, seed=1)
    camera = Camera("only", 64, 48, 58.0, 58.0, 32.0, 24.0, np.eye(4))
    splats = some_splats(40, degree=0)
    splats.positions[:] = 0
    splats.positions[:, 2] = np.linspace(1, 11.9, 40)
    for metres, amount in ((0.0, 1.0), (2.0, 0.5)):
        baked = water.bake_water(splats, network.to_json(metres), [camera], amount, metres)
        own, seen = (0.5 + 0.28209479177387814 * each.sh[:, 0] for each in (splats, baked))
        offsets = torch.from_numpy(splats.positions)
        directions = torch.nn.functional.normalize(
            torch.randn(300, 3, generator=torch.Generator().manual_seed(5)), dim=1
        )
        around = [network.logits(length * directions).sigmoid().mean(dim=0) for length in offsets[:, 2]]
        expected = torch.from_numpy(own).clamp(min=0) * torch.stack(around)[:, :3] ** amount
        expected += amount * torch.stack(around)[:, 3:]
        np.testing.assert_allclose(seen, expected.detach().numpy(), atol=0.01)


def test_a_table_of_the_water_is_read_between_its_ranges():
    table = {"ranges": [0, 2, 6], "transmission": [[1] * 3, [0.64, 0.36, 0.16], [0.04, 0, 0]], "light": "srgb"}
    table["backscatter"] = [[0] * 3, [0.1, 0.2, 0.3], [0.5, 0.6, 0.7]]
    camera = Camera("only", 64, 48, 58.0, 58.0, 32.0, 24.0, np.eye(4))
    splats = some_splats(2, degree=0)
    splats.positions[:] = [[0, 0, 2], [0, 0, 4]]
    splats.sh[:] = 0
    seen = 0.5 + 0.28209479177387814 * water.bake_water(splats, table, [camera], 0.5).sh[:, 0]
    middle = 0.5 * np.sqrt([0.34, 0.18, 0.08]) + [0.15, 0.2, 0.25]
    np.testing.assert_allclose(seen, [[0.45, 0.4, 0.35], middle.tolist()], atol=1e-6)


def test_water_per_metre_is_the_same_water():
    splats, medium = some_splats(50), some_medium()
    camera = Camera("only", 64, 48, 58.0, 58.0, 32.0, 24.0, np.eye(4))
    camera.world_to_camera[:3, 3] = 0.3, -0.2, 5
    per_unit = water.bake_water(splats, medium.to_json(), [camera])
    per_metre = water.bake_water(splats, medium.to_json(0.5), [camera], 1.0, 0.5)
    np.testing.assert_allclose(per_metre.sh, per_unit.sh, atol=1e-4)
    with pytest.raises(InputError, match="per metre"):
        water.bake_water(splats, medium.to_json(0.5), [camera])


def test_the_camera_of_the_median_range_counts():
    """Three cameras see the splat, one looks away from close by; where none sees it, the nearest counts."""

    def camera(z, look=1.0):
        pose = np.diag([1.0, look, look, 1.0])
        pose[:3, 3] = 0, 0, z
        return Camera("c", 40, 40, 40.0, 40.0, 20.0, 20.0, np.linalg.inv(pose))

    cameras = [camera(-9), camera(-2), camera(-4), camera(-1, -1.0)]
    places = np.array([[0, 0, 0], [0, 90.0, 0]])
    np.testing.assert_allclose(water._viewpoints(places, cameras), [[0, 0, -4], [0, 0, -1]])


def test_no_water_is_the_file_as_it_is(run, tmp_path):
    export_run(run, "ply", tmp_path / "out.ply")
    assert (tmp_path / "out.ply").read_bytes() == (run / "result.ply").read_bytes()


def test_a_run_that_took_no_water_away(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "water.json").unlink()
    export_run(tmp_path / "run", "ply", tmp_path / "out.ply", ExportOptions(water=1))
    assert (tmp_path / "out.ply").read_bytes() == (run / "result.ply").read_bytes()
    with pytest.raises(InputError, match="modelled no water"):
        export_run(tmp_path / "run", "ply", tmp_path / "out.ply", ExportOptions(water=0.5))
    (tmp_path / "run" / "water.json").write_text('{"beta_D": "blue"}')
    for options in ({"water": 0.5}, {"cameras": True}):
        with pytest.raises(InputError, match="coefficients"):
            export_run(tmp_path / "run", "ply", tmp_path / "out.ply", ExportOptions(**options))


# ------------------------------------------------------------------------------------------------ axes, scale, cameras


@pytest.mark.parametrize("kind, up", [("ply", "scene"), ("ply", "y-down"), ("ply", "y-up"), ("ply", "z-up"),
                                      ("glb", "scene")])  # fmt: skip
def test_turned_splats_seen_by_the_turned_cameras_are_the_same_picture(run, tmp_path, kind, up):
    """The cameras come back through COLMAP's own reader; so does the rotation of the harmonics, through the picture."""
    out = tmp_path / f"out.{kind}"
    export_run(run, kind, out, ExportOptions(up=up, metres_per_unit=2.5, cameras=True))
    splats = read_ply(out) if kind == "ply" else read_glb(out, up=(0, 1, 0))  # as glTF says it
    scene = load_scene(RunFolder(run).read_config()[0])
    model = pycolmap.Reconstruction(str(tmp_path / "out_cameras" / "sparse" / "0"))
    assert model.num_reg_images() == len(scene.views) == 10 and model.num_points3D() == 300
    by_name = {image.name: image for image in model.images.values()}
    for view in scene.views[::3]:
        image = by_name[view.name]
        lens = model.cameras[image.camera_id]
        assert lens.model.name == "PINHOLE" and tuple(lens.params) == view.lens.params
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        fx, fy, cx, cy = lens.params
        camera = Camera(view.name, lens.width, lens.height, fx, fy, cx, cy, pose)
        # Sharp splats are widened by a third of a pixel: the same in both pictures.
        same = psnr(draw_splats(splats, camera).color, draw_splats(some_splats(), view.camera).color)
        assert same > 50, (kind, up, same)
    axis = {"y-down": (0, -1, 0), "z-up": (0, 0, 1)}.get(up, (0, 1, 0))
    if (kind, up) != ("ply", "scene"):
        direction = np.array(UP) / np.linalg.norm(UP) * 2.5
        before, after = some_splats().positions, splats.positions
        np.testing.assert_allclose((after[1:] - after[0]) @ axis, (before[1:] - before[0]) @ direction, atol=1e-5)
    np.testing.assert_allclose(
        np.prod(splats.scales, axis=1), 2.5**3 * np.prod(some_splats().scales, axis=1), rtol=1e-4
    )


def test_the_glb_holds_the_same_cameras(run, tmp_path):
    out = tmp_path / "out.glb"
    export_run(run, "glb", out, ExportOptions(metres_per_unit=2.5, cameras=True))
    data = out.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    model = pycolmap.Reconstruction(str(tmp_path / "out_cameras" / "sparse" / "0"))
    root, *nodes = document["nodes"]

    def rotation(node):
        x, y, z, w = node["rotation"]
        return rotation_matrices(np.array([w, x, y, z]))

    assert root["children"] == list(range(1, 11)) and len(document["cameras"]) == 10
    for node in nodes:
        image = next(image for image in model.images.values() if image.name == node["name"])
        place = rotation(root) @ node["translation"]
        np.testing.assert_allclose(place, image.projection_center(), atol=1e-9)
        looks = rotation(root) @ rotation(node) @ (0, 0, -1)
        np.testing.assert_allclose(looks, image.viewing_direction(), atol=1e-9)
        lens, camera = document["cameras"][node["camera"]]["perspective"], node["extras"]
        assert lens["yfov"] == pytest.approx(2 * np.arctan(camera["height"] / 2 / camera["fy"]))
        assert lens["aspectRatio"] == pytest.approx(64 / 48) and lens["znear"] > 0


def test_transforms_json_projects_to_the_same_pixels(run, tmp_path):
    export_run(run, "ply", tmp_path / "out.ply", ExportOptions(up="z-up", metres_per_unit=2.5, cameras=True))
    folder = tmp_path / "out_cameras"
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    scene = load_scene(RunFolder(run).read_config()[0])
    before, after = some_splats().positions[:50], read_ply(tmp_path / "out.ply").positions[:50]
    for frame, view in zip(frames, scene.views, strict=True):
        assert (folder / frame["file_path"]).resolve() == view.path.resolve()
        x, y, z = np.linalg.inv(frame["transform_matrix"])[:3] @ np.c_[after, np.ones(50)].T
        theirs = [frame["fl_x"] * x / -z + frame["cx"], frame["fl_y"] * -y / -z + frame["cy"]]
        seen = view.camera.K @ (view.camera.world_to_camera @ np.c_[before, np.ones(50)].T)[:3]
        np.testing.assert_allclose(theirs, seen[:2] / seen[2], atol=1e-3)


def test_lenses_and_names_come_back(tmp_path):
    camera = Camera("dive2/Öl#1.jpg", 90, 70, 50.0, 50.0, 45.0, 35.0, np.eye(4))
    lenses = {
        "SIMPLE_RADIAL": (51.5, 45.1, 35.2, -0.1),
        "OPENCV": (51.25, 52.5, 45.1, 35.2, -0.1, 0.02, 1e-3, -2e-3),
        "OPENCV_FISHEYE": (51.25, 52.5, 45.1, 35.2, 0.1, 0.2, 0.3, 0.4),
        "FULL_OPENCV": (51.25, 52.5, 45.1, 35.2, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
    }
    photographs = [
        PosedImage(Camera(f"{i}", 90, 70, 50.0, 50.0, 45.0, 35.0, np.eye(4)), model, 100, 80, params, "x.jpg")
        for i, (model, params) in enumerate(lenses.items())
    ]
    none = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    files, notes = write_cameras(tmp_path / "all", photographs, *none)
    assert "FULL_OPENCV" in notes[0] and not (tmp_path / "all" / "transforms.json").exists()
    model = pycolmap.Reconstruction(str(tmp_path / "all" / "sparse" / "0"))
    assert {c.model.name: tuple(c.params) for c in model.cameras.values()} == lenses
    files, notes = write_cameras(tmp_path / "some", photographs[:3], *none)
    frames = json.loads((tmp_path / "some" / "transforms.json").read_text())["frames"]
    assert not notes and len(files) == 4
    assert [frame["camera_model"] for frame in frames] == ["OPENCV", "OPENCV", "OPENCV_FISHEYE"]
    assert (frames[0]["fl_x"], frames[0]["fl_y"], frames[0]["k1"], frames[0]["p2"]) == (51.5, 51.5, -0.1, 0.0)
    assert (frames[2]["k4"], frames[2]["w"]) == (0.4, 100)
    write_cameras(tmp_path / "named", [PosedImage.from_camera(camera)], *none)
    images = pycolmap.Reconstruction(str(tmp_path / "named" / "sparse" / "0")).images
    assert [image.name for image in images.values()] == [camera.name]
    spaced = PosedImage.from_camera(Camera("dive 2.jpg", 90, 70, 50.0, 50.0, 45.0, 35.0, np.eye(4)))
    assert "dive 2.jpg" in write_cameras(tmp_path / "spaced", [spaced], *none)[1][0]
    for name in ("", "two\nlines"):
        odd = PosedImage.from_camera(Camera(name, 9, 7, 5.0, 5.0, 4.0, 3.0, np.eye(4)))
        with pytest.raises(InputError, match="rename"):
            write_cameras(tmp_path / "odd", [odd], *none)


def test_water_json_fits_the_file(run, tmp_path):
    """Light from the same place through the same length: the coefficients follow scale and axes."""
    export_run(run, "ply", tmp_path / "out.ply", ExportOptions(up="z-up", metres_per_unit=2.5, cameras=True))
    ours = json.loads((tmp_path / "out_cameras" / "water.json").read_text())
    before = json.loads((run / "water.json").read_text())
    assert ours["per"] == "metre" and before["per"] == "unit"
    np.testing.assert_allclose(np.array(ours["beta_D"]) * 2.5, before["beta_D"])
    a, b = some_splats().positions.astype(float), read_ply(tmp_path / "out.ply").positions.astype(float)
    steps = [(p[1:] - p[0]) / np.linalg.norm(p[1:] - p[0], axis=1, keepdims=True) for p in (a, b)]
    lights = [sh_basis(step, 2) @ np.array(w["background_sh"]) for step, w in zip(steps, (before, ours), strict=True)]
    np.testing.assert_allclose(lights[1], lights[0], atol=1e-4)
    network = WaterNetwork.starting(4.0, seed=1)
    table = water.transform_water(network.to_json(0.5), np.eye(3), 2.0, 0.5, False)
    np.testing.assert_allclose(table["ranges"], 2 * np.array(network.to_json()["ranges"]), atol=1e-5)
    np.testing.assert_allclose(np.array(table["beta_D"]) * 2, network.to_json()["beta_D"], atol=1e-5)
    assert table["per"] == "unit" and table["transmission"] == network.to_json()["transmission"]


def test_moved_cameras_keep_their_pixels():
    turn = np.eye(4)
    turn[:3, :3] = 3 * rotation_matrices(np.array([0.5, 0.5, -0.5, 0.5]))
    turn[:3, 3] = 1, 2, 3
    camera = Camera("c", 40, 30, 35.0, 36.0, 19.0, 16.0, np.linalg.inv(turn @ np.diag([1 / 3, 1 / 3, 1 / 3, 1])))
    point = np.array([0.2, 0.4, 9.0, 1.0])
    after = transform_camera(camera, turn)
    pixels = [c.K @ (c.world_to_camera @ p)[:3] for c, p in ((camera, point), (after, turn @ point))]
    np.testing.assert_allclose(pixels[0][:2] / pixels[0][2], pixels[1][:2] / pixels[1][2])


def test_an_upright_box_is_between_its_corners():
    corners = np.array([[-1.0, 2, 5, 1], [3, 4, 9, 1]]) @ box_between((-1, 2, 5), (3, 4, 9)).T
    np.testing.assert_allclose(corners, [[-1, -1, -1, 1], [1, 1, 1, 1]])
