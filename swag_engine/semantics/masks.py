"""The user's own masks as regions."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..scene.colmap import Scene, View
from ..scene.images import TrainingImage
from ..scene.lenses import source_map
from .regions import Region, resized_labels

NAMES = "labels.txt"


class MaskFolder:
    """A folder of masks, drawn on the photographs as they were taken, in one of two forms.

    FOLDER/CLASS/NAME.png: black and white, one folder a class (NAME with or without the photograph's own suffix);
    where two classes claim a pixel, the first in the order of the alphabet has it. Or FOLDER/NAME.png with labels.txt:
    one picture a photograph whose grey values count the lines of labels.txt from 1, 0 for nothing.
    """

    name = "The folder of masks"

    def __init__(self, folder: Path, scene: Scene) -> None:
        """Raises InputError when the folder has neither form or no mask of any photograph of the scene."""
        self.folder = folder
        self.views = {view.camera.name: view for view in scene.views}
        if not folder.is_dir():
            raise InputError(f"There is no folder {folder}: give the folder of the masks.")
        self.names = _lines(folder / NAMES) if (folder / NAMES).is_file() else None
        self.classes = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
        if self.names is None and not self.classes:
            raise InputError(
                f"{folder} holds no masks: put them in one folder a class, as coral/NAME.png, or write the names of "
                f"their grey values to {NAMES}."
            )
        files = [path for view in scene.views for _, path in self._files(view)]
        if not files:
            raise InputError(
                f"No mask in {folder} belongs to a photograph of the scene: name it as its photograph, such as "
                f"{Path(scene.views[0].name).with_suffix('.png').name}."
            )
        stats = sorted((str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files)
        self.key = f"masks:{self.names}:{stats}"

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """The masks of the photograph at its training size, those of `words` alone where there are any.

        Raises InputError for a mask that cannot be read or has another shape than the photograph.
        """
        view = self.views[image.camera.name]
        found = []
        for name, path in self._files(view):
            drawn = _grey_values(path)
            full = view.lens
            if abs(drawn.shape[1] * full.height - drawn.shape[0] * full.width) > max(*drawn.shape, full.width):
                raise InputError(
                    f"{path} is {drawn.shape[1]} x {drawn.shape[0]} pixels, which is not the shape of its photograph, "
                    f"{full.width} x {full.height}: draw it on the photograph."
                )
            labels = self._seen(view, drawn, image)
            if self.names is None:
                found.append(Region(labels > drawn.max() / 2, name))  # white is 255, 65535, or 1
                continue
            if labels.max() > len(self.names):
                raise InputError(f"{path} has the value {labels.max()}, and {NAMES} names only {len(self.names)}.")
            found += [Region(labels == value, self.names[value - 1]) for value in np.unique(labels[labels > 0])]
        return [region for region in found if not words or region.name in words]

    def _files(self, view: View) -> Iterator[tuple[str, Path]]:
        for name in self.classes if self.names is None else [""]:
            folder = self.folder / name
            for path in ((folder / view.name).with_suffix(".png"), folder / f"{view.name}.png"):
                if path.is_file():
                    yield name, path
                    break

    @staticmethod
    def _seen(view: View, drawn: np.ndarray, image: TrainingImage) -> np.ndarray:
        """The mask as the training photograph shows it: without the lens's distortion, at its size."""
        if not view.lens.is_pinhole:
            source, _ = source_map(view.lens)
            x = source[..., 0] * np.float32(drawn.shape[1] / view.lens.width) - np.float32(0.5)
            y = source[..., 1] * np.float32(drawn.shape[0] / view.lens.height) - np.float32(0.5)
            drawn = cv2.remap(drawn, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return resized_labels(drawn, image.camera.width, image.camera.height)


def _grey_values(path: Path) -> np.ndarray:
    """(H, W) uint8 or uint16, as stored: read_picture would scale 16 bits to 8."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    values = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if values is None:
        raise InputError(f"{path} cannot be read as a picture: it may be cut short; copy it again or take it out.")
    if values.ndim == 3:
        if (values[..., :3] != values[..., :1]).any():
            raise InputError(f"{path} is a mask in colours: save it in shades of grey, 0 for nothing.")
        values = values[..., 0]
    if values.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} holds {values.dtype} pixels: save the mask with 8 or 16 bits.")
    return values


def _lines(path: Path) -> list[str]:
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as text: {error}.") from error
    names = [line for line in lines if line]
    if not names or len(set(names)) != len(names):
        raise InputError(f"{path} must have one name a line, each once.")
    return names
