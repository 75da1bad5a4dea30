"""Cameras of other programs: each file is written here from the public description of its format.

The projections beside the writers are the equations of that description, independent of the engine's.
"""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.camera_files.camera_file import CameraFile
from swag_engine.camera_files.find_photos import find_photos
from swag_engine.camera_files.import_cameras import import_cameras
from swag_engine.camera_files.pairs import pairs_from_poses
from swag_engine.camera_files.polynomial_lens import PolynomialLens
from swag_engine.camera_files.registry import read_camera_file
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.georeference import read_georeference
from swag_engine.scene.images import load_image
from swag_engine.scene.lenses import source_map
from swag_engine.scene.ply_points import read_points
from tests.scenes.panels import SIZE, render, write_photos
from tests.scenes.rotation_flag import with_rotation_flag

WIDTH, HEIGHT = 1600, 1200
POINTS = np.random.default_rng(1).uniform([-2, -1.5, -1], [2, 1.5, 1], (60, 3))
NAMES = [f"dive/IMG_{number:04d}.JPG" for number in range(5)]
FLIP = np.diag([1.0, -1.0, -1.0])


def poses() -> list[np.ndarray]:
    """World to camera (4, 4), x right, y down, z forward, of cameras five units from the points, all different."""
    made = []
    for number in range(len(NAMES)):
        turn = cv2.Rodrigues(np.array([0.1 * number - 0.2, 0.15 * number - 0.3, 0.5 * number]))[0]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, [0.1 * number, -0.05, 5.0]
        made.append(pose)
    return made


POSES = poses()


def in_camera(pose: np.ndarray) -> np.ndarray:
    return POINTS @ pose[:3, :3].T + pose[:3, 3]


def projected(file: CameraFile, number: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Pixels (P, 2) of POINTS in a camera of a file that was read."""
    camera = file.cameras[number]
    lens = camera.calibration.lens(*size)
    local = POINTS @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return lens.camera.img_from_cam(np.ascontiguousarray(local))


def agree(file: CameraFile, project: Callable[[np.ndarray, int], np.ndarray]) -> None:
    """Compare all cameras of a file with a projection of (points in the camera, number of the camera)."""
    assert [camera.name for camera in file.cameras] == NAMES
    for number, pose in enumerate(POSES):
        assert np.abs(projected(file, number) - project(in_camera(pose), number)).max() < 0.01


# Metashape ------------------------------------------------------------------------------------------------------------

FRAME = {
    "f": 1500.0,
    "cx": 12.5,
    "cy": -7.25,
    "k1": -0.12,
    "k2": 0.05,
    "k3": -0.01,
    "p1": 0.002,
    "p2": -0.001,
    "b1": 3.0,
}


def metashape_pixels(points: np.ndarray, values: dict[str, float], kind: str = "frame") -> np.ndarray:
    """Appendix "Camera models" of the manual of Metashape."""

    def v(key: str) -> float:
        return values.get(key, 0.0)

    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if kind != "frame":
        r0 = np.sqrt(x**2 + y**2)
        factor = (np.arctan(r0) if kind == "fisheye" else 2 * np.sin(np.arctan(r0) / 2)) / r0
        x, y = x * factor, y * factor
    r = np.sqrt(x**2 + y**2)
    radial = 1 + v("k1") * r**2 + v("k2") * r**4 + v("k3") * r**6 + v("k4") * r**8
    xd = x * radial + v("p1") * (r**2 + 2 * x**2) + 2 * v("p2") * x * y
    yd = y * radial + v("p2") * (r**2 + 2 * y**2) + 2 * v("p1") * x * y
    u = WIDTH * 0.5 + v("cx") + xd * v("f") + xd * v("b1") + yd * v("b2")
    return np.stack([u, HEIGHT * 0.5 + v("cy") + yd * v("f")], -1)


def calibration_xml(values: dict[str, float], kind: str = "frame", group: str = "adjusted") -> str:
    entries = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    return f'<calibration type="{kind}" class="{group}">{size}{entries}</calibration>'


def camera_xml(number: int, label: str, pose: np.ndarray | None, sensor: int = 0, more: str = "") -> str:
    transform = ""
    if pose is not None:
        transform = f"<transform>{' '.join(repr(float(value)) for value in np.linalg.inv(pose).ravel())}</transform>"
    return f'<camera id="{number}" sensor_id="{sensor}" label="{label}" {more}>{transform}</camera>'


def chunk_xml(sensors: str, cameras: str, rest: str = "", label: str = "Chunk 1") -> str:
    return (
        f'<chunk label="{label}" enabled="true"><sensors next_id="9">{sensors}</sensors><cameras next_id="9">{cameras}'
        f"</cameras>{rest}</chunk>"
    )


def write_metashape(path: Path, *chunks: str) -> Path:
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">{"".join(chunks)}</document>\n')
    return path


def simple_metashape(path: Path, values: dict[str, float] = FRAME, kind: str = "frame", rest: str = "") -> Path:
    sensor = f'<sensor id="0" label="GoPro" type="{kind}">{calibration_xml(values, kind)}</sensor>'
    cameras = "".join(camera_xml(number, name, POSES[number]) for number, name in enumerate(NAMES))
    return write_metashape(path, chunk_xml(sensor, cameras, rest))


@pytest.mark.parametrize(
    ("kind", "more", "model"),
    [
        ("frame", {}, "FULL_OPENCV"),
        ("frame", {"k3": 0.0}, "OPENCV"),
        ("frame", {"k4": 0.02}, "perspective"),
        ("frame", {"b2": -1.5}, "perspective"),
        ("fisheye", {"p1": 0.0, "p2": 0.0, "k4": 0.003}, "OPENCV_FISHEYE"),
        ("fisheye", {"k4": 0.003}, "THIN_PRISM_FISHEYE"),
        ("fisheye", {"b2": 2.0}, "equidistant"),
        ("equisolid_fisheye", {}, "equisolid"),
    ],
)
def test_metashape_lenses_project_as_its_manual_says(tmp_path: Path, kind: str, more: dict, model: str) -> None:
    values = FRAME | more
    file = read_camera_file(simple_metashape(tmp_path / "cameras.xml", values, kind))
    assert file.program == "Metashape" and file.warnings == []
    lens = file.cameras[0].calibration.lens(WIDTH, HEIGHT)
    assert lens.model == model and isinstance(lens, PolynomialLens) == model.islower()
    agree(file, lambda points, number: metashape_pixels(points, values, kind))


def test_photoscan_with_two_focal_lengths_counts_the_principal_point_from_the_corner(tmp_path: Path) -> None:
    old = {"fx": 1503.0, "fy": 1500.0, "cx": WIDTH / 2 + 12.5, "cy": HEIGHT / 2 - 7.25, "skew": 0.5, "k1": -0.12}
    file = read_camera_file(simple_metashape(tmp_path / "cameras.xml", old))
    new = {"f": 1500.0, "b1": 3.0, "b2": 0.5, "cx": 12.5, "cy": -7.25, "k1": -0.12}
    agree(file, lambda points, number: metashape_pixels(points, new))


def test_a_lens_without_a_model_in_colmap_is_resampled_exactly(tmp_path: Path) -> None:
    values = FRAME | {"k4": 0.02, "b2": -1.5}
    file = read_camera_file(simple_metashape(tmp_path / "cameras.xml", values))
    for width, height in ((WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2)):
        lens = file.cameras[0].calibration.lens(width, height)
        pinhole, (source, valid) = lens.pinhole, source_map(lens)
        assert valid.all() and pinhole.width > 0.9 * width
        rows, columns = np.mgrid[0 : pinhole.height : 37, 0 : pinhole.width : 41]
        rays = np.stack(
            [
                (columns + 0.5 - pinhole.cx) / pinhole.fx,
                (rows + 0.5 - pinhole.cy) / pinhole.fy,
                np.ones(rows.shape),
            ],
            -1,
        )
        wanted = metashape_pixels(rays.reshape(-1, 3), values) * width / WIDTH
        assert np.abs(source[rows, columns].reshape(-1, 2) - wanted).max() < 0.01


def test_metashape_calibration_groups_disabled_and_unaligned_cameras(tmp_path: Path) -> None:
    initial, adjusted = FRAME | {"f": 1111.0}, FRAME | {"f": 1400.0}
    sensors = (
        f'<sensor id="0" label="left" type="frame">{calibration_xml(initial, group="initial")}'
        f"{calibration_xml(adjusted)}"
        f'</sensor><sensor id="1" label="right" type="frame">{calibration_xml(initial, group="initial")}</sensor>'
    )
    cameras = (
        camera_xml(0, "A", POSES[0], 0)
        + f'<group id="0" label="dive 2" type="folder">{camera_xml(1, "A", POSES[1], 1)}</group>'
        + camera_xml(2, "B", POSES[2], 0, 'enabled="false"')
        + camera_xml(3, "C", None)
        + camera_xml(4, "D", POSES[4], 0, 'master_id="0"')
    )
    file = read_camera_file(write_metashape(tmp_path / "cameras.xml", chunk_xml(sensors, cameras)))
    assert [camera.name for camera in file.cameras] == ["A", "dive 2/A"]
    for number, values in enumerate((adjusted, initial)):
        assert np.abs(projected(file, number) - metashape_pixels(in_camera(POSES[number]), values)).max() < 0.01
    text = " ".join(file.warnings)
    assert (
        "The lens right was not calibrated" in text and "1 photo is left out of Chunk 1: disabled in Metashape." in text
    )
    assert "not aligned" in text and "multi-camera" in text


def test_the_largest_chunk_and_component_is_taken_and_said(tmp_path: Path) -> None:
    sensor = f'<sensor id="0" label="GoPro" type="frame">{calibration_xml(FRAME)}</sensor>'
    small = chunk_xml(sensor, camera_xml(0, "x", POSES[0]) + camera_xml(1, "y", POSES[1]), label="Test")
    labels = [camera_xml(number, f"p{number}", POSES[number], 0, 'component_id="0"') for number in range(3)]
    labels += [camera_xml(9, "q", POSES[3], 0, 'component_id="1"')]
    turn = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0]
    transform = (
        f"<transform><rotation>{' '.join(map(repr, turn.ravel().tolist()))}</rotation><translation>1 2 -3</translation>"
        "<scale>0.25</scale></transform>"
    )
    components = (
        f'<components><component id="0" label="Component 1">{transform}</component><component id="1"/></components>'
    )
    rest = components + '<reference>LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]</reference>'
    big = chunk_xml(sensor, "".join(labels), rest, "Reef")
    file = read_camera_file(write_metashape(tmp_path / "two.xml", small, big))
    assert [camera.name for camera in file.cameras] == ["p0", "p1", "p2"]
    assert "3 groups of aligned cameras" in file.warnings[0] and "Reef, Component 1 with 3 photos" in file.warnings[0]
    reference = file.georeference
    assert reference and reference.metres_per_unit == 0.25 and reference.placement is None
    metres = reference.matrix[:3, :3] @ [1.0, 2.0, 3.0] + reference.translation
    assert np.allclose(metres, 0.25 * turn @ [1, 2, 3] + [1, 2, -3])


def test_a_geographic_chunk_gets_metres_and_utm_coordinates(tmp_path: Path) -> None:
    # A point of the IAU's list: Greenwich meridian is avoided, the place is 51.4 N 2.6 W, 30 m below the ellipsoid.
    latitude, longitude = np.radians([51.4, -2.6])
    a, e2 = 6378137.0, 0.00669437999014
    radius = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    place = (radius - 30) * up - [0, 0, radius * e2 * np.sin(latitude)]
    turn = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0]
    rest = (
        f"<transform><rotation>{' '.join(map(repr, turn.ravel().tolist()))}</rotation>"
        f"<translation>{' '.join(map(repr, place.tolist()))}</translation><scale>0.5</scale></transform>"
        '<reference>GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]</reference>'
    )
    reference = read_camera_file(simple_metashape(tmp_path / "cameras.xml", rest=rest)).georeference
    assert reference and reference.metres_per_unit == 0.5 and reference.axes == "full"
    assert np.degrees(np.arccos(reference.up @ (turn.T @ up))) < 0.01
    assert reference.placement and reference.placement.crs == "EPSG:32630"
    # UTM of 51.4 N 2.6 W, zone 30 (series of Snyder 1987, to 1 mm): computed with the formulas below.
    easting, northing = utm(51.4, -2.6, -3.0)
    origin = reference.translation + reference.placement.offset
    assert np.abs(origin - [easting, northing, -30]).max() < 0.01
    # North of the grid: a metre to the north by the formulas is a metre in +y.
    north = np.cross(up, [-np.sin(longitude), np.cos(longitude), 0])
    moved = reference.matrix[:3, :3] @ (turn.T @ north / 0.5)
    step = np.array(utm(51.4 + np.degrees(1 / 6372000), -2.6, -3.0)) - [easting, northing]
    assert np.abs(moved[:2] - step).max() < 0.01


def utm(latitude: float, longitude: float, meridian: float) -> tuple[float, float]:
    """Snyder, Map projections: a working manual (1987), equations 8-9 to 8-15."""
    a, e2, k0 = 6378137.0, 0.00669437999014, 0.9996
    phi, second = np.radians(latitude), e2 / (1 - e2)
    n = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    t, c = np.tan(phi) ** 2, second * np.cos(phi) ** 2
    angle = np.cos(phi) * np.radians(longitude - meridian)
    m = a * (
        (1 - e2 / 4 - 3 * e2**2 / 64 - 5 * e2**3 / 256) * phi
        - (3 * e2 / 8 + 3 * e2**2 / 32 + 45 * e2**3 / 1024) * np.sin(2 * phi)
        + (15 * e2**2 / 256 + 45 * e2**3 / 1024) * np.sin(4 * phi)
        - (35 * e2**3 / 3072) * np.sin(6 * phi)
    )
    x = k0 * n * (angle + (1 - t + c) * angle**3 / 6 + (5 - 18 * t + t**2 + 72 * c - 58 * second) * angle**5 / 120)
    y = k0 * (m + n * np.tan(phi) * (angle**2 / 2 + (5 - t + 9 * c + 4 * c**2) * angle**4 / 24))
    return x + 500_000, y


# nerfstudio and instant-ngp -------------------------------------------------------------------------------------------


def transforms(path: Path, values: dict, per_frame: bool = False, names: list[str] = NAMES) -> Path:
    frames = []
    for name, pose in zip(names, POSES, strict=False):
        to_world = np.linalg.inv(pose)
        to_world[:3, :3] = to_world[:3, :3] @ FLIP  # their camera looks along -z, y up
        frame = {"file_path": name, "transform_matrix": to_world.tolist()}
        frames.append(frame | (values if per_frame else {}))
    path.write_text(json.dumps(({} if per_frame else values) | {"frames": frames}))
    return path


LENS = {"w": WIDTH, "h": HEIGHT, "fl_x": 1500.0, "fl_y": 1490.0, "cx": 812.0, "cy": 590.0}


@pytest.mark.parametrize(
    ("more", "per_frame"),
    [
        ({}, False),
        ({"camera_model": "OPENCV", "k1": -0.1, "k2": 0.03, "p1": 0.001, "p2": -0.002}, False),
        ({"camera_model": "OPENCV", "k1": -0.1, "k2": 0.03, "k3": 0.01, "k4": -0.005, "p1": 0.001, "p2": -0.002}, True),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": 0.001}, True),
        ({"is_fisheye": True, "k1": 0.05}, False),
    ],
)
def test_transforms_json_projects_as_nerfstudio_does(tmp_path: Path, more: dict, per_frame: bool) -> None:
    file = read_camera_file(transforms(tmp_path / "transforms.json", LENS | more, per_frame))

    def project(points: np.ndarray, number: int) -> np.ndarray:
        theirs = points @ FLIP  # x right, y up, z backward
        x, y = theirs[:, 0] / -theirs[:, 2], -theirs[:, 1] / -theirs[:, 2]
        k1, k2, k3, k4 = (more.get(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
        p1, p2 = more.get("p1", 0.0), more.get("p2", 0.0)
        if "is_fisheye" in more or "FISHEYE" in more.get("camera_model", ""):
            r = np.hypot(x, y)
            theta = np.arctan(r)
            scaled = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / r
            x, y = x * scaled, y * scaled
        else:
            r2 = x * x + y * y
            d = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
            x, y = (
                d * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                d * y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
            )
        return np.stack([LENS["fl_x"] * x + LENS["cx"], LENS["fl_y"] * y + LENS["cy"]], -1)

    agree(file, project)


def test_transforms_json_with_an_angle_and_no_size_fits_any_photo(tmp_path: Path) -> None:
    file = read_camera_file(transforms(tmp_path / "transforms.json", {"camera_angle_x": 0.9}))
    focal = WIDTH / 2 / np.tan(0.45)
    local = in_camera(POSES[0])
    wanted = focal * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
    assert np.abs(projected(file, 0) - wanted).max() < 0.01


# RealityScan ----------------------------------------------------------------------------------------------------------


def scan_pixels(points: np.ndarray, row: dict[str, float]) -> np.ndarray:
    """ "RealityCapture XMP Camera Math": film 36 mm wide, principal point in lengths of the longer side."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1 + row["k1"] * r2 + row["k2"] * r2**2 + row["k3"] * r2**3 + row["k4"] * r2**4
    xd = x * radial + row["t2"] * (r2 + 2 * x * x) + 2 * row["t1"] * x * y
    yd = y * radial + row["t1"] * (r2 + 2 * y * y) + 2 * row["t2"] * x * y
    side = max(WIDTH, HEIGHT)
    u = row["f"] / 36 * side * xd + row["px"] * side + WIDTH / 2
    return np.stack([u, row["f"] / 36 * side * yd + row["py"] * side + HEIGHT / 2], -1)


SCAN = {"f": 28.5, "px": 0.004, "py": -0.006, "k1": -0.1, "k2": 0.04, "k3": -0.01, "k4": 0.0, "t1": 0.001, "t2": 0.002}


def scan_csv(path: Path, lens: dict[str, float] = SCAN, offset: tuple[float, float, float] = (0, 0, 0)) -> Path:
    columns = ["x", "y", "alt", "heading", "pitch", "roll", *lens]
    lines = [",".join(["#name", *columns])]
    for name, pose in zip(NAMES, POSES, strict=True):
        to_world = np.linalg.inv(pose)
        rotation = to_world[:3, :3] @ FLIP  # = Rz(-heading) Rx(pitch) Ry(roll): its angles from its entries
        pitch = np.degrees(np.arcsin(rotation[2, 1]))
        heading = np.degrees(np.arctan2(rotation[0, 1], rotation[1, 1]))
        roll = np.degrees(np.arctan2(-rotation[2, 0], rotation[2, 2]))
        place = to_world[:3, 3] + offset
        values = [*place, heading, pitch, roll, *lens.values()]
        lines.append(",".join([name, *(repr(float(value)) for value in values)]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("k4", [0.0, 0.01])
def test_realityscan_csv_projects_as_its_camera_math_says(tmp_path: Path, k4: float) -> None:
    lens = SCAN | {"k4": k4}
    path = scan_csv(tmp_path / "cameras.csv", lens)
    file = read_camera_file(path)
    assert file.program == "RealityScan"
    agree(file, lambda points, number: scan_pixels(points, lens))
    path.write_text(f"#cameras {len(NAMES)}\n{path.read_text().replace(',', ';')}")
    agree(read_camera_file(path), lambda points, number: scan_pixels(points, lens))


def test_realityscan_angles_mean_what_its_help_says(tmp_path: Path) -> None:
    header = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    rows = ["down,0,0,5,0,0,0,28,0,0,0,0,0,0,0,0", "east,0,0,5,90,90,0,28,0,0,0,0,0,0,0,0"]
    (tmp_path / "a.csv").write_text(header + "\n".join(rows))
    down, east = (camera.world_to_camera for camera in read_camera_file(tmp_path / "a.csv").cameras)
    assert np.allclose(down[2, :3], [0, 0, -1]) and np.allclose(down[1, :3], [0, -1, 0])  # looks down, top is north
    assert np.allclose(east[2, :3], [1, 0, 0]) and np.allclose(east[1, :3], [0, 0, -1])  # looks east, upright


def scan_xmp(folder: Path, model: str = "brown3t2", lens: dict[str, float] = SCAN) -> Path:
    for name, pose in zip(NAMES, POSES, strict=True):
        path = (folder / name).with_suffix(".xmp")
        path.parent.mkdir(parents=True, exist_ok=True)
        rotation = " ".join(repr(float(value)) for value in pose[:3, :3].ravel())
        centre = " ".join(repr(float(value)) for value in -pose[:3, :3].T @ pose[:3, 3])
        distortion = " ".join(repr(lens[key]) for key in ("k1", "k2", "k3", "k4", "t1", "t2"))
        path.write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xcr:Version="3" xcr:PosePrior="initial" xcr:Coordinates="absolute" '
            f'xcr:DistortionModel="{model}" xcr:FocalLength35mm="{lens["f"]}" xcr:Skew="0" xcr:AspectRatio="1" '
            f'xcr:PrincipalPointU="{lens["px"]}" xcr:PrincipalPointV="{lens["py"]}" '
            'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">'
            f"<xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>{centre}</xcr:Position>"
            f"<xcr:DistortionCoeficients>{distortion}</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"
        )
    return (folder / NAMES[0]).with_suffix(".xmp")


def test_realityscan_xmp_files_project_as_its_camera_math_says(tmp_path: Path) -> None:
    file = read_camera_file(scan_xmp(tmp_path))
    assert [camera.name for camera in file.cameras] == [f"IMG_{number:04d}" for number in range(5)]
    for number, pose in enumerate(POSES):
        assert np.abs(projected(file, number) - scan_pixels(in_camera(pose), SCAN)).max() < 0.01


def test_realityscan_division_model(tmp_path: Path) -> None:
    lens = SCAN | dict.fromkeys(("k2", "k3", "t1", "t2"), 0.0)
    file = read_camera_file(scan_xmp(tmp_path, "division", lens))
    local = in_camera(POSES[0])
    ru = np.hypot(local[:, 0], local[:, 1]) / local[:, 2]
    rd = (1 - np.sqrt(1 - 4 * lens["k1"] * ru**2)) / (2 * lens["k1"] * ru)  # ru = rd / (1 + k1 rd^2)
    side = max(WIDTH, HEIGHT)
    wanted = local[:, :2] / local[:, 2:] * (rd / ru)[:, None] * lens["f"] / 36 * side
    wanted += [WIDTH / 2 + lens["px"] * side, HEIGHT / 2 + lens["py"] * side]
    assert np.abs(projected(file, 0) - wanted).max() < 0.01


# Bundler, OpenMVG, OpenSfM --------------------------------------------------------------------------------------------


def bundler_pixels(points: np.ndarray) -> np.ndarray:
    """Bundler's README: P = R X + t, p = -P / P.z, p' = f r(p) p, from the middle of the image, y up."""
    theirs = points @ FLIP
    p = -theirs[:, :2] / theirs[:, 2:]
    r2 = (p**2).sum(1, keepdims=True)
    return 1500 * (1 - 0.1 * r2 + 0.02 * r2**2) * p


def write_bundler(folder: Path) -> Path:
    lines = ["# Bundle file v0.3", f"{len(NAMES) + 1} {len(POINTS)}"]
    for pose in POSES:
        theirs = FLIP @ pose[:3]
        lines += ["1500 -0.1 0.02", *(" ".join(map(repr, row.tolist())) for row in theirs[:, :3])]
        lines.append(" ".join(map(repr, theirs[:, 3].tolist())))
    lines += ["0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"]  # an image without a pose
    seen = [bundler_pixels(in_camera(pose)) for pose in POSES]
    for number, point in enumerate(POINTS):
        lines += [" ".join(map(repr, point.tolist())), f"{number} 100 200"]
        views = " ".join(
            f"{camera} {number} {seen[camera][number, 0]!r} {seen[camera][number, 1]!r}" for camera in range(5)
        )
        lines.append(f"5 {views}".replace("np.float64(", "").replace(")", ""))
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"{name} 0 1500\n" for name in [*NAMES, "unposed.jpg"]))
    return folder / "bundle.out"


def test_bundler_projects_as_its_readme_says(tmp_path: Path) -> None:
    file = read_camera_file(write_bundler(tmp_path))
    agree(file, lambda points, number: bundler_pixels(points) * [1, -1] + [WIDTH / 2, HEIGHT / 2])
    assert (
        file.points and np.allclose(file.points.positions, POINTS) and file.points.colors[7].tolist() == [7, 100, 200]
    )
    assert file.warnings == ["1 photo is left out, without a pose in bundle.out."]
    for camera, x, y in file.points.observations[3]:
        assert np.abs(projected(file, camera)[3] - [x + WIDTH / 2, y + HEIGHT / 2]).max() < 0.01


MVG = {
    "pinhole": {},
    "pinhole_radial_k1": {"disto_k1": [-0.1]},
    "pinhole_radial_k3": {"disto_k3": [-0.1, 0.03, -0.01]},
    "pinhole_brown_t2": {"disto_t2": [-0.1, 0.03, -0.01, 0.001, -0.002]},
    "fisheye": {"fisheye": [0.05, -0.01, 0.002, 0.001]},
}


def mvg_pixels(points: np.ndarray, model: str) -> np.ndarray:
    """OpenMVG's documentation of camera models."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    values = next(iter(MVG[model].values()), [])
    r = np.hypot(x, y)
    if model == "fisheye":
        theta = np.arctan(r)
        scaled = (theta + sum(k * theta ** (3 + 2 * power) for power, k in enumerate(values))) / r
        x, y = x * scaled, y * scaled
    else:
        k1, k2, k3, t1, t2 = (*values, *(0.0,) * 5)[:5]
        radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
        x, y = (
            x * radial + t2 * (r**2 + 2 * x * x) + 2 * t1 * x * y,
            y * radial + t1 * (r**2 + 2 * y * y) + 2 * t2 * x * y,
        )
    return 1500 * np.stack([x, y], -1) + [812.0, 590.0]


def write_openmvg(path: Path, model: str) -> Path:
    def wrapped(key: int, data: dict, **more: object) -> dict:
        return {"key": key, "value": more | {"ptr_wrapper": {"id": 2147483649 + key, "data": data}}}

    intrinsics = [
        wrapped(
            number,
            {"width": WIDTH, "height": HEIGHT, "focal_length": 1500.0, "principal_point": [812.0, 590.0]} | MVG[model],
            **({"polymorphic_id": 2147483650, "polymorphic_name": model} if not number else {"polymorphic_id": 2}),
        )
        for number in range(2)
    ]
    views = [
        wrapped(
            number,
            {"local_path": "dive", "filename": name.rsplit("/")[-1], "width": WIDTH, "height": HEIGHT,
             "id_view": number, "id_intrinsic": number % 2, "id_pose": number},
            polymorphic_id=1073741824,
        )
        for number, name in enumerate([*NAMES, "dive/unposed.jpg"])
    ]  # fmt: skip
    extrinsics = [
        {
            "key": number,
            "value": {"rotation": pose[:3, :3].tolist(), "center": (-pose[:3, :3].T @ pose[:3, 3]).tolist()},
        }
        for number, pose in enumerate(POSES)
    ]
    seen = [mvg_pixels(in_camera(pose), model) for pose in POSES]
    structure = [
        {"key": number, "value": {"X": point.tolist(), "observations": [
            {"key": camera, "value": {"id_feat": number, "x": seen[camera][number].tolist()}} for camera in range(5)
        ]}}
        for number, point in enumerate(POINTS)
    ]  # fmt: skip
    document = {"sfm_data_version": "0.3", "root_path": "/photos", "views": views, "intrinsics": intrinsics}
    path.write_text(json.dumps(document | {"extrinsics": extrinsics, "structure": structure, "control_points": []}))
    return path


@pytest.mark.parametrize("model", list(MVG))
def test_openmvg_projects_as_its_documentation_says(tmp_path: Path, model: str) -> None:
    file = read_camera_file(write_openmvg(tmp_path / "sfm_data.json", model))
    agree(file, lambda points, number: mvg_pixels(points, model))
    assert file.points and np.allclose(file.points.positions, POINTS)
    for camera, x, y in file.points.observations[3]:
        assert np.abs(projected(file, camera)[3] - [x + WIDTH / 2, y + HEIGHT / 2]).max() < 0.01


SFM = {
    "perspective": {"focal": 0.95, "k1": -0.1, "k2": 0.02},
    "brown": {"focal_x": 0.95, "focal_y": 0.94, "c_x": 0.01, "c_y": -0.02, "k1": -0.1, "k2": 0.02, "k3": 0.01,
              "p1": 0.001, "p2": -0.002},
    "fisheye": {"focal": 0.95, "k1": -0.05, "k2": 0.01},
    "fisheye_opencv": {"focal_x": 0.95, "focal_y": 0.94, "c_x": 0.01, "c_y": -0.02, "k1": -0.05, "k2": 0.01,
                       "k3": 0.002, "k4": 0.001},
}  # fmt: skip


def sfm_pixels(points: np.ndarray, model: str) -> np.ndarray:
    """OpenSfM's documentation of camera models, with its pixels (centre of the first one at 0) moved by a half."""
    values = SFM[model]
    k1, k2, k3, k4, p1, p2 = (values.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if model.startswith("fisheye"):
        r = np.hypot(x, y)
        theta = np.arctan(r)
        factor = theta / r * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        x, y = x * factor, y * factor
    else:
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        )
    u = values.get("focal_x", values.get("focal")) * x + values.get("c_x", 0.0)
    v = values.get("focal_y", values.get("focal")) * y + values.get("c_y", 0.0)
    side = max(WIDTH, HEIGHT)
    return np.stack([u * side + WIDTH / 2 - 0.5, v * side + HEIGHT / 2 - 0.5], -1) + 0.5


def write_opensfm(path: Path, model: str) -> Path:
    shots = {
        name: {"rotation": cv2.Rodrigues(pose[:3, :3])[0].ravel().tolist(), "translation": pose[:3, 3].tolist(),
               "camera": "v2 gopro"}
        for name, pose in zip(NAMES, POSES, strict=True)
    }  # fmt: skip
    cloud = {
        str(number): {"color": [number, 1.0, 2.0], "coordinates": point.tolist()} for number, point in enumerate(POINTS)
    }
    camera: dict[str, object] = {"projection_type": model, "width": WIDTH, "height": HEIGHT}
    best = {
        "cameras": {"v2 gopro": camera | SFM[model]},
        "shots": shots,
        "points": cloud,
        "reference_lla": {"latitude": 51.4, "longitude": -2.6, "altitude": -30.0},
    }
    small = best | {"shots": dict(list(shots.items())[:2])}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([small, best]))
    return path


@pytest.mark.parametrize("model", list(SFM))
def test_opensfm_projects_as_its_documentation_says(tmp_path: Path, model: str) -> None:
    write_opensfm(tmp_path / "opensfm" / "reconstruction.json", model)
    file = read_camera_file(tmp_path)  # the project of OpenDroneMap
    agree(file, lambda points, number: sfm_pixels(points, model))
    assert file.points and file.points.colors[9].tolist() == [9, 1, 2] and "2 reconstructions" in file.warnings[0]
    reference = file.georeference
    assert reference and reference.metres_per_unit == 1 and reference.placement
    assert np.allclose(reference.up, [0, 0, 1], atol=1e-6)
    assert np.abs(np.array(reference.placement.offset)[:2] - utm(51.4, -2.6, -3.0)).max() < 0.01


# Damaged and unsuitable files -----------------------------------------------------------------------------------------

WRITERS: dict[str, Callable[[Path], Path]] = {
    "metashape": lambda folder: simple_metashape(folder / "cameras.xml"),
    "nerfstudio": lambda folder: transforms(folder / "transforms.json", LENS),
    "csv": lambda folder: scan_csv(folder / "cameras.csv"),
    "xmp": lambda folder: scan_xmp(folder),
    "bundler": write_bundler,
    "openmvg": lambda folder: write_openmvg(folder / "sfm_data.json", "pinhole_radial_k3"),
    "opensfm": lambda folder: write_opensfm(folder / "reconstruction.json", "brown"),
}


@pytest.mark.parametrize("name", list(WRITERS))
def test_damaged_files_are_refused_in_a_sentence_or_read(tmp_path: Path, name: str) -> None:
    path = WRITERS[name](tmp_path)
    whole = path.read_text()
    random = np.random.default_rng(0)
    refused = 0
    for trial in range(60):
        if trial < 20:
            text = whole[: int(len(whole) * trial / 20)]
        else:  # one number or word becomes another
            at = int(random.integers(len(whole)))
            text = whole[:at] + str(random.choice(["x", "nan", "1e400", "-", "null", "[]", '"'])) + whole[at + 1 :]
        path.write_text(text)
        try:
            read_camera_file(path)
        except InputError as error:
            refused += 1
            assert str(tmp_path) in str(error) and "\n" not in str(error)
    assert refused >= 15


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "no file of cameras that can be read"),
        ('{"frames": []}', "no file of cameras that can be read"),
        ('{"frames": [', "damaged or was cut short"),
        ('{"frames": [{"transform_matrix": [[1]], "file_path": "a"}]}', "frame 1 (a)"),
        (
            '{"camera_model": "EQUIRECTANGULAR", "frames": [{"transform_matrix": [], "file_path": "a"}]}',
            "EQUIRECTANGULAR",
        ),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "file").write_text(text)
    with pytest.raises(InputError) as caught:
        read_camera_file(tmp_path / "file")
    assert message in str(caught.value) and str(tmp_path / "file") in str(caught.value)


# Photos ---------------------------------------------------------------------------------------------------------------


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def test_photos_are_found_by_path_name_and_label(tmp_path: Path) -> None:
    folder = touch(tmp_path / "photos", "one/A.JPG", "two/A.JPG", "one/B.jpeg", "C.tif", "deep/er/D.1.png", "E.png")
    names = ["C:/data/two/A.JPG", "./one/A.JPG", "b", "c.CR2", "D.1", "E.PNG", "nowhere"]
    found = find_photos(folder, names)
    expected = ["two/A.JPG", "one/A.JPG", "one/B.jpeg", "C.tif", "deep/er/D.1.png", "E.png"]
    assert {number: path.relative_to(folder).as_posix() for number, path in found.paths.items()} == dict(
        enumerate(expected)
    )
    assert found.warnings == [f"1 photo is left out, not found in {folder}: nowhere."]


def test_labels_that_fit_two_photos_are_left_out_unless_their_group_decides(tmp_path: Path) -> None:
    folder = touch(tmp_path / "photos", "dive 1/A.jpg", "dive 2/A.jpg", "B.jpg", "C.jpg", "D.jpg")
    found = find_photos(folder, ["dive 2/A", "B", "C"])
    assert found.paths[0] == folder / "dive 2" / "A.jpg" and len(found.paths) == 3
    found = find_photos(folder, ["A", "B", "C", "D", "D"])
    assert (
        sorted(found.paths) == [1, 2]
        and "3 photos are left out, with the name of another: A, D, D." in found.warnings[0]
    )
    with pytest.raises(InputError, match="Only 1 of the 2 photos were found in .*: choose their folder. .*nowhere"):
        find_photos(folder, ["B", "nowhere"])


def test_copies_in_a_scene_below_the_folder_are_not_the_photos(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "photos/A.jpg",
        "photos/B.jpg",
        "scene/images/A.jpg",
        "scene/images/B.jpg",
        "scene/sparse/0/images.bin",
    )
    assert {path.parent.name for path in find_photos(tmp_path, ["A", "B"]).paths.values()} == {"photos"}
    assert len(find_photos(tmp_path / "scene", ["A", "B"]).paths) == 2


def test_pairs_grow_with_the_photos_and_join_neighbouring_lines() -> None:
    rows, columns = np.mgrid[0:20, 0:30]
    many = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (600, 1, 1))  # a survey straight down
    centres = np.stack([columns, rows, 0 * rows], -1).reshape(-1, 3)
    many[:, :3, 3] = np.einsum("vij,vj->vi", -many[:, :3, :3], centres)
    pairs = pairs_from_poses(many)
    assert len(pairs) <= 14 * 600
    assert {(0, 1), (0, 30), (0, 31)} <= set(pairs)
    opposite = np.tile(np.eye(4), (60, 1, 1))
    opposite[30:, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    assert all((first < 30) == (second < 30) for first, second in pairs_from_poses(opposite))


# Scenes ---------------------------------------------------------------------------------------------------------------

PLACES = np.linspace(-1.0, 1.0, 6)
FOCAL = 1.1 * SIZE[0]


def panel_pose(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = [-x, -0.1 * np.sin(2 * x), 0]
    return pose


def panel_transforms(path: Path, axes: np.ndarray = FLIP, **more: object) -> Path:
    frames = []
    for number, x in enumerate(PLACES):
        matrix = np.linalg.inv(panel_pose(x))
        matrix[:3, :3] = axes
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": matrix.tolist()})
    lens = {"w": SIZE[0], "h": SIZE[1], "fl_x": FOCAL, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2}
    path.write_text(json.dumps(lens | more | {"frames": frames}))
    return path


def test_points_are_triangulated_from_the_poses_of_the_file(tmp_path: Path) -> None:
    write_photos(tmp_path / "dive" / "images", PLACES)
    stages: list[str] = []
    made = import_cameras(
        panel_transforms(tmp_path / "dive" / "transforms.json"),
        tmp_path / "scene",
        progress=lambda stage, fraction: stages.append(stage),
    )
    assert made["registered"] == 6 and made["points_from"] == "photos" and made["warnings"] == []
    assert made["reprojection_error"] < 0.5 and made["epipolar_error"] < 0.5
    assert "Triangulating points" in stages and sorted(path.name for path in tmp_path.iterdir()) == ["dive", "scene"]
    scene = load_scene(tmp_path / "scene")
    for view, x in zip(scene.views, PLACES, strict=True):
        assert np.abs(view.camera.world_to_camera - panel_pose(x)).max() < 1e-12
    depths = scene.points.positions[:, 2]
    assert len(depths) > 200 and np.quantile(depths, 0.02) > 4.3 and np.quantile(depths, 0.98) < 7.2
    assert np.ptp(scene.points.colors.mean(0)) > 20  # colors of the photos, not of the grey copies


def test_poses_that_do_not_fit_the_photos_are_doubted(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", PLACES)
    path = panel_transforms(tmp_path / "transforms.json", axes=np.eye(3))  # looks backward, upside down
    made = import_cameras(path, tmp_path / "out")
    assert made["epipolar_error"] > 2 and "miss their epipolar lines" in made["warnings"][0]


def test_a_stopped_import_leaves_nothing(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", PLACES)
    path = panel_transforms(tmp_path / "transforms.json")

    def stop(stage: str, fraction: float) -> None:
        if stage == "Matching photos":
            raise InputError("stopped")

    with pytest.raises(InputError, match="stopped"):
        import_cameras(path, tmp_path / "out", progress=stop)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["images", "transforms.json"]


def distorted_panels(folder: Path, values: dict[str, float]) -> list[str]:
    """Write photos of a lens of Metashape, made from pinhole photos by inverting its equations."""
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    wanted = np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2).astype(float)
    plane = (wanted - np.array(SIZE) / 2) / FOCAL
    for _ in range(50):  # fixed point
        here = metashape_pixels(np.concatenate([plane, np.ones((len(plane), 1))], -1), values) * SIZE[0] / WIDTH
        plane += (wanted - here) / FOCAL
    source = (plane * FOCAL + np.array(SIZE) / 2 - 0.5).reshape(*rows.shape, 2).astype(np.float32)
    folder.mkdir(parents=True)
    for number, x in enumerate(PLACES):
        photo = cv2.remap(render(x), source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        (folder / f"{number}.png").write_bytes(cv2.imencode(".png", photo)[1].tobytes())
    return [str(number) for number in range(len(PLACES))]


PANEL_LENS = {"f": 1760.0, "k1": 0.25, "k2": -0.1, "k4": 0.5, "b2": 4.0, "cx": 10.0, "p1": 0.004}
"""For photos of 1600 x 1200 pixels; the photos have 320 x 240."""
PANEL_TRANSFORM = (
    "<transform><rotation>0 0 1 1 0 0 0 1 0</rotation><translation>5 6 7</translation><scale>2</scale></transform>"
)


def panel_metashape(path: Path, labels: list[str]) -> Path:
    sensor = f'<sensor id="0" label="GoPro" type="frame">{calibration_xml(PANEL_LENS)}</sensor>'
    cameras = "".join(
        camera_xml(n, label, panel_pose(x)) for n, (label, x) in enumerate(zip(labels, PLACES, strict=True))
    )
    return write_metashape(path, chunk_xml(sensor, cameras, PANEL_TRANSFORM))


def test_photos_of_a_lens_without_a_model_in_colmap_are_undistorted(tmp_path: Path) -> None:
    labels = distorted_panels(tmp_path / "photos", PANEL_LENS)
    path = panel_metashape(tmp_path / "cameras.xml", labels)
    made = import_cameras(path, tmp_path / "out", tmp_path / "photos")
    assert made["epipolar_error"] < 0.3 and made["points"] > 200
    assert made["warnings"] == [
        "6 photos are 320 x 240 pixels large, another size than the calibration, which was scaled to it.",
        "6 photos are undistorted in the scene, because COLMAP has no camera model for the lens.",
    ]
    scene = load_scene(tmp_path / "out")
    assert all(view.lens.is_pinhole for view in scene.views)
    # The undistorted photos are those of a pinhole camera.
    lens = scene.views[0].lens
    pixels = cv2.imread(str(scene.views[0].path)).astype(float)
    rows, columns = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float32)
    fx, fy, cx, cy = lens.params
    x, y = (columns + 0.5 - cx) / fx * FOCAL + SIZE[0] / 2 - 0.5, (rows + 0.5 - cy) / fy * FOCAL + SIZE[1] / 2 - 0.5
    truth = cv2.remap(render(PLACES[0]), x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC).astype(float)
    assert np.median(np.abs(pixels - truth)) <= 2
    reference = read_georeference(tmp_path / "out")
    assert reference and reference.metres_per_unit == 2 and reference.method == "Metashape"
    assert np.allclose(scene.up, [0, 1, 0])  # z of the chunk's metres


def write_ply(path: Path, positions: np.ndarray, form: str = "binary_little_endian") -> Path:
    colors = np.tile(np.array([[10, 200, 30]], np.uint8), (len(positions), 1))
    header = f"ply\nformat {form} 1.0\ncomment made here\nelement vertex {len(positions)}\n"
    header += "property double x\nproperty double y\nproperty double z\nproperty float nx\n"
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    if form == "ascii":
        rows = [f"{x!r} {y!r} {z!r} 0 10 200 30" for x, y, z in positions.tolist()]
        path.write_text(header + "\n".join(rows) + "\n")
        return path
    order = "<" if "little" in form else ">"
    table = np.zeros(len(positions), [(axis, order + "f8") for axis in "xyz"] + [("nx", order + "f4"), ("c", "u1", 3)])
    for index, axis in enumerate("xyz"):
        table[axis] = positions[:, index]
    table["c"] = colors
    path.write_bytes(header.encode() + table.tobytes())
    return path


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_points_are_read(tmp_path: Path, form: str) -> None:
    path = write_ply(tmp_path / "points.ply", POINTS, form)
    positions, colors = read_points(path)
    assert np.array_equal(positions, POINTS) and (colors == [10, 200, 30]).all()
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="cut short"):
        read_points(path)


def panel_points() -> np.ndarray:
    """Points of the far wall in the world of `panel_pose`, and some hidden behind it."""
    x, y = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 30))
    wall = np.stack([x, y, np.full_like(x, 7.0)], -1).reshape(-1, 3)
    return np.concatenate([wall, wall[::10] * 1.5])


@pytest.mark.parametrize("metric", [False, True])
def test_ply_points_may_have_the_coordinates_of_the_cameras_or_metres(tmp_path: Path, metric: bool) -> None:
    labels = distorted_panels(tmp_path / "photos", PANEL_LENS)
    path = panel_metashape(tmp_path / "cameras.xml", labels)
    truth = panel_points()
    turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    write_ply(tmp_path / "points.ply", 2 * truth @ turn.T + [5, 6, 7] if metric else truth)
    made = import_cameras(path, tmp_path / "out", tmp_path / "photos", tmp_path / "points.ply")
    assert made["points_from"] == str(tmp_path / "points.ply") and made["reprojection_error"] is None
    scene = load_scene(tmp_path / "out")
    distance = np.abs(scene.points.positions[:, None] - truth[:1200]).max(-1).min(1)
    assert len(scene.points.positions) > 500
    assert np.mean(distance < 1e-9) > 0.95  # few of the hidden ones are taken for visible
    assert (scene.points.colors == [10, 200, 30]).all()
    assert min(len(view.point_indices) for view in scene.views) > 300


def test_ply_points_elsewhere_are_refused(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", PLACES)
    path = panel_transforms(tmp_path / "transforms.json", ply_file_path="far.ply")
    write_ply(tmp_path / "far.ply", panel_points() - [0, 0, 1000])
    with pytest.raises(InputError, match="0% of the points .* are in front of the cameras"):
        import_cameras(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_masks_and_depth_images_that_the_file_names_are_copied(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", PLACES)
    write_ply(tmp_path / "wall.ply", panel_points())
    path = panel_transforms(tmp_path / "transforms.json", ply_file_path="wall.ply")
    document = json.loads(path.read_text())
    document["frames"][0] |= {"mask_path": "x.png", "depth_file_path": "x.png"}
    document["frames"][1]["mask_path"] = "absent.png"
    path.write_text(json.dumps(document))
    half = np.repeat([[0], [255]], SIZE[1] // 2, 0).repeat(SIZE[0], 1).astype(np.uint8)
    (tmp_path / "x.png").write_bytes(cv2.imencode(".png", half)[1].tobytes())
    made = import_cameras(path, tmp_path / "out", tmp_path / "images")
    scene = load_scene(tmp_path / "out")
    assert list(scene.masks.of) == [scene.views[0].path] and (tmp_path / "out" / "depths" / "0.png").is_file()
    valid = load_image(scene, scene.views[0]).valid
    assert valid[SIZE[1] // 2 :].all() and not valid[: SIZE[1] // 2].any()
    assert "absent.png" in made["warnings"][0] and "1 of 1 photos are in depths" in made["warnings"][1]


def small_photos(folder: Path, size: tuple[int, int] = (160, 120)) -> Path:
    """Write photos of the names in NAMES, of another size than the calibration."""
    for number, name in enumerate(NAMES):
        pixels = np.random.default_rng(number).integers(0, 255, (size[1], size[0], 3), np.uint8)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(cv2.imencode(".jpg", pixels)[1].tobytes())
    return folder


@pytest.mark.parametrize("program", ["bundler", "openmvg", "opensfm"])
def test_points_of_the_file_keep_their_observations(tmp_path: Path, program: str) -> None:
    folder = small_photos(tmp_path / "photos", (WIDTH, HEIGHT) if program == "bundler" else (160, 120))
    made = import_cameras(WRITERS[program](tmp_path), tmp_path / "out", folder)
    scene = load_scene(tmp_path / "out")
    assert np.abs(scene.points.positions[:, None] - POINTS).max(-1).min(1).max() < 1e-9
    assert (tmp_path / "out" / "images" / NAMES[0]).read_bytes() == (folder / NAMES[0]).read_bytes()
    if program == "opensfm":  # no observations in its file: a photo sees what projects into it and is not hidden
        assert len(scene.points.positions) > 50
    else:
        assert len(scene.points.positions) == 60 and scene.points.track_lengths.min() == 5
        assert made["reprojection_error"] < 0.01


def test_large_coordinates_become_an_offset(tmp_path: Path) -> None:
    offset = (512345.25, 5698765.5, -31.75)
    write_photos(tmp_path / "photos", PLACES)
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    places = []
    for number, x in enumerate(PLACES):
        place = np.array([x, 0.1 * np.sin(2 * x), 0])  # a camera that looks down, its top to the north
        place = place * [1, -1, -1] + offset
        places.append(place)
        lines.append(f"{number}.png,{','.join(map(repr, place.tolist()))},0,0,0,{36 * 1.1},0,0,0,0,0,0,0,0")
    (tmp_path / "photos" / "cameras.csv").write_text("\n".join(lines))
    import_cameras(tmp_path / "photos" / "cameras.csv", tmp_path / "out")
    scene, reference = load_scene(tmp_path / "out"), read_georeference(tmp_path / "out")
    assert reference and reference.placement and np.allclose(scene.up, [0, 0, 1])
    assert np.abs(scene.points.positions).max() < 50
    for view, place in zip(scene.views, places, strict=True):
        local = reference.matrix[:3, :3] @ view.camera.centre + reference.translation
        assert np.abs(local + reference.placement.offset - place).max() < 1e-6


def test_bad_photos_among_good_ones_are_named_and_left_out(tmp_path: Path) -> None:
    folder = small_photos(tmp_path / "photos")
    (folder / NAMES[0]).write_bytes(b"no image")
    square = cv2.imencode(".jpg", np.zeros((100, 100, 3), np.uint8))[1].tobytes()
    (folder / NAMES[1]).write_bytes(square)
    path = write_opensfm(tmp_path / "reconstruction.json", "brown")
    made = import_cameras(path, tmp_path / "out", folder)
    assert made["registered"] == 3 and made["images"] == 5
    assert f"1 photo is left out, not readable as images: {NAMES[0]}." in made["warnings"]
    assert any(f"{NAMES[1]} has 100 x 100 pixels instead of 1600 x 1200" in warning for warning in made["warnings"])
    for name in NAMES[2:4]:
        (folder / name).write_bytes(square)
    with pytest.raises(InputError, match="Only 1 of the photos in .* can be used"):
        import_cameras(path, tmp_path / "second", folder)
    assert not (tmp_path / "second").exists()


def test_photos_that_only_fit_when_turned_are_turned(tmp_path: Path) -> None:
    folder = small_photos(tmp_path / "photos")
    upright = np.zeros((120, 160, 3), np.uint8)
    upright[:, :80] = 250
    stored = cv2.imencode(".jpg", np.rot90(upright))[1].tobytes()
    (folder / NAMES[0]).write_bytes(with_rotation_flag(stored))
    (folder / "Mask").mkdir()
    (folder / "Mask" / "img_0000_mask.PNG").write_bytes(cv2.imencode(".png", np.rot90(upright))[1].tobytes())
    path = write_opensfm(tmp_path / "reconstruction.json", "brown")
    made = import_cameras(path, tmp_path / "out", folder)
    assert made["registered"] == 5 and "1 photo is turned as the EXIF orientation says" in " ".join(made["warnings"])
    written = cv2.imread(
        str(tmp_path / "out" / "images" / NAMES[0]), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    )
    assert written.shape == (120, 160, 3) and written[:, :70].min() > 200 and written[:, 90:].max() < 50
    masks = load_scene(tmp_path / "out").masks.of
    assert np.array_equal(cv2.imread(str(masks[tmp_path / "out" / "images" / NAMES[0]])) > 0, upright > 0)


def test_webp_photos_become_png_files_which_colmap_reads(tmp_path: Path) -> None:
    folder = small_photos(tmp_path / "photos")
    for name in NAMES:
        pixels = cv2.imread(str(folder / name))
        (folder / name).with_suffix(".webp").write_bytes(cv2.imencode(".webp", pixels)[1].tobytes())
        (folder / name).unlink()
    import_cameras(write_openmvg(tmp_path / "sfm_data.json", "pinhole"), tmp_path / "out", folder)
    assert [view.name for view in load_scene(tmp_path / "out").views] == [
        f"dive/IMG_{number:04d}.webp.png" for number in range(5)
    ]


def test_the_scene_folder_must_be_free(tmp_path: Path) -> None:
    folder = small_photos(tmp_path / "photos")
    path = write_opensfm(tmp_path / "reconstruction.json", "brown")
    with pytest.raises(InputError, match="is not an empty folder"):
        import_cameras(path, folder, folder)
    with pytest.raises(InputError, match="There is no folder of photos"):
        import_cameras(path, tmp_path / "out", tmp_path / "none")
    with pytest.raises(InputError, match="There is no file"):
        import_cameras(tmp_path / "none.xml", tmp_path / "out", folder)


def test_the_command_prints_one_document_or_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from swag_engine.app.cli import main

    folder = small_photos(tmp_path / "photos")
    path = write_opensfm(tmp_path / "reconstruction.json", "brown")
    command = ["import-cameras", str(path), "--photos", str(folder), "--out", str(tmp_path / "out")]
    assert main([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["program"] == "OpenSfM or OpenDroneMap" and document["registered"] == 5
    assert document["scale"]["metres_per_unit"] == 1 and document["scale"]["crs"] == "EPSG:32630"
    assert main(command) == 2
    assert "is not an empty folder" in capsys.readouterr().err.splitlines()[-1]
