"""What was found in photographs, kept so that the next run of the same question answers at once."""

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


def load_found(
    cache: Path | None, image: TrainingImage, key: Sequence[str]
) -> tuple[np.ndarray, tuple[str, ...], np.ndarray] | None:
    """Index, names and embeddings (see regions.Found) that were kept for a photograph; None when there are none."""
    if cache is None:
        return None
    try:
        with np.load(_path(cache, image, key), allow_pickle=False) as kept:
            index, names, embeddings = kept["index"], from_json(str(kept["names"])), kept["embeddings"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    if index.shape != image.valid.shape or len(names) != len(embeddings):
        return None
    return index, tuple(names), embeddings


def save_found(
    cache: Path | None,
    image: TrainingImage,
    key: Sequence[str],
    index: np.ndarray,
    names: Sequence[str],
    embeddings: np.ndarray,
) -> None:
    """Keep what was found; a cache that cannot be written only costs time."""
    if cache is None:
        return
    try:
        with atomic_path(_path(cache, image, key)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, index=index, names=json.dumps(list(names)), embeddings=embeddings)
    except (InputError, OSError):
        pass


def file_key(path: Path) -> str:
    """Tells a weights file from another without reading it."""
    status = path.stat()
    return f"{path.name}:{status.st_size}:{status.st_mtime_ns}"


def _path(cache: Path, image: TrainingImage, key: Sequence[str]) -> Path:
    digest = hashlib.sha256(json.dumps([_FORMAT, image.pixels.shape, *key]).encode())
    digest.update(np.ascontiguousarray(image.pixels).tobytes())
    digest.update(np.packbits(image.valid).tobytes())
    return cache / f"{digest.hexdigest()[:32]}.npz"
