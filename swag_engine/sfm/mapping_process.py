"""The child processes of structure from motion: one for features and matches, one for each hypothesis."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from .child_process import run_child
from .hypotheses import Hypothesis, Outcome
from .mapping import FEATURES_STAGE, MAPPING_STAGE
from .progress import Progress


def find_matches(scene: Path, scratch: Path, names: list[str], report: Progress) -> dict[str, Any]:
    """Detect and match features in a child process, which fills the database in `scratch`.

    Args:
        scene: Folder with images/.
        scratch: Folder for files that nobody needs later, with pictures/ (see `photos.equalise`).
        names: Names of the images in images/, in the order of their pictures.
        report: Called with the stages.

    Returns:
        `pairs`, the number of pairs that were matched, `memory` in bytes that COLMAP needs (an estimate), and
        `contradicting_share` (see `features.contradicting_share`).

    Raises:
        InputError: When the child failed.
    """
    return _run_child(scene, scratch, names, None, report)


def try_hypothesis(
    scene: Path, scratch: Path, names: list[str], hypothesis: Hypothesis, report: Progress
) -> tuple[Outcome, str | None]:
    """Map with a hypothesis in a child process, which writes the largest model (see `mapping.model_folder`).

    Args:
        scene: See `find_matches`.
        scratch: See `find_matches`.
        names: See `find_matches`.
        hypothesis: The hypothesis.
        report: Called with the stage.

    Returns:
        The outcome, and why the child failed: that is an outcome without a model.
    """
    try:
        result = _run_child(scene, scratch, names, hypothesis, report)
    except InputError as error:
        return Outcome(hypothesis.name, []), str(error)
    return Outcome(**result), None


def _run_child(
    scene: Path, scratch: Path, names: list[str], hypothesis: Hypothesis | None, report: Progress
) -> dict[str, Any]:
    task = {
        "scene": str(scene),
        "scratch": str(scratch),
        "names": names,
        "hypothesis": hypothesis and asdict(hypothesis),
    }
    first_stage = FEATURES_STAGE if hypothesis is None else MAPPING_STAGE
    return run_child("swag_engine.sfm.mapping", task, scratch, first_stage, report)
