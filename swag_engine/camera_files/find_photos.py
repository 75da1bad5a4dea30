"""Photo files of the names in a file of cameras."""

import unicodedata
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from ..base.errors import InputError
from ..base.text import first_names
from ..scene.image_files import FoundMasks, find_masks, image_files_below
from .camera_file import photos_are


@dataclass
class FoundPhotos:
    """Which photo belongs to which camera.

    Attributes:
        paths: Photo of each camera, by index.
        masks: Masks of all photos in the folder.
        warnings: Sentences about cameras without a photo.
    """

    paths: dict[int, Path] = field(default_factory=dict)
    masks: FoundMasks = FoundMasks({}, ())
    warnings: list[str] = field(default_factory=list)


def find_photos(folder: Path, names: Sequence[str]) -> FoundPhotos:
    """Find the photo of each name in a folder and below, and the masks.

    File names are compared first, then the name with the file name without extension (labels), then both without
    extensions (photos that were converted); case does not matter. Of several files with the name, the one whose
    folders agree with those of the name is taken, and none where that does not decide.

    Args:
        folder: The folder.
        names: Paths, file names or labels.

    Raises:
        InputError: When fewer than two photos are found.
    """
    files = [path for path in image_files_below(folder) if not _in_scene(path, folder)]
    if not files:
        raise InputError(f"There are no photos (JPEG, PNG, TIFF, BMP or WebP) in {folder}.")
    keys = {path: _parts(path.relative_to(folder).as_posix()) for path in files}
    rules: tuple[tuple[Callable[[str], str], Callable[[str], str]], ...] = (
        (_whole, _whole),
        (_whole, _stem),
        (_stem, _stem),
    )
    by_key: list[dict[str, list[Path]]] = []
    for _, of_file in rules:
        table: dict[str, list[Path]] = defaultdict(list)
        for path in files:
            table[of_file(keys[path][-1])].append(path)
        by_key.append(table)

    chosen: dict[int, Path] = {}
    missing, ambiguous = [], []
    for number, name in enumerate(names):
        parts = _parts(name)
        candidates: list[Path] = []
        for (of_name, _), table in zip(rules, by_key, strict=True):
            candidates = table.get(of_name(parts[-1]), []) if parts else []
            if candidates:
                break
        if not candidates:
            missing.append(name)
            continue
        # An equal path decides over one that ends like the name.
        common = [_common(parts[:-1], keys[path][:-1]) + (keys[path] == parts) for path in candidates]
        if common.count(max(common)) == 1:
            chosen[number] = candidates[common.index(max(common))]
        else:
            ambiguous.append(name)
    cameras_of: dict[Path, list[int]] = defaultdict(list)
    for number, path in chosen.items():
        cameras_of[path].append(number)
    found = FoundPhotos({numbers[0]: path for path, numbers in cameras_of.items() if len(numbers) == 1})
    masks = find_masks(files, folder)
    found.masks = replace(masks, unused=tuple(mask for mask in masks.unused if not _in_scene(mask, folder)))
    ambiguous += [names[number] for numbers in cameras_of.values() if len(numbers) > 1 for number in numbers]
    if missing:
        found.warnings.append(f"{photos_are(len(missing))} left out, not found in {folder}: {first_names(missing)}.")
    if ambiguous:
        found.warnings.append(
            f"{photos_are(len(ambiguous))} left out, with the name of another: {first_names(ambiguous)}. Give the "
            "photos different names, or the camera groups the names of their folders."
        )
    if len(found.paths) < 2:
        reasons = "".join(f" {sentence}" for sentence in found.warnings)
        raise InputError(
            f"Only {len(found.paths)} of the {len(names)} photos were found in {folder}: choose their folder.{reasons}"
        )
    return found


def _in_scene(path: Path, folder: Path) -> bool:
    """Return whether a photo is a copy in a scene below the folder, which a former import may have made there."""
    parents = path.parents[: len(path.relative_to(folder).parts) - 1]
    return any(
        parent.name in ("images", "masks") and parent.parent != folder and (parent.parent / "sparse").is_dir()
        for parent in parents
    )


def _parts(name: str) -> tuple[str, ...]:
    normal = unicodedata.normalize("NFC", name).casefold()
    return tuple(part for part in normal.split("/") if part not in ("", ".", ".."))


def _whole(name: str) -> str:
    return name


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


def _common(first: Sequence[str], second: Sequence[str]) -> int:
    """Return how many of the last parts are equal."""
    count = 0
    for one, other in zip(reversed(first), reversed(second), strict=False):
        if one != other:
            break
        count += 1
    return count
