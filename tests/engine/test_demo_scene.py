"""The shipped demo scene, and what its generator's settings do, on a small scene rendered afresh."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "tests" / "scenes" / "reef_wreck"
SIZE = (80, 45)  # an eighth of the shipped scene's

# Blender's data is global, so the generator runs in a process of its own: one render, several scenes.
GENERATE = f"""
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from tests.scenes import make_scene as generator
from tests.scenes.make_scene import Settings, make_scene, render

generator.Model = cache(generator.Model)  # building the reef takes longer than all renders of it
out = Path(sys.argv[1])
base = Settings(out / "base", views=6, width={SIZE[0]}, height={SIZE[1]}, points=400, truth="all")
fish = replace(base, out=out / "fish", moving_object=0.34)
rendered = render(fish)
make_scene(fish, rendered)
still = replace(rendered, seen=rendered.still)
make_scene(base, still)
make_scene(replace(base, out=out / "again"), still)
make_scene(replace(base, out=out / "lamp", lamp=1.0), still)
make_scene(replace(base, out=out / "exposure", exposure=0.15), still)
make_scene(replace(base, out=out / "caustics", caustics=0.5), still)
one_view = replace(rendered, poses=6 * rendered.poses[:1], still=6 * rendered.still[:1], seen=6 * rendered.still[:1])
make_scene(replace(base, out=out / "standing", caustics=0.5), one_view)
make_scene(replace(base, out=out / "srgb", water=replace(base.water, light="srgb")), still)
make_scene(replace(base, out=out / "volume", views=2, samples=2, volume=True))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenes")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", GENERATE, str(out)], env=environment, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return out


def truth(scene: Path) -> dict:
    return json.loads((scene / "truth.json").read_text())


def picture(path: Path) -> np.ndarray:
    """(H,W,3) displayed values 0..1."""
    return cv2.imread(str(path))[..., ::-1] / 255.0


def photographs(scene: Path) -> np.ndarray:
    return np.stack([picture(path) for path in sorted((scene / "images").iterdir())])


def ranges(scene: Path) -> np.ndarray:
    """(V,H,W) metres, inf in open water."""
    values = np.stack([cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted((scene / "range").iterdir())]) / 1000.0
    return np.where(values == 0, np.inf, values)


def linear(displayed: np.ndarray) -> np.ndarray:
    return np.where(displayed <= 0.04045, displayed / 12.92, ((displayed + 0.055) / 1.055) ** 2.4)


def displayed(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def smooth(scene: Path) -> np.ndarray:
    """(V,H,W) where the range hardly changes within a pixel's neighbourhood, so that one range stands for it."""
    kernel = np.ones((3, 3))
    filled = [np.where(np.isinf(r), 1e3, r).astype(np.float32) for r in ranges(scene)]
    return np.stack([(r < 999) & (cv2.dilate(r, kernel) < 1.1 * cv2.erode(r, kernel)) for r in filled])


def modelled(scene: Path) -> np.ndarray:
    """Photographs by the formula, from what was written as truth: clean images, ranges, coefficients."""
    water = truth(scene)["water"]
    clean = np.stack([picture(path) for path in sorted((scene / "clean").iterdir())])
    values = linear(clean) if water["light"] == "linear" else clean
    z = np.where(np.isinf(ranges(scene)), 1e6, ranges(scene))[..., None]
    seen = values * np.exp(-np.array(water["beta_D"]) * z)
    seen = seen + np.array(water["B_inf"]) * (1 - np.exp(-np.array(water["beta_B"]) * z))
    return displayed(seen) if water["light"] == "linear" else seen


@pytest.mark.parametrize("name", ["base", "srgb"])
def test_photographs_are_clean_images_through_the_water_model(made: Path, name: str) -> None:
    inside = smooth(made / name)
    assert inside.mean() > 0.2
    difference = (photographs(made / name) - modelled(made / name))[inside]
    np.testing.assert_allclose(np.median(difference, axis=0), 0, atol=0.008)  # the rest is JPEG, most of it chroma
    assert np.median(np.abs(difference.mean(-1))) < 0.01
    # The other light, as a control that the comparison can tell.
    other = (photographs(made / name) - modelled(made / {"base": "srgb", "srgb": "base"}[name]))[inside]
    assert np.abs(np.median(other, axis=0)).max() > 0.02


def test_open_water_shows_the_water_color(made: Path) -> None:
    b_inf = displayed(np.array(truth(made / "base")["water"]["B_inf"]))
    for image, distance in zip(photographs(made / "base"), ranges(made / "base"), strict=True):
        open_water = cv2.erode(np.isinf(distance).astype(np.uint8), np.ones((9, 9))) > 0
        if open_water.any():
            np.testing.assert_allclose(np.median(image[open_water], axis=0), b_inf, atol=0.01)
    assert np.isinf(ranges(made / "base"))[:, :4].mean() > 0.5, "no open water at the top"


@pytest.mark.parametrize("name", ["base", "shipped"])
def test_points_reproject_to_their_observations_and_lie_on_the_surface(made: Path, name: str) -> None:
    scene = SHIPPED if name == "shipped" else made / name
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    camera = model.cameras[1]
    fx, fy, cx, cy = camera.params
    errors, tracks, off = [], [], []
    for image in model.images.values():
        pose = image.cam_from_world().matrix()
        held_out = scene / "range" / Path(image.name).with_suffix(".png").name
        surface = cv2.imread(str(held_out), cv2.IMREAD_UNCHANGED) / 1000.0 if held_out.is_file() else None
        for point in image.points2D:
            x, y, z = local = pose[:, :3] @ model.points3D[point.point3D_id].xyz + pose[:, 3]
            assert z > 0
            errors.append(np.hypot(fx * x / z + cx - point.xy[0], fy * y / z + cy - point.xy[1]))
            column, row = np.floor(point.xy).astype(int).clip(0, [camera.width - 1, camera.height - 1])
            if surface is not None:
                off.append(np.linalg.norm(local) / surface[row, column] - 1 if surface[row, column] else np.inf)
    tracks = [p.track.length() for p in model.points3D.values()]
    assert 0.15 < np.mean(errors) < 0.6, "observations carry 0.3 px of noise"
    assert np.percentile(errors, 98) < 1
    assert min(tracks) >= 3
    assert np.median(np.abs(off)) < 0.01
    assert np.mean(np.abs(off) < 0.05) > 0.8


def test_lamp_light_falls_with_range(made: Path) -> None:
    lamp = truth(made / "lamp")["lamp"]
    expected_ratio = (lamp["tau"] + lamp["reference_range"] ** 2) / (lamp["tau"] + ranges(made / "base") ** 2)
    water = truth(made / "base")["water"]
    z = np.where(np.isinf(ranges(made / "base")), 1e6, ranges(made / "base"))[..., None]
    backscatter = np.array(water["B_inf"]) * (1 - np.exp(-np.array(water["beta_B"]) * z))
    direct = [(linear(photographs(made / name)) - backscatter)[..., 1] for name in ("base", "lamp")]
    usable = smooth(made / "base") & (direct[0] > 0.04) & (direct[1] < 0.6)
    ratio = direct[1][usable] / direct[0][usable]
    assert np.ptp(np.percentile(expected_ratio[usable], [2, 98])) > 1
    assert np.median(np.abs(ratio / expected_ratio[usable] - 1)) < 0.1


def test_exposure_gains_are_those_written(made: Path) -> None:
    gains = np.array(list(truth(made / "exposure")["exposure"]["gains"].values()))
    assert 0.08 < np.log(gains).std() < 0.22
    pairs = zip(photographs(made / "exposure"), photographs(made / "base"), gains, strict=True)
    for changed, plain, gain in pairs:
        usable = (changed < 0.9) & (plain > 0.2)
        assert np.median(linear(changed)[usable] / linear(plain)[usable]) == pytest.approx(gain, rel=0.02)
    assert set(truth(made / "base")["exposure"]["gains"].values()) == {1.0}


def test_caustics_move_over_surfaces_and_spare_open_water(made: Path) -> None:
    assert truth(made / "caustics")["caustics"]["strength"] == 0.5
    change = linear(photographs(made / "caustics")) - linear(photographs(made / "base"))
    near = ranges(made / "base") < 5
    assert np.abs(change[near]).mean() > 0.01
    assert abs(change[near].mean()) < 0.3 * np.abs(change[near]).mean(), "waves move light, they add little"
    open_water = np.stack(
        [cv2.erode(np.isinf(r).astype(np.uint8), np.ones((17, 17))) > 0 for r in ranges(made / "base")]
    )
    assert open_water.any() and np.abs(change[open_water]).mean() < 0.005
    standing = linear(photographs(made / "standing"))[:2] - linear(photographs(made / "base"))[0]
    patterns = standing[:, near[0]].mean(-1)
    assert np.corrcoef(patterns)[0, 1] < 0.5, "the same view in two images has the same pattern"


def test_fish_are_where_the_masks_say_and_not_in_the_clean_images(made: Path) -> None:
    names = truth(made / "fish")["moving_objects"]
    assert len(names) == 2  # 0.34 of 6
    assert sorted(p.stem for p in (made / "fish" / "masks").iterdir()) == sorted(Path(n).stem for n in names)
    for name in sorted(path.name for path in (made / "fish" / "images").iterdir()):
        change = np.abs(picture(made / "fish" / "images" / name) - picture(made / "base" / "images" / name)).max(-1)
        png, clean = Path(name).with_suffix(".png").name, Path("clean", name).with_suffix(".webp")
        mask = np.zeros(change.shape, np.uint8)
        if name in names:
            mask = 255 - cv2.imread(str(made / "fish" / "masks" / png), cv2.IMREAD_GRAYSCALE)
            assert mask.mean() > 0.01 * 255
            assert np.median(change[mask > 0]) > 0.05
        away = cv2.dilate(mask, np.ones((19, 19))) == 0  # JPEG blocks carry a change up to 16 pixels
        assert np.percentile(change[away], 99) < 0.06
        assert (made / "fish" / clean).read_bytes() == (made / "base" / clean).read_bytes()


def test_a_real_volume_takes_red_light_away_with_range(made: Path) -> None:
    written = truth(made / "volume")
    assert written["water"] is None and written["volume"]["scattering"]
    images = linear(photographs(made / "volume"))
    clean = linear(np.stack([picture(path) for path in sorted((made / "volume" / "clean").iterdir())]))
    distance = ranges(made / "volume")

    def red_share(values: np.ndarray, where: np.ndarray) -> float:
        return values[where][:, 0].mean() / values[where].mean()

    near, far = distance < 4, (distance > 9) & np.isfinite(distance)
    assert red_share(images, near) < 0.7 * red_share(clean, near)
    assert red_share(images, far) < 0.7 * red_share(images, near)
    assert images[np.isinf(distance)].mean() > 0.05, "open water scatters light"


def test_the_same_settings_write_the_same_files(made: Path) -> None:
    files = sorted(p.relative_to(made / "base") for p in (made / "base").rglob("*") if p.is_file())
    assert len(files) > 3 * 6
    for file in files:
        assert (made / "base" / file).read_bytes() == (made / "again" / file).read_bytes(), file


def test_ranges_are_euclidean() -> None:
    """A held-out view's ranges carry its pixels to where the next photograph shows the same; z-depths would not."""
    model = pycolmap.Reconstruction(str(SHIPPED / "sparse" / "0"))
    poses = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    fx, fy, cx, cy = model.cameras[1].params
    y, x = np.mgrid[0:360, 0:640] + 0.5
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1)
    length = np.linalg.norm(rays, axis=-1)
    for k, distance in zip((0, 8, 16), ranges(SHIPPED), strict=True):
        here, there = poses[f"reef_{k:03d}.jpg"], poses[f"reef_{k + 1:03d}.jpg"]
        photograph, other = (picture(SHIPPED / "images" / f"reef_{n:03d}.jpg").astype(np.float32) for n in (k, k + 1))

        def mismatch(z: np.ndarray, here=here, there=there, photograph=photograph, other=other) -> float:
            surface = np.isfinite(z)
            world = (rays * np.where(surface, z, 1)[..., None] - here[:, 3]) @ here[:, :3]
            u, v, w = np.moveaxis(world @ there[:, :3].T + there[:, 3], -1, 0)
            u, v = (fx * u / w + cx - 0.5).astype(np.float32), (fy * v / w + cy - 0.5).astype(np.float32)
            inside = surface & (length > 1.1) & (w > 0) & (u > 0) & (u < 639) & (v > 0) & (v < 359)
            return float(np.median(np.abs(cv2.remap(other, u, v, cv2.INTER_LINEAR) - photograph).max(-1)[inside]))

        assert mismatch(distance / length) < 0.6 * mismatch(distance)


def test_the_generator_makes_the_shipped_scene(made: Path) -> None:
    assert truth(SHIPPED)["held_out"] == [f"reef_{k:03d}.jpg" for k in (0, 8, 16)]
    for k in (0, 8, 16):  # of 24 views are 0, 2, 4 of 6
        shipped = linear(picture(SHIPPED / "clean" / f"reef_{k:03d}.webp"))
        shipped = cv2.resize(shipped, SIZE, interpolation=cv2.INTER_AREA)
        afresh = linear(picture(made / "base" / "clean" / f"reef_{k // 4:03d}.webp"))
        assert np.corrcoef(shipped.ravel(), afresh.ravel())[0, 1] > 0.93
        assert shipped.mean() == pytest.approx(afresh.mean(), rel=0.05)
        there, here = ranges(SHIPPED)[k // 8][4::8, 4::8], ranges(made / "base")[k // 4]
        both = np.isfinite(there) & np.isfinite(here)
        assert np.median(np.abs(here[both] / there[both] - 1)) < 0.015


def test_the_shipped_scene_is_small_whole_and_deep() -> None:
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*") if path.is_file()) <= 4_000_000
    images = sorted((SHIPPED / "images").iterdir())
    assert len(images) == 24
    assert {picture(path).shape for path in images} == {(360, 640, 3)}
    model = pycolmap.Reconstruction(str(SHIPPED / "sparse" / "0"))
    assert sorted(image.name for image in model.images.values()) == [path.name for path in images]
    assert model.cameras[1].model.name == "PINHOLE"
    assert model.num_points3D() == truth(SHIPPED)["points"] >= 2000
    span = truth(SHIPPED)["range"]
    assert span["p98"] / span["p2"] >= 8
    assert len(list((SHIPPED / "clean").iterdir())) == len(list((SHIPPED / "range").iterdir())) == 3
