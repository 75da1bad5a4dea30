import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.georeference.measure import Measurements, describe, measure, scale_scene
from swag_engine.georeference.positions import _degrees, read_gps
from swag_engine.georeference.sheet import Sheet, draw_pages, write_sheet
from swag_engine.georeference.targets import detect
from swag_engine.scene.colmap import load_scene, up_direction
from swag_engine.scene.colmap_library import pycolmap
from swag_engine.scene.georeference import Georeference, Placement, read_georeference, write_georeference
from swag_engine.scene.inspect import describe as describe_scene
from swag_engine.scene.inspect import inspect_scene
from tests.scenes.targets import TargetScene, make_target_scene, ring, target_corners

FAMILY = "aruco_4x4_50"


@pytest.fixture(scope="module")
def photographed(tmp_path_factory) -> TargetScene:
    """Four targets of 0.15 m, photographed in dim water."""
    return make_target_scene(tmp_path_factory.mktemp("targets") / "Tauchgang ü")


@pytest.fixture
def plain(tmp_path) -> TargetScene:
    """The same cameras with photos that show nothing."""
    return make_target_scene(tmp_path / "scene", centres=ring(12), draw=False)


def measured(made: TargetScene, **known) -> Georeference:
    return measure(load_scene(made.folder), Measurements(**known))


def in_scene(made: TargetScene, metres: np.ndarray) -> np.ndarray:
    return (metres - made.translation) @ made.rotation / made.metres_per_unit


def angle(first: np.ndarray, second: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, first @ second)))


def true_up(made: TargetScene) -> np.ndarray:
    """Metres' z axis in the scene's coordinates."""
    return made.rotation.T @ (0, 0, 1)


# Targets --------------------------------------------------------------------------------------------------------------


def test_targets_give_the_scale(photographed):
    found = measured(photographed, targets=FAMILY, size=0.15)
    assert found.metres_per_unit == pytest.approx(photographed.metres_per_unit, rel=2e-3)
    assert 1e-4 < found.error < 5e-3 and found.method == "targets" and found.axes == "estimated"
    assert sorted(found.residuals) == ["target 0", "target 11", "target 3", "target 7"] and not found.notes
    assert found.placement is None and angle(found.up, true_up(photographed)) < 10


def test_distances_between_targets_give_the_scale(photographed):
    corners = photographed.corners
    true = np.linalg.norm(corners[3].mean(0) - corners[11].mean(0))
    found = measured(photographed, targets=FAMILY, distances=(f"3,11={true}",))
    assert found.metres_per_unit == pytest.approx(photographed.metres_per_unit, rel=2e-3)
    with pytest.raises(InputError, match="Target 5 of the distance 3,5 cannot be used: .* targets 0, 3, 7, 11"):
        measured(photographed, targets=FAMILY, distances=("3,5=1",))


def test_a_distorted_lens_another_family_and_a_wrong_target(tmp_path):
    corners = target_corners(0.2, (1, 2, 30))
    corners[30] = corners[30].mean(0) + 0.8 * (corners[30] - corners[30].mean(0))
    made = make_target_scene(
        tmp_path / "scene", cv2.aruco.DICT_APRILTAG_36h11, corners, ring(5), metres_per_unit=2.5, distortion=-0.2
    )
    found = measured(made, targets="apriltag_36h11", size=0.2)
    assert found.metres_per_unit == pytest.approx(2.5, rel=3e-3)
    assert "Target 30 is 20% shorter in the photos than 0.2 m" in found.notes[0]
    assert found.residuals["target 30"] == pytest.approx(-0.04, abs=2e-3)


def test_one_target_states_an_error(tmp_path):
    made = make_target_scene(tmp_path / "scene", corners=target_corners(0.15, (7,)), centres=ring(3))
    found = measured(made, targets=FAMILY, size=0.15)
    assert abs(found.metres_per_unit / made.metres_per_unit - 1) < max(3 * found.error, 5e-3)
    assert 1e-3 < found.error < 0.02


def test_two_targets_that_contradict_each_other_are_refused(tmp_path):
    corners = target_corners(0.15, (0, 1))
    corners[1] = corners[1].mean(0) + 0.7 * (corners[1] - corners[1].mean(0))
    made = make_target_scene(tmp_path / "scene", corners=corners, centres=ring(3))
    with pytest.raises(InputError, match="The target 0 says 0.37.* and the target 1 0.5.*: check their true lengths"):
        measured(made, targets=FAMILY, size=0.15)


def test_targets_that_cannot_be_used_are_named(tmp_path, plain):
    with pytest.raises(InputError, match="No target of the family aruco_4x4_50 was found in the 12 photos"):
        measured(plain, targets=FAMILY, size=0.15)
    corners = target_corners(0.15, (0, 1, 2))
    made = make_target_scene(tmp_path / "moved", corners=corners, centres=ring(4))
    other = make_target_scene(tmp_path / "other", corners=corners | {2: corners[2] + (0.3, 0.2, 0)}, centres=ring(4))
    for name in list(made.centres)[:2]:
        (made.folder / "images" / name).write_bytes((other.folder / "images" / name).read_bytes())
    name = list(made.centres)[3]
    picture = cv2.imread(str(made.folder / "images" / name))
    seen = np.stack([made.project(name, corner) for corner in corners[1]])
    left, top = seen.min(0).astype(int) - 12
    right, bottom = seen.max(0).astype(int) + 12
    picture[20 : 20 + bottom - top, 20 : 20 + right - left] = picture[top:bottom, left:right]
    cv2.imwrite(str(made.folder / "images" / name), picture)
    notes = measured(made, targets=FAMILY, size=0.15).notes
    assert f"Target 1 appears twice in {name} and is not used there." in notes


# GPS and depths -------------------------------------------------------------------------------------------------------


def write_gps(
    made: TargetScene, noise: float = 0.0, altitudes: bool = True, wrong: int = 0, scale: float = 10
) -> dict[str, np.ndarray]:
    """Write GPS tags near 59 degrees north to the photos; return UTM coordinates of the cameras."""
    random = np.random.default_rng(2)
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    places = {}
    for index, (name, centre) in enumerate(made.centres.items()):
        places[name] = np.array([500_321.25, 6_540_052.5, -20.0]) + scale * centre
        told = places[name] + random.normal(0, noise, 3) + (40.0 if index < wrong else 0.0)
        latitude, longitude, altitude = transform.utm_to_ellipsoid(told[None], 33, True)[0]
        exif = Image.Exif()
        tags = exif.get_ifd(ExifTags.IFD.GPSInfo)
        tags[ExifTags.GPS.GPSLatitude], tags[ExifTags.GPS.GPSLatitudeRef] = sexagesimal(latitude), "N"
        tags[ExifTags.GPS.GPSLongitude], tags[ExifTags.GPS.GPSLongitudeRef] = sexagesimal(longitude), "E"
        if altitudes:
            tags[ExifTags.GPS.GPSAltitude], tags[ExifTags.GPS.GPSAltitudeRef] = abs(altitude), b"\1"
        path = made.folder / "images" / name
        with Image.open(path) as image:
            image.load()
            image.save(path, exif=exif.tobytes())
    return places


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    minutes = 60 * (degrees % 1)
    return (float(int(degrees)), float(int(minutes)), round(60 * (minutes % 1), 6))


def test_gps_places_the_scene_on_the_earth(plain):
    places = write_gps(plain, noise=0.05, wrong=2)
    found = measured(plain, gps=True)
    assert found.metres_per_unit == pytest.approx(10 * plain.metres_per_unit, rel=0.01)
    assert abs(found.metres_per_unit / (10 * plain.metres_per_unit) - 1) < 4 * found.error < 0.03
    assert found.axes == "full" and angle(found.up, true_up(plain)) < 1
    assert found.placement.crs == "EPSG:32633" and found.placement.offset[2] == 0
    assert "2 of 12 GPS positions contradict the others and were left out: photo_00.png, photo_01.png." in found.notes
    for view in load_scene(plain.folder).views:
        at = found.matrix[:3, :3] @ view.camera.centre + found.matrix[:3, 3] + found.placement.offset
        assert np.linalg.norm(at - places[view.name]) < 0.15


def test_a_straight_path_does_not_give_the_roll(tmp_path):
    line = {f"{i}.png": np.array([0.3 * i - 1.5, 0.001 * i, 2.0]) for i in range(10)}
    made = make_target_scene(tmp_path / "scene", centres=line, draw=False)
    write_gps(made, noise=0.05)
    found = measured(made, gps=True)
    assert found.axes == "estimated" and "up direction was estimated" in found.notes[0]
    assert angle(found.up, true_up(made)) < 15 and found.metres_per_unit == pytest.approx(3.7, rel=0.02)


def test_depths_take_the_place_of_altitudes(plain, tmp_path):
    places = write_gps(plain, altitudes=False)
    with pytest.raises(InputError, match="12 photos have a GPS position without an altitude.*--depths"):
        measured(plain, gps=True)
    table = tmp_path / "depths.csv"
    table.write_text("name;depth\n" + "".join(f"{n};{-p[2]:.3f}\n".replace(".", ",", 2) for n, p in places.items()))
    table.write_text(table.read_text().replace(",png", ".png"))
    found = measured(plain, gps=True, depths=table)
    assert found.metres_per_unit == pytest.approx(3.7, rel=1e-3) and found.axes == "full"


def test_targets_give_the_scale_and_gps_the_place(photographed, tmp_path):
    made = replace(photographed, folder=tmp_path / "scene")
    shutil.copytree(photographed.folder, made.folder)
    write_gps(made, scale=1.05)
    found = measured(made, targets=FAMILY, size=0.15, gps=True)
    assert found.metres_per_unit == pytest.approx(0.37, rel=2e-3) and found.method == "targets"
    assert found.axes == "full" and found.placement.crs == "EPSG:32633"
    assert [note[:28] for note in found.notes] == ["The GPS positions say 0.3885"]


def photo_with_gps(path: Path, tags: dict) -> Path:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(tags)
    Image.new("RGB", (8, 8)).save(path, exif=exif.tobytes())
    return path


def test_photos_without_a_usable_position(plain, tmp_path):
    assert read_gps(photo_with_gps(tmp_path / "a.jpg", {})) is None
    assert read_gps(photo_with_gps(tmp_path / "a.jpg", {2: (1.0, 0.0, 0.0)})) is None
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:100])
    assert read_gps(tmp_path / "b.jpg") is None
    with pytest.raises(InputError, match="0 of the 12 photos have a GPS position"):
        measured(plain, gps=True)


NONE = IFDRational(0, 0)
SYDNEY = {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (151.0, 0.0, 0.0), 5: b"\1", 6: 12.5}


@pytest.mark.parametrize(
    "tags, latitude, altitude",
    [
        ({}, -33.51, -12.5),
        ({1: "s", 3: "w"}, -33.51, -12.5),
        ({1: "n"}, 33.51, -12.5),
        ({1: "North"}, 33.51, -12.5),
        ({2: (33.51,)}, -33.51, -12.5),
        ({2: (33.0, 30.6)}, -33.51, -12.5),
        ({2: (IFDRational(3351, 100), NONE, NONE)}, -33.51, -12.5),
        ({2: (33.0, 30.6, NONE)}, -33.51, -12.5),
        ({5: b"\0"}, -33.51, 12.5),
        ({5: None}, -33.51, 12.5),
        ({5: b"\3"}, -33.51, -12.5),
        ({6: NONE}, -33.51, None),
        ({6: IFDRational(1, 0)}, -33.51, None),
    ],
)
def test_altitude_and_hemisphere(tmp_path, tags, latitude, altitude):
    given = {key: value for key, value in (SYDNEY | tags).items() if value is not None}
    assert read_gps(photo_with_gps(tmp_path / "a.jpg", given)) == (pytest.approx(latitude), -151.0, altitude)


def test_signs_of_degrees_without_a_reference():
    assert _degrees((-33.0, 30.0, 36.0), None, "NS") == pytest.approx(-33.51) == _degrees("-33.51", b"N\0", "NS")


@pytest.mark.parametrize(
    "tags, reason",
    [
        ({1: None}, "the reference N or S is missing"),
        ({3: ""}, "the reference E or W is missing"),
        ({2: (33.0, 30.0, NONE)}, "they are not degrees, minutes and seconds"),
        ({2: (33.0, 70.0, 0.0)}, "they are not degrees, minutes and seconds"),
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, "latitude and longitude are 0"),
        ({2: (95.0, 0.0, 0.0)}, "they are beyond 84 degrees"),
    ],
)
def test_gps_that_cannot_be_used_is_named(plain, tags, reason):
    write_gps(plain)
    given = {key: value for key, value in (SYDNEY | tags).items() if value is not None}
    photo_with_gps(plain.folder / "images" / "photo_03.png", given)
    (note,) = [note for note in measured(plain, gps=True).notes if "are not used" in note]
    assert note.startswith(f"GPS positions of 1 of 12 photos are not used, as {reason}") and note.endswith(
        ": photo_03.png."
    )


def depth_table(path: Path, made: TargetScene, noise: float = 0.0) -> Path:
    random = np.random.default_rng(4)
    rows = [f"{name},{8 - centre[2] + random.normal(0, noise):.4f}" for name, centre in made.centres.items()]
    path.write_text("name,depth\n" + "\n".join(rows) + "\nother.png,3\n")
    return path


def test_depths_give_scale_and_up(tmp_path):
    random = np.random.default_rng(1)
    centres = {f"{i}.png": random.uniform((-2, -2, 0.5), (2, 2, 4)) for i in range(15)}
    made = make_target_scene(tmp_path / "scene", centres=centres, draw=False)
    found = measured(made, depths=depth_table(tmp_path / "depths.csv", made, 0.02))
    assert found.axes == "up" and angle(found.up, true_up(made)) < 2
    assert abs(found.metres_per_unit / 0.37 - 1) < 4 * found.error < 0.1
    view = load_scene(made.folder).views[0]
    height = (found.matrix[:3, :3] @ view.camera.centre + found.matrix[:3, 3])[2]
    assert height == pytest.approx(made.centres[view.name][2] - 8, abs=0.1)  # 0 is the surface


def test_equal_depths_do_not_give_the_scale(tmp_path):
    grid = {f"{i}.png": np.array([i % 4, i // 4, 2.0 + 0.01 * (i % 2)]) for i in range(12)}
    made = make_target_scene(tmp_path / "scene", centres=grid, draw=False)
    with pytest.raises(InputError, match="The depths do not give the scale, as they vary by 0.01 m only"):
        measured(made, depths=depth_table(tmp_path / "depths.csv", made))


# Reference points -----------------------------------------------------------------------------------------------------

FAR = np.array([412_345.678, 6_123_456.789, -31.25])
"""UTM coordinates of the middle of the scene."""


def point_table(path: Path, made: TargetScene, places: dict[str, np.ndarray], noise: float = 0.3) -> Path:
    """Write points with their pixels in three photos; `places` in metres."""
    random = np.random.default_rng(8)
    rows = ["Name,X,Y,Z,Photo,U,V", "# measured with a tape"]
    for name, place in places.items():
        for photo in list(made.centres)[::3]:
            u, v = made.project(photo, place) + random.normal(0, noise, 2)
            rows.append(f"{name},{','.join(f'{value:.4f}' for value in place + FAR)},{photo},{u:.2f},{v:.2f}")
    path.write_text("\n".join(rows))
    return path


PLACES = {
    "A": np.array([-1.0, -0.8, 0.0]), "B": np.array([1.1, -0.6, 0.2]), "C": np.array([0.9, 0.9, 0.1]),
    "D": np.array([-0.8, 1.0, 0.5]), "E": np.array([0.0, 0.1, 0.9]),
}  # fmt: skip


def test_reference_points_keep_millimetres_of_large_coordinates(plain, tmp_path):
    found = measured(plain, points=point_table(tmp_path / "points.csv", plain, PLACES, noise=0), crs="EPSG:32631")
    assert found.metres_per_unit == pytest.approx(0.37, rel=1e-4) and found.axes == "full" and not found.notes
    assert found.placement.crs == "EPSG:32631" and all(value == round(value) for value in found.placement.offset)
    write_georeference(plain.folder, found)
    read = read_georeference(plain.folder)
    for place in PLACES.values():
        local = read.matrix[:3, :3] @ in_scene(plain, place) + read.matrix[:3, 3]
        assert np.abs(local).max() < 50  # as float32 the local frame keeps micrometres
        assert np.abs(local.astype(np.float32) + np.array(read.placement.offset) - (place + FAR)).max() < 1e-3


def test_the_error_of_reference_points_is_that_of_leaving_one_out(plain, tmp_path):
    found = measured(plain, points=point_table(tmp_path / "points.csv", plain, PLACES, noise=2))
    assert abs(found.metres_per_unit / 0.37 - 1) < 4 * found.error < 0.1
    assert sorted(found.residuals) == list("ABCDE") and max(found.residuals.values()) < 0.05
    exact = measured(plain, points=point_table(tmp_path / "points.csv", plain, PLACES, noise=0.1))
    assert exact.error < found.error / 4


def test_two_reference_points_give_scale_but_no_error(plain, tmp_path):
    places = {name: PLACES[name] for name in "AC"}
    found = measured(plain, points=point_table(tmp_path / "points.csv", plain, places))
    assert found.metres_per_unit == pytest.approx(0.37, rel=0.01) and found.error is None
    assert found.axes == "estimated" and "a third one" in found.notes[-1]


def test_targets_and_photos_are_reference_points(photographed, tmp_path):
    rows = [f"{number}\t" + "\t".join(f"{v:.5f}" for v in c.mean(0)) for number, c in photographed.corners.items()]
    rows += [f"{name}\t" + "\t".join(f"{v:.5f}" for v in c) for name, c in list(photographed.centres.items())[:2]]
    (tmp_path / "points.csv").write_text("name\tx\ty\tz\n" + "\n".join(rows) + "\nlost\t1\t2\t3")
    found = measured(photographed, targets=FAMILY, points=tmp_path / "points.csv")
    assert found.metres_per_unit == pytest.approx(0.37, rel=1e-3) and found.method == "points"
    assert found.notes == ("The point lost has no pixels, and is neither a target that was found nor a photo with a "
                           "camera.",)  # fmt: skip
    assert found.placement is None and angle(found.up, true_up(photographed)) < 0.5


def test_geographic_reference_points_become_utm(plain, tmp_path):
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    path = point_table(tmp_path / "points.csv", plain, PLACES, noise=0)
    lines = path.read_text().splitlines()
    for index, line in enumerate(lines[2:], start=2):
        name, *xyz, photo, u, v = line.split(",")
        place = np.array([[float(value) for value in xyz]])
        latitude, longitude, height = transform.utm_to_ellipsoid(place, 31, True)[0]
        lines[index] = f"{name},{longitude:.12f},{latitude:.12f},{height:.4f},{photo},{u},{v}"
    path.write_text("\n".join(lines))
    found = measured(plain, points=path, crs="EPSG:4326")
    assert found.placement.crs == "EPSG:32631" and found.metres_per_unit == pytest.approx(0.37, rel=1e-4)


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "is empty: it needs a first line with the columns name, x, y, z"),
        ("name,x,y\nA,1,2", "has no column z"),
        ("name,x,y,z", "has no rows"),
        ("name,x,y,z\nA,1,2,drei", "line 2: z is 'drei', which is not a number"),
        ("name,x,y,z\nA,1,2,nan", "line 2: z is 'nan'"),
        ("name,x,y,z\nA,1,2", "line 2: z is ''"),
        ("name,x,y,z\n,1,2,3", "line 2: the point has no name"),
        ("name,x,y,z\nA,1,2,3\n\nA,1,2,4", "line 4: the point A has other coordinates"),
        ("name,x,y,z,photo,u,v\nA,1,2,3,photo_00.png,1,2", "0 of the 1 points .* seen in one photo alone"),
        ("name,x,y,z,photo,u,v\nA,1,2,3,no.png,1,2", "no.png, where the point A is seen, has no camera"),
        ('name,x,y,z\n"A,1,2,3\nB,1,2,3\n', "quotation marks"),
        (b"name,x,y,z\n\xff\xfe,1,2,3", "is not a text in UTF-8"),
        ("name,x,y,z\nphoto_00.png,1,2,3\nphoto_01.png,1,2,3", "All reference points are at one place"),
    ],
)
def test_bad_tables_are_refused(text, message, plain, tmp_path):
    path = tmp_path / "points.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message):
        scale_scene(plain.folder, Measurements(points=path))
    assert not (plain.folder / "scale.json").exists()


# The file, and who reads it -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "known, message",
    [
        ({}, "Give targets, reference points, GPS or depths"),
        ({"targets": FAMILY}, "The targets need a known length"),
        ({"size": 0.1, "gps": True}, "give their family with --targets"),
        ({"targets": FAMILY, "size": -1.0}, "The size of the targets is -1 m"),
        ({"targets": FAMILY, "size": math.nan}, "The size of the targets is nan m"),
        ({"points": Path("a.csv"), "gps": True}, "not both"),
        ({"gps": True, "crs": "EPSG:32633"}, "is that of reference points"),
        ({"points": Path("a.csv"), "crs": "UTM 33"}, "'UTM 33' is no name such as EPSG:32633"),
    ],
)
def test_measurements_that_say_nothing_are_refused(known, message):
    with pytest.raises(InputError, match=message):
        Measurements(**known)


@pytest.mark.parametrize("text", ["3=0.5", "3,3=1", "3,7", "3,7=-1", "3,7=x", "a,7=1"])
def test_distances_that_cannot_be_read_are_refused(text, plain):
    with pytest.raises(InputError, match="is not of the form 3,7=0.5"):
        measured(plain, targets=FAMILY, distances=(text,))


REFERENCE = Georeference(
    0.5, 0.01, "gps", "full", np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0]),
    Placement("EPSG:32633", (500_000.125, 6_540_000.001, 0.0)), {"a.png": 0.25}, ("A note.",),
)  # fmt: skip


def test_the_scene_has_the_scale_of_its_file(plain):
    write_georeference(plain.folder, REFERENCE)
    scene = load_scene(plain.folder)
    assert scene.georeference.to_json() == REFERENCE.to_json() and scene.metres_per_unit == 0.5
    np.testing.assert_allclose(scene.up, (0, 0, -1))
    summary = inspect_scene(scene)
    assert summary["scale"] == REFERENCE.to_json()
    assert "1 unit = 0.5 m, ± 1 % (gps), all axes measured, offset 500000.125 6540000.001 0 (EPSG:32633)" in (
        describe_scene(summary)
    )
    write_georeference(plain.folder, replace(REFERENCE, axes="estimated", placement=None))
    poses = np.stack([view.camera.world_to_camera for view in scene.views])
    np.testing.assert_allclose(load_scene(plain.folder).up, up_direction(poses, scene.points.positions))


@pytest.mark.parametrize(
    "changed",
    [
        {"metres_per_unit": 0}, {"metres_per_unit": None}, {"error": -1}, {"axes": "some"}, {"rotation": [[1]]},
        {"rotation": np.zeros((3, 3)).tolist()}, {"translation": [1, 2, None]}, {"offset": [1, 2]},
        {"crs": 4}, {"residuals": {"a": "b"}}, {"notes": "text"}, {"method": None},
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_and_can_be_measured_again(changed, plain, tmp_path):
    (plain.folder / "scale.json").write_text(json.dumps(REFERENCE.to_json() | changed))
    with pytest.raises(InputError, match="scale.json cannot be read .*: measure the scale again"):
        load_scene(plain.folder)
    scale_scene(plain.folder, Measurements(points=point_table(tmp_path / "points.csv", plain, PLACES)))
    assert load_scene(plain.folder).metres_per_unit == pytest.approx(0.37, rel=0.01)


def test_the_command_line(photographed, capsys):
    arguments = ["scale", str(photographed.folder), "--targets", FAMILY, "--size", "0.15"]
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["metres_per_unit"] == pytest.approx(0.37, rel=2e-3) and Path(document["path"]).is_file()
    assert "Scale: 1 unit = 0.3" in describe(document) and "target 3: off by" in describe(document)
    (photographed.folder / "scale.json").unlink()
    assert main(["scale", str(photographed.folder)]) == 2
    assert main([*arguments[:4], "--json"]) == 2
    assert "need a known length" in json.loads(capsys.readouterr().out)["error"]
    assert main(["scale", str(photographed.folder / "nothing"), "--gps"]) == 2


# Sheets ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sheet, pages",
    [
        (Sheet("aruco_4x4_50", 0.15, 2, 0, "a4"), 2),
        (Sheet("apriltag_36h11", 0.05, 10, 5, "letter"), 2),
        (Sheet("aruco_original", 0.03, 7, 1017, "a3"), 1),
    ],
)
def test_printed_targets_are_found_and_have_their_size(sheet, pages, tmp_path):
    figures = list(draw_pages(sheet))
    assert len(figures) == pages
    found: dict[int, np.ndarray] = {}
    for figure in figures:
        figure.savefig(tmp_path / "page.png", dpi=300)
        picture = cv2.imread(str(tmp_path / "page.png"))
        found |= dict(detect(picture[..., ::-1].copy(), sheet.family))
    assert sorted(found) == list(range(sheet.first, sheet.first + sheet.count))
    for corners in found.values():
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) / 300 * 25.4
        assert np.abs(edges - 1000 * sheet.size).max() < 0.1


def test_a_sheet_is_a_pdf_of_the_size_of_the_paper(tmp_path, capsys):
    out = tmp_path / "Bögen" / "targets.pdf"
    assert main(["targets", "--out", str(out), "--count", "7", "--size", "0.08", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["targets"] == list(range(7))
    text = out.read_bytes()
    assert text.startswith(b"%PDF") and text.count(b"/MediaBox [ 0 0 595.27") == 4
    write_sheet(tmp_path / "a.pdf", Sheet(FAMILY, 0.08, 1, 0, "a3"))
    assert (tmp_path / "a.pdf").read_bytes().count(b"/MediaBox [ 0 0 841.8") == 1


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--size", "0.3"], "does not fit on a4: at most 0.15 m does"),
        (["--size", "-1"], "at least 0.005 m"),
        (["--count", "60"], "has the targets 0 to 49: there is no target 59"),
        (["--count", "0"], "The number of targets is 0"),
    ],
)
def test_sheets_that_cannot_be_printed_are_refused(arguments, message, tmp_path, capsys):
    assert main(["targets", "--out", str(tmp_path / "a.pdf"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert main(["targets", "--out", str(tmp_path / "a.png")]) == 2
    assert not list(tmp_path.iterdir())
