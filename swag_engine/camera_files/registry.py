"""The formats of camera files, each recognised by its content."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..base.foreign_files import refuse_foreign
from . import bundler, colmap_model, metashape, nerf_transforms, openmvg, opensfm, realityscan_csv, realityscan_xmp
from .camera_file import CameraFile, FileCamera, reading
from .source import Source

_IN_FOLDERS = (
    "transforms.json",
    "opensfm/reconstruction.json",
    "reconstruction.json",
    "sfm_data.json",
    "bundle.out",
    "images.bin",
    "images.txt",
)
"""Files that are looked for where a folder is given, such as the project of OpenDroneMap."""
_ANY_SIZE = 4000, 3000
"""Size in pixels at which lenses of files without a size are checked."""
_NAMES = "COLMAP, Metashape (XML), RealityScan (CSV, XMP), nerfstudio (transforms.json), Bundler, OpenMVG and OpenSfM"


@dataclass(frozen=True)
class Format:
    """A format of camera files.

    Attributes:
        recognise: Whether a file has this format.
        read: Read it; raises ValueError, KeyError, TypeError, IndexError or AttributeError where it is damaged.
    """

    recognise: Callable[[Source], bool]
    read: Callable[[Source], CameraFile]


FORMATS = {
    module.PROGRAM + (" XMP" if module is realityscan_xmp else ""): Format(module.recognise, module.read)
    for module in (
        colmap_model,
        metashape,
        nerf_transforms,
        realityscan_csv,
        realityscan_xmp,
        bundler,
        openmvg,
        opensfm,
    )
}
"""Formats by name."""


def read_camera_file(path: Path) -> CameraFile:
    """Read the cameras of another program.

    Args:
        path: The file, or a folder that has one of the usual names in it.

    Returns:
        Its cameras, at least two.

    Raises:
        InputError: When it cannot be read.
    """
    if path.is_dir():
        inside = [path / name for name in _IN_FOLDERS if (path / name).is_file()]
        if not inside:
            refuse_foreign(path)
            raise InputError(f"There is no file of cameras in {path}: choose the file itself.")
        path = inside[0]
    refuse_foreign(path)
    source = Source(path)
    found = next((entry for entry in FORMATS.values() if entry.recognise(source)), None)
    if found is None:
        cut_short = source.text.lstrip()[:1] in ("{", "[", "<") and source.json is None and source.xml is None
        if cut_short:
            raise InputError(f"{path} is damaged or was cut short: export the cameras again.")
        raise InputError(f"{path} is no file of cameras that can be read: {_NAMES} can.")
    try:
        with np.errstate(all="ignore"):  # numbers that are not finite are refused in their places
            cameras = found.read(source)
        for camera in cameras.cameras:
            _check_lens(camera)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, np.linalg.LinAlgError) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path} cannot be read: {what.rstrip('.')}.") from error
    if len(cameras.cameras) < 2:
        reasons = "".join(f" {sentence}" for sentence in cameras.warnings)
        raise InputError(f"{path} has {len(cameras.cameras)} photos with a pose, and a scene needs two.{reasons}")
    return cameras


def _check_lens(camera: FileCamera) -> None:
    """Raise ValueError where a lens has numbers that no lens has."""
    with reading(camera.name):
        size = camera.calibration.size
        if size and min(size) < 1:
            raise ValueError(f"its image size is {size[0]} x {size[1]} pixels")
        lens = camera.calibration.lens(*(size or _ANY_SIZE))
        if lens.fault:
            raise ValueError(lens.fault)
