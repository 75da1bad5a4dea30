"""Find splats by what they are like: size, opacity, color, label, distance."""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from mathutils.kdtree import KDTree

from ..swag_engine.base.errors import InputError
from . import labels, scene_import, splat_selection
from .blender_types import present
from .cameras import cameras_of
from .nodes.splat_colors import HAZE_SCORE

KINDS: Any = [
    ("SIZE", "Size", "By the largest standard deviation of the splat"),
    ("OPACITY", "Opacity", "By the opacity of the splat"),
    ("HAZE", "Open Water", "By how sure it is that the splat is open water; the slider Haze shows such splats"),
    ("COLOR", "Color", "By the difference from a color"),
    ("LABEL", "Label Name", "By the name of the label"),
    ("CAMERA", "Distance to Camera", "By the distance to the nearest camera of the photos"),
    ("OTHERS", "Distance to Others", "Splats with fewer than six others within a distance"),
]
LENGTHS = {"SIZE": 99.0, "CAMERA": 95.0, "OTHERS": 99.0}
"""Kinds with a length as threshold, and the percentile of the splats at which it starts."""
NEIGHBORS = 6
"""A splat is apart from the others by the distance within which it has fewer others than this."""
GAP_SIZES = 4.0
"""Longest step between connected splats, in medians of their largest standard deviation: two touch within 2 x 2."""
SAMPLE = 500
"""Splats from which the usual distance to others is estimated."""


def similar_colors(obj: bpy.types.Object, color: Sequence[float], distance: float) -> np.ndarray:
    """Mask (N,) bool of the splats whose color differs from `color` (sRGB 0..1) by at most a distance, 0..1."""
    return np.linalg.norm(splat_selection.colors(obj) - np.array(color[:3]), axis=1) / np.sqrt(3) <= distance


def labelled(obj: bpy.types.Object, words: str) -> np.ndarray:
    """Mask (N,) bool of the splats of the labels whose name has the words in it.

    Raises:
        InputError: there is no such label.
    """
    numbers = labels.numbers_named(obj, words) if words.strip() else []
    if not numbers:
        names = ", ".join(entry.name for entry in labels.labels_of(obj).entries if entry.number)
        raise InputError(f"No label of {obj.name} is called {words or '(empty)'}: {names or 'no labels are read yet'}.")
    return np.isin(present(labels.attribute(obj, labels.LABEL)), numbers)


def camera_distances(context: bpy.types.Context, obj: bpy.types.Object) -> np.ndarray:
    """Distance (N,) of the splats to the nearest camera of their photos, or of the Blender scene without photos.

    Raises:
        InputError: there is no camera.
    """
    root = scene_import.find_root(obj)
    cameras = cameras_of(context, [root] if root else [])
    if not cameras:
        raise InputError("The scene has no cameras: import the photos, or add a camera.")
    tree = KDTree(len(cameras))
    for index, camera in enumerate(cameras):
        tree.insert(camera.centre.tolist(), index)
    tree.balance()
    # Half a second for 200 000 splats, however many cameras there are.
    return np.array([tree.find(position)[2] for position in splat_selection.world_positions(obj).tolist()])


def apart(positions: np.ndarray, distance: float) -> np.ndarray:
    """Mask (N,) bool of the points (N, 3) with fewer than NEIGHBORS others around them.

    Others are counted in 27 cubes, the point's own and those around it, with edges of `distance`.
    """
    cube = np.floor((positions - positions.min(axis=0)) / max(distance, 1e-9)).astype(np.int64) + 1
    if (cube.max(axis=0) + 2 >= 2**20).any():  # the cubes are too small to be numbered, and to hold two points
        return np.ones(len(positions), bool)
    steps = np.array([2**42, 2**21, 1])
    keys = cube @ steps
    order = np.argsort(keys)
    ordered = keys[order]  # looking up numbers in order is several times faster
    count = np.zeros(len(keys), np.int64)
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            # Three cubes in a column have consecutive numbers.
            middle = ordered + x * steps[0] + y * steps[1]
            count += np.searchsorted(ordered, middle + 1, "right") - np.searchsorted(ordered, middle - 1, "left")
    alone = np.empty(len(keys), bool)
    alone[order] = count - 1 < NEIGHBORS
    return alone


def connected(positions: np.ndarray, start: int, distance: float) -> np.ndarray:
    """Mask (N,) bool of the points that a chain of points reaches from the point `start`.

    Points are neighbors where they are in the same cube with edges of `distance`, or in cubes that touch.

    Args:
        positions: (N, 3).
        start: index of the first point.
        distance: longest step, roughly.
    """
    cube = np.floor((positions - positions.min(axis=0)) / max(distance, 1e-9)).astype(np.int64) + 1
    if (cube.max(axis=0) + 2 >= 2**20).any():  # the cubes are too small to be numbered, and to hold two points
        return np.arange(len(positions)) == start
    steps = np.array([2**42, 2**21, 1])
    around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) @ steps
    keys, of_point = np.unique(cube @ steps, return_inverse=True)
    reached = np.zeros(len(keys), bool)
    newest = of_point.ravel()[[start]]
    while len(newest):
        reached[newest] = True
        wanted = np.unique(keys[newest][:, None] + around)
        found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        found = found[keys[found] == wanted]
        newest = found[~reached[found]]
    return reached[of_point.ravel()]


def flood(
    obj: bpy.types.Object, start: int, tolerance: float, distance: float, same_label: bool
) -> tuple[np.ndarray, float]:
    """Find the splats that are connected with one of them by splats of similar color.

    Args:
        obj: a splat object.
        start: index of a drawn splat.
        tolerance: largest difference, 0..1, from the mean color around the splat, weighted by opacity.
        distance: longest step between splats in Blender units; 0: GAP_SIZES of their sizes.
        same_label: whether splats of other labels end it.

    Returns:
        Mask (N,) bool; the distance that was used.
    """
    positions, drawn = splat_selection.world_positions(obj), labels.drawn(obj)
    if not distance:
        distance = GAP_SIZES * float(np.median(splat_selection.world_sizes(obj).max(axis=1)[drawn]))
    near = drawn & (np.linalg.norm(positions - positions[start], axis=1) <= distance)
    color = np.average(splat_selection.colors(obj)[near], axis=0, weights=splat_selection.opacities(obj)[near] + 1e-6)
    fits = drawn & similar_colors(obj, color.tolist(), tolerance)
    numbers = labels.attribute(obj, labels.LABEL)
    if same_label and numbers is not None:
        fits &= numbers == numbers[start]
    fits[start] = True
    rows = np.flatnonzero(fits)
    found = np.zeros(len(positions), bool)
    found[rows[connected(positions[rows], int(np.searchsorted(rows, start)), distance)]] = True
    return found, distance


def usual_distance(positions: np.ndarray) -> float:
    """Distance within which 99 % of the points (N, 3) have at least NEIGHBORS others, from a sample."""
    if len(positions) <= NEIGHBORS:
        return 1.0
    tree = KDTree(len(positions))
    for index, position in enumerate(positions.tolist()):
        tree.insert(position, index)
    tree.balance()
    sample = positions[:: max(len(positions) // SAMPLE, 1)].tolist()
    return float(np.percentile([tree.find_n(position, NEIGHBORS + 1)[-1][2] for position in sample], 99))


def find(
    context: bpy.types.Context,
    obj: bpy.types.Object,
    kind: str,
    threshold: float,
    above: bool,
    color: Sequence[float],
    label: str,
) -> np.ndarray:
    """Mask (N,) bool of the splats of an object that a condition fits.

    Args:
        context: of the scene whose cameras count.
        obj: a splat object.
        kind: one of KINDS.
        threshold: a length in Blender units, or a fraction 0..1 for "OPACITY", "HAZE" and "COLOR".
        above: whether values above the threshold fit, else those below, for "SIZE", "OPACITY" and "CAMERA".
        color: sRGB values (3,) 0..1, for "COLOR".
        label: words in the label's name, for "LABEL".

    Raises:
        InputError: there is no such label, or no camera.
    """
    if kind == "COLOR":
        return similar_colors(obj, color, threshold)
    if kind == "LABEL":
        return labelled(obj, label)
    if kind == "OTHERS":
        return apart(splat_selection.world_positions(obj), threshold)
    values = _values(context, obj, kind)
    return values > threshold if above or kind == "HAZE" else values < threshold


def _values(context: bpy.types.Context, obj: bpy.types.Object, kind: str) -> np.ndarray:
    if kind == "HAZE":
        score = labels.attribute(obj, HAZE_SCORE)
        if score is None:
            raise InputError(
                f"No open water was found among the splats of {obj.name}: its photos show none, or it was trained by "
                "an earlier version. Select such splats by hand."
            )
        return score
    if kind == "SIZE":
        return splat_selection.world_sizes(obj).max(axis=1)
    return splat_selection.opacities(obj) if kind == "OPACITY" else camera_distances(context, obj)


def properties_of(kind: str) -> tuple[str, ...]:
    """Names of the properties of Select By that a kind uses."""
    return {
        "SIZE": ("side", "length"),
        "OPACITY": ("side", "fraction"),
        "HAZE": ("fraction",),
        "COLOR": ("color", "fraction"),
        "LABEL": ("label",),
        "CAMERA": ("side", "length"),
        "OTHERS": ("length",),
    }[kind]


def usual_length(context: bpy.types.Context, obj: bpy.types.Object, kind: str) -> float:
    """Threshold in Blender units that few splats of the object are above; 1 where it cannot be determined."""
    if kind == "OTHERS":
        return usual_distance(splat_selection.world_positions(obj))
    try:
        values = _values(context, obj, kind)
    except InputError:
        return 1.0
    return float(np.percentile(values, LENGTHS[kind])) if len(values) else 1.0


def selected_color(obj: bpy.types.Object) -> tuple[float, float, float]:
    """Mean color, sRGB values, of the selected splats; grey where none are."""
    chosen = labels.mask_of(obj, labels.SELECTED)
    red, green, blue = splat_selection.colors(obj)[chosen].mean(axis=0).tolist() if chosen.any() else (0.5, 0.5, 0.5)
    return red, green, blue


def active_label(obj: bpy.types.Object) -> str:
    """Name of the label that is chosen in the list of labels; "" without labels."""
    own = labels.labels_of(obj)
    return own.entries[own.active].name if 0 <= own.active < len(own.entries) else ""
