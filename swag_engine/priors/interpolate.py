"""Frames between two photographs, by a frame interpolation network (docs/method.md section 8).

Only between training photographs that nothing held out lies between: a frame made across a test view would show what
the run must not know. Whether a network is good enough for a scene is measured on the scene before it is used.
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

STRIDE = 32  # sides must be multiples of it, for the network halves them five times

MIN_PSNR, MIN_GAIN, MAX_INCONSISTENCY, MIN_CONSISTENT = 22.0, 1.0, 2.0, 0.8  # dB, dB over a blend, pixels, share
MOST_TESTS = 8


class Interpolator:
    """A frame interpolation network in an ONNX file, such as RIFE 4.

    Inputs, in this order: two images (1, 3, H, W) RGB in 0..1, H and W multiples of 32, and t as one number. Output
    (1, 3, H, W).
    """

    def __init__(self, path: Path) -> None:
        """Raises InputError when the file is absent or no such network."""
        image = (1, 3, None, None)
        self.network = Network(path, "a frame interpolation network", [image, image, ()], [image])

    def __call__(self, a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
        """The frame at time t in 0..1 between a (0) and b (1), all (H, W, 3) uint8 sRGB.

        Raises InputError when the images differ in size or the network fails.
        """
        if a.shape != b.shape:
            raise InputError(
                f"No frame can be made between photographs of {a.shape[1]} x {a.shape[0]} and {b.shape[1]} x "
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
    """The camera at time t in 0..1 from a to b: slerp of the rotations, lerp of the centres.

    Raises InputError when the two have different intrinsics.
    """
    first, second = (
        (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) for camera in (camera_a, camera_b)
    )
    if not np.allclose(first, second, rtol=1e-6, atol=0):
        raise InputError(
            f"No camera can be put between {camera_a.name} and {camera_b.name}: they were taken with different lenses "
            "or sizes."
        )
    rotations = Rotation.from_matrix([camera.world_to_camera[:3, :3] for camera in (camera_a, camera_b)])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = Slerp([0, 1], rotations)(t).as_matrix()
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ ((1 - t) * camera_a.centre + t * camera_b.centre)
    return replace(camera_a, name=f"{camera_a.name}+{camera_b.name}@{t:g}", world_to_camera=world_to_camera)


def neighbour_pairs(names: Iterable[str], train_names: Iterable[str]) -> list[tuple[str, str]]:
    """Pairs of training images that are neighbours in the order of all images, `names`, held-out ones too.

    The order is that of their numbers: 2 comes before 10 however many digits are written, since in the order of the
    letters frames that were taken far apart, with held-out ones between them, would be neighbours. Images in different
    folders (cameras of a rig, dives) are no neighbours.
    """
    ordered = sorted(set(names), key=_by_number)
    training = set(train_names)
    return [
        (a, b)
        for a, b in zip(ordered, ordered[1:], strict=False)
        if a in training and b in training and a.rpartition("/")[0] == b.rpartition("/")[0]
    ]


def _by_number(name: str) -> tuple[list[str | int], str]:
    """Sorts names by the numbers in them; equal ones (1, 01) by their letters."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))], name


# Admission ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Admission:
    """Whether interpolated frames are good enough to train on, and the figures that say so.

    Medians over `count` training photographs that were left out and interpolated from their neighbours: psnr in dB
    against the photograph, gain in dB over a plain blend of the neighbours, and `consistent`, the share of pixels whose
    flow to both neighbours and back ends within 2 pixels. `reason` is one sentence, empty where admitted.
    """

    count: int
    psnr: float
    gain: float
    consistent: float
    admitted: bool
    reason: str


def admission(
    interpolator: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
    images: Mapping[str, TrainingImage],
    pairs: Sequence[tuple[str, str]],
) -> Admission:
    """Test the interpolator on the scene: leave the middle one of three neighbours out (docs/method.md section 8).

    `pairs` are those of `neighbour_pairs`, so that no held-out image is looked at; `images` holds theirs. At most eight
    triples are tried, spread over the scene. Admitted are a PSNR of >= 22 dB, consistent flow on >= 80 % of the pixels,
    and 1 dB more than a plain blend reaches: in murky scenes that is 30 dB, and its flow may well be consistent.
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
            "Interpolation cannot be tested: no three training photographs of one size (32 pixels or more) follow each "
            "other."
        )
        return Admission(0, nan, nan, nan, False, reason)
    chosen = np.linspace(0, len(triples) - 1, min(MOST_TESTS, len(triples))).round().astype(int)
    figures = []
    for before, middle, behind in (triples[i] for i in chosen):
        made = interpolator(before.pixels, behind.pixels, 0.5)
        blend = cv2.addWeighted(before.pixels, 0.5, behind.pixels, 0.5, 0)
        consistent = consistent_flow(made, before.pixels) & consistent_flow(made, behind.pixels)
        psnr = _psnr(made, middle)
        figures.append((psnr, psnr - _psnr(blend, middle), consistent[middle.valid].mean()))
    psnr, gain, share = (float(value) for value in np.median(figures, axis=0))
    if psnr < MIN_PSNR:
        reason = f"Interpolated frames miss the photographs: {psnr:.1f} dB, and {MIN_PSNR:g} dB are needed."
    elif gain < MIN_GAIN:
        reason = (
            f"Interpolated frames are hardly better than a blend of their neighbours: by {gain:.1f} dB, and "
            f"{MIN_GAIN:g} dB is needed."
        )
    elif share < MIN_CONSISTENT:
        reason = (
            f"Interpolated frames do not move with their neighbours: {share:.1%} of the pixels do, and "
            f"{MIN_CONSISTENT:.0%} are needed."
        )
    else:
        reason = ""
    return Admission(len(chosen), psnr, gain, share, not reason, reason)


def consistent_flow(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) bool of image a come back within 2 pixels when they follow the optical flow (DIS, Kroeger et
    al. 2016) to image b and back; both (H, W, 3) uint8 RGB."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (a, b)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = (
        dis.calc(first, second, None)  # type: ignore[call-overload]  # its stubs know no absent first guess
        for first, second in (grey, grey[::-1])
    )
    rows, columns = np.indices(grey[0].shape, np.float32)
    x, y = columns + there[..., 0], rows + there[..., 1]
    returned = there + cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.linalg.norm(returned, axis=-1) < MAX_INCONSISTENCY


def _psnr(made: np.ndarray, photograph: TrainingImage) -> float:
    """Peak signal-to-noise ratio in dB over the photograph's valid pixels."""
    difference = (made.astype(np.float32) - photograph.pixels)[photograph.valid] / 255
    return float(-10 * np.log10(max(np.square(difference).mean(), 1e-10)))
