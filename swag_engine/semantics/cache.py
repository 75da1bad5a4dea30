"""Cache of the regions found in images, so that finding them again takes no time."""

import hashlib
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.strict_json import from_json
from ..scene.images import TrainingImage

_FORMAT = 1
"""Version of the files; a change of what is computed needs another."""


def load_regions(
    cache: Path | None, image: TrainingImage, key: Sequence[str]
) -> tuple[np.ndarray, tuple[str, ...], np.ndarray] | None:
    """Load the regions of an image.

    Args:
        cache: Folder of the cache, None for no cache.
        image: The image; its pixels are part of the key.
        key: What else the regions depend on.

    Returns:
        Index, labels and embeddings as in regions.ImageRegions; None where the cache has none that can be read.
    """
    if cache is None:
        return None
    try:
        with np.load(_path(cache, image, key), allow_pickle=False) as stored:
            index, labels, embeddings = stored["index"], from_json(str(stored["names"])), stored["embeddings"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    if index.shape != image.valid.shape or len(labels) != len(embeddings):
        return None
    return index, tuple(labels), embeddings


def save_regions(
    cache: Path | None,
    image: TrainingImage,
    key: Sequence[str],
    index: np.ndarray,
    labels: Sequence[str],
    embeddings: np.ndarray,
) -> None:
    """Save the regions of an image; a cache that cannot be written is ignored, because it only costs time.

    Args:
        cache: Folder of the cache, None for no cache.
        image: The image.
        key: What else the regions depend on.
        index: (H, W) uint16, 0 for no region, i for the i-th label.
        labels: R labels.
        embeddings: (R, D) float32.
    """
    if cache is None:
        return
    try:
        with atomic_path(_path(cache, image, key)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, index=index, names=json.dumps(list(labels)), embeddings=embeddings)
    except (InputError, OSError):
        pass


def file_key(path: Path) -> str:
    """Return a key that distinguishes a file of weights from others, without reading it."""
    status = path.stat()
    return f"{path.name}:{status.st_size}:{status.st_mtime_ns}"


def _path(cache: Path, image: TrainingImage, key: Sequence[str]) -> Path:
    digest = hashlib.sha256(json.dumps([_FORMAT, image.pixels.shape, *key]).encode())
    digest.update(np.ascontiguousarray(image.pixels).tobytes())
    digest.update(np.packbits(image.valid).tobytes())
    return cache / f"{digest.hexdigest()[:32]}.npz"
