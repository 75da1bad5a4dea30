"""Why images have no pose: what can be seen from each, compared with images that have one."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.text import first_names
from .colmap import Scene
from .image_files import image_files_below
from .images import read_image

_MOST_EXAMINED = 200
"""Images without a pose that are examined, at most, so that the time is bounded."""
_REFERENCES = 15
"""Images with a pose that they are compared with."""
_SIDE = 800
"""Longest side in pixels at which images are compared."""
_DARK = 30
"""8-bit value that an image must exceed somewhere (99th percentile) to show anything."""
_LESS_STRUCTURE = 0.2
"""Corners over the median of the images that have a pose, below which it shows too little to match."""
_LESS_CONTRAST = 0.25
"""Contrast of coarse structure over that median, below which an image without corners shows water, not a blurred
scene."""

UNREADABLE = "unreadable"
DARK = "too dark"
EMPTY = "hardly any structure"
BLURRED = "blurred"
NO_OVERLAP = "no overlap with other photos found"
NOT_EXAMINED = "reason not examined"
_ADVICE = {
    UNREADABLE: "copy or export them again",
    DARK: "use more light or a longer exposure",
    EMPTY: "stay nearer to the ground, so that it is seen through less water",
    BLURRED: "use a shorter exposure, or move more slowly",
    NO_OVERLAP: "add photos between them and the others",
    NOT_EXAMINED: "see to the others first",
}


@dataclass(frozen=True)
class Unregistered:
    """An image without a pose.

    Attributes:
        name: Its path below the image folder.
        reason: One of the reasons of this module.
    """

    name: str
    reason: str


def explain_unregistered(scene: Scene) -> list[Unregistered]:
    """Say of each image of a scene without a pose why it probably has none.

    Args:
        scene: The scene.

    Returns:
        The images in the order of their names. Images after the first `_MOST_EXAMINED` are not examined.
    """
    posed = {view.path for view in scene.views}
    files = [path for path in image_files_below(scene.image_folder) if path not in posed]
    if not files:
        return []
    chosen = scene.views[:: max(1, len(scene.views) // _REFERENCES)]
    references = [look for view in chosen if (look := _Appearance.of(view.path)) is not None]
    found = []
    for number, path in enumerate(files):
        reason = NOT_EXAMINED if number >= _MOST_EXAMINED else _reason(_Appearance.of(path), references)
        found.append(Unregistered(path.relative_to(scene.image_folder).as_posix(), reason))
    return found


def unregistered_sentences(images: Iterable[Unregistered]) -> list[str]:
    """Return a sentence for each reason, that of most images first."""
    names: defaultdict[str, list[str]] = defaultdict(list)
    for image in images:
        names[image.reason].append(image.name)
    return [
        f"{len(found)} photo{'s' if len(found) > 1 else ''} without a pose ({reason}): {first_names(found)}. "
        f"What helps: {_ADVICE[reason]}."
        for reason, found in sorted(names.items(), key=lambda item: -len(item[1]))
    ]


@dataclass(frozen=True)
class _Appearance:
    """What an image shows: 99th percentile of its brightness, standard deviation of coarse structure, and corners."""

    brightness: float
    contrast: float
    corners: int

    @classmethod
    def of(cls, path: Path) -> "_Appearance | None":
        """Examine an image; None if it cannot be read."""
        try:
            grey = cv2.cvtColor(read_image(path)[0], cv2.COLOR_RGB2GRAY)
        except InputError:
            return None
        scale = _SIDE / max(grey.shape)
        if scale < 1:
            grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        # Corners are counted after the contrast is equalised, as for matching. Coarse structure outlasts a blur.
        equal = cv2.createCLAHE(clipLimit=4, tileGridSize=(8, 8)).apply(grey)
        smooth = cv2.GaussianBlur(grey, (0, 0), 1.5).astype(np.float32)
        return cls(
            brightness=float(np.percentile(grey, 99)),
            contrast=float(np.std(smooth - cv2.GaussianBlur(smooth, (0, 0), 6.0))),
            corners=len(cv2.FastFeatureDetector.create(threshold=30).detect(equal)),
        )


def _reason(image: _Appearance | None, references: list[_Appearance]) -> str:
    if image is None:
        return UNREADABLE
    if image.brightness < _DARK:
        return DARK
    if references and image.corners < _LESS_STRUCTURE * np.median([other.corners for other in references]):
        seen = image.contrast >= _LESS_CONTRAST * np.median([other.contrast for other in references])
        return BLURRED if seen else EMPTY
    return NO_OVERLAP
