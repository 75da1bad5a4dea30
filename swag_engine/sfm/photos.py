"""Photos prepared for structure from motion: which can be used, and their copies."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..scene.colmap_library import pycolmap
from ..scene.image_files import PHOTO_FOLDERS, find_masks, image_files_below
from ..scene.images import decode_image, read_image, read_mask, write_mask
from .progress import Progress

RAW_SUFFIXES = frozenset(
    {
        ".arw",
        ".avif",
        ".cr2",
        ".cr3",
        ".crw",
        ".dng",
        ".gpr",
        ".heic",
        ".heif",
        ".jxl",
        ".nef",
        ".nrw",
        ".orf",
        ".pef",
        ".raf",
        ".raw",
        ".rw2",
        ".sr2",
        ".srf",
        ".srw",
        ".x3f",
    }
)
"""Photos of cameras and phones that cannot be read: raw files and newer compressions."""
VIDEO_SUFFIXES = frozenset(
    {".avi", ".insv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".webm", ".wmv"}
)
"""Videos, which are chosen themselves, not their folder."""
_LEAST_STRUCTURE = 1.0
"""Local contrast, in grey levels, that a tenth of a photo exceeds at least: open water, also with some particles, and
darkness have 0.2 to 0.7, the faintest photo of five underwater data sets 3.7."""
_SAME_PICTURE = 0.985
"""Correlation of thumbnails from which photos are copies: a shift by 0.2 % of the width gives less, a copy of half the
size, or with more compression, gives more."""
_JPEG = [
    *(cv2.IMWRITE_JPEG_QUALITY, 95),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
]
"""Color at full size: at half the size, as usual, details of red follow those of green, and water is found wrongly."""
_THUMBNAIL = (64, 48)
"""Width and height in pixels at which pictures are compared."""


@dataclass(frozen=True)
class ChosenImages:
    """Images that structure from motion uses.

    Attributes:
        names: Their names below images/, in order.
        notes: Sentences that say what was chosen.
        warnings: Sentences that say what was left out and why.
    """

    names: list[str]
    notes: list[str]
    warnings: list[str]


def copy_photos(source: Path, images: Path, pictures: Path, report: Progress) -> ChosenImages:
    """Copy the photos of a folder that can be used, and write their equalised grey copies.

    Photos that cannot be read, without structure, wholly masked, or that show the same picture as a larger file are
    left out. Masks are written to masks/ beside images/, as NAME.EXT.png.

    Args:
        source: The folder (its images/ or input/ where it has one of these).
        images: Folder of the copies, which are equal byte by byte; those of WebP files are PNG files.
        pictures: Folder of the grey copies, numbered in the order of the photos (see `copy_name`).
        report: Called before each photo.

    Raises:
        InputError: When fewer than two photos can be used, or a mask cannot.
    """
    source = next((source / name for name in PHOTO_FOLDERS if (source / name).is_dir()), source)
    paths = image_files_below(source)
    masks = find_masks(paths, source)
    if not paths:
        raise InputError(_no_photos(source))
    if len(paths) == 1:
        raise InputError(f"There is only one photo in {source}, and poses need several that overlap.")
    thumbnails = np.empty((len(paths), _THUMBNAIL[0] * _THUMBNAIL[1]), np.float32)
    used: dict[Path, Path] = {}
    unreadable, empty, copies, covered = [], [], [], []
    # Large files first, so that a photo is kept and its thumbnail or smaller export left out.
    for number, path in enumerate(sorted(paths, key=lambda path: -path.stat().st_size if path.exists() else 0)):
        report("Preparing photos", number / len(paths))
        try:
            grey = cv2.cvtColor(read_image(path)[0], cv2.COLOR_RGB2GRAY)
        except InputError:
            unreadable.append(path)
            continue
        mask = read_mask(masks.of[path], path, (grey.shape[1], grey.shape[0])) if path in masks.of else None
        if mask is not None and not mask.any():
            covered.append(path)
            continue
        if not has_structure(grey):
            empty.append(path)
            continue
        equalised = equalise(grey)
        thumbnail = thumbnails[len(used)] = _thumbnail(equalised)
        if (thumbnails[: len(used)] @ thumbnail > _SAME_PICTURE).any():
            copies.append(path)
            continue
        used[path] = pictures / f"part_{number}.jpg"
        write_jpeg(used[path], equalised)
        copy = images / _name(path, source)
        if mask is not None:
            write_mask(mask_of_copy(images, _name(path, source)), mask)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if copy.suffix == path.suffix:
            shutil.copy2(path, copy)
        else:
            copy.write_bytes(cv2.imencode(copy.suffix, decode_image(path))[1].tobytes())
    stems = {path.stem for path in paths}
    raw = [path for path in image_files_below(source, RAW_SUFFIXES) if path.stem not in stems]
    left_out = [
        f"{_counted(found, source)} {why}"
        for found, why in (
            (unreadable, "that cannot be read; copy or save again with 8 or 16 bits per channel"),
            (empty, "without structure, as of open water or in darkness"),
            (copies, "of the same picture as another one"),
            (covered, "whose mask leaves no valid pixel"),
            (raw, "of a type that cannot be read; save as JPEG or TIFF"),
        )
        if found
    ]
    if len(used) < 2:
        raise InputError(
            f"Poses need several photos that overlap, and {'only one' if used else 'none'} of the {len(paths)} photos "
            f"in {source} can be used; left out: {'; '.join(left_out)}."
        )
    kept = [path for path in paths if path in used]
    for number, path in enumerate(kept):
        used[path].rename(pictures / copy_name(number))
    names = [_name(path, source) for path in kept]
    write_feature_masks(images, names, pictures)
    return ChosenImages(names, [], [*masks.warnings(), *(f"Left out: {photos}." for photos in left_out)])


def mask_of_copy(images: Path, name: str) -> Path:
    """Return the file of the mask of a copied photo in images/ of a new scene."""
    return images.parent / "masks" / f"{name}.png"


def write_feature_masks(images: Path, names: Sequence[str], pictures: Path) -> None:
    """Write masks of the grey copies where a photo of images/ has one: COLMAP then wants one for each."""
    for number, name in enumerate(names if (images.parent / "masks").is_dir() else ()):
        mask, copy = mask_of_copy(images, name), copy_name(number)
        valid = decode_image(mask) > 0 if mask.is_file() else decode_image(pictures / copy) >= 0
        write_mask(pictures.with_name("masks") / f"{copy}.png", valid)


def reader_options(pictures: Path, model: str, params: str) -> pycolmap.ImageReaderOptions:
    """Return how COLMAP reads grey copies: a camera model, its parameters, and masks (see `write_feature_masks`)."""
    masks = pictures.with_name("masks")
    options = pycolmap.ImageReaderOptions(camera_model=model, camera_params=params)
    if masks.is_dir():
        options.mask_path = str(masks)
    return options


def equalise(grey: np.ndarray) -> np.ndarray:
    """Return a grey image (H, W) uint8 with equalised local contrast (CLAHE): turbid water hides features."""
    return cv2.createCLAHE(clipLimit=4, tileGridSize=(8, 8)).apply(grey)


def has_structure(grey: np.ndarray) -> bool:
    """Return whether a grey image (H, W) uint8 shows more than open water or darkness.

    It looks at a picture that is reduced and smoothed, in which the noise of the camera hardly counts.
    """
    scale = min(1.0, 480 / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    contrast = np.abs(cv2.GaussianBlur(small, (0, 0), 2.5) - cv2.GaussianBlur(small, (0, 0), 10))
    return bool(np.quantile(contrast, 0.9) > _LEAST_STRUCTURE)


def copy_name(number: int) -> str:
    """Return the file name of the grey copy of an image."""
    return f"{number:06d}.jpg"


def write_jpeg(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W) or (H, W, 3) uint8 BGR, with color at full size."""
    # cv2.imwrite cannot write to every path on Windows, and does not say why it failed.
    path.write_bytes(cv2.imencode(".jpg", image, _JPEG)[1].tobytes())


def _thumbnail(equalised: np.ndarray) -> np.ndarray:
    """Reduce a picture to its details, a unit vector (N,) float32: the product of two is their correlation."""
    small = cv2.resize(equalised, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32)
    details = (small - cv2.GaussianBlur(small, (0, 0), 2)).ravel()
    details -= details.mean()
    return details / max(float(np.linalg.norm(details)), 1e-6)


def _name(path: Path, source: Path) -> str:
    """Return the name of a photo of a folder in the scene: COLMAP does not read WebP."""
    name = path.relative_to(source).as_posix()
    return f"{name}.png" if path.suffix.lower() == ".webp" else name


def _counted(paths: list[Path], source: Path) -> str:
    """Return the number of photos and the names of the first."""
    names = sorted(path.relative_to(source).as_posix() for path in paths)
    listed = f"{', '.join(names[:3])}{' ...' if len(names) > 3 else ''}"
    return f"{len(names)} photo{'s' * (len(names) > 1)} ({listed})"


def _no_photos(source: Path) -> str:
    """Say that a folder has no photos that can be read, and what it has instead."""
    sentence = f"There are no photos (JPEG, PNG, TIFF, BMP or WebP) in {source}"
    if raw := image_files_below(source, RAW_SUFFIXES):
        return f"{sentence}, only {_counted(raw, source)} of types that cannot be read: save them as JPEG or TIFF."
    if videos := image_files_below(source, VIDEO_SUFFIXES):
        return f"{sentence}, but videos: choose one of them, such as {videos[0].name}."
    return f"{sentence}."
