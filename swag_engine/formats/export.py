"""The result of a run as a file that other programs read."""

from pathlib import Path

from ..errors import InputError
from ..training.run_folder import RunFolder
from .gltf import write_glb
from .ply import read_ply, write_ply


def export_run(folder: Path, format: str, out: Path) -> None:
    """Write the result of the run `folder` to `out` as "ply" (3DGS) or "glb" (KHR_gaussian_splatting, Y up).

    Raises InputError when the folder is no run or has no result yet, or when `out` cannot be written.
    """
    run = RunFolder(folder)
    _, _, up = run.read_config()
    if not run.ply.exists():
        raise InputError(f"The run {folder} has no result yet; continue it with train --resume.")
    splats = read_ply(run.ply)
    if format == "ply":
        write_ply(out, splats)
    else:
        write_glb(out, splats, up)
