"""Labels of splats: which are shown, selecting and searching by them, separating and merging objects.

Point attributes beside those of splats.py, all usable in geometry nodes: `swag:label` (INT, 0 for none),
`swag:confidence` (FLOAT, 0..1, how well the color without water is known), `swag:similarity` (FLOAT, -1..1, of the
last search), `swag:selected` (BOOLEAN), `swag:masked` (BOOLEAN: hidden by the user), `swag:hidden` (BOOLEAN: not drawn,
because masked or of a hidden label), `swag:tint` (FLOAT_COLOR: this color is mixed in, by its alpha), and `mask:NAME`
(BOOLEAN) for each selection that was saved as a mask.
"""

import colorsys
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
import numpy as np
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)
from bpy.types import PropertyGroup
from mathutils import Color

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.strict_json import from_json
from ..swag_engine.splats.splats import Splats, concatenate
from ..swag_engine.splats.transform import transformed
from . import crop_box, display, splats, water
from .blender_types import present, with_properties
from .nodes.splat_colors import HIDDEN, TINT
from .nodes.splat_preview import copy_inputs, ensure_modifier

LABEL, SIMILARITY = "swag:label", "swag:similarity"
CONFIDENCE = "swag:confidence"
SELECTED, MASKED = "swag:selected", "swag:masked"
MASK_PREFIX = "mask:"
NOT_COPIED = {"swag_labels", "swag_display", "swag_survey_tiles", "swag_survey_levels"}
"""Properties that a separated part does not take over as they are: it has no whole tiles of a survey."""
TABLE, FEATURES = "labels.json", "semantics.safetensors"
SELECTED_COLOR = (1.0, 0.45, 0.0, 0.6)
"""Tint of selected splats, linear light and alpha: the orange of Blender's own selection."""
TINT_STRENGTH = 0.65
"""Alpha of a label's color where colors are shown."""
UNCERTAIN_COLOR = (1.0, 0.0, 0.3)
"""Tint of splats of confidence 0, linear light: a color that no water has."""

Source = Annotated[
    str,
    EnumProperty(
        name="Source",
        description="What assigns the labels",
        items=[
            ("AUTO", "Scene", "The masks in the scene's folder labels, or salient regions where it has none"),
            ("MASKS", "Masks", "Your own mask images: one folder for each label, with an image for each photo"),
            ("WORDS", "Words", "Networks that find what you name in the photos"),
            ("SALIENCY", "Salient Regions", "Open water, salient regions and the rest; needs no networks"),
        ],
    ),
]
Words = Annotated[str, StringProperty(name="Words", description="What to label, as in coral, wreck, open water")]
Masks = Annotated[str, StringProperty(name="Masks", description="Folder of the masks", subtype="DIR_PATH")]
Download = Annotated[
    bool,
    BoolProperty(
        name="Download Networks", description="Download networks that are not on this machine from their authors"
    ),
]


@with_properties
class SwagLabel(PropertyGroup):
    """One label of an object's splats."""

    number: Annotated[int, IntProperty(description="Value of swag:label")]
    count: Annotated[int, IntProperty(description="Splats with this label")]
    visible: Annotated[
        bool,
        BoolProperty(
            name="Visible",
            description="Show the splats with this label",
            default=True,
            update=lambda self, context: show(self.id_data),
        ),
    ]
    color: Annotated[
        Sequence[float],
        FloatVectorProperty(
            name="Color", subtype="COLOR", size=3, min=0, max=1, update=lambda self, context: show(self.id_data)
        ),
    ]


@with_properties
class SwagLabels(PropertyGroup):
    """`object.swag_labels`: the labels of a splat object and how they are shown."""

    entries: Annotated["bpy.types.bpy_prop_collection_idprop[SwagLabel]", CollectionProperty(type=SwagLabel)]
    active: Annotated[int, IntProperty(name="Label")]
    tinted: Annotated[
        bool,
        BoolProperty(
            name="Show Colors",
            description="Mix the color of its label into each splat",
            update=lambda self, context: show(self.id_data),
        ),
    ]
    uncertain: Annotated[
        bool,
        BoolProperty(
            name="Show Uncertain Colors",
            description="Mix pink into splats of which too little light reached the camera to know their color "
            "without water",
            update=lambda self, context: show(self.id_data),
        ),
    ]
    words: Annotated[str, StringProperty(name="Search", description="What to look for, such as coral")]
    threshold: Annotated[
        float,
        FloatProperty(
            name="Threshold",
            description="Splats with a higher similarity than this to the search are selected",
            default=0.5,
            min=-1,
            max=1,
            update=lambda self, context: select_similar(self.id_data),
        ),
    ]
    folder: Annotated[str, StringProperty(description="Run folder that the names are from", subtype="DIR_PATH")]
    source: Source
    wanted: Words
    masks: Masks
    download: Download


def labels_of(obj: bpy.types.Object) -> SwagLabels:
    """The labels of a splat object."""
    return cast(Any, obj).swag_labels


def take_labels(obj: bpy.types.Object, result: Splats, folder: str) -> int:
    """Give a splat object the labels of its run's result and list them; returns how many there are.

    Splats are found in the result by their positions, so that an object from which some were deleted or separated gets
    labels too. As many splats that are not found there, as those of an earlier training, are replaced by the result,
    which removes masks and the selection.

    Args:
        obj: a splat object.
        result: the splats of the run, with labels.
        folder: the run's folder.

    Raises:
        InputError: the object has other splats than the run, and fewer or more.
    """
    count = splats.count(obj)
    rows = splats.find_rows(splats.positions(obj), result.positions)
    if rows is not None:
        set_attribute(obj, LABEL, "INT", result.extras["label"][rows])
    elif count == len(result):
        splats.replace_splats(obj, result)
    else:
        raise InputError(
            f"The run has {len(result)} splats and {obj.name} has {count} others: open the run's result.ply again."
        )
    labels_of(obj).entries.clear()
    return read_labels(obj, folder)


def read_labels(obj: bpy.types.Object, folder: str) -> int:
    """List the labels of a splat object, with the names of labels.json in `folder` where there is one.

    Hidden labels stay hidden. Returns how many labels there are. Raises InputError when the splats have no labels, or
    the file is damaged.
    """
    values = attribute(obj, LABEL)
    if values is None:
        raise InputError(f"The splats of {obj.name} have no labels: label the run, then open its result.ply again.")
    names = names_in(Path(folder)) if folder else {}
    own = labels_of(obj)
    known = {entry.number: (entry.name, entry.visible, tuple(entry.color)) for entry in own.entries}
    own.entries.clear()
    numbers, counts = np.unique(values, return_counts=True)
    for number, count in sorted(zip(numbers.tolist(), counts.tolist(), strict=True), key=lambda pair: -pair[1]):
        new = (f"Label {number}" if number else "No label", True, color_of(number))
        before, visible, color = known.get(number, new)
        entry = own.entries.add()
        entry.number, entry.count, entry.name = number, count, names.get(number, before)
        entry["visible"], entry["color"] = visible, color  # not by the properties, which would call `show` each time
    own.active = min(own.active, len(own.entries) - 1)
    if names:
        own.folder = folder
    show(obj)
    return len(own.entries)


def names_in(folder: Path) -> dict[int, str]:
    """Names by number in the labels.json of a run; empty without the file. Raises InputError when it is damaged."""
    path = folder / TABLE
    if not path.is_file():
        return {}
    try:
        table = from_json(path.read_text(encoding="utf-8"))
        return {int(entry["id"]): str(entry["name"]) for entry in table["labels"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} does not list labels ({error}): press Label in the panel Labels.") from error


def show(obj: bpy.types.Object) -> None:
    """Write the attributes that are drawn: hidden labels and splats, colors of labels, confidence, the selection."""
    values = attribute(obj, LABEL)
    own = labels_of(obj)
    count = splats.count(obj)
    if values is None:
        values = np.zeros(count, np.int32)
    hidden = np.isin(values, [entry.number for entry in own.entries if not entry.visible])
    hidden |= mask_of(obj, MASKED)
    tint = np.zeros((count, 4), np.float32)
    if own.tinted:
        for entry in own.entries:
            if entry.number:
                tint[values == entry.number] = (*entry.color, TINT_STRENGTH)
    confidence = attribute(obj, CONFIDENCE)
    if own.uncertain and confidence is not None:
        tint[:, :3], tint[:, 3] = UNCERTAIN_COLOR, 1 - confidence
    tint[mask_of(obj, SELECTED)] = SELECTED_COLOR
    ensure_modifier(obj)
    set_attribute(obj, HIDDEN, "BOOLEAN", hidden)
    set_attribute(obj, TINT, "FLOAT_COLOR", tint)


def isolate(obj: bpy.types.Object, number: int) -> None:
    """Show one label alone; all labels where it was shown alone already."""
    entries = labels_of(obj).entries
    alone = all(entry.visible == (entry.number == number) for entry in entries)
    for entry in entries:
        entry["visible"] = alone or entry.number == number
    show(obj)


def show_all(obj: bpy.types.Object) -> None:
    """Show all labels."""
    for entry in labels_of(obj).entries:
        entry["visible"] = True
    show(obj)


def drawn(obj: bpy.types.Object) -> np.ndarray:
    """Mask (N,) bool of the splats that are neither hidden nor outside the crop box."""
    return ~mask_of(obj, HIDDEN) & crop_box.inside_crop(obj)


def select(obj: bpy.types.Object, mask: np.ndarray) -> int:
    """Select the splats of a mask (N,) bool, without hidden and cropped ones; returns how many there are."""
    mask = mask & drawn(obj)
    set_attribute(obj, SELECTED, "BOOLEAN", mask)
    show(obj)
    return int(mask.sum())


def select_label(obj: bpy.types.Object, number: int, extend: bool = False) -> int:
    """Select the splats of a label, in addition to the selection with `extend`; returns how many are selected."""
    values = attribute(obj, LABEL)
    mask = np.zeros(splats.count(obj), bool) if values is None else values == number
    return select(obj, mask | mask_of(obj, SELECTED) if extend else mask)


def select_similar(obj: bpy.types.Object) -> int:
    """Select the splats whose similarity to the last search is above the threshold; returns how many."""
    similarity = attribute(obj, SIMILARITY)
    return 0 if similarity is None else select(obj, similarity > labels_of(obj).threshold)


def selection(obj: bpy.types.Object) -> np.ndarray:
    """Mask (N,) bool of the selected splats that are drawn. Raises InputError when there are none."""
    mask = mask_of(obj, SELECTED) & drawn(obj)
    if not mask.any():
        raise InputError(f"No splats of {obj.name} are selected: select some in the viewport, a label, or search.")
    return mask


def numbers_named(obj: bpy.types.Object, words: str) -> list[int]:
    """Numbers of the labels whose name has the words in it, whatever the case."""
    wanted = " ".join(words.split()).casefold()
    return [entry.number for entry in labels_of(obj).entries if entry.number and wanted in entry.name.casefold()]


def similarity_to_labels(obj: bpy.types.Object, numbers: list[int]) -> np.ndarray:
    """Similarity (N,) float32 of each splat to labels: the largest cosine between its feature and theirs.

    Without features of the same number of splats in the run folder: 1 for splats with one of these labels, else 0.
    """
    folder = labels_of(obj).folder
    tensors = _tensors(Path(folder) / FEATURES) if folder else None
    if tensors and len(tensors["features"]) == splats.count(obj):
        return (tensors["features"] @ tensors["prototypes"][[number - 1 for number in numbers]].T).max(1)
    return np.isin(present(attribute(obj, LABEL)), numbers).astype(np.float32)


def set_similarity(obj: bpy.types.Object, similarity: np.ndarray) -> int:
    """Write the similarity (N,) of a search and select the splats above the threshold; returns how many.

    Raises InputError when there are more or fewer values than splats.
    """
    count = splats.count(obj)
    if len(similarity) != count:
        raise InputError(f"The run has {len(similarity)} splats and {obj.name} has {count}: open its result.ply again.")
    set_attribute(obj, SIMILARITY, "FLOAT", similarity)
    return select_similar(obj)


def keep_mask(obj: bpy.types.Object, name: str) -> str:
    """Save the selection as an attribute for geometry nodes; returns the attribute's name.

    Raises InputError when nothing is selected.
    """
    mask = selection(obj)
    attribute_name = MASK_PREFIX + (name.strip() or "selection")
    set_attribute(obj, attribute_name, "BOOLEAN", mask)
    return attribute_name


def separate(obj: bpy.types.Object) -> bpy.types.Object:
    """Move the selected splats to a new object with the same parent, transform and collection.

    Raises InputError when nothing or everything is selected.
    """
    mask = selection(obj)
    if mask.all():
        raise InputError(f"All splats of {obj.name} are selected: select a part of them.")
    whole = splats.read_splats(obj)
    values = attribute(obj, LABEL)
    chosen = set() if values is None else set(values[mask].tolist())
    names = [entry.name for entry in labels_of(obj).entries if entry.number in chosen]
    title = f"{obj.name} {names[0]}" if len(names) == 1 else f"{obj.name} part"
    collection = obj.users_collection[0] if obj.users_collection else present(bpy.context.scene).collection
    made = splats.new_splat_object(title, whole.subset(mask), collection, obj.parent)
    made.matrix_parent_inverse = obj.matrix_parent_inverse.copy()
    made.matrix_basis = obj.matrix_basis.copy()
    _copy_settings(obj, made)
    splats.copy_attributes(splats.pointcloud_of(obj), splats.pointcloud_of(made), mask)
    splats.keep_splats(obj, ~mask)
    for one in (obj, made):
        set_attribute(one, SELECTED, "BOOLEAN", np.zeros(splats.count(one), bool))
        list_again(one)
    return made


def merge(target: bpy.types.Object, others: list[bpy.types.Object]) -> int:
    """Move the splats of `others` to `target`, at the same place, and remove those objects; returns how many it has.

    Labels are merged by number, so that objects that were separated become what they were. Labels that only the others
    have keep their names.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    frame = target.evaluated_get(depsgraph).matrix_world.copy()
    parts: list[Splats] = [splats.read_splats(target)]
    for obj in others:
        to_target = frame.inverted() @ obj.evaluated_get(depsgraph).matrix_world
        parts.append(transformed(splats.read_splats(obj), np.array(to_target, np.float64)))
    known = {entry.number for entry in labels_of(target).entries}
    for obj in others:
        for entry in labels_of(obj).entries:
            if entry.number not in known:
                known.add(entry.number)
                taken = labels_of(target).entries.add()
                taken.number, taken.name = entry.number, entry.name
                taken["visible"], taken["color"] = entry.visible, tuple(entry.color)
    splats.replace_splats(target, concatenate(parts))
    for obj in others:
        data = splats.pointcloud_of(obj)
        bpy.data.objects.remove(obj)
        if data.users == 0:
            bpy.data.pointclouds.remove(data)
    list_again(target)
    return splats.count(target)


def merge_selected(context: bpy.types.Context, target: bpy.types.Object) -> int:
    """Merge the other selected splat objects into `target`, as `merge`. Raises InputError when there are none."""
    others = [obj for obj in context.selected_objects if splats.is_splats(obj) and obj != target]
    if not others:
        raise InputError("Only one object with splats is selected: select the objects to merge, the one to keep last.")
    return merge(target, others)


def attribute(obj: bpy.types.Object, name: str) -> np.ndarray | None:
    """Values (N,) of a point attribute; None where the object does not have it."""
    found: Any = splats.pointcloud_of(obj).attributes.get(name)
    if found is None:
        return None
    values = np.empty(len(found.data), {"INT": np.int32, "BOOLEAN": bool}.get(found.data_type, np.float32))
    found.data.foreach_get("value", values)
    return values


def mask_of(obj: bpy.types.Object, name: str) -> np.ndarray:
    """Values (N,) bool of a point attribute; all false where the object does not have it."""
    found = attribute(obj, name)
    return np.zeros(splats.count(obj), bool) if found is None else found.astype(bool)


def color_of(number: int) -> tuple[float, float, float]:
    """Color of a label in linear light: hues in steps of the golden ratio, so that neighbours differ."""
    shown = colorsys.hsv_to_rgb(number * 0.618034 % 1, 0.75, 0.95) if number else (0.5, 0.5, 0.5)
    red, green, blue = Color(shown).from_srgb_to_scene_linear()[:]
    return red, green, blue


def list_again(obj: bpy.types.Object) -> None:
    """List the labels again after the splats were replaced."""
    if LABEL in splats.pointcloud_of(obj).attributes:
        read_labels(obj, "")
    else:
        show(obj)


def _copy_settings(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Copy the label list, the extension's properties and the inputs of the preview."""
    for entry in labels_of(source).entries:
        copied = labels_of(target).entries.add()
        copied.number, copied.name = entry.number, entry.name
        copied["visible"], copied["color"] = entry.visible, tuple(entry.color)
    for name in ("tinted", "uncertain"):
        labels_of(target)[name] = getattr(labels_of(source), name)
    for key in source.keys():  # noqa: SIM118 (an ID, not a dict)
        if key.startswith("swag_") and key not in NOT_COPIED:
            target[key] = source[key]
    copy_inputs(source, target)
    display.copy_settings(source, target)
    water.follow_slider(target)


def set_attribute(obj: bpy.types.Object, name: str, kind: str, values: np.ndarray) -> None:
    """Write values (N,) or (N, 4) to a point attribute; an attribute of that name with another type is replaced."""
    pointcloud = splats.pointcloud_of(obj)
    attributes: Any = pointcloud.attributes
    found = attributes.get(name)
    if found is not None and (found.data_type != kind or found.domain != "POINT"):
        attributes.remove(found)
        found = None
    found = found or attributes.new(name, kind, "POINT")
    field = "color" if kind == "FLOAT_COLOR" else "value"
    dtype = {"BOOLEAN": bool, "INT": np.int32}.get(kind, np.float32)
    found.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())
    splats.mark_changed(pointcloud)


def _tensors(path: Path) -> dict[str, np.ndarray] | None:
    """Read the float32 arrays of a safetensors file; None where it cannot be read.

    Blender's Python has no package for it. The file has 8 bytes with the length of a JSON header, the header, the data.
    """
    try:
        data = path.read_bytes()
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])
        body = data[8 + length :]
        return {
            name: np.frombuffer(body[slice(*entry["data_offsets"])], "<f4").reshape(entry["shape"])
            for name, entry in header.items()
            if name != "__metadata__" and entry["dtype"] == "F32"
        }
    except (OSError, ValueError, KeyError, TypeError):
        return None


_CLASSES = (SwagLabel, SwagLabels)


def register() -> None:
    """Register the property groups and give every object its labels."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    cast(Any, bpy.types.Object).swag_labels = PointerProperty(type=SwagLabels)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Object).swag_labels
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
