"""Labels of a whole run, made by the engine: the choices, the request, the result."""

import os
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.run_folder import RunFolder
from . import labels, splats
from .engine_process import run_request
from .properties import swag_of
from .runs import RUN_KEY, SURVEY_KEY


def names_folder(context: bpy.types.Context, obj: bpy.types.Object) -> str:
    """Folder of the names of the labels of a splat object: that of its run or survey, else of the scene's run."""
    known = bpy.path.abspath(obj.get(RUN_KEY, "")) or labels.labels_of(obj).folder
    return known if known or obj.get(SURVEY_KEY) else swag_of(context.scene).run_path


def label_request(
    context: bpy.types.Context, obj: bpy.types.Object, source: str, words: str, masks: str, download: bool
) -> dict[str, Any]:
    """The engine's request to label the run of a splat object.

    Args:
        context: its scene's run folder is taken where the object names no run.
        obj: a splat object.
        source: "AUTO", "MASKS", "WORDS" or "SALIENCY".
        words: what to label, separated by commas; for "WORDS".
        masks: folder of masks; for "MASKS".
        download: whether missing networks may be downloaded; for "WORDS".

    Raises:
        InputError: no run, no words or no masks, or a download without online access.
    """
    if obj.get(SURVEY_KEY):
        raise InputError(
            f"The splats of {obj.name} are of a survey: its blocks are labelled outside of Blender, as the page "
            "Surveys of the documentation says; merge them again and open the survey anew afterwards."
        )
    run = bpy.path.abspath(obj.get(RUN_KEY, "")) or swag_of(context.scene).run_path
    if not run:
        raise InputError(f"The splats of {obj.name} are from no run on this machine: train, or choose the run folder.")
    request: dict[str, Any] = {"request": "label", "run": run, "saliency": source == "SALIENCY"}
    if source == "WORDS":
        if not words.strip():
            raise InputError("There is nothing to look for: write words such as coral, wreck, open water.")
        if download and not bpy.app.online_access:
            raise InputError("Networks cannot be downloaded: allow online access in Preferences > System first.")
        request |= {"words": words, "download": download}
    elif source == "MASKS":
        if not masks:
            raise InputError("There is no folder of masks: choose it, or another source.")
        request["masks"] = os.path.abspath(bpy.path.abspath(masks))
    return request


def take_run_labels(name: str, run: str, event: dict[str, Any]) -> str:
    """Give the splat object `name` the labels of a `result` event for the folder `run`; returns what to tell the user.

    Raises:
        InputError: the object was removed, or has other splats than the run.
    """
    obj = bpy.data.objects.get(name)
    if obj is None:
        raise InputError(f"{name} was removed; the labels are in {run}.")
    labels.take_labels(obj, read_ply(RunFolder(Path(run)).ply), run)
    names = [entry["name"] for entry in event["labels"]]
    return " ".join([f"{len(names)} labels: {', '.join(names[:8])}.", *event["notes"]])


def search(obj: bpy.types.Object, words: str) -> int:
    """Select the splats of an object that are similar to the words; returns how many.

    Labels whose name has the words in it are compared first. Without one, the engine's text network compares the words
    with the features of the object's run, where the object has read one.

    Raises:
        InputError: no words, or neither a label nor a run to search.
        EngineError: the engine cannot compare them.
    """
    words = words.strip()
    if not words:
        raise InputError("There is nothing to search for: write what to look for, such as coral.")
    own = labels.labels_of(obj)
    numbers = labels.numbers_named(obj, words)
    if numbers:
        similarity = labels.similarity_to_labels(obj, numbers)
    elif own.folder:
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "similarity.npy")
            run_request({"request": "search", "run": own.folder, "words": words, "path": path})
            similarity = np.load(path)
        if len(similarity) != splats.count(obj):  # some were deleted or separated
            known = read_ply(RunFolder(Path(own.folder)).ply).positions
            rows = splats.find_rows(splats.positions(obj), known)
            similarity = similarity if rows is None else similarity[rows]
    else:
        names = ", ".join(entry.name for entry in own.entries if entry.number)
        raise InputError(f"No label is called {words}: the labels are {names or 'not read yet'}.")
    own.words = words
    return labels.set_similarity(obj, similarity)
