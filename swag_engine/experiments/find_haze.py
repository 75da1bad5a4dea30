"""Find open water among the splats of a finished run, as training does at its end."""

from pathlib import Path
from typing import Any

from ..base.errors import InputError, continue_run
from ..formats.ply import read_ply
from ..formats.run_folder import RunFolder
from ..gaussians.cloud import to_numpy
from ..kernels.hardware import device_for
from ..rendering.haze import haze_score, without_haze
from ..rendering.model import SceneModel
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..splats.haze import HAZE
from ..training.checkpoint import load_checkpoint, save_checkpoint


def find_haze(folder: Path) -> dict[str, Any]:
    """Find which splats are open water, and write it to the checkpoint and the result files of a run.

    Args:
        folder: Folder of the run, which may be of a version that did not look for them.

    Returns:
        `run`; `splats`, their number; `haze`, the number of those that are more likely open water than not.

    Raises:
        InputError: If the run has no result, or its files do not fit together; they are unchanged then.
    """
    run = RunFolder(folder)
    scene_folder, settings, up = run.read_config()
    loaded = load_checkpoint(folder)
    if loaded is None or not run.ply.exists():
        raise InputError(f"The run {folder} has no result yet; {continue_run()}.")
    tensors, stored = loaded
    model, splats = SceneModel.from_checkpoint(tensors, stored).to(device_for("auto")), read_ply(run.ply)
    own = len(model.cloud) - stored.get("fixed", 0)
    if own != len(splats):
        raise InputError(
            f"{run.ply} holds {len(splats)} splats and the checkpoint of its run {own}; to write it again, "
            f"{continue_run()}."
        )
    scene = load_scene(scene_folder)
    names = set(scene.split.train)
    images = load_images(scene, [view for view in scene.views if view.name in names], settings.width)
    score = haze_score(model, images, scene)
    opacities = to_numpy(without_haze(model.cloud, score).opacities)
    splats.opacities[:] = opacities[:own]
    splats.extras[HAZE] = to_numpy(score)[:own]
    run.write_result(splats, up)
    save_checkpoint(folder, stored["iteration"], tensors | {HAZE: score.cpu()}, stored)
    return {"run": str(folder), "splats": own, "haze": int((score[:own] > 0.5).sum())}


def describe(found: dict[str, Any]) -> str:
    """Return the line that the command `haze` prints."""
    return f"{found['haze']:,} of {found['splats']:,} splats are open water, and not shown without water."
