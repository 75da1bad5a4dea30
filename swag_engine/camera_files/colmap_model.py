"""COLMAP: images.bin or images.txt of a model, which may lack points."""

from ..scene.colmap import read_posed_images
from ..scene.model_folders import points_beside
from .camera_file import CameraFile, FileCamera, FilePoints, reading, rigid, sized_calibration
from .source import Source

PROGRAM = "COLMAP"


def recognise(source: Source) -> bool:
    """Return whether the file is that of the images of a model."""
    return source.path.name in ("images.bin", "images.txt")


def read(source: Source) -> CameraFile:
    """Read the poses, and the points where there are some.

    Raises:
        ValueError: For a pose that is none.
    """
    folder = source.path.parent
    images, points = read_posed_images(folder)
    calibrations = {lens: sized_calibration(lens) for _, lens, _ in images}
    cameras = []
    for name, lens, pose in images:
        with reading(name):
            cameras.append(FileCamera(name, calibrations[lens], rigid(pose[:, :3], pose[:, 3])))
    cloud = FilePoints(points.positions, points.colors) if len(points.positions) else None
    return CameraFile(PROGRAM, tuple(cameras), cloud, points_beside(folder))
