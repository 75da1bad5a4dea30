"""Photos copied into a scene, resampled where COLMAP has no camera model for their lens."""

import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.text import first_names
from ..scene.images import decode_image, exif_turn, fits, read_image, read_mask, undistort, write_mask
from ..scene.lenses import Lens
from ..sfm.photos import mask_of_copy
from ..sfm.progress import Progress
from .camera_file import FileCamera, photos_are
from .polynomial_lens import PolynomialLens

_JPEG_QUALITY = 97
"""Quality of resampled JPEG files: photos that are compressed a second time should not show it."""


@dataclass(frozen=True, eq=False)
class PlacedPhoto:
    """A photo in the scene.

    Attributes:
        camera: Index in the list of cameras.
        name: Name of the photo in images/.
        lens: Lens of that photo, of a model of COLMAP.
        scale: Pixels of the photo to one of the calibration; 0 where it was resampled.
    """

    camera: int
    name: str
    lens: Lens
    scale: float


def place_photos(
    cameras: tuple[FileCamera, ...],
    paths: Mapping[int, Path],
    masks: Mapping[int, Path],
    folder: Path,
    images: Path,
    warnings: list[str],
    report: Progress,
) -> list[PlacedPhoto]:
    """Copy photos; resample those whose lens COLMAP lacks; turn those that only fit their calibration when turned.

    Args:
        cameras: The cameras.
        paths: Photo of a camera by its index.
        masks: Mask of a camera by its index.
        folder: Folder of the photos, whose structure is kept.
        images: Folder that is written to.
        warnings: Gets sentences.
        report: Called with the stages.

    Returns:
        The photos, sorted by name.

    Raises:
        InputError: When fewer than two photos can be used, or a mask cannot.
    """
    placed: list[PlacedPhoto] = []
    resampled, turned, depths, other_size = 0, 0, 0, Counter[str]()
    unreadable: list[str] = []
    wrong: list[tuple[str, str]] = []
    order = sorted(paths.items(), key=lambda item: item[1])
    for number, (index, path) in enumerate(order):
        report("Copying photos", number / len(order))
        name = path.relative_to(folder).as_posix()
        calibration = cameras[index].calibration
        try:
            height, width = decode_image(path).shape[:2]
        except InputError:
            unreadable.append(name)
            continue
        size, is_turned = (width, height), False
        if calibration.size and not fits(size, calibration.size):
            if not (fits(size[::-1], calibration.size) and exif_turn(path)):
                wrong.append(
                    (name, f"{size[0]} x {size[1]} pixels instead of {calibration.size[0]} x {calibration.size[1]}")
                )
                continue
            size, is_turned = size[::-1], True
        lens = calibration.lens(*size)
        lens.pinhole  # noqa: B018 (refuses what is no lens)
        if path.suffix.lower() == ".webp":  # COLMAP cannot read it
            name += ".png"
        target = images / name
        target.parent.mkdir(parents=True, exist_ok=True)
        scale = size[0] / calibration.size[0] if calibration.size else 1.0
        if scale != 1.0:
            other_size[f"{size[0]} x {size[1]}"] += 1
        turned += is_turned
        mask = read_mask(masks[index], path, size) if index in masks else None
        if isinstance(lens, PolynomialLens):
            if mask is not None:
                mask = undistort(lens, mask.view(np.uint8), mask)[1]
            lens = _resample(path, lens, target)
            resampled, scale = resampled + 1, 0.0
        elif is_turned or target.suffix != path.suffix:
            _write(target, *read_image(path, calibration.size))
        else:
            shutil.copy2(path, target)
            if depth := cameras[index].depth:
                copy = (images.parent / "depths" / name).with_suffix(depth.suffix)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(depth, copy)
                depths += 1
        if mask is not None:
            write_mask(mask_of_copy(images, name), mask)
        placed.append(PlacedPhoto(index, name, lens, scale))
    if unreadable:
        warnings.append(f"{photos_are(len(unreadable))} left out, not readable as images: {first_names(unreadable)}.")
    if wrong:
        warnings.append(
            f"{photos_are(len(wrong))} left out, not of the shape of the calibration: {wrong[0][0]} has {wrong[0][1]}. "
            "Use the photos that the cameras were made from, uncropped."
        )
    if len(placed) < 2:
        raise InputError(f"Only {len(placed)} of the photos in {folder} can be used. {' '.join(warnings)}")
    for text, count in other_size.items():
        warnings.append(
            f"{photos_are(count)} {text} pixels large, another size than the calibration, which was scaled to it."
        )
    if turned:
        warnings.append(f"{photos_are(turned)} turned as the EXIF orientation says, to fit the calibration.")
    if given := sum(cameras[photo.camera].depth is not None for photo in placed):
        warnings.append(f"Depth images of {depths} of {given} photos are in depths, for other programs.")
    if resampled:
        warnings.append(
            f"{photos_are(resampled)} undistorted in the scene, because COLMAP has no camera model for the lens."
        )
    return placed


def _resample(path: Path, lens: Lens, target: Path) -> Lens:
    """Write the pinhole image of a photo; return its lens."""
    pixels, valid = read_image(path, (lens.width, lens.height))
    pixels, seen = undistort(lens, pixels, valid)
    _write(target, pixels, None if valid is None else seen)
    pinhole = lens.pinhole
    return Lens("PINHOLE", pinhole.width, pinhole.height, (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy))


def _write(path: Path, pixels: np.ndarray, valid: np.ndarray | None) -> None:
    """Write pixels (H, W, 3) uint8 RGB, with an alpha channel where `valid` (H, W) bool is given."""
    image = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    if valid is not None:
        image = np.dstack([image, np.where(valid, 255, 0).astype(np.uint8)])
    # cv2.imwrite cannot write to every path on Windows.
    path.write_bytes(cv2.imencode(path.suffix, image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes())
