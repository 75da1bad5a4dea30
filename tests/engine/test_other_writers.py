"""Models and camera files as other programs, editors and hands write them."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.camera_files.import_cameras import import_cameras
from swag_engine.camera_files.registry import read_camera_file
from swag_engine.scene.colmap import load_scene, read_model
from swag_engine.scene.inspect import inspect_scene
from tests.engine.test_camera_files import (
    NAMES,
    PLACES,
    POSES,
    panel_points,
    panel_transforms,
    scan_csv,
    write_bundler,
    write_ply,
)
from tests.scenes.dots import dot_positions, make_dot_scene
from tests.scenes.panels import write_photos

NO_OBSERVATIONS = re.compile(r"(?m)^(?!#)((?:\S+ ){9}.*)\n.*$")
WRITINGS = {
    "no empty last line": lambda text: NO_OBSERVATIONS.sub(r"\1\n", text).rstrip() + "\n",
    "no lines of observations": lambda text: NO_OBSERVATIONS.sub(r"\1", text),
    "comments": lambda text: re.sub(r"(?m)^(?!#)(.*)$", r"\1\n# by hand\n  # again", text),
    "blank lines": lambda text: text.replace("\n", "\n\n"),
    "CRLF and spaces": lambda text: text.replace("\n", "  \r\n"),
    "a mark": lambda text: "\ufeff" + re.sub(r"(?m)^#.*\n", "", text),
}


@pytest.mark.parametrize("writing", WRITINGS)
@pytest.mark.parametrize("classic", [False, True])
def test_text_models_of_other_writers(tmp_path: Path, writing: str, classic: bool) -> None:
    true = load_scene(make_dot_scene(tmp_path / "true", name="a b {:02d}.png"))
    folder = make_dot_scene(tmp_path / "written", text=True, name="a b {:02d}.png")
    for path in (folder / "sparse" / "0").iterdir():
        if classic and path.stem in ("rigs", "frames"):
            path.unlink()
        elif path.stem == "images" or "observations" not in writing and "last" not in writing:
            path.write_bytes(WRITINGS[writing](path.read_text()).encode())
    scene = load_scene(folder)
    assert [view.name for view in scene.views] == [view.name for view in true.views]
    assert np.allclose(scene.points.positions, true.points.positions)
    for view, other in zip(scene.views, true.views, strict=True):
        assert np.allclose(view.camera.world_to_camera, other.camera.world_to_camera)
        assert view.point_indices.tolist() in ([], other.point_indices.tolist())
        assert ("observations" in writing or "last" in writing) == (len(view.point_indices) == 0)
    assert read_model(scene).num_reg_images() == 4 and inspect_scene(scene)["points"] == 60


@pytest.mark.parametrize(
    ("part", "line", "text", "reason"),
    [
        ("images", 1, "1 1 0 0 0 0 0 3 a.png", "a photo needs"),
        ("images", 1, "10 20 5", "belong to no photo"),
        ("images", 3, "1 1 0 0 0 0 0 3 1 again.png", "line above"),
        ("images", 3, "2 0.9 0.1 0 0 0.5 0.1 3 1", "not a whole number"),
        ("images", 2, "10 20 5 10 20", "x, y and the id"),
        ("images", 1, "one 1 0 0 0 0 0 3 1 a.png", "one"),
        ("cameras", 1, "1 PINHOLE 200 150 150 100 75", "4 parameters, not 3"),
        ("cameras", 1, "1 PINEHOLE 200 150 150 100 75", "PINEHOLE"),
        ("points3D", 2, "7 0 0", "cannot be read"),
    ],
)
def test_unclear_lines_of_text_models_are_refused_with_their_number(
    tmp_path: Path, part: str, line: int, text: str, reason: str
) -> None:
    path = make_dot_scene(tmp_path, text=True) / "sparse" / "0" / f"{part}.txt"
    lines = [row for row in path.read_text().splitlines() if not row.startswith("#")]
    path.write_text("\n".join([*lines[: line - 1], text, *lines[line:]]))
    with pytest.raises(InputError, match=rf"{part}\.txt, line {line}, .*{reason}"):
        load_scene(tmp_path)


@pytest.mark.parametrize("by_basename", [False, True])
def test_converted_photos_are_taken_by_name_where_unique(tmp_path: Path, by_basename: bool) -> None:
    make_dot_scene(tmp_path, name="dive/G{:04d}.JPG")
    images = tmp_path / "images"
    for path in (images / "dive").iterdir():
        if not path.name.startswith("G0001"):
            path.rename((images if by_basename else images / "dive") / path.with_suffix(".png").name)
    if by_basename:
        (images / "dive" / "G0001.JPG").unlink()
    other = next(images.rglob("G0004.png"))
    other.with_suffix(".tif").write_bytes(other.read_bytes())
    scene = load_scene(tmp_path)
    suffixes = {view.name: view.path.suffix for view in scene.views}
    expected = {f"dive/G{number:04d}.JPG": ".png" for number in (2, 3)}
    assert suffixes == expected | ({} if by_basename else {"dive/G0001.JPG": ".JPG"})
    assert "dive/G0004.JPG" in scene.missing
    assert any("G0002.png for dive/G0002.JPG" in warning for warning in scene.warnings)


@pytest.mark.parametrize("place", ["sparse/0/points3D.ply", "sparse/points.ply"])
@pytest.mark.parametrize(("text", "kept"), [(False, False), (False, True), (True, False), (True, True)])
def test_points_of_a_ply_beside_the_model(tmp_path: Path, text: bool, place: str, kept: bool) -> None:
    model = make_dot_scene(tmp_path, text=text) / "sparse" / "0"
    points = model / f"points3D.{'txt' if text else 'bin'}"
    points.write_bytes(b"" if text else bytes(8)) if kept else points.unlink()
    positions = dot_positions()[:50].astype(np.float32)
    write_ply(tmp_path / place, positions)
    scene = load_scene(tmp_path)
    assert np.array_equal(scene.points.positions, positions) and place in scene.warnings[0]
    assert inspect_scene(scene)["points"] == 50
    write_ply(tmp_path / place, positions - [0, 0, 90])
    with pytest.raises(InputError, match="0% of the points of .*remove the file"):
        load_scene(tmp_path)


def test_the_command_that_finds_points_for_known_poses(tmp_path: Path) -> None:
    write_photos(tmp_path / "dive" / "images", PLACES)
    file, ply = panel_transforms(tmp_path / "dive" / "transforms.json"), write_ply(tmp_path / "a.ply", panel_points())
    import_cameras(file, tmp_path / "scene", points=ply)
    model = tmp_path / "scene" / "sparse" / "0"
    true = {view.name: view.camera.world_to_camera for view in load_scene(tmp_path / "scene").views}
    (model / "points3D.bin").write_bytes(bytes(8))
    with pytest.raises(InputError, match="has no points: find points in the photos") as caught:
        load_scene(tmp_path / "scene")
    words = shlex.split(str(caught.value).split("`")[1])
    assert words[:3] == ["python", "-m", "swag_engine"] and main(words[3:]) == 0
    found = load_scene(Path(words[-1]))
    assert len(found.points.positions) > 100 and {view.name for view in found.views} == set(true)
    assert all(np.allclose(view.camera.world_to_camera, true[view.name], atol=1e-9) for view in found.views)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ([0.0, 150, 100, 75], "focal length is 0 pixels"),
        ([150, -150, 100, 75], "focal length is -150 pixels"),
        ([np.nan, 150, 100, 75], "not a finite number"),
        ([150, 150, 900, 75], r"principal point \(900, 75\) is far outside its 200 x 150"),
    ],
)
def test_impossible_cameras_are_named(tmp_path: Path, text: bool, params: list[float], reason: str) -> None:
    camera = pycolmap.Camera(model="PINHOLE", width=200, height=150, params=[150, 150, 100, 75])
    folder = make_dot_scene(tmp_path, camera, text=text)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    model.camera(1).params = params
    (model.write_text if text else model.write_binary)(str(folder / "sparse" / "0"))
    with pytest.raises(InputError, match=rf"Camera 1 .*view_01\.png.*{reason}"):
        load_scene(folder)
    with pytest.raises(InputError, match=rf"view_01\.png: .*{reason}"):
        read_camera_file(folder / "sparse" / "0")


@pytest.mark.parametrize("text", [False, True])
def test_quaternions_rounded_by_hand_are_normalised_and_zero_ones_refused(tmp_path: Path, text: bool) -> None:
    folder = make_dot_scene(tmp_path, text=True)
    path = folder / "sparse" / "0" / "images.txt"
    for name in ("rigs.txt", "frames.txt"):
        (path.parent / name).unlink()
    written = path.read_text()

    def rotation(values: str) -> None:
        path.write_text(re.sub(r"(?m)^2 \S+ \S+ \S+ \S+", f"2 {values}", written))
        if not text:
            model = pycolmap.Reconstruction()
            model.read_text(str(path.parent))
            model.write_binary(str(path.parent))

    rotation("0.72 0 0.68 0")
    scene = load_scene(folder)
    expected = np.array([0.0571, 0, 0.9984])
    assert np.allclose(scene.views[1].camera.world_to_camera[0, :3], expected, atol=1e-4)
    assert np.allclose(read_model(scene).image(2).cam_from_world().matrix()[0, :3], expected, atol=1e-4)
    rotation("0 0 0 0")
    with pytest.raises(InputError, match=r"rotation of view_02\.png .* zero"):
        load_scene(folder)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"fl_x": 0.0}, "focal length is 0"),
        ({"fl_x": -900.0}, "focal length is -900"),
        ({"fl_x": float("inf")}, "not finite"),
        ({"cx": 9000.0}, "principal point"),
        ({"w": 0}, "0 x 1200"),
    ],
)
def test_impossible_numbers_in_transforms(tmp_path: Path, values: dict[str, float], reason: str) -> None:
    good = {"w": 1600, "h": 1200, "fl_x": 900.0, "fl_y": 900.0}
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in ("a.png", "b.png")]
    frames[1] |= values
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(good | {"frames": frames}))
    with pytest.raises(InputError, match=rf"b\.png.*{reason}"):
        read_camera_file(path)


def test_bundler_lists_and_numbers(tmp_path: Path) -> None:
    file = write_bundler(tmp_path)
    names = [f"C:/my dives/{name}" for name in [*NAMES, "unposed.jpg"]]
    (tmp_path / "notes.txt").write_text("one\n" * len(names))
    for path in tmp_path.glob("*list*"):
        path.unlink()
    (tmp_path / "imagelist.lst").write_text("".join(f"{name} 0 2345.6\r\n" for name in names).replace("/", "\\"))
    read = read_camera_file(file)
    assert [camera.name for camera in read.cameras] == names[:5]
    (tmp_path / "other.txt").write_text("".join(f"other {name}\n" for name in names))
    with pytest.raises(InputError, match="several lists of its 6 images"):
        read_camera_file(file)
    (tmp_path / "other.txt").unlink()
    lines = file.read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if number > 1 and len(line.split()) == 3)
    lines[first] = " ".join(["-1", *lines[first].split()[1:]])
    file.write_text("\n".join(lines))
    with pytest.raises(InputError, match="my dives/dive/IMG_0000.JPG.*focal length is -1"):
        read_camera_file(file)


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_camera_tables_of_spreadsheets(tmp_path: Path, separator: str, encoding: str) -> None:
    path = scan_csv(tmp_path / "cameras.csv")
    text = path.read_text()
    path.write_text(text.replace(",", separator).replace(".", ",").replace(",JPG", ".JPG"), encoding=encoding)
    read = read_camera_file(path)
    assert [camera.name for camera in read.cameras] == NAMES
    assert all(np.allclose(c.world_to_camera, p, atol=1e-6) for c, p in zip(read.cameras, POSES, strict=True))
    path.write_text(text.replace("0.", "0,"))
    with pytest.raises(InputError, match=r"cameras\.csv, line \d: .*cells.*semicolons"):
        read_camera_file(path)


@pytest.mark.parametrize(
    ("part", "old", "new", "said"),
    [
        ("cameras", " 57.6 57.6 ", " 1e30 1e30 ", "times the image"),
        ("images", "4.0 1 view_03.png", "1e12 1 view_03.png", "view_03.png more than 1e"),
    ],
)
def test_numbers_that_are_finite_but_impossible_are_refused(tiny_scene, tmp_path, part, old, new, said):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    path = scene / "sparse" / "0" / f"{part}.txt"
    assert old in (text := path.read_text())
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=said):
        load_scene(scene)


@pytest.mark.parametrize("line", ["9999 1 2 3 1 2", "9999 1 2 3 1 2 300 0.5", "9999 1 2 3 red 0 0 0"])
def test_a_line_of_a_point_that_cannot_be_read_is_named_in_words(tiny_scene, tmp_path, line):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    with open(scene / "sparse" / "0" / "points3D.txt", "a") as file:
        file.write(line + "\n")
    with pytest.raises(InputError, match=r"line 301, cannot be read \((a color is|a point needs)"):
        load_scene(scene)


def test_a_link_to_a_folder_around_the_photos_is_not_followed(tiny_scene, tmp_path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    (scene / "images" / "all").symlink_to("/")
    assert load_scene(scene).image_count == 10
