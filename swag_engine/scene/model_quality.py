"""Quality of a COLMAP model: how certain its cameras are, and what about them is doubtful.

Everything is computed from the model alone, whichever program made it. Images are taken in the order of their names.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..base.text import first_names
from .colmap_library import pycolmap
from .drift import Drift, find_drift, find_open_loops
from .focal_error import focal_errors
from .model_observations import Observations
from .rolling_shutter import RollingShutter, fit_rolling_shutter

FEW_REGISTERED = 0.9
"""Fraction of the images that have a pose, below which it is reported: of fewer than ten, each that has none."""
_LARGE_ERROR = 2.0
"""Mean reprojection error in pixels above which poses are doubtful: COLMAP drops observations above 4, and the example
scenes have 0.3 to 0.7."""
_FEW_POINTS = 40
"""Points of an image below which its pose is doubtful: COLMAP accepts a pose from 30 on."""
_FIELDS_OF_VIEW = 15.0, 120.0
"""Horizontal fields of view in degrees, from a telephoto lens to action cameras: outside of them the focal length of a
lens without known focal length is probably wrong."""
_WIDEST_FISHEYE = 220.0
"""Largest field of view of fisheye lenses in degrees."""
_PRIOR_RATIOS = 0.8, 1.6
"""Focal lengths under water over those in EXIF: 1 behind a dome port, 1.33 behind a flat port."""
_SMALL_ANGLE = 2.0
"""Median triangulation angle in degrees below which ranges, and with them the cameras, are uncertain."""
_LARGE_FOCAL_ERROR = 0.05
"""Relative standard error of the focal length above which it is not known."""
_CERTAIN = 6.0
"""Standard errors from zero at which a rolling shutter is reported: without one, scenes had up to 2.4."""
_LARGE_SHIFT = 0.3
"""Shift in pixels between first and last row that a rolling shutter must explain to matter: half a usual reprojection
error."""
_LARGE_DRIFT = 0.01
"""Drift over the length of the path above which it is reported."""
_MOST_OPEN_LOOPS = 3
"""Pairs of images that should share points and do not, from which on they are reported: one may be a coincidence."""


@dataclass(frozen=True)
class Doubt:
    """Something about a model that is probably wrong.

    Attributes:
        kind: What it is about: "registered", "field_of_view", "focal_prior", "focal_error", "triangulation_angle",
            "reprojection_error", "drift", "open_loop", "rolling_shutter" or "few_points".
        sentence: What was found, and what to do.
    """

    kind: str
    sentence: str


@dataclass(frozen=True)
class ModelQuality:
    """Figures of a model. None and empty mappings where the model has no observations.

    Attributes:
        image_count: Images that the model was made from.
        registered: Images that have a pose.
        registered_share: Their fraction, 0..1.
        points: Number of sparse points.
        track_length: Mean number of images that observe a point.
        reprojection_error: Mean over the points, pixels.
        triangulation_angle: Median over the points of the largest angle between two of its views, degrees.
        fields_of_view: Horizontal fields of view by camera id, degrees.
        focal_lengths: Focal lengths (in x) by camera id, pixels.
        focal_errors: Relative standard errors of the focal lengths by camera id, None where undetermined.
        drift: Disagreement of the first and the last visit of a place, None where no place is visited twice.
        open_loops: Names of images that should show the same place, but share no points.
        rolling_shutter: What a rolling shutter explains of the residuals, None where it cannot be determined.
        few_points: Names of images with few points.
        doubts: What is doubtful, most serious first.
    """

    image_count: int
    registered: int
    registered_share: float
    points: int
    track_length: float | None
    reprojection_error: float | None
    triangulation_angle: float | None
    fields_of_view: dict[int, float]
    focal_lengths: dict[int, float]
    focal_errors: dict[int, float | None]
    drift: Drift | None
    open_loops: tuple[tuple[str, str], ...]
    rolling_shutter: RollingShutter | None
    few_points: tuple[str, ...]
    doubts: tuple[Doubt, ...]


def assess_model(
    model: pycolmap.Reconstruction, image_count: int, focal_priors: Mapping[int, float] = {}
) -> ModelQuality:
    """Assess a model.

    Args:
        model: The model. It is not changed.
        image_count: Images that it was made from, registered or not.
        focal_priors: Focal lengths in pixels by camera id, from EXIF or a calibration.

    Returns:
        The figures, and what is doubtful.
    """
    with np.errstate(all="ignore"):  # figures that are not finite stand for damaged models
        quality = _figures(model, image_count)
    return replace(quality, doubts=tuple(_doubts(model, quality, focal_priors)))


def _figures(model: pycolmap.Reconstruction, image_count: int) -> ModelQuality:
    observations = Observations.of(model)
    cameras = {model.image(image_id).camera_id: None for image_id in model.reg_image_ids()}
    registered = model.num_reg_images()
    errors = [point.error for point in model.points3D.values() if point.error >= 0]
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return ModelQuality(
        image_count=image_count,
        registered=registered,
        registered_share=min(1.0, registered / image_count) if image_count else 0.0,
        points=model.num_points3D(),
        track_length=model.compute_mean_track_length() if len(observations.image) else None,
        reprojection_error=float(np.mean(errors)) if errors else None,
        triangulation_angle=_median_angle(observations),
        fields_of_view={camera_id: field_of_view(model.camera(camera_id)) for camera_id in cameras},
        focal_lengths={camera_id: float(model.camera(camera_id).focal_length_x) for camera_id in cameras},
        focal_errors=focal_errors(model, observations),
        drift=find_drift(model, observations),
        open_loops=tuple(find_open_loops(model, observations)),
        rolling_shutter=fit_rolling_shutter(model, observations),
        # A model may come without observations, from a simulator or a survey.
        few_points=tuple(sorted(image.name for image in images if 0 < image.num_points3D < _FEW_POINTS)),
        doubts=(),
    )


def field_of_view(camera: pycolmap.Camera) -> float:
    """Return the horizontal field of view in degrees, between the rays of the left and the right border."""
    middle = camera.height / 2
    rays = camera.cam_ray_from_img(np.array([[0.0, middle], [camera.width, middle]]))
    if not np.isfinite(rays).all():
        return math.degrees(2 * math.atan2(camera.width, 2 * camera.focal_length_x))
    left, right = (math.degrees(math.atan2(x, z)) for x, _, z in rays)
    return right - left


def _median_angle(observations: Observations) -> float | None:
    """Return the median over the points of the largest angle between two of their views, degrees."""
    if not len(observations.image):
        return None
    rays = observations.positions[observations.point] - observations.centres[observations.image]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    starts = np.unique(observations.point, return_index=True)[1]
    angles = []
    for track in np.split(rays, starts[1:]):
        if len(track) > 1:
            angles.append(np.arccos(np.clip((track @ track.T).min(), -1, 1)))
    return float(np.degrees(np.median(angles))) if angles else None


def _doubts(model: pycolmap.Reconstruction, quality: ModelQuality, focal_priors: Mapping[int, float]) -> list[Doubt]:
    doubts = []

    def doubt(kind: str, sentence: str) -> None:
        doubts.append(Doubt(kind, sentence))

    if quality.registered < FEW_REGISTERED * quality.image_count:
        doubt(
            "registered",
            f"Only {quality.registered} of the {quality.image_count} photos have a pose: more overlap between "
            "neighbouring photos would help.",
        )
    least, most = _FIELDS_OF_VIEW
    for camera_id, field in quality.fields_of_view.items():
        prior, focal = focal_priors.get(camera_id), quality.focal_lengths[camera_id]
        if prior is None:
            widest = _WIDEST_FISHEYE if model.camera(camera_id).is_perspective_fisheye() else most
            if not least <= field <= widest:
                doubt(
                    "field_of_view",
                    f"A horizontal field of view of {field:.0f}° is unlikely (usual: {least:.0f}° to {widest:.0f}°): "
                    "the focal length is doubtful. Photos that keep their EXIF data, or that look at the same place "
                    "from more directions, would help.",
                )
        elif not _PRIOR_RATIOS[0] <= focal / prior <= _PRIOR_RATIOS[1]:
            doubt(
                "focal_prior",
                f"The focal length of {focal:.0f} px is {focal / prior:.2f} times that in the photos' EXIF data "
                f"(usual under water: {_PRIOR_RATIOS[0]:g} to {_PRIOR_RATIOS[1]:g} times): it is doubtful. Photos of "
                "the same place from more directions would help.",
            )
        error = quality.focal_errors[camera_id]
        if error is not None and error > _LARGE_FOCAL_ERROR:
            doubt(
                "focal_error",
                f"The focal length of {focal:.0f} px is known to {error:.0%} only (threshold "
                f"{_LARGE_FOCAL_ERROR:.0%}): photos with the camera turned by 90°, or that look at the same place from "
                "more directions, would determine it.",
            )
    angle = quality.triangulation_angle
    if angle is not None and angle < _SMALL_ANGLE:
        doubt(
            "triangulation_angle",
            f"Points are seen from directions that differ by {angle:.1f}° only (median, threshold {_SMALL_ANGLE:g}°): "
            "ranges are uncertain. Photos from places further apart would help.",
        )
    error = quality.reprojection_error
    if error is not None and error > _LARGE_ERROR:
        doubt(
            "reprojection_error",
            f"The mean reprojection error is {error:.1f} px (threshold {_LARGE_ERROR:g} px): the poses are doubtful.",
        )
    drift = quality.drift
    if drift is not None and drift.fraction > max(_LARGE_DRIFT, 3 * drift.error):
        doubt(
            "drift",
            f"The place in {drift.first} and, later, in {drift.last} lies apart by {drift.fraction:.1%} of the path "
            f"(threshold {_LARGE_DRIFT:.0%}): the cameras drift. Photos that come back to places seen before, with "
            "more overlap, would help.",
        )
    if len(quality.open_loops) >= _MOST_OPEN_LOOPS:
        first, last = quality.open_loops[0]
        doubt(
            "open_loop",
            f"{first} and {last} should show the same place, but share no points: between them the cameras may drift, "
            "and surfaces may appear twice. Match these photos, or add some between them.",
        )
    rolling = quality.rolling_shutter
    if rolling is not None and rolling.certainty > _CERTAIN and rolling.shift > _LARGE_SHIFT:
        doubt(
            "rolling_shutter",
            f"A rolling shutter shifts the rows of the photos by about {rolling.shift:.1f} px or more from first to "
            "last: edges and poses become less exact. Move more slowly, or film with a shorter readout (a higher frame "
            "rate) or a global shutter.",
        )
    if quality.few_points:
        doubt(
            "few_points",
            f"Photos with fewer than {_FEW_POINTS} points, whose poses are doubtful: "
            f"{first_names(quality.few_points)}.",
        )
    return doubts
