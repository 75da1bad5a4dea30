"""Rolling shutter of the images of a COLMAP model, from its residuals."""

from dataclasses import dataclass

import numpy as np

from .colmap_library import pycolmap
from .model_observations import Observations


@dataclass(frozen=True)
class RollingShutter:
    """The part of the residuals that is in proportion to the row and to the motion in the image.

    Attributes:
        readout: Time between the first and the last row, over that between two images; an underestimate, as poses and
            points take up a part.
        certainty: Absolute value of `readout` over its standard error.
        shift: Mean shift between the first and the last row that it explains, pixels.
    """

    readout: float
    certainty: float
    shift: float


def fit_rolling_shutter(model: pycolmap.Reconstruction, observations: Observations) -> RollingShutter | None:
    """Fit a rolling shutter to the residuals, taking the images in the order of their names as a sequence.

    With a rolling shutter, each row is taken from another place of the path, so that residuals are the row (from the
    middle) times the motion of the point in the image from one image to the next. Of both, what the pose of an image
    and the lens could explain is removed first; so a camera that always moves in one direction shows nothing.

    Returns:
        The fit, None where there is too little to tell.
    """
    motion = _motion(model, observations)
    size_of = {camera_id: (camera.width, camera.height) for camera_id, camera in model.cameras.items()}
    sizes = np.array([size_of[camera_id] for camera_id in observations.camera_ids.tolist()], float).reshape(-1, 2)
    size = sizes[observations.image] if len(sizes) else np.zeros((0, 2))
    used = np.isfinite(motion).all(1) & np.isfinite(observations.residuals).all(1)
    # Images further apart than this are no sequence.
    used &= np.linalg.norm(motion, axis=1) < 0.5 * size.max(1, initial=0)
    counts = np.bincount(observations.image[used], minlength=len(observations.image_ids))
    used &= counts[observations.image] >= 20
    if len(np.unique(observations.image[used])) < 8:
        return None
    image, residuals = observations.image[used], observations.residuals[used]
    place = (observations.pixels[used] - size[used] / 2) / size[used].max(1, keepdims=True)
    row = observations.pixels[used][:, 1] / size[used][:, 1] - 0.5
    shift = row[:, None] * motion[used]
    x, y, zero, one = place[:, 0], place[:, 1], np.zeros(len(place)), np.ones(len(place))
    squared = x * x + y * y
    by_pose = [(one, zero), (zero, one), (x, y), (-y, x)]
    by_lens = [(x, -y), (y, x), (x * squared, y * squared)]
    basis = np.stack([np.stack(pair, 1) for pair in (*by_pose, *by_lens)], 2)  # (M, 2, 7)
    target = np.concatenate([residuals[..., None], shift[..., None], basis[..., 4:]], 2)
    for index in np.unique(image):
        own = image == index
        pose = basis[own][..., :4].reshape(-1, 4)
        values = target[own].reshape(-1, target.shape[2])
        target[own] = (values - pose @ np.linalg.lstsq(pose, values, rcond=None)[0]).reshape(-1, 2, target.shape[2])
    cameras = observations.camera_ids[image]
    for camera_id in np.unique(cameras):
        own = cameras == camera_id
        lens = target[own][..., 2:].reshape(-1, 3)
        values = target[own][..., :2].reshape(-1, 2)
        target[own, :, :2] = (values - lens @ np.linalg.lstsq(lens, values, rcond=None)[0]).reshape(-1, 2, 2)
    left, explained = target[..., 0], target[..., 1]
    power = float((explained**2).sum())
    if power < 1e-6 * float((shift**2).sum()) or power == 0:
        return None
    readout = float((explained * left).sum() / power)
    remaining = left - readout * explained
    # Residuals of one image depend on each other: the error is that of sums over images.
    by_image = np.bincount(image, weights=(explained * remaining).sum(1))
    error = float(np.sqrt((by_image**2).sum()) / power)
    return RollingShutter(
        readout=readout,
        certainty=abs(readout) / max(error, 1e-300),
        shift=abs(readout) * float(np.linalg.norm(motion[used], axis=1).mean()),
    )


def _motion(model: pycolmap.Reconstruction, observations: Observations) -> np.ndarray:
    """Return the motion in the image of each observation, (M, 2) pixels from one image to the next, NaN at the ends."""
    places = []
    for offset in (-1, 1):
        neighbour = observations.image + offset
        known = (neighbour >= 0) & (neighbour < len(observations.image_ids))
        # Where the point would be in this image's camera, had it the pose of the neighbour.
        places.append(observations.project(model, np.clip(neighbour, 0, len(observations.image_ids) - 1)))
        places[-1][~known] = np.nan
    return (places[1] - places[0]) / 2
