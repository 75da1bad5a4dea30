"""Other cameras that may explain the observations of a finished model better.

Mapping can end in the wrong solution where a camera moves straight on over a flat floor (`plane_solutions`), and it
assumes a perspective lens. In both cases bundle adjustment bends the model until it fits, with a small reprojection
error and a wrong focal length. So the alternatives are adjusted to a sample of the same observations, which takes
seconds.
"""

import copy
from dataclasses import dataclass

import numpy as np

from ..scene.colmap_library import pycolmap
from ..scene.model_observations import Observations
from ..scene.model_quality import Doubt, field_of_view
from .plane_solutions import other_plane_solution

_CLEARLY_LESS = 0.9
"""Ratio of mean reprojection errors below which one plane solution is right: ten generated videos forward had 0.3 to
0.7. Between this and its inverse they cannot be told apart."""
_FISHEYE_LESS = 0.8
"""Ratio of mean reprojection errors below which a lens is a fisheye: those of generated fisheye lenses had 0.3 to 0.45,
perspective ones 0.98 and more. Its model has more parameters, so that it always fits somewhat better."""
_FISHEYE = "OPENCV_FISHEYE"
"""COLMAP's model of fisheye lenses that most programs read."""
_POINTS = 1500
"""Points of a sample, at least."""
_POINTS_PER_IMAGE = 30
"""Points of a sample per image, at least: each image observes a few times as many."""
_LONG_TRACK = 3
"""Observations of a point of a sample, at least: almost any poses explain two of them."""
_FEWEST_POINTS = 50
"""Points of a sample below which no alternative is tried."""
_LARGEST_ERROR = 4.0
"""Limit of the reprojection error of an observation in a mean, pixels: COLMAP removes observations above it."""
_ITERATIONS = 60
"""Iterations of a bundle adjustment of a sample, at most."""
_TOLERANCE = 1e-6
"""Relative decrease of the cost at which it ends."""


@dataclass(frozen=True)
class Alternative:
    """The cameras that explain a model's observations best.

    Attributes:
        model: A sample of the model with adjusted poses and lenses, None where the model's own are best.
        notes: Sentences that say which poses or lens model were taken instead.
        doubts: Doubts about the model's own cameras.
    """

    model: pycolmap.Reconstruction | None
    notes: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()


def find_alternative(model: pycolmap.Reconstruction) -> Alternative:
    """Compare a model with its other plane solution, then with a fisheye lens. The model is not changed."""
    sample = _sample(model)
    if sample.num_points3D() < _FEWEST_POINTS:
        return Alternative(None)
    best = _adjusted(sample, free_lens=True)
    other = other_plane_solution(sample)
    notes: list[str] = []
    doubts: list[Doubt] = []
    if other is not None and other.num_points3D() >= sample.num_points3D() / 2:
        other = _adjusted(_adjusted(other, free_lens=False), free_lens=True)
        ratio = _error(other) / _error(_with_points_of(best, other))
        if ratio < _CLEARLY_LESS:
            notes.append(
                f"The camera moves straight on over a nearly flat floor, which has two solutions: the other one was "
                f"taken, as its reprojection error is {1 - ratio:.0%} less."
            )
            best = other
        elif ratio < 1 / _CLEARLY_LESS:
            doubts.append(_undetermined(best, other))
    lens = _adjusted(_with_fisheye_lens(best), free_lens=True)
    ratio = _error(lens) / _error(best)
    if ratio < _FISHEYE_LESS:
        notes.append(f"The lens is a fisheye ({_FISHEYE}): the reprojection error is {1 - ratio:.0%} less.")
        best = lens
    return Alternative(best if notes else None, tuple(notes), tuple(doubts))


def _undetermined(first: pycolmap.Reconstruction, second: pycolmap.Reconstruction) -> Doubt:
    fields = [field_of_view(camera) for model in (first, second) for camera in model.cameras.values()]
    return Doubt(
        "plane_solutions",
        "The focal length and the poses cannot be known from these photos: the camera moves straight on over a nearly "
        "flat floor, and two solutions fit equally well, with horizontal fields of view from "
        f"{min(fields):.0f}° to {max(fields):.0f}°. Photos from other heights, or from the side, would tell them "
        "apart.",
    )


def _sample(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy of a model with a sample of its points."""
    sample = copy.deepcopy(model)
    ids = np.array(sorted(sample.point3D_ids()), np.uint64)
    long = [key for key in ids.tolist() if sample.point3D(key).track.length() >= _LONG_TRACK]
    wanted = max(_POINTS, _POINTS_PER_IMAGE * model.num_reg_images())
    chosen = set(np.random.default_rng(0).permutation(np.array(long, np.uint64))[:wanted].tolist())
    for key in ids.tolist():
        if key not in chosen:
            sample.delete_point3D(key)
    return sample


def _with_points_of(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy of a model with those of its points that another one has, too."""
    common = copy.deepcopy(model)
    for key in set(model.point3D_ids()) - set(other.point3D_ids()):
        common.delete_point3D(key)
    return common


def _adjusted(model: pycolmap.Reconstruction, free_lens: bool) -> pycolmap.Reconstruction:
    """Return a copy of a model after a bundle adjustment that is robust against wrong observations."""
    adjusted = copy.deepcopy(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = free_lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    pycolmap.bundle_adjustment(adjusted, options)
    return adjusted


def _error(model: pycolmap.Reconstruction) -> float:
    """Return the mean reprojection error in pixels, with wrong observations limited."""
    errors = np.linalg.norm(Observations.of(model).residuals, axis=1)
    return float(np.minimum(np.nan_to_num(errors, nan=_LARGEST_ERROR, posinf=_LARGEST_ERROR), _LARGEST_ERROR).mean())


def _with_fisheye_lens(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy of a model with fisheye lenses of about the same directions of view."""
    fisheye = copy.deepcopy(model)
    for key, camera in fisheye.cameras.items():
        images = [image for image in model.images.values() if image.camera_id == key]
        seen = [feature.xy for image in images for feature in image.points2D if feature.has_point3D()]
        if not seen:
            continue
        centre = np.array([camera.principal_point_x, camera.principal_point_y])
        from_centre = np.linalg.norm(np.array(seen) - centre, axis=1)
        angles = np.arctan(np.linalg.norm(camera.cam_from_img(np.array(seen)), axis=1))
        focal = float(np.nanmedian(from_centre / angles))
        lens = pycolmap.Camera.create_from_model_name(key, _FISHEYE, focal, camera.width, camera.height)
        params = lens.params
        params[lens.principal_point_idxs()] = centre
        camera.model, camera.params = lens.model, params
    return fisheye
