"""Find a color chart in the photos of a scene, or measure it between corners that the user gives."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import InputError
from ..scene.cameras import Camera
from ..scene.colmap import Scene, View
from ..scene.images import TrainingImage, load_images, read_image
from .chart_kinds import ChartKind
from .find_chart import ChartObservation, chart_at, find_chart

SEARCH_WIDTH = 1600
"""Width in pixels, at most, of the images that are searched."""
CORNERS = "PHOTO:x,y,x,y,x,y,x,y"
"""How the corners of a chart are written."""


@dataclass(frozen=True, eq=False)
class ChartImage:
    """A photo that shows the chart.

    Attributes:
        image: The undistorted image that was searched.
        observation: The chart in it.
    """

    image: TrainingImage
    observation: ChartObservation

    @property
    def name(self) -> str:
        """Name of the photo."""
        return self.image.camera.name


def parse_corners(texts: Sequence[str], scene: Scene) -> dict[str, np.ndarray]:
    """Read the corners that a user gives.

    Args:
        texts: One for each photo, as in CORNERS.
        scene: The scene that has the photos.

    Returns:
        Corners (4, 2) in pixels of the photo's file, by name of the photo.

    Raises:
        InputError: For another form, or a photo that the scene does not have.
    """
    names = {view.name for view in scene.views}
    given = {}
    for text in texts:
        name, _, numbers = text.rpartition(":")
        try:
            corners = np.array([float(number) for number in numbers.split(",")]).reshape(4, 2)
        except ValueError:
            corners = np.full((4, 2), np.nan)
        if not name or not np.isfinite(corners).all():
            raise InputError(f"The corners {text!r} are not of the form {CORNERS}.")
        if name not in names:
            raise InputError(f"{scene.folder} has no photo named {name}; the first is {scene.views[0].name}.")
        given[name] = corners
    return given


def find_charts(
    scene: Scene,
    kind: ChartKind,
    given: Mapping[str, np.ndarray],
    progress: Callable[[str, float], None],
    marked: Mapping[str, np.ndarray] | None = None,
) -> list[ChartImage]:
    """Find the chart in the photos that show it.

    Args:
        scene: The scene.
        kind: The chart.
        given: Corners (4, 2) of the chart in pixels of the photo's file, by name, for photos that are not searched.
        progress: Called with the stage and its fraction, 0..1.
        marked: Corners (4, 2) in fractions of the width and height of the undistorted photo, by name. Where there are
            some, no other photo is read.

    Returns:
        The photos, in the order of the scene.

    Raises:
        InputError: Where no photo shows the chart, or it is not between the given corners.
    """
    found = []
    views = [view for view in scene.views if not marked or view.name in marked]
    for index, view in enumerate(views):
        progress(f"Find the color chart: photo {index + 1} of {len(views)}", index / len(views))
        image = load_images(scene, [view], SEARCH_WIDTH)[0]
        if marked or view.name in given:
            corners = (
                marked[view.name] * [image.camera.width, image.camera.height]
                if marked
                else _undistorted(given[view.name], view, image.camera)
            )
            observation = chart_at(image.pixels, image.valid, kind, corners)
            if observation is None:
                raise InputError(
                    f"{view.name} shows no {kind.title} between the given corners: give the outer corners of its four "
                    "corner patches, going around the chart."
                )
        else:
            observation = find_chart(image.pixels, image.valid, kind)
        if observation is not None:
            found.append(ChartImage(image, observation))
    if not found:
        raise InputError(
            f"None of the {len(scene.views)} photos of {scene.folder} shows a {kind.title} that can be found. If one "
            f"does, give the outer corners of its corner patches: --corners {CORNERS}"
        )
    return found


def _undistorted(corners: np.ndarray, view: View, camera: Camera) -> np.ndarray:
    """Return pixels (4, 2) of a photo's file as pixels of its undistorted image."""
    lens = view.lens
    height, width = read_image(view.path, (lens.width, lens.height))[0].shape[:2]
    rays = lens.camera.cam_ray_from_img(np.ascontiguousarray(corners * [lens.width / width, lens.height / height]))
    homogeneous = rays @ camera.K.T
    return homogeneous[:, :2] / homogeneous[:, 2:]
