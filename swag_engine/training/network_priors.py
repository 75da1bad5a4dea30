"""Priors that networks give a run: depth of single images, and frames interpolated between images.

Each function also returns a sentence for the user. A prior that cannot be had is left out with the reason.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..evidence.scene_evidence import FrameNetwork
from ..priors.depth import InverseDepth, StoredDepth, depth_priors
from ..priors.interpolate import Interpolator, interpolated_pose, interpolation_test, neighbour_pairs
from ..scene.colmap import Scene
from ..scene.images import TrainingImage
from ..weights.registry import find

DEPTH_NETWORK = "depth-anything-v2-small"
FRAME_NETWORK = "rife"


def network_path(name: str, weights_dir: Path | None) -> Path | None:
    """Return where the file of a network is, None where there is none."""
    try:
        return find(name, weights_dir)
    except InputError:
        return None


def depth_of_images(
    scene: Scene, training: Sequence[TrainingImage], weights_dir: Path | None
) -> tuple[str, dict[str, np.ndarray]]:
    """Predict the inverse range of the training images.

    A scene may bring its own maps: depth/NAME.png (16 bits) or depth/NAME.npy, inverse depth up to scale and shift.

    Args:
        scene: The scene, whose sparse points give the scale.
        training: Images to predict.
        weights_dir: Folder where networks are looked for first.

    Returns:
        A sentence for the user, and by image name the inverse range (H, W) float32 per scene unit.
    """
    try:
        if (scene.folder / "depth").is_dir():
            priors, alignments = depth_priors(StoredDepth(scene), training, scene)
        else:
            network = InverseDepth(find(DEPTH_NETWORK, weights_dir))
            priors, alignments = depth_priors(lambda image: network(image.pixels), training, scene)
    except InputError as error:
        return f"No depth prior: {error}", {}
    refused = sorted({alignment.reason for alignment in alignments.values() if not alignment.accepted})
    why = f" {refused[0]}" if refused else ""
    return f"Depth prior on {len(priors)} of {len(training)} images.{why}", priors


def interpolated_frames(
    scene: Scene, training: Sequence[TrainingImage], weights_dir: Path | None
) -> tuple[str, list[TrainingImage]]:
    """Interpolate a frame in the middle between each two neighbouring training images.

    Args:
        scene: The scene, whose image names give the order.
        training: Images to interpolate between.
        weights_dir: Folder where networks are looked for first.

    Returns:
        A sentence for the user, and the frames with their cameras.
    """
    try:
        return frames_between(Interpolator(find(FRAME_NETWORK, weights_dir)), scene, training)
    except InputError as error:
        return f"No interpolated frames: {error}", []


def frames_between(
    interpolator: FrameNetwork, scene: Scene, training: Sequence[TrainingImage]
) -> tuple[str, list[TrainingImage]]:
    """Interpolate frames by a network; other arguments and results as of `interpolated_frames`.

    Raises:
        InputError: If two neighbouring images have different intrinsics, or the network fails.
    """
    images = {image.camera.name: image for image in training}
    pairs = neighbour_pairs([view.camera.name for view in scene.views], images)
    judged = interpolation_test(interpolator, images, pairs)
    if not judged.accepted:
        return f"No interpolated frames: {judged.reason}", []
    frames = []
    for first, second in ((images[a], images[b]) for a, b in pairs):
        if first.pixels.shape != second.pixels.shape:
            continue
        camera = interpolated_pose(first.camera, second.camera, 0.5)
        pixels = interpolator(first.pixels, second.pixels, 0.5)
        frames.append(TrainingImage(camera, pixels, first.valid & second.valid))
    return f"{len(frames)} interpolated frames ({judged.psnr:.1f} dB against images that were left out).", frames
