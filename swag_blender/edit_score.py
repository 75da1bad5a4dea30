"""PSNR of a run on its held-out photos without the splats that are selected, computed by the engine."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.run_folder import RunFolder
from . import labels, splats
from .runs import RUN_KEY


def request(scene: bpy.types.Scene, obj: bpy.types.Object, folder: Path) -> dict[str, Any]:
    """The engine's request to compare the run of a splat object with and without the selected splats.

    All objects of the scene with splats of this run count, so that a separated part is not missed.

    Args:
        scene: the Blender scene.
        obj: a splat object of the run.
        folder: where the file of masks is written.

    Raises:
        InputError: the splats are from no run or are not those of its result, or none are selected.
    """
    run = bpy.path.abspath(obj.get(RUN_KEY, ""))
    if not run:
        raise InputError(f"The splats of {obj.name} are from no run on this machine, so there are no held-out photos.")
    known = read_ply(RunFolder(Path(run)).ply).positions
    before, after = np.zeros(len(known), bool), np.zeros(len(known), bool)
    for part in scene.objects:
        if not splats.is_splats(part) or bpy.path.abspath(part.get(RUN_KEY, "")) != run:
            continue
        rows = splats.find_rows(splats.positions(part), known)
        if rows is None:
            raise InputError(
                f"The splats of {part.name} are not those of the result in {run}: open its result.ply again."
            )
        before[rows] = True
        after[rows] = ~(labels.mask_of(part, labels.SELECTED) & labels.drawn(part))
    if np.array_equal(before, after):
        raise InputError("No splats are selected: select those to leave out, as with Find Floaters.")
    np.save(folder / "masks.npy", np.stack([before, after]))
    return {"request": "score_edit", "run": run, "masks": str(folder / "masks.npy")}


def describe(event: dict[str, Any]) -> str:
    """A sentence about the result of the request."""
    text = bpy.app.translations.pgettext_iface(
        "Without the selected splats the held-out PSNR is {after} dB instead of {before} dB ({difference} dB, {views} "
        "photos)."
    )
    figures = {name: f"{event[name]:.2f}" for name in ("after", "before")}
    return text.format(difference=f"{event['after'] - event['before']:+.2f}", views=event["views"], **figures)
