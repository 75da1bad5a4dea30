"""Photographs as training sees them: undistorted, resized, with a mask of what is valid, and cached."""

import hashlib
import json
import os
import time
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import platformdirs

from ..base.errors import InputError
from ..base.files import atomic_path
from .cameras import Camera
from .colmap import Scene, View
from .lenses import source_map

_CACHE_FORMAT = 1
_CACHE_DAYS = 30


@dataclass
class TrainingImage:
    """pixels (H, W, 3) uint8 sRGB and valid (H, W) bool, at the size of `camera`; invalid pixels mean nothing."""

    camera: Camera
    pixels: np.ndarray
    valid: np.ndarray


def load_images(
    scene: Scene,
    views: Sequence[View],
    width: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[TrainingImage]:
    """Undistort the photographs of `views` and reduce them to `width` pixels (None: full size), never enlarging.

    Results are kept in the user's cache folder (or SWAG_CACHE_DIR), so that only the first call takes long. `progress`
    is called with how many are done and how many there are. A mask (masks/NAME.png, black is masked) and an
    alpha of 0 make pixels invalid. Raises InputError naming the picture that cannot be used.
    """
    cache = cache_folder(scene, "images")
    images: list[TrainingImage] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [pool.submit(_load_image, scene, view, width, cache) for view in views]
        try:
            for job in jobs:
                images.append(job.result())
                if progress:
                    progress(len(images), len(views))
        finally:
            for job in jobs:
                job.cancel()
    _drop_stale(cache.parent)
    return images


def read_picture(path: Path, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Read a photograph: (H, W, 3) uint8 RGB, and (H, W) bool from its alpha channel or None.

    16-bit pictures are reduced to 8, grey ones repeated. COLMAP reads pixels as they are stored, ignoring an EXIF
    orientation, and so does this; only when a camera of `size` (width, height) is known and just the turned picture
    fits it, the orientation is applied. Raises InputError naming the file.
    """
    try:
        data = np.fromfile(path, np.uint8)  # cv2.imread cannot open every path on Windows
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if picture is None:
        raise InputError(f"{path} cannot be read as a picture: it may be cut short; copy it again or take it out.")
    height, width = picture.shape[:2]
    if size and not _fits((width, height), size) and _fits((height, width), size):
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        height, width = picture.shape[:2]
    if size and not _fits((width, height), size):
        raise InputError(
            f"{path} is {width} x {height} pixels, but its camera in the COLMAP model is {size[0]} x {size[1]}: use "
            "the photographs that the model was made from."
        )
    if picture.dtype == np.uint16:
        picture = np.round(picture / 257).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise InputError(f"{path} holds {picture.dtype} pixels: save it with 8 or 16 bits per channel.")
    if picture.ndim == 2:
        return cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB), None
    if picture.shape[2] == 4:
        return cv2.cvtColor(picture, cv2.COLOR_BGRA2RGB), picture[..., 3] > 0
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), None


def _fits(picture: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Whether the picture has the camera's shape, perhaps at another resolution (to a pixel of rounding)."""
    return abs(picture[0] * camera[1] - picture[1] * camera[0]) <= max(*picture, *camera)


def mask_of(scene: Scene, view: View) -> Path | None:
    for folder in (scene.folder / "masks", scene.image_folder / "masks", scene.image_folder.parent / "masks"):
        for mask in (folder / f"{view.name}.png", (folder / view.name).with_suffix(".png")):
            if mask.is_file():
                return mask
    return None


def _load_image(scene: Scene, view: View, width: int | None, cache: Path) -> TrainingImage:
    mask_path = mask_of(scene, view)
    try:
        files = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in (view.path, mask_path) if path]
    except OSError as error:
        raise InputError(f"Cannot read {view.path}: {error.strerror or error}.") from error
    lens = (view.lens.model, view.lens.width, view.lens.height, view.lens.params)
    key = hashlib.sha256(json.dumps([_CACHE_FORMAT, files, lens, width]).encode()).hexdigest()[:32]
    cached = cache / f"{key}.npz"
    arrays = _read_cached(cached)
    if arrays is None:
        arrays = _undistorted(view, mask_path, width)
        try:
            with atomic_path(cached) as temporary, open(temporary, "wb") as file:
                np.savez(file, pixels=arrays[0], valid=arrays[1])
        except (InputError, OSError):
            pass  # a cache that cannot be written only costs time
    pixels, valid = arrays
    return TrainingImage(view.camera.resized(pixels.shape[1]), pixels, valid)


def _undistorted(view: View, mask_path: Path | None, width: int | None) -> tuple[np.ndarray, np.ndarray]:
    lens, camera = view.lens, view.camera
    pixels, valid = read_picture(view.path, (lens.width, lens.height))
    height_on_disk, width_on_disk = pixels.shape[:2]
    if mask_path:
        mask = read_picture(mask_path)[0].max(-1)
        mask = cv2.resize(mask, (width_on_disk, height_on_disk), interpolation=cv2.INTER_NEAREST) > 0
        valid = mask if valid is None else valid & mask
    if not lens.is_pinhole:
        source, seen = source_map(lens)
        # cv2 puts the first pixel's centre at 0, COLMAP at 0.5; the file may have another resolution than the camera.
        x = source[..., 0] * np.float32(width_on_disk / lens.width) - np.float32(0.5)
        y = source[..., 1] * np.float32(height_on_disk / lens.height) - np.float32(0.5)
        pixels = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if valid is not None:
            whole = cv2.remap(valid.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            seen = seen & (whole > 0.999)
        valid = seen
    elif valid is None:
        valid = np.ones(pixels.shape[:2], bool)

    # Full size is that of the camera, or of the file where that is smaller.
    full = min(camera.width, round(camera.width * width_on_disk / lens.width))
    small = camera.resized(min(width or full, full))
    size = (small.width, small.height)
    if size != (pixels.shape[1], pixels.shape[0]):
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        valid = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    return pixels, valid


def cache_root() -> Path:
    """The user's cache folder, or SWAG_CACHE_DIR."""
    return Path(os.environ.get("SWAG_CACHE_DIR") or platformdirs.user_cache_dir("swag_splatting", appauthor=False))


def cache_folder(scene: Scene, kind: str) -> Path:
    """The folder of the user's cache (or of SWAG_CACHE_DIR) for what is made of one scene's photographs."""
    return cache_root() / kind / hashlib.sha256(str(scene.folder).encode()).hexdigest()[:16]


def _read_cached(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as arrays:  # a zip file: its checksums tell when it is corrupt
            pixels, valid = arrays["pixels"], arrays["valid"]
        os.utime(path)  # in use: see _drop_stale
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return pixels, valid


def _drop_stale(cache: Path) -> None:
    """Remove what no run has used for a month, so that the cache does not grow for ever."""
    oldest = time.time() - _CACHE_DAYS * 86400
    for path in cache.glob("*/*.npz"):
        try:
            if path.stat().st_mtime < oldest:
                path.unlink()
        except OSError:
            continue
