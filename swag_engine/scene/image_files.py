"""Image files in a folder, and the masks that belong to them."""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..base.text import first_names

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
PHOTO_FOLDERS = ("images", "input")
"""Usual names of the folder of photos in a scene."""
UNREADABLE = frozenset({".gif", ".npy", ".npz", ".mat", ".exr", ".tga", ".pgm", ".heic", ".avif"})
"""Suffixes of masks that other programs write and that cannot be read here."""
MASK_FOLDERS = frozenset({"masks", "mask", "image_masks", "images_masks", "images_mask"})
"""Names of folders of masks, in lower case."""
_MASK_ENDING = re.compile(r"[._-]mask$", re.IGNORECASE)


@dataclass(frozen=True)
class FoundMasks:
    """Masks by their photos, and files beside them that are not used.

    Attributes:
        of: The mask of each photo that has one.
        unused: Masks that belong to no photo.
        second: Further masks of photos that have one.
        unreadable: Files in folders of masks whose type cannot be read.
    """

    of: Mapping[Path, Path]
    unused: tuple[Path, ...]
    second: tuple[Path, ...] = ()
    unreadable: tuple[Path, ...] = ()

    def warnings(self) -> list[str]:
        """Return a sentence on each kind of files that are not used."""
        said = (
            (
                self.unused,
                "Masks that fit no photo, not used ({count}): {names}. Name a mask as its photo, such as "
                "masks/NAME.png or, where photos have the same name, masks/FOLDER/NAME.jpg.png.",
            ),
            (
                self.second,
                "Photos with more than one mask; not used ({count}): {names}. Remove those that do not count.",
            ),
            (self.unreadable, "Masks of a type that cannot be read ({count}): {names}. Save them as PNG."),
        )
        return [
            sentence.format(count=len(paths), names=first_names([f"{path.parent.name}/{path.name}" for path in paths]))
            for paths, sentence in said
            if paths
        ]


def image_files_below(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """List the image files in a folder and below, sorted, without hidden folders and masks.

    Folders that are symbolic links are entered, as image collections often lie on another disk; each folder counts
    once, so that links in a circle end, and under its own path where it has one here.

    Args:
        folder: The folder.
        suffixes: Suffixes of the files, in lower case.

    Returns:
        Paths that begin with `folder`.
    """
    return [path for path, is_mask in files_below(folder, suffixes) if not is_mask]


def file_key(name: str) -> str:
    """Return a key that is equal for names that differ in case or in how accents are encoded (macOS splits them)."""
    return unicodedata.normalize("NFC", name).casefold()


def find_masks(photos: Iterable[Path], root: Path, others: Iterable[Path] | None = None) -> FoundMasks:
    """Find the masks of photos: in folders of masks (see MASK_FOLDERS), or beside the photo as NAME_mask.png.

    Args:
        photos: The photos, below `root`.
        root: Folder of the photos; folders of masks may be in it or below.
        others: Folders with folders of masks that count before. Default: the parent of a root called images or input.
    """
    if others is None:
        others = [root.parent] if root.name.lower() in PHOTO_FOLDERS else []
    suffixes = IMAGE_SUFFIXES | UNREADABLE
    found = [
        (path, _name_below(path, parent))
        for parent in dict.fromkeys(others)
        for folder in sorted(next(os.walk(parent), ("", [], []))[1])
        if folder.lower() in MASK_FOLDERS and root not in (parent, parent / folder)
        for path, _ in files_below(parent / folder, suffixes)
    ]
    found += [(path, _name_below(path, root)) for path, is_mask in files_below(root, suffixes) if is_mask]
    files = [(path, name) for path, name in found if path.suffix.lower() in IMAGE_SUFFIXES]
    named = {path: path.relative_to(root).as_posix() for path in photos}
    of, unused = match_masks(list(named.values()), files)
    left = {path for path, _ in found} - {*of.values(), *unused}
    second, unreadable = (
        tuple(sorted(path for path in left if (path.suffix.lower() in UNREADABLE) == wanted))
        for wanted in (False, True)
    )
    return FoundMasks({path: of[name] for path, name in named.items() if name in of}, unused, second, unreadable)


def _name_below(mask: Path, folder: Path) -> str:
    """Return the name of a mask below a folder, without folders of masks."""
    *folders, name = mask.relative_to(folder).parts
    return "/".join([*(part for part in folders if part.lower() not in MASK_FOLDERS), name])


def match_masks(photos: Sequence[str], masks: Sequence[tuple[Path, str]]) -> tuple[dict[str, Path], tuple[Path, ...]]:
    """Match masks to photos by name: NAME.png, NAME.jpg.png, NAME_mask.png, NAME.mask.png, of any type and case.

    A name without the photo's suffix or folder counts where only one photo has it.

    Args:
        photos: Names of the photos with forward slashes.
        masks: Files and their names; of several for one photo the first is taken.

    Returns:
        The mask of each photo that has one, and the masks that fit none.
    """
    names = [PurePosixPath(file_key(photo)) for photo in photos]
    photo_of: dict[str, str] = {}
    for forms in zip(*((str(name), str(name.with_suffix("")), name.name, name.stem) for name in names), strict=True):
        counts = Counter(forms)
        for photo, form in zip(photos, forms, strict=True):
            if counts[form] == 1:
                photo_of.setdefault(form, photo)
    mask_of: dict[str, Path] = {}
    unused = []
    for path, name in masks:
        stem = file_key(name.rsplit(".", 1)[0])
        form = stem if stem in photo_of else _MASK_ENDING.sub("", stem)
        if form in photo_of:
            mask_of.setdefault(form, path)
        else:
            unused.append(path)
    of: dict[str, Path] = {}
    for form, photo in photo_of.items():
        if form in mask_of:
            of.setdefault(photo, mask_of[form])
    return of, tuple(unused)


def _is_around(folder: Path, here: Path) -> bool:
    """Return whether a folder is a link to another one that holds `here`, a real path."""
    return folder.is_symlink() and here.is_relative_to(folder.resolve())


def files_below(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> Iterator[tuple[Path, bool]]:
    """Yield image files, sorted, and whether each is a mask: in a folder of masks, or beside its photo."""
    found: list[tuple[Path, bool]] = []
    entered: set[str] = set()
    here = folder.resolve()
    for parent, folders, files in os.walk(folder, followlinks=True):
        if (real := os.path.realpath(parent)) in entered:
            folders.clear()
            continue
        entered.add(real)
        # A link to a folder around this one would lead to all that is on the disk.
        wanted = [name for name in folders if not name.startswith(".") and not _is_around(Path(parent, name), here)]
        folders[:] = sorted(wanted, key=lambda name: (os.path.islink(os.path.join(parent, name)), name))
        images = [name for name in files if Path(name).suffix.lower() in suffixes and not name.startswith(".")]
        in_masks = any(part.lower() in MASK_FOLDERS for part in Path(parent).relative_to(folder).parts)
        photos = {form for name in images for form in (name, Path(name).stem)}
        for name in images:
            stem = Path(name).stem
            beside = _MASK_ENDING.sub("", stem)
            found.append((Path(parent, name), in_masks or (beside != stem and beside in photos)))
    yield from sorted(found)
