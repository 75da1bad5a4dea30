"""Checkpoints on disk: safetensors files, which hold no code, written whole or not at all."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.strict_json import from_json

KEEP = 2
"""Newest checkpoints that are kept."""


def save_checkpoint(run: Path, iteration: int, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> Path:
    """Write a checkpoint and remove old ones.

    Args:
        run: Folder of the run.
        iteration: Iterations done, for the file's name.
        tensors: Tensors by name.
        state: A dict that JSON can hold.

    Returns:
        Path of the checkpoint.

    Raises:
        InputError: If it cannot be written.
    """
    path = run / f"checkpoint-{iteration:07d}.safetensors"
    with atomic_path(path) as temporary:
        try:
            save_file(
                {name: tensor.contiguous() for name, tensor in tensors.items()}, temporary, {"state": json.dumps(state)}
            )
        except SafetensorError as error:
            raise InputError(f"Cannot write {path}: {error}; free some space on the disk.") from error
    for old in checkpoints(run)[:-KEEP]:
        old.unlink(missing_ok=True)
    return path


def checkpoints(run: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    return sorted(
        path for path in run.glob("checkpoint-*.safetensors") if path.stem[11:].isdecimal() and path.is_file()
    )


def load_checkpoint(run: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """Read the newest checkpoint of a run that can be read.

    Args:
        run: Folder of the run.

    Returns:
        Tensors and state as `save_checkpoint` took them, None where the run has no checkpoint.

    Raises:
        InputError: If there are checkpoints but none can be read.
    """
    found = checkpoints(run)
    for path in reversed(found):
        try:
            with safe_open(path, framework="pt") as stored:
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 (not a dict)
                state = from_json(stored.metadata()["state"])
            if _is_whole(tensors, state):
                return tensors, state
        except (SafetensorError, OSError, KeyError, TypeError, ValueError):
            continue
    if found:
        raise InputError(
            f"No checkpoint in {run} can be read; the newest is {found[-1].name}. Train again to a new folder."
        )
    return None


def _is_whole(tensors: dict[str, torch.Tensor], state: Any) -> bool:
    """Whether a file has what a run continues with, in shapes that fit. Raises KeyError for what is missing."""
    cloud = {name: tensor for name, tensor in tensors.items() if name.startswith("cloud.")}
    n, higher = len(cloud["cloud.means"]), cloud["cloud.shN"].shape[1]
    known = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh0": (n, 1, 3)}
    known |= {"shN": (n, higher, 3), "background": (3,)}
    kinds = (("iteration", int), ("seconds", float), ("dropout", float), ("guard", dict))
    return (
        all(tuple(cloud[f"cloud.{name}"].shape) == shape for name, shape in known.items())
        and all(len(tensor) == n for name, tensor in cloud.items() if name != "cloud.background")
        and all(tensor.dtype == torch.float32 for tensor in cloud.values())
        and all(type(state[name]) is kind for name, kind in kinds)
    )
