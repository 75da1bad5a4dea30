"""A COLMAP scene from photos or a video.

Images are prepared here; COLMAP itself (pycolmap) runs in a child process.
"""

import os
import time
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..scene.camera_page import write_camera_page
from ..scene.cameras import CAMERA_PAGE
from ..scene.colmap import load_scene
from ..scene.new_scene import new_scene
from .hypotheses import Hypothesis, Outcome, choose_model, disagreement, is_usable
from .mapping import model_folder
from .mapping_process import find_matches, try_hypothesis
from .photos import copy_photos
from .progress import Progress
from .video import pick_frames

_MOVING_SHARE = 0.15
"""Fraction of contradicting matches from which motion in the scene is suspected: four times that of still scenes."""


def reconstruct(source: Path, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Estimate the poses of images, or of the frames of a video, and make a COLMAP scene.

    The scene gets images/ (copies of the images, or the chosen frames), sparse/0, and cameras.html, the page about its
    cameras; it appears when all is done.
    Until then a hidden folder beside it holds the files; what a killed process left there is removed.
    Features are detected in copies with equalised contrast, because turbid water hides them.

    Args:
        source: Folder of images (those in images/ or input/ where it has one of these), or a video.
        out: Folder of the scene; it must not exist or be empty.
        progress: Called at least once a second with a stage (words for the user) and its fraction; what it raises ends
            the work.

    Returns:
        Numbers of images, registered images and points, `registered_share` (0..1), `reprojection_error` (pixels),
        seconds, notes (sentences that say which frames of a video were taken, and which solution or lens), warnings
        (sentences about the images and the model), and `hypotheses`: of each that was tried its name, number of
        registered images, `field_of_view` (of one camera) and `triangulation_angle` (degrees), `reprojection_error`,
        and whether it was chosen. `pairs`, `memory` and `contradicting_share` are those of `find_matches`.

    Raises:
        InputError: When the images cannot be used or no model is worth using.
    """
    started = time.monotonic()
    report = progress or (lambda stage, fraction: None)
    source, out = Path(source).expanduser().absolute(), Path(out).expanduser().absolute()
    if not source.exists():
        raise InputError(f"There is no folder of photos or video {source}.")
    with new_scene(out) as (scene, scratch):
        (scratch / "pictures").mkdir()
        choose = copy_photos if source.is_dir() else pick_frames
        chosen = choose(source, scene / "images", scratch / "pictures", report)
        names = chosen.names
        matched = find_matches(scene, scratch, names, report)
        best, outcomes = _map(scene, scratch, names, report)
        (scene / "sparse").mkdir()
        os.replace(model_folder(scratch, best.name), scene / "sparse" / "0")
    warnings = [*chosen.warnings, *_warnings(best, outcomes, matched["contradicting_share"])]
    write_camera_page(load_scene(out), out / CAMERA_PAGE, warnings)
    return {
        "images": len(names),
        "registered": best.registered,
        "registered_share": best.registered / len(names),
        "points": best.points,
        "reprojection_error": best.reprojection_error,
        **matched,
        "hypotheses": [_describe(outcome, outcome is best) for outcome in outcomes],
        "seconds": time.monotonic() - started,
        "notes": [*chosen.notes, *best.notes],
        "warnings": warnings,
    }


def _map(scene: Path, scratch: Path, names: list[str], report: Progress) -> tuple[Outcome, list[Outcome]]:
    """Return the best outcome and all, the models being in `scratch`.

    Raises:
        InputError: When no model is worth using.
    """
    failures = []

    def run(hypothesis: Hypothesis) -> Outcome:
        outcome, failure = try_hypothesis(scene, scratch, names, hypothesis, report)
        if failure:
            failures.append(failure)
        return outcome

    best, outcomes = choose_model(run)
    if failures and len(failures) == len(outcomes):
        raise InputError(failures[0])
    if not is_usable(best, len(names)):
        found = f"the largest model has {best.registered}: {_some(best.groups[0])}" if best.groups else "none"
        raise InputError(
            f"The cameras of these {len(names)} photos cannot be found ({found}). Photos need to overlap by half or "
            "more, be taken from different places, and show structure: take more of them, or leave out those of open "
            "water and of other places."
        )
    return best, outcomes


def _describe(outcome: Outcome, chosen: bool) -> dict[str, Any]:
    return {
        "name": outcome.name,
        "registered": outcome.registered,
        "field_of_view": next(iter(outcome.fields_of_view.values()), None),
        "triangulation_angle": outcome.triangulation_angle,
        "reprojection_error": outcome.reprojection_error,
        "chosen": chosen,
    }


def _warnings(best: Outcome, outcomes: list[Outcome], contradicting_share: float) -> list[str]:
    warnings = [sentence for kind, sentence in best.doubts if kind != "registered"]  # the scene says it
    used = set(best.groups[0])
    # A hypothesis with a given first pair makes one model only, so the groups may be those of another one.
    groups = max((outcome.groups[1:] for outcome in outcomes), key=len)
    apart = [group for group in groups if not used & set(group)]
    if apart:
        others = "; ".join(f"{len(group)} ({_some(group)})" for group in apart)
        warnings.append(
            f"The photos fall into {len(apart) + 1} groups without connection, and only the largest, of "
            f"{best.registered}, is used. The others: {others}. Photos between them would help."
        )
    said = any(kind in {"focal_held", "plane_solutions"} for kind, _ in best.doubts)
    if not said and (different := disagreement(best, outcomes)):
        warnings.append(different)
    if contradicting_share > _MOVING_SHARE:
        warnings.append(
            f"{contradicting_share:.0%} of the matches between photos contradict the motion of the camera (threshold "
            f"{_MOVING_SHARE:.0%}): something moves, such as fish, plants, or shadows of a lamp. Leave out photos in "
            "which much of the picture moves."
        )
    return warnings


def _some(names: list[str]) -> str:
    return f"{', '.join(names[:3])}{' ...' if len(names) > 3 else ''}"
