"""Files of a run's labels: labels.json for people and Blender, semantics.safetensors for searching."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from ..base.errors import DAMAGE, InputError, make_labels
from ..base.files import atomic_path
from ..formats.run_folder import RunFolder, read_json, write_json
from ..formats.select import LABEL
from ..splats.splats import Splats
from .assign import Assignment
from .embed import DIMENSIONS, Projection
from .regions import SceneRegions

TABLE = "labels.json"
"""File of the labels: id, name, count, fraction and gain each."""
FEATURES = "semantics.safetensors"
"""File of the features."""


@dataclass(frozen=True, eq=False)
class Semantics:
    """What searching needs.

    Attributes:
        features: (N, 32) of the run's splats.
        prototypes: (L, 32), mean feature of each label.
        projection: From embeddings to features.
        embedder: Name of the embedder.
    """

    features: np.ndarray
    prototypes: np.ndarray
    projection: Projection
    embedder: str


def label_table(regions: SceneRegions, labels: np.ndarray, gains: np.ndarray) -> list[dict[str, Any]]:
    """Make the entries of labels.json.

    Args:
        regions: Regions of the scene's images.
        labels: (N,) labels of the Gaussians.
        gains: (L + 1,) as `label_gains` returns them.

    Returns:
        For each label `id`, `name`, `count` of Gaussians, `fraction`, the fraction of the images' pixels, and `gain`.
    """
    counts = np.bincount(labels, minlength=len(regions.labels) + 1)
    fractions = regions.pixel_fractions()
    return [
        {
            "id": i, "name": name, "count": int(counts[i]), "fraction": round(float(fractions[i]), 6),
            "gain": round(float(gains[i]), 4),
        }
        for i, name in enumerate(regions.labels, start=1)
    ]  # fmt: skip


def write_semantics(
    folder: Path,
    splats: Splats,
    up: Sequence[float],
    regions: SceneRegions,
    assignment: Assignment,
    about: dict[str, Any],
    with_features: bool = False,
) -> dict[str, Any]:
    """Write a run's result with labels, labels.json and semantics.safetensors.

    Args:
        folder: Folder of the run.
        splats: Its splats, in the order of the assignment's Gaussians.
        up: Up direction (3,) of the scene.
        regions: Regions of the scene's images.
        assignment: Labels and features of the Gaussians.
        about: Further entries of labels.json, `embedder` among them.
        with_features: Whether the result has the features too, as 32 properties feature_00 to feature_31.

    Returns:
        The contents of labels.json.

    Raises:
        InputError: If a file cannot be written.
    """
    run = RunFolder(folder)
    labels = assignment.labels.cpu().numpy().astype(np.int32)
    features = assignment.features.float().cpu().numpy()
    extras = {name: values for name, values in splats.extras.items() if not name.startswith("feature_")}
    extras[LABEL] = labels
    if with_features:
        extras |= {f"feature_{i:02d}": np.ascontiguousarray(features[:, i]) for i in range(DIMENSIONS)}
    labelled = replace(splats, extras=extras)
    agreement = assignment.agreement[assignment.labels > 0]
    document = {
        "labels": label_table(regions, labels, assignment.gains),
        "unlabelled": int((labels == 0).sum()),
        "agreement": round(float(agreement.mean()), 4) if len(agreement) else None,
        **about,
        "notes": list(regions.notes),
    }
    run.write_result(labelled, up)
    tensors = {
        "features": features,
        "prototypes": regions.prototypes,
        "projection.matrix": regions.projection.matrix,
        "projection.mean": regions.projection.mean,
    }
    with atomic_path(folder / FEATURES) as temporary:
        save_file({name: np.ascontiguousarray(array) for name, array in tensors.items()}, temporary)
    write_json(folder / TABLE, document)
    return document


def read_labels(folder: Path) -> list[dict[str, Any]]:
    """Read labels.json of a run.

    Returns:
        Its labels, as `label_table` makes them; the gain is 1 in files that have none.

    Raises:
        InputError: If the run has no labels yet or the file is damaged.
    """
    path = folder / TABLE
    document = read_json(path, f"The run {folder} has no labels yet: {make_labels()}.")
    try:
        return [
            {
                "id": int(entry["id"]), "name": str(entry["name"]), "count": int(entry["count"]),
                "fraction": float(entry["fraction"]), "gain": float(entry.get("gain", 1)),
            }
            for entry in document["labels"]
        ]  # fmt: skip
    except DAMAGE as error:
        raise InputError(f"{path} does not list labels ({error}): {make_labels()}.") from error


def read_semantics(folder: Path) -> Semantics:
    """Read semantics.safetensors of a run.

    Raises:
        InputError: If the run has no labels yet or a file is damaged.
    """
    path = folder / FEATURES
    table = read_json(folder / TABLE, f"The run {folder} has no labels yet: {make_labels()}.")
    try:
        tensors = load_file(path)
        projection = Projection(tensors["projection.matrix"], tensors["projection.mean"])
        return Semantics(tensors["features"], tensors["prototypes"], projection, str(table["embedder"]))
    except (OSError, KeyError, SafetensorError) as error:
        raise InputError(f"{path} cannot be read ({error}): {make_labels()}.") from error
