"""Regions from the user's own masks."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.files import read_text
from ..scene.colmap import Scene, View
from ..scene.image_files import files_below, match_masks
from ..scene.images import TrainingImage, decode_image, file_map, is_white, mask_values, turned_as_photo
from .regions import Region, resized_labels

LABELS_FILE = "labels.txt"
"""File with the labels of grey values, one a line."""


class MaskFolder:
    """Provider of regions from a folder of masks, made for the images as they were taken, in one of two forms.

    FOLDER/LABEL/NAME.png: black and white, one folder a label (names as `match_masks` takes them); where two
    masks have a pixel, the label that comes first in the alphabet gets it. Or FOLDER/NAME.png with labels.txt: one mask
    an image, whose grey values count the lines of labels.txt from 1, 0 for none.

    Args:
        folder: Folder of the masks.
        scene: The scene.

    Raises:
        InputError: If the folder has neither form, or no mask of an image of the scene.
    """

    name = "The folder of masks"

    def __init__(self, folder: Path, scene: Scene) -> None:
        self.folder = folder
        self.views = {view.camera.name: view for view in scene.views}
        if not folder.is_dir():
            raise InputError(f"There is no folder {folder}: give the folder of the masks.")
        self.labels = _lines(folder / LABELS_FILE) if (folder / LABELS_FILE).is_file() else None
        self.folders = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
        if self.labels is None and not self.folders:
            raise InputError(
                f"{folder} holds no masks: put them in one folder a label, as coral/NAME.png, or write the labels of "
                f"their grey values to {LABELS_FILE}."
            )
        self._masks = {
            label: match_masks(
                list(self.views),
                [(path, path.relative_to(folder / label).as_posix()) for path, _ in files_below(folder / label)],
            )[0]
            for label in (self.folders if self.labels is None else [""])
        }
        files = [path for view in scene.views for _, path in self._files(view)]
        if not files:
            raise InputError(
                f"No mask in {folder} belongs to an image of the scene: name it as its image, such as "
                f"{Path(scene.views[0].name).with_suffix('.png').name}."
            )
        stats = sorted((str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files)
        self.key = f"masks:{self.labels}:{stats}"

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """Read the masks of an image.

        Args:
            image: The training image, whose size the masks get.
            words: Labels to return; without any, all.

        Returns:
            The regions.

        Raises:
            InputError: If a mask cannot be read, has another aspect ratio than the image, or a value without a label.
        """
        view = self.views[image.camera.name]
        found = []
        for label, path in self._files(view):
            values = turned_as_photo(_grey_values(path), path, view.path, (view.lens.width, view.lens.height))
            if self.labels is None:
                found.append(Region(self._undistorted(view, is_white(values).astype(np.uint8), image) > 0, label))
                continue
            values = self._undistorted(view, values, image)
            if values.max() > len(self.labels):
                raise InputError(
                    f"{path} has the value {values.max()}, and {LABELS_FILE} has only {len(self.labels)} labels."
                )
            found += [Region(values == value, self.labels[value - 1]) for value in np.unique(values[values > 0])]
        return [region for region in found if not words or region.label in words]

    def _files(self, view: View) -> list[tuple[str, Path]]:
        """Return label and file of each mask of a view."""
        return [(label, of[view.name]) for label, of in self._masks.items() if view.name in of]

    @staticmethod
    def _undistorted(view: View, mask: np.ndarray, image: TrainingImage) -> np.ndarray:
        """Return the mask without lens distortion, at the size of the training image."""
        if not view.lens.is_pinhole:
            x, y, _ = file_map(view.lens, mask.shape)
            mask = cv2.remap(mask, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return resized_labels(mask, image.camera.width, image.camera.height)


def _grey_values(path: Path) -> np.ndarray:
    """Return the values (H, W) of a file as stored, uint8 or uint16; read_image would scale 16 bits to 8."""
    image = decode_image(path)
    if image.ndim == 3 and (image[..., :3] != image[..., :1]).any():
        raise InputError(f"{path} is a mask in color: save it in shades of grey, 0 for no label.")
    values = mask_values(image)
    if values.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} holds {values.dtype} pixels: save the mask with 8 or 16 bits.")
    return values


def _lines(path: Path) -> list[str]:
    """Return the lines of labels.txt."""
    try:
        lines = [line.strip() for line in read_text(path).splitlines()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as text: {error}.") from error
    labels = [line for line in lines if line]
    if not labels or len(set(labels)) != len(labels):
        raise InputError(f"{path} must have one label a line, each once.")
    return labels
