"""Planning of a survey: what its blocks and its coarse model are, written to the folder of the survey."""

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, remedy
from ..base.files import LOCK, locked_folder
from ..base.text import first_names
from ..formats.survey_folder import COARSE, Block, Box, Survey, SurveyFolder
from ..kernels.machine import engine_version
from ..scene.colmap import Scene, load_scene
from ..scene.scene_part import part_of, without_points, write_part
from ..scene.split import Split, split_views
from ..settings.settings import TrainSettings
from .cut import MARGIN_REACHES, Cutter, Part, Places, Seam, median_distance, seams_of, survey_bounds, survey_ground
from .places import connected_groups, covering_images
from .sizes import Sizes

Progress = Callable[[str, float], None]
"""A function of the stage of the work and its fraction (0..1)."""

FEWEST_TRAINING = 3
"""Training images of a block, at least: what two images see agrees with wrong depths, too; the third one tells."""
PLACE_IMAGES = 8
"""Images of a group without connection to the others from which on it is a place of its own, at least."""
PLACE_FRACTION = 0.02
"""The same as a fraction of all images: smaller groups are left of places with few features."""
COARSE_TRAINING = 270
"""Training images of the coarse model, at most."""
COARSE_VALIDATION = 30
"""Validation images of the coarse model, at most."""
FEWEST_BLOCK_IMAGES = 2 * FEWEST_TRAINING
"""Smallest number of images that blocks may be limited to."""


def plan_survey(
    scene: Path,
    out: Path,
    settings: TrainSettings,
    block_images: int = 300,
    progress: Progress | None = None,
    memory: int | None = None,
) -> dict[str, Any]:
    """Cut a survey into blocks and write survey.json, and block.json of each block and of each seam between two.

    Args:
        scene: Folder of the scene.
        out: Folder of the survey, which is made; an empty one may exist.
        settings: What the user chose. A number of Gaussians is that of all blocks together, a number of iterations that
            of the average block.
        block_images: Images that a block has at most, where the survey can be cut so.
        progress: Gets the stage of the work and its fraction.
        memory: Bytes of the machine that trains a block, None without a limit.

    Returns:
        A dict for JSON, of which `describe` makes text: `blocks`, `seams` and `coarse` with figures, `totals`, and
        `notes`, sentences for the user.

    Raises:
        InputError: If the survey cannot be planned; nothing is written then.
    """
    report = progress or (lambda stage, fraction: None)
    if settings.budget:
        raise InputError("A survey has no time budget, as its blocks may be trained anywhere: give iterations.")
    if block_images < FEWEST_BLOCK_IMAGES:
        raise InputError(f"A block needs at least {FEWEST_BLOCK_IMAGES} images, and {block_images} were asked for.")
    with locked_folder(out):
        _check_empty(out)
        report("Read the scene", 0.0)
        loaded = load_scene(scene)
        survey, parts, document = _planned(loaded, settings, block_images, memory, report)
        survey = replace(survey, scene=_scene_path(scene, out))
        report("Write the blocks", 0.95)
        _write(SurveyFolder(out), loaded, survey, parts)
    return {"survey": str(out), "scene": str(scene)} | document


def _check_empty(out: Path) -> None:
    if SurveyFolder(out).survey.exists():
        raise InputError(f"{out} is planned already: run its blocks, or give a new folder.")
    if any(entry.name != LOCK for entry in out.iterdir()):
        raise InputError(f"{out} is not empty: give a new folder for the survey.")


def _scene_path(scene: Path, out: Path) -> Path:
    """Return the path of the scene for survey.json: relative where both are in one folder, which can then be moved."""
    scene, out = scene.expanduser().resolve(), out.resolve()
    return Path(os.path.relpath(scene, out)) if scene.is_relative_to(out.parent) else scene


def _write(folder: SurveyFolder, scene: Scene, survey: Survey, parts: Sequence[Block]) -> None:
    """Write all files, survey.json last: a folder without it is no survey."""
    try:
        for part in parts:
            folder.write_block(part)
            split = Split(part.training, part.validation, part.test)
            write_part(folder.scene_part(part.name), part_of(scene, split))
        split = Split(survey.coarse_training, survey.coarse_validation, ())
        write_part(folder.scene_part(COARSE), part_of(scene, split))
        write_part(folder.all_views, without_points(scene))
        folder.write(survey)
    except BaseException:
        folder.survey.unlink(missing_ok=True)
        for made in ("blocks", "seams", COARSE):
            shutil.rmtree(folder.path / made, ignore_errors=True)
        raise


def _planned(
    scene: Scene, settings: TrainSettings, block_images: int, memory: int | None, report: Progress
) -> tuple[Survey, list[Block], dict[str, Any]]:
    """Plan a survey without writing anything; return it, its blocks and seams, and the document."""
    names = [view.name for view in scene.views]
    split = split_views(names)
    notes = list(scene.warnings)
    report("Find the ground", 0.4)
    positions = scene.points.positions
    centres = np.stack([view.camera.centre for view in scene.views])
    seen: Sequence[np.ndarray] = [view.point_indices for view in scene.views]
    if not any(len(rows) for rows in seen):
        raise InputError(
            f"The COLMAP model of {scene.folder} does not say which points a photo shows, and blocks start from the "
            "points of their photos: make the model with COLMAP (sfm), or train the scene as one run."
        )
    _check_one_place(scene, names, seen, notes)

    ground = survey_ground(scene.up, centres, positions)
    places = Places(ground.on_ground(centres)[:, :2], ground.on_ground(positions)[:, :2], seen)
    reach = median_distance(places.cameras, places.points, seen)
    distance = MARGIN_REACHES * reach
    bounds = survey_bounds(places, distance)
    observed = np.zeros(len(positions), bool)
    for rows in seen:
        observed[rows] = True
    overlap = sum(map(len, seen)) / max(1, np.count_nonzero(observed))
    report("Fit the sizes", 0.5)
    sizes = Sizes.of(scene, settings, overlap, memory)
    is_training = np.isin(names, split.train)

    report("Cut the survey", 0.6)
    cutter = Cutter(
        places,
        bounds,
        distance,
        block_images,
        fits=sizes.fits,
        enough=lambda part: np.count_nonzero(is_training[part.images]) >= FEWEST_TRAINING,
        seed=settings.seed,
    )
    parts = cutter.cut()
    _check_parts(parts, cutter, sizes, notes)
    left_out = np.setdiff1d(np.arange(len(names)), np.concatenate([part.images for part in parts]))
    if len(left_out):
        notes.append(
            f"{len(left_out)} photos are in no block, as they show too few sparse points: "
            f"{first_names([names[image] for image in left_out])}."
        )
    largest = max(map(sizes.block_gaussians, parts))
    blocks = _blocks(parts, names, split, sizes, largest, settings.seed)
    seams = _seams(seams_of(parts, places, bounds, distance), blocks, names, split, sizes, largest, notes)

    report("Choose the photos of the coarse model", 0.9)
    directions = np.stack([view.camera.world_to_camera[2, :3] for view in scene.views])
    chosen = {}
    for kind, most in (("train", COARSE_TRAINING), ("validation", COARSE_VALIDATION)):
        of_kind = np.flatnonzero(np.isin(names, getattr(split, kind)))
        if len(of_kind):
            of_kind = of_kind[covering_images(centres[of_kind], directions[of_kind], max(reach, 1e-12), most)]
        chosen[kind] = tuple(sorted(names[image] for image in of_kind))
    mean_training = sum(len(block.training) for block in blocks) / len(blocks)
    coarse_settings, coarse_memory = sizes.coarse(
        len(chosen["train"]),
        len(chosen["validation"]),
        max(1, round(sizes.iterations * min(1.0, len(chosen["train"]) / mean_training))),
        largest,
    )
    # What remains after merging: of each block the Gaussians in its core.
    total = sum(block.max_gaussians * part.core_points / part.points for block, part in zip(blocks, parts, strict=True))
    survey = Survey(
        scene=scene.folder,
        engine=engine_version() or "unknown",
        settings=replace(
            settings,
            iterations=sizes.iterations,
            width=sizes.width,
            max_gaussians=settings.max_gaussians or round(total),
        ),
        coarse_settings=coarse_settings,
        coarse_training=chosen["train"],
        coarse_validation=chosen["validation"],
        test=split.test,
        ground=ground,
        bounds=bounds,
        images=len(names),
        blocks=tuple(block.name for block in blocks),
        seams=tuple(seam.name for seam in seams),
        median_range=median_distance(centres, positions, seen),
    )
    document = _document(survey, blocks, seams, coarse_memory, len(names) - len(left_out), notes)
    return survey, [*blocks, *seams], document


def _check_one_place(scene: Scene, names: list[str], seen: Sequence[np.ndarray], notes: list[str]) -> None:
    """Raise InputError for a survey of several places; note small groups of images without connection."""
    groups = connected_groups(seen, len(scene.points.positions))
    least = max(PLACE_IMAGES, PLACE_FRACTION * len(names))
    large = [[names[image] for image in group] for group in groups if len(group) >= least]
    if len(large) > 1:
        counts = "; ".join(f"{len(group)} photos from {group[0]} to {group[-1]}" for group in large)
        raise InputError(
            f"{scene.folder} shows {len(large)} places that share no sparse points ({counts}): how they lie to each "
            "other is unknown, so make a scene of the photos of each and plan each by itself."
        )
    apart = sorted(names[image] for group in groups[1:] for image in group)
    if apart:
        notes.append(f"{len(apart)} photos share no sparse points with the others: {first_names(apart)}.")


def _check_parts(parts: Sequence[Part], cutter: Cutter, sizes: Sizes, notes: list[str]) -> None:
    """Raise InputError where a block cannot be trained; note blocks that are larger than asked."""
    if not all(cutter.enough(part) for part in parts):
        raise InputError(
            f"The survey has fewer than {FEWEST_TRAINING} training photos that show sparse points: add photos that "
            "overlap more, and find the cameras again."
        )
    largest = max(parts, key=sizes.block_memory)
    if not sizes.fits(largest):
        raise InputError(
            f"A block of {len(largest.images)} photos needs {sizes.block_memory(largest) / 1e9:.2f} GB of memory, "
            f"{(sizes.memory or 0) / 1e9:.2f} GB are for it, and its photos show too much of the same place to be cut "
            "further: give a smaller width or fewer Gaussians, or plan for a machine with more memory."
        )
    count = len(cutter.places.seen)
    over = [len(part.images) for part in parts if len(part.images) > cutter.block_images]
    if over:
        notes.append(
            f"{len(over)} of {len(parts)} blocks have more than {cutter.block_images} photos, up to {max(over)}: these "
            "show the same place, and cutting it further would make blocks that are hardly smaller."
        )
    if len(parts) == 1 and not over:
        notes.append(
            f"{count} photos are few enough for one block: {remedy('`train`', 'Train')} does the same with less work."
        )


def _members(images: np.ndarray, names: Sequence[str], split: Split) -> dict[str, tuple[str, ...]]:
    """Return the names of images (N,) by what they are for, as `Block` has them."""
    joined = {names[image] for image in images}
    of_kind = {"training": split.train, "validation": split.validation, "test": split.test}
    return {kind: tuple(sorted(joined.intersection(wanted))) for kind, wanted in of_kind.items()}


def _blocks(
    parts: Sequence[Part], names: Sequence[str], split: Split, sizes: Sizes, largest: int, seed: int
) -> list[Block]:
    members = [_members(part.images, names, split) for part in parts]
    training = [len(member["training"]) for member in members]
    iterations = [sizes.part_iterations(images, training) for images in training]
    return [
        Block(
            name=f"B-{number:03d}",
            core=part.core,
            extended=part.extended,
            **member,
            seed=(seed + number) % 2**31,
            iterations=steps,
            max_gaussians=sizes.block_gaussians(part),
            points=part.points,
            memory=sizes.block_memory(part, largest),
        )
        for number, (part, member, steps) in enumerate(zip(parts, members, iterations, strict=True), 1)
    ]


def _seams(
    seams: Sequence[Seam],
    blocks: Sequence[Block],
    names: Sequence[str],
    split: Split,
    sizes: Sizes,
    largest: int,
    notes: list[str],
) -> list[Block]:
    """Return the seams as parts of the survey; a border that too few training images show has none."""
    training = [len(block.training) for block in blocks]
    fitting = [seam for seam in seams if sizes.fits(seam, largest)]
    if len(fitting) < len(seams):
        notes.append(
            f"{len(seams) - len(fitting)} of {len(seams)} borders between blocks are not trained as seams, as the "
            "memory does not suffice: pixels beside them will be less good than others."
        )
    made = []
    for seam in fitting:
        member = _members(seam.images, names, split)
        if len(member["training"]) < FEWEST_TRAINING:
            continue
        first, second = (blocks[side] for side in seam.sides)
        made.append(
            Block(
                name=f"S-{first.name[2:]}-{second.name[2:]}",
                core=seam.core,
                extended=seam.extended,
                **member,
                seed=first.seed,
                iterations=sizes.part_iterations(len(member["training"]), training),
                max_gaussians=max(1, round(sizes.block_gaussians(seam) * seam.core_points / max(1, seam.points))),
                points=seam.points,
                memory=sizes.block_memory(seam, largest),
                sides=(first.name, second.name),
            )
        )
    return made


def _document(
    survey: Survey, blocks: Sequence[Block], seams: Sequence[Block], coarse_memory: int, joined: int, notes: list[str]
) -> dict[str, Any]:
    coarse = survey.coarse_settings
    memberships = sum(len(block.images) for block in blocks)
    return {
        "engine": survey.engine,
        "ground": {"origin": survey.ground.origin, "axes": survey.ground.axes},
        "bounds": survey.bounds,
        "blocks": [_figures(block) for block in blocks],
        "seams": [_figures(seam) for seam in seams],
        "coarse": {
            "training": len(survey.coarse_training),
            "validation": len(survey.coarse_validation),
            "iterations": coarse.iterations,
            "width": coarse.width,
            "max_gaussians": coarse.max_gaussians,
            "memory": coarse_memory,
        },
        "totals": {
            "images": survey.images,
            "test": len(survey.test),
            "blocks": len(blocks),
            "width": survey.settings.width,
            "max_gaussians": survey.settings.max_gaussians,
            "iterations": sum(part.iterations for part in (*blocks, *seams)),
            # Images that are trained in several blocks, as a fraction of those in one.
            "extra_images": memberships / joined - 1,
            "largest_memory": max(coarse_memory, *(part.memory for part in (*blocks, *seams))),
        },
        "notes": notes,
    }


def _figures(block: Block) -> dict[str, Any]:
    return {
        "name": block.name,
        "core": _edges(block.core),
        "extended": _edges(block.extended),
        "images": len(block.images),
        "training": len(block.training),
        "validation": len(block.validation),
        "test": len(block.test),
        "iterations": block.iterations,
        "max_gaussians": block.max_gaussians,
        "points": block.points,
        "memory": block.memory,
    }


def _edges(box: Box) -> list[float | None]:
    return [edge if np.isfinite(edge) else None for edge in box]


def describe(document: dict[str, Any]) -> str:
    """Format a plan as text.

    Args:
        document: What `plan_survey` returned.

    Returns:
        The lines that `survey plan` prints.
    """
    totals, coarse = document["totals"], document["coarse"]
    lines = [
        f"Survey:       {document['survey']}",
        f"Scene:        {document['scene']}",
        f"Photos:       {totals['images']}, of which {totals['test']} are held out for testing",
        f"Blocks:       {totals['blocks']}, with {100 * totals['extra_images']:.0f} % more photos by their overlap",
        f"Size:         {totals['width']} px, {totals['max_gaussians']} Gaussians, {totals['iterations']} iterations",
        f"Memory:       {totals['largest_memory'] / 1e9:.2f} GB for the largest run",
        f"Coarse model: {coarse['training'] + coarse['validation']} photos of {coarse['width']} px, "
        f"{coarse['max_gaussians']} Gaussians, {coarse['iterations']} iterations, {coarse['memory'] / 1e9:.2f} GB",
        "",
        f"{'block':11} {'photos':>7} {'points':>9} {'Gaussians':>10} {'iterations':>11} {'GB':>6}",
    ]
    for block in document["blocks"] + document["seams"]:
        lines.append(
            f"{block['name']:11} {block['images']:7} {block['points']:9} {block['max_gaussians']:10} "
            f"{block['iterations']:11} {block['memory'] / 1e9:6.2f}"
        )
    if document["notes"]:
        lines += ["", *(f"Note: {note}" for note in document["notes"])]
    return "\n".join(lines)
