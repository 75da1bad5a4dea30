"""The labels of a run: labels.json for people and Blender, semantics.safetensors for searching."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from ..base.errors import InputError
from ..base.files import atomic_path
from ..formats.run_folder import RunFolder, read_json, write_json
from ..formats.select import LABEL
from ..splats.splats import Splats
from .assign import Assignment
from .embed import DIMENSIONS, Projection
from .regions import SceneRegions

TABLE, FEATURES = "labels.json", "semantics.safetensors"


@dataclass(frozen=True, eq=False)
class Semantics:
    """What searching needs: features (N, 32) of the run's splats, prototypes (L, 32) of its labels, the projection, and
    the embedder that they are from."""

    features: np.ndarray
    prototypes: np.ndarray
    projection: Projection
    embedder: str


def label_table(regions: SceneRegions, labels: np.ndarray) -> list[dict[str, Any]]:
    """One entry a label: id, name, count of the Gaussians in labels (N,), share of the photographs' pixels."""
    counts = np.bincount(labels, minlength=len(regions.labels) + 1)
    shares = regions.shares()
    return [
        {"id": i, "name": name, "count": int(counts[i]), "share": round(float(shares[i]), 6)}
        for i, name in enumerate(regions.labels, start=1)
    ]


def write_semantics(
    folder: Path,
    splats: Splats,
    up: Sequence[float],
    regions: SceneRegions,
    assignment: Assignment,
    about: dict[str, Any],
    with_features: bool = False,
) -> dict[str, Any]:
    """Write result.ply and result.glb with the splats' labels, labels.json and semantics.safetensors to a run.

    splats: the run's, in the order of the assignment's Gaussians. with_features: 32 further properties feature_00 ...
    in both files. `about` (`embedder` among it) becomes part of labels.json, which is returned.
    """
    run = RunFolder(folder)
    labels = assignment.labels.cpu().numpy().astype(np.int32)
    features = assignment.features.float().cpu().numpy()
    extras = {name: values for name, values in splats.extras.items() if not name.startswith("feature_")}
    extras[LABEL] = labels
    if with_features:
        extras |= {f"feature_{i:02d}": np.ascontiguousarray(features[:, i]) for i in range(DIMENSIONS)}
    labelled = Splats(splats.positions, splats.rotations, splats.scales, splats.opacities, splats.sh, extras)
    agreement = assignment.agreement[assignment.labels > 0]
    document = {
        "labels": label_table(regions, labels),
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


def read_table(folder: Path) -> list[dict[str, Any]]:
    """The labels of a run: id, name, count, share each. Raises InputError when it has none yet."""
    path = folder / TABLE
    document = read_json(path, f"The run {folder} has no labels yet: make them with `label`.")
    try:
        return [
            {"id": int(entry["id"]), "name": str(entry["name"]), "count": entry["count"], "share": entry["share"]}
            for entry in document["labels"]
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not list labels ({error}): make them again with `label`.") from error


def read_semantics(folder: Path) -> Semantics:
    """What `write_semantics` kept for searching. Raises InputError when it is missing or damaged."""
    path = folder / FEATURES
    table = read_json(folder / TABLE, f"The run {folder} has no labels yet: make them with `label`.")
    try:
        tensors = load_file(path)
        projection = Projection(tensors["projection.matrix"], tensors["projection.mean"])
        return Semantics(tensors["features"], tensors["prototypes"], projection, str(table["embedder"]))
    except (OSError, KeyError, SafetensorError) as error:
        raise InputError(f"{path} cannot be read ({error}): make the labels again with `label`.") from error
