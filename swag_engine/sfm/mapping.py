"""COLMAP's part of structure from motion, run as child processes: `python -m swag_engine.sfm.mapping JOB`.

One child detects and matches features; then one child for each hypothesis maps. A child reports on its standard output
and ends with its standard input, so that a crash or a cancel leaves no files.
"""

import copy
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..scene.colmap_library import pycolmap
from ..scene.model_quality import Doubt, ModelQuality, assess_model
from .child_process import do_job, say
from .features import ImageData, contradicting_share, estimate_memory, extract_features, match_features
from .hypotheses import Hypothesis, Outcome
from .model_alternatives import find_alternative

FEATURES_STAGE = "Detecting features"
"""First stage of the child that detects and matches features."""
MAPPING_STAGE = "Placing cameras"
"""Stage of the children that map."""
_INITIAL_TRIALS = 50
"""Candidates for the initial pair that COLMAP tries before it accepts smaller triangulation angles. Its default of 200
takes longer than the mapping itself where all angles are small."""
_RELAXATIONS = 4
"""Times that mapping starts again with half as many matches, then half the angle, of an initial pair, as in COLMAP."""
_GOOD_MATCHES = 100
"""Matches that an initial pair must have, as in COLMAP."""
_SAMPLE_PAIRS = 60
"""Pairs whose triangulation angle is computed, at most, evenly spaced in the order of their numbers of matches."""
_SAMPLE_MATCHES = 300
"""Matches from which the triangulation angle of a pair is computed, at most: 10 ms per pair, and
with all of them the quantile of the angles differs by 1 %."""
_INITIAL_QUANTILE = 0.75
"""Quantile of the triangulation angles that an initial pair must have, where it is below COLMAP's 16 degrees. Otherwise
COLMAP tries many pairs in vain, halves the angle, and tries again: half of the time of mapping at 4 degrees."""
_TOLERANCE = 1e-5
"""Relative decrease of the cost at which bundle adjustment ends; with COLMAP's default of 0 it always takes its largest
number of iterations."""
_GROWTH = 1.6
"""Growth of the model from one global bundle adjustment to the next; COLMAP's default is 1.1. Together with
`_TOLERANCE` and `_REFINEMENTS` it saves a quarter of the time, and focal lengths differ by less than 0.1 % (40
images)."""
_REFINEMENTS = 2
"""Rounds of global bundle adjustment and removal of wrong observations, at most; COLMAP's default of 5 gives almost the
same model."""
_GLOBAL_TRACKS = 200
"""Tracks of an image, the longest ones, from which all images are placed at once; all points follow by triangulation.
COLMAP's default takes all tracks, and about twice the time (40 images)."""
_COMPLETIONS = 2
"""Rounds of triangulation and bundle adjustment of a model whose cameras were replaced."""
_PAIRS_DIFFER = 0.1
"""Relative difference between the focal lengths of a model and of its pairs from which the model is doubtful."""
_LOSES_FOCAL_LENGTH = frozenset({"field_of_view", "focal_prior", "focal_error"})
"""Kinds of doubts (`model_quality.Doubt`) for which a held focal length is kept."""


def _find_matches(scene: Path, scratch: Path, names: list[str]) -> dict[str, Any]:
    """Fill the database with features and matches."""
    database = scratch / "database.db"
    pycolmap.set_random_seed(0)
    images = [ImageData.read(scene / "images" / name) for name in names]
    memory = estimate_memory(images)
    stage = f"{FEATURES_STAGE} (COLMAP needs up to {memory / 1e9:.1f} GB of memory)"
    say(stage=stage, table="keypoints", total=len(names))
    extract_features(database, scratch / "pictures", images)
    say(stage="Matching photos")

    def say_pairs(count: int) -> None:
        say(stage="Matching photos", table="two_view_geometries", total=count)

    pairs = match_features(database, images, say_pairs)
    return {"pairs": pairs, "memory": memory, "contradicting_share": contradicting_share(database)}


def _map(scene: Path, scratch: Path, names: list[str], hypothesis: Hypothesis) -> dict[str, Any]:
    """Map with a hypothesis, and write the largest model, with the images' names and colors, to `model_folder`."""
    database, models = scratch / "database.db", scratch / "models" / hypothesis.name
    models.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(str(database)) as opened:
        priors = {
            camera.camera_id: camera.focal_length_x
            for camera in opened.read_all_cameras()
            if camera.has_prior_focal_length
        }
    if hypothesis.calibrate_view_graph:
        database = _calibrate(database, models, reestimate=True)
    run = _run_global if hypothesis.global_mapping else _run_incremental
    found = sorted(run(database, scratch, models, hypothesis, len(names)), key=lambda model: -model.num_reg_images())
    if not found:
        return asdict(Outcome(hypothesis.name, []))
    alternative = find_alternative(found[0])
    if alternative.model is not None:
        found[0] = _complete(alternative.model, database, scratch, models, len(names))
    for model in found:
        for image in model.images.values():
            image.name = names[int(Path(image.name).stem)]
    model, quality = found[0], assess_model(found[0], len(names), priors)
    doubts = list(quality.doubts)
    if hypothesis.hold_focal_length and alternative.model is None:
        model, quality, doubts = _free_focal_length(model, quality, priors)
    doubts += alternative.doubts
    if not hypothesis.calibrate_view_graph and not priors:
        doubts += _compare_with_pairs(model, quality, database, models)
    if not model.num_points3D():  # poses alone cannot be trained from
        return asdict(Outcome(hypothesis.name, []))
    model.extract_colors_for_all_images(str(scene / "images"))
    folder = model_folder(scratch, hypothesis.name)
    folder.mkdir()
    model.write_binary(str(folder))
    return asdict(
        Outcome(
            hypothesis.name,
            [sorted(each.image(key).name for key in each.reg_image_ids()) for each in found],
            quality.points,
            quality.track_length,
            quality.reprojection_error,
            quality.triangulation_angle,
            {str(key): value for key, value in quality.focal_lengths.items()},
            {str(key): value for key, value in quality.fields_of_view.items()},
            tuple((doubt.kind, doubt.sentence) for doubt in doubts),
            alternative.notes,
        )
    )


def _calibrate(database: Path, folder: Path, reestimate: bool) -> Path:
    """Copy the database to a folder and set the focal lengths to those on which all pairs of images agree best.

    Args:
        database: The database.
        folder: Where the copy is made.
        reestimate: Estimate the poses of the pairs again, which global mapping needs.

    Returns:
        The copy. Its cameras have a prior focal length where one could be found.
    """
    calibrated = Path(shutil.copy(database, folder / "database.db"))
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = 0
    options.reestimate_relative_pose = reestimate
    pycolmap.calibrate_view_graph(str(calibrated), options)
    return calibrated


def _compare_with_pairs(
    model: pycolmap.Reconstruction, quality: ModelQuality, database: Path, folder: Path
) -> list[Doubt]:
    """Return doubts about focal lengths that differ from those estimated from pairs of images.

    The estimate assumes a perspective lens, so that fisheye lenses are not compared.
    """
    with pycolmap.Database.open(str(_calibrate(database, folder, reestimate=False))) as opened:
        pairs = {
            camera.camera_id: camera.focal_length_x
            for camera in opened.read_all_cameras()
            if camera.has_prior_focal_length
        }
    return [
        Doubt(
            "focal_pairs",
            f"The focal length of the model is {focal:.0f} px, and that of pairs of photos {pairs[camera]:.0f} px "
            f"(threshold {_PAIRS_DIFFER:.0%}): it is doubtful. Photos of the same place from more directions would "
            "help.",
        )
        for camera, focal in quality.focal_lengths.items()
        if camera in pairs
        and not model.camera(camera).is_perspective_fisheye()
        and abs(focal / pairs[camera] - 1) > _PAIRS_DIFFER
    ]


def model_folder(scratch: Path, name: str) -> Path:
    """Return the folder of the largest model of a hypothesis."""
    return scratch / "models" / name / "largest"


def _run_incremental(
    database: Path, scratch: Path, models: Path, hypothesis: Hypothesis, image_count: int
) -> list[pycolmap.Reconstruction]:
    placed = 0

    def one_more() -> None:
        nonlocal placed
        placed += 1
        say(stage=MAPPING_STAGE, fraction=min(1.0, placed / image_count))

    say(stage=MAPPING_STAGE)
    options = _incremental_options()
    options.init_num_trials = _INITIAL_TRIALS
    if hypothesis.hold_focal_length:
        options.ba_refine_focal_length = False
        options.mapper.abs_pose_refine_focal_length = False
    if angles := _triangulation_angles(database):
        common = float(np.quantile(list(angles.values()), _INITIAL_QUANTILE))
        options.mapper.init_min_tri_angle = min(options.mapper.init_min_tri_angle, common)
        if hypothesis.widest_pair:
            options.init_image_id1, options.init_image_id2 = max(angles, key=lambda pair: angles[pair])
            options.multiple_models = False  # every further model would have the same initial pair
            options.mapper.init_min_tri_angle = 0.5
    return _map_incrementally(database, options, one_more)


def _map_incrementally(
    database: Path, options: pycolmap.IncrementalPipelineOptions, image_placed: Callable[[], None]
) -> list[pycolmap.Reconstruction]:
    """Map as `pycolmap.incremental_mapping` does, but search the initial pair of images in one thread.

    COLMAP searches it in all threads, and that of the thread which finds one first is taken: so the same matches led to
    different models from run to run. Bundle adjustment of large scenes still uses all threads. Other Python threads
    run only while `image_placed` is called.

    Args:
        database: COLMAP's database.
        options: The options.
        image_placed: Called after the initial pair and after each further image.

    Returns:
        The models.
    """
    manager = pycolmap.ReconstructionManager()
    with pycolmap.Database.open(str(database)) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, manager)
    for event in ("INITIAL_IMAGE_PAIR_REG_CALLBACK", "NEXT_IMAGE_REG_CALLBACK"):
        pipeline.add_callback(getattr(pycolmap.IncrementalPipelineCallback, event), image_placed)
    mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
    constraints = options.get_mapper()
    constraints.num_threads = 1
    for relaxations in range(1 + _RELAXATIONS):
        if relaxations:
            constraints.init_min_num_inliers //= 1 + relaxations % 2
            constraints.init_min_tri_angle /= 2 - relaxations % 2
            mapper.reset_initialization_stats()
        ended = pipeline.reconstruct(mapper, constraints, False) == pycolmap.IncrementalPipelineStatus.STOP
        if ended or mapper.num_total_reg_images() == pipeline.database_cache.num_images():
            break
    return [manager.get(number) for number in range(manager.size())]


def _incremental_options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.extract_colors = False  # they come from the images, not from the grey copies
    options.random_seed = 0
    options.ba_local_function_tolerance = options.ba_global_function_tolerance = _TOLERANCE
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_max_refinements = _REFINEMENTS
    options.ba_local_max_refinements = 1  # the next image's adjustment removes what is left
    return options


def _complete(
    sample: pycolmap.Reconstruction, database: Path, scratch: Path, models: Path, image_count: int
) -> pycolmap.Reconstruction:
    """Return a model with the poses and lenses of a sample, with all points that they explain and all images."""
    folder, pictures = models / "completed", scratch / "pictures"
    folder.mkdir()
    database = Path(shutil.copy(database, folder / "database.db"))
    with pycolmap.Database.open(str(database)) as opened:  # COLMAP wants lenses of the same kind in both
        for camera in sample.cameras.values():
            opened.update_camera(camera)
    model, options = sample, _incremental_options()
    for _ in range(_COMPLETIONS):
        model = pycolmap.triangulate_points(model, str(database), str(pictures), str(folder), True, options)
        _adjust(model)
    if model.num_reg_images() < image_count:
        model.write_binary(str(folder))
        more = pycolmap.incremental_mapping(str(database), str(pictures), str(folder), options, str(folder))
        model = max([model, *more.values()], key=lambda each: each.num_reg_images())
    model.update_point_3d_errors()
    return model


def _adjust(model: pycolmap.Reconstruction) -> None:
    """Adjust poses, points and lenses of a model."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)


def _run_global(
    database: Path, scratch: Path, models: Path, hypothesis: Hypothesis, image_count: int
) -> list[pycolmap.Reconstruction]:
    say(stage=MAPPING_STAGE)
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1  # sums of several threads differ from run to run
    options.mapper.track_required_tracks_per_view = _GLOBAL_TRACKS
    return list(pycolmap.global_mapping(str(database), str(scratch / "pictures"), str(models), options).values())


def _triangulation_angles(database: Path) -> dict[tuple[int, int], float]:
    """Return triangulation angles in degrees of a sample of the pairs of images with many matches, by image ids."""
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = 0
    random = np.random.default_rng(0)
    angles = {}
    with pycolmap.Database.open(str(database)) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        images = {image.image_id: image for image in opened.read_all_images()}
        matches = sorted(zip(*opened.read_two_view_geometry_num_inliers(), strict=True), key=lambda pair: -pair[1])
        good = [pair_id for pair_id, count in matches if count >= _GOOD_MATCHES]
        for pair_id in good[:: max(1, math.ceil(len(good) / _SAMPLE_PAIRS))]:
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            lenses = [cameras[images[key].camera_id] for key in pair]
            pixels = [opened.read_keypoints(key)[:, :2].astype(float) for key in pair]
            matches_of_pair = random.permutation(opened.read_two_view_geometry(*pair).inlier_matches)[:_SAMPLE_MATCHES]
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                lenses[0], pixels[0], lenses[1], pixels[1], matches_of_pair, options
            )
            angles[pair] = math.degrees(geometry.tri_angle)
    return angles


def _free_focal_length(
    held: pycolmap.Reconstruction, quality: ModelQuality, priors: dict[int, float]
) -> tuple[pycolmap.Reconstruction, ModelQuality, list[Doubt]]:
    """Refine the focal lengths of a model that was mapped with held ones, unless that makes them doubtful.

    Returns:
        The model, its quality, and its doubts.
    """
    free = copy.deepcopy(held)
    _adjust(free)
    freed = assess_model(free, quality.image_count, priors)
    if not _LOSES_FOCAL_LENGTH & {doubt.kind for doubt in freed.doubts}:
        return free, freed, list(freed.doubts)
    # The error of a focal length that was not estimated is not the model's.
    doubts = [doubt for doubt in quality.doubts if doubt.kind not in _LOSES_FOCAL_LENGTH]
    fields = ", ".join(f"{field:.0f}°" for field in quality.fields_of_view.values())
    sentence = (
        "The focal length cannot be known from these photos: the initial one "
        f"was kept (horizontal field of view: {fields}). Photos with the camera turned by 90°, or that look at the "
        "same place from more directions, would determine it."
    )
    return held, quality, [Doubt("focal_held", sentence), *doubts]


def _run(task: dict[str, Any]) -> dict[str, Any]:
    scene, scratch = Path(task["scene"]), Path(task["scratch"])
    if task["hypothesis"] is None:
        return _find_matches(scene, scratch, task["names"])
    return _map(scene, scratch, task["names"], Hypothesis(**task["hypothesis"]))


if __name__ == "__main__":
    do_job(_run)
