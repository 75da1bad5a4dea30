"""Frames between two images, by a frame interpolation network (docs/method.md section 8).

Frames are made only between neighbouring training images without a held-out image between them: such a frame would show
the pixels of the held-out one. Whether a network is good enough for a scene is measured on the scene before it is used.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ..base.errors import InputError
from ..scene.cameras import Camera
from ..scene.images import TrainingImage
from ..weights.onnx import Network

STRIDE = 32
"""The sides of the network's input are multiples of it, because the network halves them five times."""
MIN_PSNR = 22.0
"""Median PSNR of interpolated against left-out images, dB."""
MIN_GAIN = 1.0
"""Median gain over the blend of the two neighbours, dB."""
MAX_INCONSISTENCY = 2.0
"""Distance between a pixel and where optical flow there and back takes it, below which flow is consistent, pixels."""
MIN_CONSISTENT = 0.8
"""Median fraction of pixels with consistent flow."""
MAX_TESTS = 8
"""Images that are left out and interpolated."""


class Interpolator:
    """A frame interpolation network in an ONNX file, such as RIFE 4.

    Inputs, in this order: two images (1, 3, H, W) RGB in 0..1, H and W multiples of STRIDE, and the time t as one
    number. Output: (1, 3, H, W).

    Args:
        path: The file.

    Raises:
        InputError: If the file is absent or another network.
    """

    def __init__(self, path: Path) -> None:
        image = (1, 3, None, None)
        self.network = Network(path, "a frame interpolation network", [image, image, ()], [image])

    def __call__(self, a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
        """Interpolate a frame.

        Args:
            a: Image at t = 0, (H, W, 3) uint8 sRGB.
            b: Image at t = 1, of the same size.
            t: Time of the frame, 0..1.

        Returns:
            The frame, (H, W, 3) uint8 sRGB.

        Raises:
            InputError: If the images differ in size or the network fails.
        """
        if a.shape != b.shape:
            raise InputError(
                f"No frame can be made between images of {a.shape[1]} x {a.shape[0]} and {b.shape[1]} x "
                f"{b.shape[0]} pixels: they must have the same size."
            )
        height, width = a.shape[:2]
        margins = ((0, -height % STRIDE), (0, -width % STRIDE), (0, 0))
        first, second = (
            np.pad(image, margins, mode="edge").transpose(2, 0, 1)[None].astype(np.float32) / 255 for image in (a, b)
        )
        made = self.network(first, second, np.array(t, np.float32))
        if made.shape != first.shape:
            raise InputError(
                f"{self.network.path} is not a frame interpolation network: it made {made.shape} from {first.shape}."
            )
        return (made[0].transpose(1, 2, 0)[:height, :width].clip(0, 1) * 255).round().astype(np.uint8)


def interpolated_pose(camera_a: Camera, camera_b: Camera, t: float) -> Camera:
    """Interpolate a camera: spherical interpolation of the rotations (Shoemake 1985), linear of the centres.

    Args:
        camera_a: Camera at t = 0.
        camera_b: Camera at t = 1.
        t: Time, 0..1.

    Returns:
        The camera at t, named A+B@t.

    Raises:
        InputError: If the two have different intrinsics.
    """
    first, second = (
        (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) for camera in (camera_a, camera_b)
    )
    if not np.allclose(first, second, rtol=1e-6, atol=0):
        raise InputError(
            f"No camera can be interpolated between {camera_a.name} and {camera_b.name}: their lenses or sizes differ."
        )
    rotations = Rotation.from_matrix([camera.world_to_camera[:3, :3] for camera in (camera_a, camera_b)])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = Slerp([0, 1], rotations)(t).as_matrix()
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ ((1 - t) * camera_a.centre + t * camera_b.centre)
    return replace(camera_a, name=f"{camera_a.name}+{camera_b.name}@{t:g}", world_to_camera=world_to_camera)


def neighbour_pairs(names: Iterable[str], train_names: Iterable[str]) -> list[tuple[str, str]]:
    """Find pairs of training images that are neighbours in the order of all images.

    Numbers in the names are ordered by value, so that 2 comes before 10: in alphabetical order images that were taken
    far apart, with held-out ones between them, would be neighbours. Images in different folders (cameras of a rig,
    dives) are not neighbours.

    Args:
        names: All images of the scene, held-out ones too.
        train_names: The training images.

    Returns:
        Pairs of names, in order.
    """
    ordered = sorted(set(names), key=_by_number)
    training = set(train_names)
    return [
        (a, b)
        for a, b in zip(ordered, ordered[1:], strict=False)
        if a in training and b in training and a.rpartition("/")[0] == b.rpartition("/")[0]
    ]


def _by_number(name: str) -> tuple[list[str | int], str]:
    """Return the sort key of a name: the numbers in it by value, then its letters (for 1 and 01)."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))], name


@dataclass(frozen=True)
class InterpolationTest:
    """Whether interpolated frames are good enough to train on, from training images that were left out.

    Attributes:
        count: Number of images that were left out and interpolated from their neighbours.
        psnr: Median PSNR of the interpolated against the left-out image, dB.
        gain: Median of how much that is more than the PSNR of a blend of the neighbours, dB.
        consistent: Median fraction of pixels whose optical flow to both neighbours is consistent.
        accepted: Whether the frames are good enough.
        reason: Why they are not, a sentence; empty where they are accepted.
    """

    count: int
    psnr: float
    gain: float
    consistent: float
    accepted: bool
    reason: str


def interpolation_test(
    interpolator: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
    images: Mapping[str, TrainingImage],
    pairs: Sequence[tuple[str, str]],
) -> InterpolationTest:
    """Test an interpolator on a scene: leave out the middle one of three neighbours and interpolate it.

    Frames are accepted with a median PSNR of MIN_PSNR, consistent flow at MIN_CONSISTENT of the pixels, and MIN_GAIN
    more than a blend of the neighbours reaches, because in turbid water a blend reaches 30 dB and its flow can be
    consistent.

    Args:
        interpolator: Makes the frame between two images at a time in 0..1.
        images: Image name -> image, of all images in `pairs`.
        pairs: Result of `neighbour_pairs`. Up to MAX_TESTS triples are tested, distributed over the scene.

    Returns:
        The figures, and whether the frames are accepted.
    """
    after = dict(pairs)
    triples = [(images[a], images[b], images[after[b]]) for a, b in pairs if b in after]
    triples = [
        triple
        for triple in triples
        if len({image.pixels.shape for image in triple}) == 1
        and min(triple[1].valid.shape) >= STRIDE
        and triple[1].valid.any()
    ]
    if not triples:
        nan = float("nan")
        reason = (
            f"Interpolation cannot be tested: no three training images of one size ({STRIDE} pixels or more) follow "
            "each other."
        )
        return InterpolationTest(0, nan, nan, nan, False, reason)
    chosen = np.linspace(0, len(triples) - 1, min(MAX_TESTS, len(triples))).round().astype(int)
    figures = []
    for before, middle, behind in (triples[i] for i in chosen):
        made = interpolator(before.pixels, behind.pixels, 0.5)
        blend = cv2.addWeighted(before.pixels, 0.5, behind.pixels, 0.5, 0)
        consistent = consistent_flow(made, before.pixels) & consistent_flow(made, behind.pixels)
        psnr = _psnr(made, middle)
        figures.append((psnr, psnr - _psnr(blend, middle), consistent[middle.valid].mean()))
    psnr, gain, consistent_fraction = (float(value) for value in np.median(figures, axis=0))
    if psnr < MIN_PSNR:
        reason = f"Interpolated frames differ from the images: {psnr:.1f} dB, and {MIN_PSNR:g} dB are needed."
    elif gain < MIN_GAIN:
        reason = (
            f"Interpolated frames are hardly better than a blend of their neighbours: by {gain:.1f} dB, and "
            f"{MIN_GAIN:g} dB is needed."
        )
    elif consistent_fraction < MIN_CONSISTENT:
        reason = (
            f"Interpolated frames do not move with their neighbours: {consistent_fraction:.1%} of the pixels do, and "
            f"{MIN_CONSISTENT:.0%} are needed."
        )
    else:
        reason = ""
    return InterpolationTest(len(chosen), psnr, gain, consistent_fraction, not reason, reason)


def consistent_flow(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Find pixels that optical flow (DIS, Kroeger et al. 2016) takes to another image and back to the same place.

    Args:
        a: (H, W, 3) uint8 sRGB.
        b: The other image, of the same size.

    Returns:
        (H, W) bool, pixels of `a` that come back within MAX_INCONSISTENCY.
    """
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (a, b)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = (
        dis.calc(first, second, None)  # type: ignore[call-overload]  # the stubs lack None for the initial flow
        for first, second in (grey, grey[::-1])
    )
    rows, columns = np.indices(grey[0].shape, np.float32)
    x, y = columns + there[..., 0], rows + there[..., 1]
    returned = there + cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.linalg.norm(returned, axis=-1) < MAX_INCONSISTENCY


def _psnr(made: np.ndarray, image: TrainingImage) -> float:
    """Return the peak signal-to-noise ratio over the image's valid pixels, dB."""
    difference = (made.astype(np.float32) - image.pixels)[image.valid] / 255
    return float(-10 * np.log10(max(np.square(difference).mean(), 1e-10)))
