"""Pretrained networks that the engine can use, and where their files are."""

import hashlib
import os
import shutil
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from ..base.errors import InputError


@dataclass(frozen=True)
class Weights:
    """A network's file.

    Attributes:
        version: Version of the network.
        licence: Licence of the file.
        file: Its name.
        size: Bytes, None where that is not known.
        sha256: Checksum in hexadecimal, None where users make or choose the file themselves.
        page: Web page where users get it.
        note: What the file has to be, where users make or choose it.
        url: Where `fetch` downloads the file, "" where users have to get it; a file with a url has a checksum.
    """

    version: str
    licence: str
    file: str
    size: int | None
    sha256: str | None
    page: str
    note: str = ""
    url: str = ""


def _hosted(folder: str, file: str, version: str, licence: str, size: int | None, sha256: str) -> Weights:
    """Return a file that can be downloaded from a folder of a model hub or a repository, whose page it is on."""
    page = folder.partition("/resolve/")[0].partition("/raw/")[0]
    return Weights(version, licence, file, size, sha256, page, url=f"{folder}/{file}")


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
    "clip-image": _hosted(
        "https://huggingface.co/rocca/openai-clip-js/resolve/main",
        "clip-image-vit-32-float32.onnx",
        "ViT-B/32",
        "MIT",
        351468764,
        "bd2ccde5ba3e10a05d8276ac106f1d171c80d1be540a32f8febf602818f53201",
    ),
    "clip-text": _hosted(
        "https://huggingface.co/rocca/openai-clip-js/resolve/main",
        "clip-text-vit-32-float32-int32.onnx",
        "ViT-B/32",
        "MIT",
        254069585,
        "214c6c6303c60edf26aec493cacea831e22d9137786991fc69c92242627de0d7",
    ),
    "clip-vocabulary": _hosted(
        "https://github.com/openai/CLIP/raw/main/clip",
        "bpe_simple_vocab_16e6.txt.gz",
        "1.0",
        "MIT",
        1356917,
        "924691ac288e54409236115652ad4aa250f48203de50a9e4722a6ecd48d6804a",
    ),
    "grounding-dino": _hosted(
        # This export scores several words in one pass; the one of onnx-community is right only for a single word.
        "https://huggingface.co/mtbui2010/grounding-dino-tiny-fixedmask-ONNX/resolve/main",
        "model-fixedmask.onnx",
        "tiny",
        "Apache-2.0",
        None,
        "ae9a0026953c6d5ce5a97b421af84c065d7f07173971cb105edb0071868fc180",
    ),
    "bert-vocabulary": _hosted(
        "https://huggingface.co/google-bert/bert-base-uncased/resolve/main",
        "vocab.txt",
        "base uncased",
        "Apache-2.0",
        231508,
        "07eced375cec144d27c900241f3e339478dec958f92fddbc551f295c992038a3",
    ),
    "mobile-sam-image": _hosted(
        "https://huggingface.co/Acly/MobileSAM/resolve/main",
        "mobile_sam_image_encoder.onnx",
        "ViT-tiny",
        "Apache-2.0",
        28157093,
        "580f5fb648ea1062c0aabc26217aed56921985f03f0cbbd852bba81d760cc749",
    ),
    "mobile-sam-mask": _hosted(
        "https://huggingface.co/Acly/MobileSAM/resolve/main",
        "sam_mask_decoder_single.onnx",
        "ViT-tiny",
        "Apache-2.0",
        16501323,
        "93915fc7c993ab9d59ab8c9ccd3bce37f7509c81ab4150a74abd4d2abbd8570d",
    ),
    "blip-image": Weights(
        version="captioning base",
        licence="BSD-3-Clause",
        file="blip_vision_model.onnx",
        size=None,
        sha256=None,
        page="https://huggingface.co/Salesforce/blip-image-captioning-base",
        note="its vision_model, exported to ONNX with pixel_values (1, 3, 384, 384) to last_hidden_state",
    ),
    "blip-text": Weights(
        version="captioning base",
        licence="BSD-3-Clause",
        file="blip_text_decoder.onnx",
        size=None,
        sha256=None,
        page="https://huggingface.co/Salesforce/blip-image-captioning-base",
        note="its text_decoder, exported to ONNX with input_ids (1, L) and encoder_hidden_states to logits",
    ),
}
"""Name -> file."""


def find(name: str, weights_dir: Path | None) -> Path:
    """Find the file of a network.

    Args:
        name: A key of NETWORKS.
        weights_dir: Folder that is searched before the cache folder.

    Returns:
        The file.

    Raises:
        InputError: If the file is missing, its size or checksum is another, or there is no network of this name.
    """
    weights = _registered(name)
    path = _locate(weights, weights_dir)
    if path is None:
        note = f" ({weights.note})" if weights.note else ""
        raise InputError(
            f"The network {name} {weights.version} (licence {weights.licence}) is not on this machine: get it{note} "
            f"from {weights.page} and save it as {(weights_dir or cache_folder()) / weights.file}."
        )
    _check(name, path)
    return path


def is_available(name: str, weights_dir: Path | None) -> bool:
    """Return whether the file of a network exists; it may be damaged.

    Args:
        name: A key of NETWORKS.
        weights_dir: Folder that is searched before the cache folder.

    Raises:
        InputError: If there is no network of this name.
    """
    return _locate(_registered(name), weights_dir) is not None


def find_or_fetch(
    name: str, weights_dir: Path | None, consent: bool, progress: Callable[[float], None] = lambda fraction: None
) -> Path:
    """Find the file of a network, and download it first where it is missing.

    Args:
        name: A key of NETWORKS.
        weights_dir: Folder that is searched before the cache folder.
        consent: Whether the user has agreed to the download.
        progress: Called with the fraction of the download that is done.

    Returns:
        The file.

    Raises:
        InputError: As `find` and `fetch`.
    """
    if consent and not is_available(name, weights_dir) and NETWORKS[name].url:
        return fetch(name, progress)
    return find(name, weights_dir)


def fetch(name: str, progress: Callable[[float], None] = lambda fraction: None) -> Path:
    """Download a network to the cache folder, continuing where an earlier attempt stopped.

    Call it only where the user has agreed to this network, its licence and its size. A file with another checksum than
    the registered one is removed.

    Args:
        name: A key of NETWORKS.
        progress: Called with the fraction of the download that is done, where the size is known.

    Returns:
        The file.

    Raises:
        InputError: If the network cannot be downloaded, the download fails (the part that has arrived is kept for the
            next attempt), or the checksum is another.
    """
    weights = _registered(name)
    if not weights.url:
        return find(name, None)
    path = cache_folder() / weights.file
    part = path.with_name(f".{weights.file}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _download(weights, part, progress)
    except urllib.error.HTTPError as error:
        raise InputError(
            f"{weights.url} cannot be downloaded: the server answers {error.code} {error.reason}."
        ) from error
    except OSError as error:  # URLError and time-outs among them
        reason = getattr(error, "reason", None) or error.strerror or error
        raise InputError(
            f"{weights.url} cannot be downloaded ({reason}): try again, which continues where it stopped, or save the "
            f"file as {path}."
        ) from error
    try:
        _check(name, part)
    except InputError as error:
        part.unlink(missing_ok=True)
        raise InputError(
            f"What {weights.url} gave is not {name} {weights.version}, or is damaged, and was removed: try again, or "
            f"get it from {weights.page}."
        ) from error
    os.replace(part, path)
    return path


def _download(weights: Weights, part: Path, progress: Callable[[float], None]) -> None:
    """Complete the file `part`; it is whole when this returns, as far as the server says."""
    existing = part.stat().st_size if part.exists() else 0
    if existing and existing == weights.size:
        return
    headers = {"User-Agent": "swag-splatting"} | ({"Range": f"bytes={existing}-"} if existing else {})
    try:
        answer = urllib.request.urlopen(urllib.request.Request(weights.url, headers=headers), timeout=30)
    except urllib.error.HTTPError as error:
        if error.code != 416:  # the part is as long as the file, or longer
            raise
        part.unlink()
        return _download(weights, part, progress)
    with answer, open(part, "ab" if answer.status == 206 else "wb") as file:
        done = existing if answer.status == 206 else 0
        announced = int(answer.headers.get("Content-Length") or 0)
        total = weights.size or (done + announced if announced else 0)
        if announced and shutil.disk_usage(part.parent).free < announced:
            raise InputError(
                f"The disk of {part.parent} has no space for {weights.file}, {announced / 1e6:.0f} MB: free some and "
                "try again."
            )
        while block := answer.read(1 << 20):
            file.write(block)
            done += len(block)
            if total:
                progress(min(1.0, done / total))
    if announced and done < (existing if answer.status == 206 else 0) + announced:
        raise OSError("the connection ended early")


def _registered(name: str) -> Weights:
    """Return the file of a network; raises InputError for an unknown name."""
    if name not in NETWORKS:
        raise InputError(f"There is no network {name!r}: choose one of {', '.join(sorted(NETWORKS))}.")
    return NETWORKS[name]


def _locate(weights: Weights, weights_dir: Path | None) -> Path | None:
    """Return where a file is, None where it is missing."""
    folders = [folder for folder in (weights_dir, cache_folder()) if folder]
    return next((folder / weights.file for folder in folders if (folder / weights.file).is_file()), None)


def _check(name: str, path: Path) -> None:
    """Raise InputError where a file is not the registered one."""
    weights = NETWORKS[name]
    try:
        whole = weights.size in (None, path.stat().st_size) and weights.sha256 in (None, _sha256(path))
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    if not whole:
        raise InputError(
            f"{path} is not the file of {name} {weights.version}, or is damaged: get it again from {weights.page}."
        )


def cache_folder() -> Path:
    """Return the folder for networks in the user's cache, or in SWAG_CACHE_DIR."""
    root = os.environ.get("SWAG_CACHE_DIR") or platformdirs.user_cache_dir("swag_splatting", appauthor=False)
    return Path(root) / "weights"


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
