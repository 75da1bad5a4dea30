"""Labels of splats: what is shown of them, what is chosen by them, and what is searched among them.

Point attributes beside those of splats.py, all usable in geometry nodes: `swag:label` (INT, 0 for none),
`swag:similarity` (FLOAT, -1..1, of the last search), `swag:selected` (BOOLEAN), `swag:hidden` (BOOLEAN: the preview
leaves these out), `swag:tint` (FLOAT_COLOR: the preview mixes this colour in, by its alpha), and `mask:NAME` (BOOLEAN)
for each selection that was kept.
"""

import colorsys
import json
from pathlib import Path
from typing import Any

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
from . import splats, water
from .nodes.splat_preview import HIDDEN, TINT, copy_inputs

LABEL, SIMILARITY = "swag:label", "swag:similarity"
SELECTED = "swag:selected"
MASK_PREFIX = "mask:"
TABLE, FEATURES = "labels.json", "semantics.safetensors"
SELECTED_COLOR = (1.0, 0.45, 0.0, 0.6)
TINT_STRENGTH = 0.65


SOURCE = EnumProperty(
    name="By",
    description="What the splats are labelled by",
    items=[
        ("AUTO", "Scene", "The scene's own masks, where it has some in its folder labels, else what stands out"),
        ("MASKS", "Masks", "Your own mask images: one folder a label, with a picture for each photograph"),
        ("WORDS", "Words", "Networks that find what you name in the photographs"),
        ("SALIENCY", "What Stands Out", "Open water, what stands out, and the rest; needs nothing"),
    ],
)
WORDS = StringProperty(name="Words", description="What to label, as in coral, wreck, open water")
MASKS = StringProperty(name="Masks", description="Folder of the masks", subtype="DIR_PATH")
DOWNLOAD = BoolProperty(
    name="Fetch Networks", description="Get networks that are not on this machine from their authors"
)


class SwagLabel(PropertyGroup):
    """One label of an object's splats."""

    number: IntProperty(description="The value of swag:label")
    count: IntProperty(description="Splats with this label")
    visible: BoolProperty(
        name="Visible",
        description="Show the splats with this label",
        default=True,
        update=lambda self, context: show(self.id_data),
    )
    color: FloatVectorProperty(
        name="Colour", subtype="COLOR", size=3, min=0, max=1, update=lambda self, context: show(self.id_data)
    )


class SwagLabels(PropertyGroup):
    """`object.swag_labels`: the labels of a splat object and how they are shown."""

    entries: CollectionProperty(type=SwagLabel)
    active: IntProperty(name="Label")
    tinted: BoolProperty(
        name="Show Colours",
        description="Mix the colour of its label into each splat",
        update=lambda self, context: show(self.id_data),
    )
    words: StringProperty(name="Search", description="What to look for, such as coral")
    threshold: FloatProperty(
        name="Threshold",
        description="Splats that are more similar than this to what was searched are selected",
        default=0.5,
        min=-1,
        max=1,
        update=lambda self, context: select_similar(self.id_data),
    )
    folder: StringProperty(description="Folder of the run that the names are from", subtype="DIR_PATH")
    source: SOURCE
    wanted: WORDS
    masks: MASKS
    download: DOWNLOAD


def take_labels(obj: bpy.types.Object, made: Splats, folder: str) -> int:
    """Give a splat object the labels of its run's result, `made`, in `folder`, and list them; returns how many.

    Splats that stand in another order, as after separating and merging, are replaced; masks and selections go then.
    Raises InputError when the object has fewer or more splats than the run.
    """
    count = len(obj.data.points)
    if count != len(made):
        raise InputError(
            f"The run has {len(made)} splats and {obj.name} {count}: merge its parts, or open result.ply again."
        )
    if np.array_equal(splats.read_splats(obj).positions, made.positions):
        _set(obj, LABEL, "INT", made.extras["label"])
    else:
        splats.replace_splats(obj, made)
    obj.swag_labels.entries.clear()
    return read_labels(obj, folder)


def read_labels(obj: bpy.types.Object, folder: str) -> int:
    """List the labels of a splat object, with the names of labels.json in `folder` where there is one.

    Returns how many there are. What was hidden stays hidden. Raises InputError when the splats have no labels, or the
    file is damaged.
    """
    values = attribute(obj, LABEL)
    if values is None:
        raise InputError(f"The splats of {obj.name} have no labels: label the run, then open its result.ply again.")
    names = names_in(Path(folder)) if folder else {}
    own = obj.swag_labels
    known = {entry.number: (entry.name, entry.visible, tuple(entry.color)) for entry in own.entries}
    own.entries.clear()
    numbers, counts = np.unique(values, return_counts=True)
    for number, count in sorted(zip(numbers.tolist(), counts.tolist(), strict=True), key=lambda pair: -pair[1]):
        new = (f"Label {number}" if number else "No label", True, color_of(number))
        before, visible, color = known.get(number, new)
        entry = own.entries.add()
        entry.number, entry.count, entry.name = number, count, names.get(number, before)
        entry["visible"], entry["color"] = visible, color  # not by the properties, which would show each time
    own.active = min(own.active, len(own.entries) - 1)
    if names:
        own.folder = folder
    show(obj)
    return len(own.entries)


def names_in(folder: Path) -> dict[int, str]:
    """Names by number in the labels.json of a run; none where it has none. Raises InputError when it is damaged."""
    path = folder / TABLE
    if not path.is_file():
        return {}
    try:
        table = from_json(path.read_text(encoding="utf-8"))
        return {int(entry["id"]): str(entry["name"]) for entry in table["labels"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} does not list labels ({error}): make them again with `label`.") from error


def show(obj: bpy.types.Object) -> None:
    """Write what the preview reads: hidden labels, colours of labels, the selection."""
    values = attribute(obj, LABEL)
    own = obj.swag_labels
    count = len(obj.data.points)
    if values is None:
        values = np.zeros(count, np.int32)
    hidden = np.isin(values, [entry.number for entry in own.entries if not entry.visible])
    tint = np.zeros((count, 4), np.float32)
    if own.tinted:
        for entry in own.entries:
            if entry.number:
                tint[values == entry.number] = (*entry.color, TINT_STRENGTH)
    selected = attribute(obj, SELECTED)
    if selected is not None:
        tint[selected] = SELECTED_COLOR
    _set(obj, HIDDEN, "BOOLEAN", hidden)
    _set(obj, TINT, "FLOAT_COLOR", tint)


def isolate(obj: bpy.types.Object, number: int) -> None:
    """Show one label alone; all again where it was alone already."""
    entries = obj.swag_labels.entries
    alone = all(entry.visible == (entry.number == number) for entry in entries)
    for entry in entries:
        entry["visible"] = alone or entry.number == number
    show(obj)


def select(obj: bpy.types.Object, mask: np.ndarray) -> int:
    """Make mask (N,) bool the selection; returns how many splats it has."""
    _set(obj, SELECTED, "BOOLEAN", mask)
    show(obj)
    return int(mask.sum())


def select_label(obj: bpy.types.Object, number: int, extend: bool = False) -> int:
    """Select the splats of a label, beside what is selected where `extend`."""
    values = attribute(obj, LABEL)
    mask = np.zeros(len(obj.data.points), bool) if values is None else values == number
    before = attribute(obj, SELECTED)
    return select(obj, mask | before if extend and before is not None else mask)


def select_similar(obj: bpy.types.Object) -> int:
    """Select what the last search found above the object's threshold."""
    similarity = attribute(obj, SIMILARITY)
    return 0 if similarity is None else select(obj, similarity > obj.swag_labels.threshold)


def selection(obj: bpy.types.Object) -> np.ndarray:
    """(N,) bool: what is selected. Raises InputError when nothing is."""
    mask = attribute(obj, SELECTED)
    if mask is None or not mask.any():
        raise InputError(f"No splats of {obj.name} are selected: select a label, or search, first.")
    return mask


def called(obj: bpy.types.Object, words: str) -> list[int]:
    """The numbers of the labels whose name has the words in it."""
    wanted = " ".join(words.split()).casefold()
    return [entry.number for entry in obj.swag_labels.entries if entry.number and wanted in entry.name.casefold()]


def similarity_to_labels(obj: bpy.types.Object, numbers: list[int]) -> np.ndarray:
    """(N,) float32: the largest cosine of each splat's feature with one of these labels'.

    Where the run's features are not at hand, 1 for splats with one of these labels and 0 for others.
    """
    tensors = _tensors(Path(obj.swag_labels.folder) / FEATURES) if obj.swag_labels.folder else None
    if tensors and len(tensors["features"]) == len(obj.data.points):
        return (tensors["features"] @ tensors["prototypes"][[number - 1 for number in numbers]].T).max(1)
    return np.isin(attribute(obj, LABEL), numbers).astype(np.float32)


def set_similarity(obj: bpy.types.Object, similarity: np.ndarray) -> int:
    """Keep what a search found, (N,) numbers, and select what is above the threshold; returns how many that are.

    Raises InputError when the numbers are of other splats.
    """
    if len(similarity) != len(obj.data.points):
        raise InputError(
            f"The run has {len(similarity)} splats and {obj.name} {len(obj.data.points)}: open its result.ply again."
        )
    _set(obj, SIMILARITY, "FLOAT", similarity)
    return select_similar(obj)


def keep_mask(obj: bpy.types.Object, name: str) -> str:
    """Keep the selection as an attribute for geometry nodes; returns its name. Raises InputError without one."""
    mask = selection(obj)
    attribute_name = MASK_PREFIX + (name.strip() or "selection")
    _set(obj, attribute_name, "BOOLEAN", mask)
    return attribute_name


def separate(obj: bpy.types.Object) -> bpy.types.Object:
    """Move the selected splats to a new object beside this one, which hangs and stands as it does.

    Raises InputError when nothing or everything is selected.
    """
    mask = selection(obj)
    if mask.all():
        raise InputError(f"All splats of {obj.name} are selected: select a part of them.")
    whole = splats.read_splats(obj)
    chosen = np.unique(attribute(obj, LABEL)[mask]) if attribute(obj, LABEL) is not None else []
    names = [entry.name for entry in obj.swag_labels.entries if entry.number in chosen]
    title = f"{obj.name} {names[0]}" if len(names) == 1 else f"{obj.name} part"
    collection = obj.users_collection[0] if obj.users_collection else bpy.context.scene.collection
    made = splats.new_splat_object(title, whole.subset(mask), collection, obj.parent)
    made.matrix_parent_inverse = obj.matrix_parent_inverse.copy()
    made.matrix_basis = obj.matrix_basis.copy()
    _copy_settings(obj, made)
    splats.replace_splats(obj, whole.subset(~mask))
    for one in (obj, made):
        _list_again(one)
    return made


def merge(target: bpy.types.Object, others: list[bpy.types.Object]) -> int:
    """Bring the splats of `others` into `target`, where they stand, and remove those objects; returns how many it has.

    Labels are joined by number: objects that were separated come back as they were. Names that only the others have are
    taken over.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    frame = target.evaluated_get(depsgraph).matrix_world.copy()
    parts: list[Splats] = [splats.read_splats(target)]
    for obj in others:
        to_target = frame.inverted() @ obj.evaluated_get(depsgraph).matrix_world
        parts.append(transformed(splats.read_splats(obj), np.array(to_target, np.float64)))
    known = {entry.number for entry in target.swag_labels.entries}
    for obj in others:
        for entry in obj.swag_labels.entries:
            if entry.number not in known:
                known.add(entry.number)
                taken = target.swag_labels.entries.add()
                taken.number, taken.name = entry.number, entry.name
                taken["visible"], taken["color"] = entry.visible, tuple(entry.color)
    splats.replace_splats(target, concatenate(parts))
    for obj in others:
        data = obj.data
        bpy.data.objects.remove(obj)
        if data.users == 0:
            bpy.data.pointclouds.remove(data)
    _list_again(target)
    return len(target.data.points)


def attribute(obj: bpy.types.Object, name: str) -> np.ndarray | None:
    """The values (N,) of one of the attributes above; None where the object has none."""
    found = obj.data.attributes.get(name)
    if found is None:
        return None
    values = np.empty(len(found.data), {"INT": np.int32, "BOOLEAN": bool}.get(found.data_type, np.float32))
    found.data.foreach_get("value", values)
    return values


def color_of(number: int) -> tuple[float, float, float]:
    """A colour for a label, linear light, far from those of its neighbours: hues in steps of the golden ratio."""
    shown = colorsys.hsv_to_rgb(number * 0.618034 % 1, 0.75, 0.95) if number else (0.5, 0.5, 0.5)
    return tuple(Color(shown).from_srgb_to_scene_linear())


def draw_labels(layout: bpy.types.UILayout, obj: bpy.types.Object) -> None:
    """The label list of a splat object with its buttons and the search, for a panel."""
    own = obj.swag_labels
    if not own.entries:
        layout.operator("swag.read_labels", icon="FILE_REFRESH")
        return
    row = layout.row()
    row.template_list("SWAG_UL_labels", "", own, "entries", own, "active", rows=4)
    column = row.column(align=True)
    column.operator("swag.read_labels", text="", icon="FILE_REFRESH")
    column.operator("swag.show_labels", text="", icon="HIDE_OFF")
    column.prop(own, "tinted", text="", icon="COLOR")
    row = layout.row(align=True)
    row.prop(own, "words", text="", icon="VIEWZOOM")
    row.operator("swag.search_labels", text="Search")
    row = layout.row()
    row.enabled = SIMILARITY in obj.data.attributes
    row.prop(own, "threshold", slider=True)
    row = layout.row(align=True)
    row.operator("swag.keep_mask", text="Mask")
    row.operator("swag.separate_splats", text="Separate")
    row.operator("swag.merge_splats", text="Merge")


def draw_labelling(layout: bpy.types.UILayout, obj: bpy.types.Object) -> None:
    """What a run's splats are labelled by, and the button that does it, for a panel."""
    own = obj.swag_labels
    layout.prop(own, "source")
    if own.source == "WORDS":
        layout.prop(own, "wanted")
        layout.prop(own, "download")
    elif own.source == "MASKS":
        layout.prop(own, "masks")
    button = layout.operator("swag.label_run", icon="BOOKMARKS")
    button.source, button.words, button.masks, button.download = own.source, own.wanted, own.masks, own.download


class SWAG_UL_labels(bpy.types.UIList):
    """One line a label: colour, name, count, and its buttons."""

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: Any,
        item: SwagLabel,
        icon: int,
        active_data: Any,
        active_property: str,
    ) -> None:
        row = layout.row(align=True)
        swatch = row.row()
        swatch.ui_units_x = 0.8
        swatch.prop(item, "color", text="")
        row.prop(item, "name", text="", emboss=False)
        count = row.row()
        count.alignment = "RIGHT"
        count.label(text=f"{item.count}")
        row.operator("swag.select_label", text="", icon="RESTRICT_SELECT_OFF", emboss=False).number = item.number
        row.operator("swag.isolate_label", text="", icon="ZOOM_SELECTED", emboss=False).number = item.number
        row.prop(item, "visible", text="", icon="HIDE_OFF" if item.visible else "HIDE_ON", emboss=False)


def _list_again(obj: bpy.types.Object) -> None:
    """After the splats are others: nothing is selected, and the list counts what is there."""
    if LABEL in obj.data.attributes:
        read_labels(obj, "")
    else:
        show(obj)


def _copy_settings(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """The label list, and how the preview draws."""
    for entry in source.swag_labels.entries:
        copied = target.swag_labels.entries.add()
        copied.number, copied.name = entry.number, entry.name
        copied["visible"], copied["color"] = entry.visible, tuple(entry.color)
    target.swag_labels["tinted"] = source.swag_labels.tinted
    for key in source.keys():  # noqa: SIM118 (an ID, not a dict)
        if key.startswith("swag_") and key not in ("swag_labels",):
            target[key] = source[key]
    copy_inputs(source, target)
    water.follow_slider(target)


def _set(obj: bpy.types.Object, name: str, kind: str, values: np.ndarray) -> None:
    attributes = obj.data.attributes
    found = attributes.get(name)
    if found is not None and (found.data_type != kind or found.domain != "POINT"):
        attributes.remove(found)
        found = None
    found = found or attributes.new(name, kind, "POINT")
    field = "color" if kind == "FLOAT_COLOR" else "value"
    dtype = {"BOOLEAN": bool, "INT": np.int32}.get(kind, np.float32)
    found.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())
    obj.data.update_tag()


def _tensors(path: Path) -> dict[str, np.ndarray] | None:
    """The float32 arrays of a safetensors file (8 bytes of length, a JSON header, the data); None where it cannot be
    read. Blender's Python has no package for it."""
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


CLASSES = (SwagLabel, SwagLabels, SWAG_UL_labels)


def register() -> None:
    bpy.types.Object.swag_labels = PointerProperty(type=SwagLabels)


def unregister() -> None:
    del bpy.types.Object.swag_labels
