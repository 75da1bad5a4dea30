"""Labels of a finished run: assign them, search them, extract the Gaussians of one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, continue_run
from ..base.files import atomic_path
from ..formats.export import ExportOptions, export_run
from ..formats.ply import read_ply
from ..formats.registry import find_format
from ..formats.run_folder import RunFolder
from ..kernels.hardware import device_for
from ..rendering.model import cloud_from_checkpoint
from ..scene.colmap import Scene, load_scene
from ..scene.images import cache_folder, load_images
from ..semantics.assign import Assignment, assign
from ..semantics.describe_labels import describe_labels
from ..semantics.embed import Clip, Descriptor, Embedder
from ..semantics.labels import read_labels, read_semantics, write_semantics
from ..semantics.providers import Progress, Provider, choose_provider, make_embedder, make_provider
from ..semantics.regions import check_words, find_regions
from ..semantics.search import similarity
from ..training.checkpoint import load_checkpoint


def label_run(
    folder: Path,
    words: Sequence[str] = (),
    masks: Path | None = None,
    provider: Provider | None = None,
    weights_dir: Path | None = None,
    download: bool = False,
    with_features: bool = False,
    progress: Progress = lambda stage, fraction: None,
    scene: Scene | None = None,
) -> dict[str, Any]:
    """Label the Gaussians of a run from its training images.

    Writes labels into result.ply and result.glb, and labels.json and semantics.safetensors. Regions are embedded with
    CLIP where its files are there or may be downloaded, else by color and texture.

    Args:
        folder: Folder of the run.
        words: What to look for.
        masks: Folder of mask images.
        provider: Provider of the regions; without it as in `choose_provider`.
        weights_dir: Folder where networks are searched first.
        download: Whether networks may be downloaded.
        with_features: Whether the features are written into the splat files, too.
        progress: Gets the stage and its fraction (0..1).
        scene: The scene, or the part of it that the run was trained on; read without it.

    Returns:
        The document in labels.json.

    Raises:
        InputError: For anything that cannot be used; the run is unchanged then.
    """
    run = RunFolder(folder)
    scene_folder, settings, up = run.read_config()
    words = check_words(words)
    loaded = load_checkpoint(folder)
    if loaded is None or not run.ply.exists():
        raise InputError(f"The run {folder} has no result yet; {continue_run()}.")
    splats = read_ply(run.ply)
    cloud = cloud_from_checkpoint(loaded[0]).to(device_for("auto"))
    own = len(cloud) - loaded[1].get("fixed", 0)  # surroundings that a part of a survey does not change hide others
    if own != len(splats):
        raise InputError(
            f"{run.ply} holds {len(splats)} splats and the run's checkpoint {own}: {continue_run()}, "
            "which writes the result again."
        )
    scene = scene or load_scene(scene_folder)
    chosen, masks = choose_provider(scene, words, masks, provider)
    finder, captioner = make_provider(chosen, scene, masks, bool(words), weights_dir, download, progress)
    embedder = make_embedder(weights_dir, download, progress)
    names = set(scene.split.train)
    images = load_images(scene, [view for view in scene.views if view.camera.name in names], settings.width)
    images = [image for image in images if image.valid.any()]
    regions = find_regions(
        images, finder, embedder, words, captioner, cache_folder(scene, "semantics"),
        lambda done, count: progress("Regions", done / count),
    )  # fmt: skip
    found = assign(cloud, regions, {image.camera.name: image.camera for image in images})
    assignment = Assignment(found.features[:own], found.labels[:own], found.agreement[:own], found.gains)
    regions = describe_labels(regions, splats, assignment.labels.cpu().numpy())
    about = {"regions": chosen, "embedder": embedder.name, "words": list(words), "photographs": len(images)}
    return write_semantics(folder, splats, up, regions, assignment, about, with_features)


def search_run(
    folder: Path, words: str, weights_dir: Path | None = None, download: bool = False
) -> tuple[np.ndarray, list[str]]:
    """Compute the similarity of the splats of a labelled run to words.

    Args:
        folder: Folder of the run.
        words: The words.
        weights_dir: Folder where networks are searched first.
        download: Whether networks may be downloaded.

    Returns:
        Similarity (N,) float32 in -1..1 in the order of result.ply, and the labels with that name.

    Raises:
        InputError: When the run has no labels, or no network knows the words.
    """
    wanted = check_words([words])[0]
    semantics, table = read_semantics(folder), read_labels(folder)
    count = len(read_ply(RunFolder(folder).ply))
    if count != len(semantics.features):
        raise InputError(
            f"The labels in {folder} are of {len(semantics.features)} splats and not of {count}: label again."
        )
    embedder: Embedder = Descriptor()
    if semantics.embedder == Clip.name and not any(entry["name"].casefold() == wanted.casefold() for entry in table):
        embedder = make_embedder(weights_dir, download)
    return similarity(semantics, table, wanted, embedder)


def write_similarity(out: Path, similarity: np.ndarray) -> None:
    """Write the similarity of splats as a .npy file.

    Args:
        out: The file.
        similarity: Numbers (N,).

    Raises:
        InputError: When the file cannot be written.
    """
    with atomic_path(out) as temporary, open(temporary, "wb") as file:
        np.save(file, similarity)


def describe(document: dict[str, Any]) -> str:
    """Format labels as the lines that `label RUN` prints."""
    lines = [f"{entry['name']}: {entry['count']} Gaussians, {entry['fraction']:.1%} of the pixels"
             for entry in document["labels"]]  # fmt: skip
    return "\n".join(lines)


def extract_run(folder: Path, label: str, out: Path) -> int:
    """Write the splats of one label to a file.

    Args:
        folder: Folder of the run.
        label: Name or number of the label.
        out: The file; its suffix gives the format.

    Returns:
        Number of splats.

    Raises:
        InputError: For an unknown suffix, and as `export_run` for a choice by labels.
    """
    return int(export_run(folder, find_format(out).name, out, ExportOptions(labels=(label,)))["splats"])
