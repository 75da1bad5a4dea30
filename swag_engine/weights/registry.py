"""The pretrained networks that the engine knows, and where their files are."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from ..errors import InputError


@dataclass(frozen=True)
class Weights:
    """A network's file: what it is called, under which licence, and the page where users get it.

    size in bytes and sha256 (hex) are None where users make or choose the file themselves; `note` then says what it
    has to be.
    """

    version: str
    licence: str
    file: str
    size: int | None
    sha256: str | None
    page: str
    note: str = ""


NETWORKS: dict[str, Weights] = {
    "depth-anything-v2-small": Weights(
        version="V2 Small",
        licence="Apache-2.0",  # of the small network alone: the larger ones are CC-BY-NC-4.0
        file="depth_anything_v2_vits.onnx",
        size=None,
        sha256=None,
        page="https://github.com/fabio-sim/Depth-Anything-ONNX/releases",
        note="the one of relative, not of metric depth",
    ),
    "rife": Weights(
        version="4.0",
        licence="MIT",
        file="rife.onnx",
        size=None,
        sha256=None,
        page="https://github.com/hzwer/Practical-RIFE",
        note="exported to ONNX with the inputs img0, img1 (1, 3, H, W) in 0..1 and t",
    ),
}


def find(name: str, weights_dir: Path | None) -> Path:
    """The file of the network `name`: the user's in `weights_dir`, else the one in the cache folder.

    Raises InputError when there is none, saying where to get it and where to put it, when its size or SHA-256 is not
    the registered one, and for a name that is not registered.
    """
    if name not in NETWORKS:
        raise InputError(f"There is no network {name!r}: choose one of {', '.join(sorted(NETWORKS))}.")
    weights = NETWORKS[name]
    folders = [folder for folder in (weights_dir, cache_folder()) if folder]
    path = next((folder / weights.file for folder in folders if (folder / weights.file).is_file()), None)
    if path is None:
        note = f" ({weights.note})" if weights.note else ""
        raise InputError(
            f"The network {name} {weights.version} (licence {weights.licence}) is not on this machine: get it{note} "
            f"from {weights.page} and save it as {folders[0] / weights.file}."
        )
    try:
        whole = weights.size in (None, path.stat().st_size) and weights.sha256 in (None, _sha256(path))
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    if not whole:
        raise InputError(
            f"{path} is not the file of {name} {weights.version}, or is damaged: get it again from {weights.page}."
        )
    return path


def cache_folder() -> Path:
    """The folder of the user's cache (or of SWAG_CACHE_DIR) for networks."""
    root = os.environ.get("SWAG_CACHE_DIR") or platformdirs.user_cache_dir("swag_splatting", appauthor=False)
    return Path(root) / "weights"


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
