"""Images for training: undistorted, resized, with a mask of the valid pixels, and cached."""

import functools
import hashlib
import io
import json
import os
import re
import struct
import threading
import time
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import platformdirs
from PIL import Image

from ..base.computer_memory import free_memory
from ..base.errors import InputError
from ..base.files import atomic_path, read_bytes
from ..base.text import first_names
from .cameras import Camera
from .colmap import Scene, View
from .lenses import Lens, source_map

MOST_PIXELS = 2**28
"""Pixels of the largest image that is decoded; 200-megapixel phones have 2 * 10^8."""
Image.MAX_IMAGE_PIXELS = MOST_PIXELS
DECODING_BYTES = 16
"""Largest memory of `read_image` for each pixel: four channels of 16 bits, as 8 bits, without alpha, and the mask."""
_CACHE_FORMAT = 2
"""Version of the cached files."""
_TIFF_ORIENTATION = 274
"""Tag of the orientation in a TIFF file."""
_TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    5: lambda image: image.swapaxes(0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.rot90(image, -1)[::-1],
    8: np.rot90,
}
"""How an image is turned to be shown upright, by EXIF orientations that swap width and height."""
_ALL_VALID = 0.999
"""Share of valid pixels in a mean from which it counts as all."""
_CACHE_DAYS = 30
"""Days after which a cached file that no run has used is removed."""
_READING_CACHE = threading.Lock()
"""NumPy reads the header of an array with Python's parser, which in Python 3.11 is not safe in several threads
(github.com/python/cpython/issues/106905)."""


@dataclass
class TrainingImage:
    """An undistorted image at the size of its camera.

    Attributes:
        camera: The camera.
        pixels: Display values (H, W, 3) uint8 sRGB; without meaning where they are not valid.
        valid: Valid pixels (H, W) bool.
    """

    camera: Camera
    pixels: np.ndarray
    valid: np.ndarray

    def resized(self, width: int) -> "TrainingImage":
        """Return the image reduced to a width in pixels; a pixel is valid where all that it averages are."""
        camera = self.camera.resized(width)
        return TrainingImage(camera, *_resized(self.pixels, self.valid, (camera.width, camera.height)))


def load_images(
    scene: Scene,
    views: Sequence[View],
    width: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[TrainingImage]:
    """Undistort images and reduce them to a width, never enlarging.

    Results are kept in the user's cache folder (or SWAG_CACHE_DIR), so that only the first call takes long. A mask and
    an alpha of 0 make pixels invalid.

    Args:
        scene: The scene.
        views: Views whose images are loaded.
        width: Width in pixels, None for full size.
        progress: Called with the number of images that are done and the number of all.

    Returns:
        The images in the order of the views.

    Raises:
        InputError: When an image cannot be used; the message names it.
    """
    cache, masks = cache_folder(scene, "images"), scene.masks.of
    images: list[TrainingImage] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [pool.submit(_load_image, view, masks.get(view.path), width, cache) for view in views]
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


def describe_empty(images: Sequence[TrainingImage]) -> str:
    """Return a sentence that names the images without a valid pixel, empty without such images."""
    names = [image.camera.name for image in images if not image.valid.any()]
    if not names:
        return ""
    return f"{len(names)} of {len(images)} photos are left out, without a valid pixel: {first_names(names)}."


def load_image(scene: Scene, view: View, width: int | None = None) -> TrainingImage:
    """Undistort one image as `load_images` does, without keeping the result in the cache."""
    pixels, valid = _undistorted(view, scene.masks.of.get(view.path), width)
    return TrainingImage(view.camera.resized(pixels.shape[1]), pixels, valid)


def read_image(path: Path, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Read an image file.

    16 bits are reduced to 8, a grey channel is repeated. An EXIF orientation is ignored, as COLMAP ignores it, unless
    only the turned image fits the size of the camera.

    Args:
        path: The file.
        size: Width and height of its camera in pixels, None where that is not known.

    Returns:
        Pixels (H, W, 3) uint8 RGB, and whether alpha is above 0 (H, W) bool, None without an alpha channel.

    Raises:
        InputError: When the file cannot be read, or does not fit the camera.
    """
    image = decode_image(path)
    height, width = image.shape[:2]
    if size and not fits((width, height), size) and fits((height, width), size) and (turn := exif_turn(path)):
        image = np.ascontiguousarray(_TURNS[turn](image))
        height, width = image.shape[:2]
    if size and not fits((width, height), size):
        raise InputError(
            f"{path} is {width} x {height} pixels, but its camera in the COLMAP model is {size[0]} x {size[1]}: use "
            "the photos that the model was made from."
        )
    if image.dtype == np.uint16:
        wide, image = image, np.empty(image.shape, np.uint8)
        for row in range(height):  # all rows at once would need eight times the memory
            image[row] = np.round(wide[row] / 257)
    if image.dtype != np.uint8:
        raise InputError(f"{path} holds {image.dtype} pixels: save it with 8 or 16 bits per channel.")
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), None
    if image.shape[2] == 4:
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGB), image[..., 3] > 0
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB), None


def decode_image(path: Path) -> np.ndarray:
    """Decode an image file that is not too large, by its header.

    Args:
        path: The file.

    Returns:
        Pixels (H, W) or (H, W, C) in the order of OpenCV, as stored, without the EXIF orientation.

    Raises:
        InputError: When the file cannot be read, or the image is larger than MOST_PIXELS or than the free memory.
    """
    try:
        content = read_bytes(path)  # cv2.imread cannot open every path on Windows
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    pixels, data = _header_pixels(content), np.frombuffer(content, np.uint8)
    needed, free = DECODING_BYTES * pixels, free_memory()
    if pixels > MOST_PIXELS or (free is not None and needed > free):
        raise InputError(
            f"{path} has {pixels / 1e6:.0f} million pixels, which need {needed / 1e9:.1f} GB of memory; "
            f"{MOST_PIXELS / 1e6:.0f} million pixels can be read where memory is free: reduce the image or remove it."
        )
    try:
        image = cv2.imdecode(_without_tiff_orientation(data), cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(
            f"{path} cannot be read as an image, perhaps because it was cut short: copy it again or remove it."
        )
    return image


def _header_pixels(data: bytes) -> int:
    """Return the number of pixels that the header of an image file announces; 0 for formats that Pillow lacks."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.width * image.height
    except Image.DecompressionBombError as error:
        return int(re.findall(r"\d+", str(error))[0])
    except (OSError, ValueError, SyntaxError, OverflowError, struct.error):  # damaged data; decoding will say so
        return 0


def exif_turn(path: Path) -> int:
    """Return the EXIF orientation of an image file where it swaps width and height (5 to 8), else 0."""
    try:
        with Image.open(path) as image:
            orientation = image.getexif().get(_TIFF_ORIENTATION, 1)
    except (OSError, ValueError, SyntaxError):  # PIL raises SyntaxError for damaged data
        return 0
    return orientation if orientation in _TURNS else 0


def turned_as_photo(mask: np.ndarray, path: Path, photo: Path, size: tuple[int, int]) -> np.ndarray:
    """Turn a mask (H, W) with swapped sides as its photo is turned.

    Args:
        mask: The mask, of any resolution.
        path: Its file.
        photo: File of the photo.
        size: Width and height of the photo as it is used (stored or turned), pixels.

    Raises:
        InputError: When it does not have the aspect ratio of the photo.
    """
    height, width = mask.shape
    if fits((width, height), size):
        return mask
    if fits((height, width), size) and (turn := exif_turn(photo)):
        rows, columns = decode_image(photo).shape[:2]
        if fits((columns, rows), size):  # the photo is used as stored, the mask is of the turned one
            turn = {6: 8, 8: 6}.get(turn, turn)
        return np.ascontiguousarray(_TURNS[turn](mask))
    raise InputError(
        f"{path} is {width} x {height} pixels, which is not the aspect ratio of its image, {size[0]} x {size[1]}: make "
        "it from the image."
    )


def mask_values(image: np.ndarray) -> np.ndarray:
    """Return the values (H, W) of a mask as stored: the largest channel, or alpha where the color is constant."""
    if image.ndim == 2:
        return image
    color = image[..., :3].max(-1)
    if image.shape[2] == 4 and (image[..., :3] == image[0, 0, :3]).all():
        alpha = image[..., 3]
        return np.minimum(color, alpha) if alpha.min() == alpha.max() else alpha
    return color


def is_white(values: np.ndarray) -> np.ndarray:
    """Return which values (H, W) of a mask are not black.

    These are above a quarter of the type's largest (JPEG adds noise); in a mask without such values, all above 0.
    """
    limit = np.iinfo(values.dtype).max / 4 if values.dtype.kind in "iu" else 0.25
    return values > (limit if values.max() > limit else 0)


def read_mask(path: Path, photo: Path, size: tuple[int, int]) -> np.ndarray:
    """Read the valid pixels (H, W) bool of a photo from its mask; arguments and errors as of `turned_as_photo`."""
    valid = turned_as_photo(is_white(mask_values(decode_image(path))), path, photo, size)
    return cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def write_mask(path: Path, valid: np.ndarray) -> None:
    """Write a mask (H, W) bool as a PNG file, white where it is valid."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", valid.astype(np.uint8) * 255)[1].tobytes())


def _without_tiff_orientation(data: np.ndarray) -> np.ndarray:
    """Return the bytes (N,) uint8 of a file, of a TIFF file with its orientation set to upright, as cv2 applies it."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4].tobytes())
    if order is None:
        return data
    patched = bytearray(data)
    try:
        (directory,) = struct.unpack_from(f"{order}I", patched, 4)
        (entries,) = struct.unpack_from(f"{order}H", patched, directory)
        for entry in range(directory + 2, directory + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", patched, entry) == (_TIFF_ORIENTATION,):
                struct.pack_into(f"{order}H", patched, entry + 8, 1)
    except struct.error:  # cut short; decoding will say so
        pass
    return np.frombuffer(patched, np.uint8)


def fits(image: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Return whether an image has the camera's aspect ratio, to a pixel of rounding; its resolution may differ.

    Args:
        image: Width and height, pixels.
        camera: Width and height, pixels.
    """
    return abs(image[0] * camera[1] - image[1] * camera[0]) <= max(*image, *camera)


def _load_image(view: View, mask_file: Path | None, width: int | None, cache: Path) -> TrainingImage:
    try:
        files = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in (view.path, mask_file) if path]
    except OSError as error:
        raise InputError(f"Cannot read {view.path}: {error.strerror or error}.") from error
    lens = (view.lens.model, view.lens.width, view.lens.height, view.lens.params)
    key = hashlib.sha256(json.dumps([_CACHE_FORMAT, files, lens, width]).encode()).hexdigest()[:32]
    cached = cache / f"{key}.npz"
    arrays = _read_cached(cached)
    if arrays is None:
        arrays = _undistorted(view, mask_file, width)
        try:
            with atomic_path(cached) as temporary, open(temporary, "wb") as file:
                np.savez(file, pixels=arrays[0], valid=arrays[1])
        except (InputError, OSError):
            pass  # without a cache the next run only takes longer to start
    pixels, valid = arrays
    return TrainingImage(view.camera.resized(pixels.shape[1]), pixels, valid)


def _undistorted(view: View, mask_file: Path | None, width: int | None) -> tuple[np.ndarray, np.ndarray]:
    lens, camera = view.lens, view.camera
    pixels, valid = read_image(view.path, (lens.width, lens.height))
    height_on_disk, width_on_disk = pixels.shape[:2]
    if mask_file:
        mask = read_mask(mask_file, view.path, (width_on_disk, height_on_disk))
        valid = mask if valid is None else valid & mask
    if not lens.is_pinhole:
        pixels, valid = undistort(lens, pixels, valid)
    elif valid is None:
        valid = np.ones(pixels.shape[:2], bool)

    # Full size is that of the camera, or of the file where that is smaller.
    full = min(camera.width, round(camera.width * width_on_disk / lens.width))
    small = camera.resized(min(width or full, full))
    size = (small.width, small.height)
    return _resized(pixels, valid, size)


def file_map(lens: Lens, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y (H, W) float32, as cv2 takes them, of a pinhole image's pixels in a file, and what it shows, bool."""
    source, seen = source_map(lens)
    # cv2 puts the first pixel's centre at 0, COLMAP at 0.5; the file may have another resolution than the camera.
    x = source[..., 0] * np.float32(shape[1] / lens.width) - np.float32(0.5)
    y = source[..., 1] * np.float32(shape[0] / lens.height) - np.float32(0.5)
    return x, y, seen


def undistort(lens: Lens, pixels: np.ndarray, valid: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the pinhole image of pixels (H, W, C) and its valid pixels (H, W) bool."""
    x, y, seen = file_map(lens, pixels.shape)
    pixels = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    if valid is not None:
        whole = cv2.remap(valid.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = seen & (whole > _ALL_VALID)
    return pixels, seen


def _resized(pixels: np.ndarray, valid: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    if size == (pixels.shape[1], pixels.shape[0]):
        return pixels, valid
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), share > _ALL_VALID


def cache_root() -> Path:
    """Return the user's cache folder, or SWAG_CACHE_DIR."""
    return Path(os.environ.get("SWAG_CACHE_DIR") or platformdirs.user_cache_dir("swag_splatting", appauthor=False))


def cache_folder(scene: Scene, kind: str) -> Path:
    """Return the folder in the cache for files of one kind that are made from one scene.

    Args:
        scene: The scene.
        kind: Name of the kind.
    """
    return cache_root() / kind / hashlib.sha256(str(scene.folder).encode()).hexdigest()[:16]


def _read_cached(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        # A zip file: its checksums tell when it is corrupt.
        with _READING_CACHE, np.load(path, allow_pickle=False) as arrays:
            pixels, valid = arrays["pixels"], arrays["valid"]
        os.utime(path)  # in use: see _drop_stale
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return pixels, valid


@functools.cache
def _drop_stale(cache: Path) -> None:
    """Remove cached images that no run has used for _CACHE_DAYS days; a process looks at each cache once."""
    oldest = time.time() - _CACHE_DAYS * 86400
    for path in cache.glob("*/*.npz"):
        try:
            if path.stat().st_mtime < oldest:
                path.unlink()
        except OSError:
            continue
