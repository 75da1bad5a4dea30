"""What is said about COLMAP models of known cameras: the faults that were made, and none where there are none."""

import base64
from collections.abc import Callable
from html import escape
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from swag_engine.scene.camera_page import write_camera_page
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.inspect import describe, inspect_scene
from swag_engine.scene.model_quality import ModelQuality, assess_model
from tests.scenes.observed_models import block, floor, forward_dive, lawn_mower, look, make_model, orbit
from tests.scenes.panels import SIZE, render
from tests.scenes.tiny import make_tiny_scene

shared = Path(__file__).resolve().parents[2].parent / "shared"


def kinds(quality: ModelQuality) -> list[str]:
    return [doubt.kind for doubt in quality.doubts]


def assess(model: pycolmap.Reconstruction, **more: dict[int, float]) -> ModelQuality:
    return assess_model(model, model.num_images(), **more)


def front_of_block(poses: list[np.ndarray], positions: np.ndarray) -> Callable[[int, np.ndarray], np.ndarray]:
    """Visibility of points of a block that is not transparent: those on the side of the camera."""
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)

    def seen(index: int, visible: np.ndarray) -> np.ndarray:
        centre = -poses[index][:, :3].T @ poses[index][:, 3]
        return normals @ (centre / np.linalg.norm(centre)) > 0.3

    return seen


def loop() -> pycolmap.Reconstruction:
    """A circle and a half around a block."""
    poses, positions = orbit(40, 1.4), block(700)
    return make_model(poses, positions, seen=front_of_block(poses, positions), farthest=20)


@pytest.mark.parametrize("kind", ["lawn mower", "loop", "orbit"])
def test_sound_models_are_not_doubted(kind: str) -> None:
    if kind == "lawn mower":
        model = make_model(lawn_mower(), floor())
    else:
        model = loop() if kind == "loop" else make_model(orbit(20), block(300))
    quality = assess(model)
    assert kinds(quality) == []
    assert quality.registered == quality.image_count == model.num_images() and quality.registered_share == 1
    assert quality.focal_lengths[1] == pytest.approx(800, rel=0.01)
    assert quality.fields_of_view[1] == pytest.approx(61.9, abs=1)


@pytest.mark.skipif(not (shared / "data").is_dir(), reason="the shared example scenes are not here")
@pytest.mark.parametrize("name", ["aqualoc_amphorae", "japanese_gardens", "sparus_seabed"])
def test_real_scenes_are_not_doubted(name: str) -> None:
    summary = inspect_scene(load_scene(shared / "data" / name))
    assert summary["warnings"] == [] and summary["unregistered"] == []
    assert 0 < summary["focal_error"] < 0.03 and 6 < summary["triangulation_angle"] < 10


def test_the_example_of_the_repository_is_not_doubted() -> None:
    summary = inspect_scene(load_scene(Path(__file__).resolve().parents[1] / "scenes" / "reef_wreck"))
    assert summary["warnings"] == [] and summary["drift"]["fraction"] < 0.001


def test_the_error_of_the_focal_length_is_that_of_repeated_adjustments() -> None:
    poses, positions = lawn_mower(rows=2, columns=5), floor(1200)
    found = []
    for seed in range(12):
        quality = assess(make_model(poses, positions, noise=1.0, seed=seed))
        found.append((quality.focal_lengths[1], quality.focal_errors[1]))
    focal, error = np.array(found).T
    assert np.median(error) == pytest.approx(np.std(focal / 800, ddof=1), rel=0.6)
    assert 0.0003 < np.median(error) < 0.01


def test_a_sample_of_the_points_gives_the_error_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(lawn_mower(), floor(4000))
    whole = assess(model).focal_errors[1]
    monkeypatch.setattr("swag_engine.scene.model_observations._SAMPLE", 1500)
    assert assess(model).focal_errors[1] == pytest.approx(whole, rel=0.3)


def test_the_error_of_the_focal_length_of_a_model_in_two_parts_with_an_image_of_nothing() -> None:
    poses, once = orbit(40, 1.4), block(700)
    front = front_of_block(poses, once)
    half = make_model(poses[:20], once, seen=front, farthest=20, adjust=False)
    twice = np.concatenate([once, once])
    first = np.arange(len(twice)) < len(once)
    both_fronts = front_of_block(poses, twice)

    def seen(index: int, visible: np.ndarray) -> np.ndarray:
        return both_fronts(index, visible) & (first if index < 20 else ~first) & (index != 39)

    parted = make_model(poses, twice, seen=seen, farthest=20, adjust=False)
    error, of_half = assess(parted).focal_errors[1], assess(half).focal_errors[1]
    assert error is not None and of_half is not None and error == pytest.approx(of_half / np.sqrt(2), rel=0.1)


@pytest.mark.parametrize("first_focal", [800.0, 450.0])
def test_an_undetermined_focal_length_is_said(first_focal: float) -> None:
    quality = assess(make_model(forward_dive(14), floor(1500), first_focal=first_focal))
    assert "focal_error" in kinds(quality)
    error = quality.focal_errors[1]
    assert error is not None and abs(quality.focal_lengths[1] / 800 - 1) < 3 * error
    assert f"is known to {error:.0%} only (threshold 5%)" in quality.doubts[0].sentence


@pytest.mark.parametrize(
    ("focal", "prior", "expected"),
    [(260.0, None, "field_of_view"), (4500.0, None, "field_of_view"), (260.0, 260.0, ""), (800.0, 800.0, ""),
     (800.0, 601.5, ""), (800.0, 1500.0, "focal_prior"), (800.0, 300.0, "focal_prior")],
)  # fmt: skip
def test_fields_of_view_and_priors(focal: float, prior: float | None, expected: str) -> None:
    model = make_model(orbit(12), block(300), focal=focal, model="SIMPLE_PINHOLE", adjust=False, farthest=20)
    quality = assess(model, focal_priors={} if prior is None else {1: prior})
    assert [kind for kind in kinds(quality) if kind in ("field_of_view", "focal_prior")] == [expected] * bool(expected)
    if expected == "field_of_view":
        field = 2 * np.degrees(np.arctan(480 / focal))
        assert quality.fields_of_view[1] == pytest.approx(field) and f"of {field:.0f}° is" in quality.doubts[0].sentence


def test_a_fisheye_may_see_far_more() -> None:
    model = make_model(orbit(12), block(300), focal=320, model="OPENCV_FISHEYE", adjust=False)
    quality = assess(model)
    assert quality.fields_of_view[1] == pytest.approx(np.degrees(960 / 320), abs=0.1) and kinds(quality) == []


def test_points_without_parallax_are_said() -> None:
    poses = [look(np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), np.array([0.02 * k, 0, 0])) for k in range(8)]
    quality = assess(make_model(poses, block(400) + [0, 6, 0], noise=0.1, adjust=False))
    assert quality.triangulation_angle is not None and 0.5 < quality.triangulation_angle < 2
    assert "triangulation_angle" in kinds(quality)


def test_few_registered_images_are_said() -> None:
    model = make_model(orbit(12), block(300))
    assert kinds(assess_model(model, 13)) == [] and kinds(assess_model(model, 14)) == ["registered"]


def test_drift_is_measured_and_said() -> None:
    drift = assess(loop()).drift
    assert drift is not None and drift.fraction < 0.0003

    model = loop()
    for index, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        pose = image.cam_from_world().matrix()
        centre = -pose[:, :3].T @ pose[:, 3] + [0, 0, index / model.num_images()]  # rises by 1 along the way
        image.frame.rig_from_world = pycolmap.Rigid3d(np.column_stack([pose[:, :3], -pose[:, :3] @ centre]))
    bent = assess(model)
    assert bent.drift is not None
    first, last = (int(name[6:10]) for name in (bent.drift.first, bent.drift.last))
    length = 2 * np.pi * 6 * 1.4 * 39 / 40
    assert bent.drift.fraction == pytest.approx((last - first) / 40 / length, rel=0.25) and last - first > 20
    sentence = next(doubt.sentence for doubt in bent.doubts if doubt.kind == "drift")
    assert bent.drift.first in sentence and bent.drift.last in sentence


def test_a_place_that_appears_twice_is_said() -> None:
    poses, once = orbit(40, 1.4), block(700)
    twice = np.concatenate([once, once])
    front, first = front_of_block(poses, twice), np.arange(len(twice)) < len(once)

    def seen(index: int, visible: np.ndarray) -> np.ndarray:
        return front(index, visible) & (first if index < 20 else ~first)

    quality = assess(make_model(poses, twice, seen=seen, farthest=20, adjust=False))
    assert "open_loop" in kinds(quality)
    early, late = (int(name[6:10]) for name in quality.open_loops[0])
    assert early < 12 and late - early in range(24, 34)  # a whole turn is 28.6 images


@pytest.mark.parametrize("path", ["lawn mower", "orbit"])
@pytest.mark.parametrize("readout", [0.05, -0.05])
def test_a_rolling_shutter_is_said(path: str, readout: float) -> None:
    poses, positions = (lawn_mower(), floor()) if path == "lawn mower" else (orbit(), block(700))
    quality = assess(make_model(poses, positions, readout=readout))
    assert "rolling_shutter" in kinds(quality)
    assert quality.rolling_shutter is not None and np.sign(quality.rolling_shutter.readout) == np.sign(readout)


def test_a_model_without_observations(tmp_path: Path) -> None:
    summary = inspect_scene(load_scene(make_tiny_scene(tmp_path)))
    assert summary["warnings"] == [] and summary["unregistered"] == []
    assert summary["triangulation_angle"] is summary["focal_error"] is summary["drift"] is None
    assert "Focal error" not in describe(summary)


def test_models_of_nothing_and_of_nonsense() -> None:
    assert assess_model(pycolmap.Reconstruction(), 0).doubts == ()
    model = make_model(orbit(12), block(100), adjust=False)
    for number, point in enumerate(model.points3D.values()):
        point.xyz = [np.nan, 0, 0] if number % 3 == 0 else point.xyz * (1e300 if number % 3 == 1 else 1)
    model.camera(1).params = [1e-9, 0, 0, 0]
    assert isinstance(assess(model), ModelQuality)


def test_the_page_shows_the_path_the_matrix_and_the_doubts(tmp_path: Path) -> None:
    poses, once = orbit(40, 1.4), block(300)
    twice = np.concatenate([once, once])
    front, first = front_of_block(poses, twice), np.arange(len(twice)) < len(once)

    def seen(index: int, visible: np.ndarray) -> np.ndarray:
        return front(index, visible) & (first if index < 20 else ~first)

    model = make_model(poses, twice, seen=seen, farthest=20, adjust=False, names="Wand <{:02d}> ä.jpg")
    scene = tmp_path / "Tauchgang & Riff"
    (scene / "images").mkdir(parents=True)
    (scene / "sparse" / "0").mkdir(parents=True)
    model.write(str(scene / "sparse" / "0"))
    for index in range(42):
        (scene / "images" / f"Wand <{index:02d}> ä.jpg").write_bytes(b"no image")
    write_camera_page(load_scene(scene), tmp_path / "page.html", ["The photos fall into 2 groups."])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "The photos fall into 2 groups." in page
    assert "Cameras of Tauchgang &amp; Riff" in page and "<00>" not in page and "Wand &lt;00&gt; ä.jpg" in page
    for sentence in inspect_scene(load_scene(scene))["warnings"]:
        assert escape(sentence) in page
    assert "between them the cameras may drift" in page and "unreadable" in page
    assert page.count("<svg") == 2 and page.count('class="loop"') == 20 and page.count("<title>Wand") == 80
    assert "http" not in page  # nothing is loaded, and there are no addresses
    encoded = page.split("data:image/png;base64,")[1].split('"')[0]
    matrix = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_UNCHANGED)[5::10, 5::10, 3]
    assert matrix.shape == (40, 40) and matrix[:20, 20:].max() == 0 and matrix[0, 1] > 100 and matrix[0, 0] == 0


def test_the_page_of_a_model_without_observations(tiny_scene: Path, tmp_path: Path) -> None:
    write_camera_page(load_scene(tiny_scene), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Nothing about these cameras is doubtful" in page and "Shared points" not in page


def test_reasons_of_images_without_a_pose(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    make_tiny_scene(tmp_path / "tiny", views=4)
    scene = tmp_path / "tiny"
    for index, x in enumerate([-0.5, 0.0, 0.5, 1.0]):  # the images that have a pose
        (scene / "images" / f"view_{index:02d}.png").write_bytes(cv2.imencode(".png", render(x))[1].tobytes())
    water = np.linspace(40, 80, SIZE[1])[:, None, None] * [1.4, 1.2, 0.3] + random.normal(0, 1.5, (*SIZE[::-1], 3))
    smear = np.zeros((15, 15), np.float32)
    smear[7] = 1 / 15
    for name, picture in {
        "blurred": cv2.GaussianBlur(render(0.2), (0, 0), 3),
        "dark": render(0.2) * 0.08,
        "mirrored": render(0.2)[:, ::-1],
        "shaken": cv2.filter2D(render(0.2), -1, smear),
        "water": water,
    }.items():
        (scene / "images" / f"{name}.png").write_bytes(
            cv2.imencode(".png", picture.clip(0, 255).astype(np.uint8))[1].tobytes()
        )
    (scene / "images" / "broken.png").write_bytes(b"no image")
    summary = inspect_scene(load_scene(scene))
    assert {image["name"]: image["reason"] for image in summary["unregistered"]} == {
        "blurred.png": "blurred",
        "broken.png": "unreadable",
        "dark.png": "too dark",
        "mirrored.png": "no overlap with other photos found",
        "shaken.png": "blurred",
        "water.png": "hardly any structure",
    }
    assert (
        "Warning:     2 photos without a pose (blurred): blurred.png, shaken.png. What helps: use a shorter exposure"
        in describe(summary)
    )


@pytest.mark.parametrize(("millimetres", "doubted"), [(30, False), (200, True)])
def test_the_focal_length_in_exif_data_is_the_prior(tmp_path: Path, millimetres: int, doubted: bool) -> None:
    model = make_model(orbit(8), block(200), model="SIMPLE_PINHOLE", adjust=False)  # 29 mm, by the diagonal
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write(str(tmp_path / "sparse" / "0"))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = millimetres  # focal length in 35 mm film
    for image in model.images.values():  # made smaller after the cameras were found
        Image.new("RGB", (96, 72)).save(tmp_path / "images" / image.name, exif=exif)
    scene = load_scene(tmp_path)
    warnings = inspect_scene(scene)["warnings"]
    assert [warning for warning in warnings if "times that in the photos' EXIF data" in warning] == warnings
    assert bool(warnings) == doubted
    if doubted:
        assert "of 800 px is 0.14 times" in warnings[0]
