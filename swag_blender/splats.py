"""Splats as Blender objects, in the point-cloud schema that Blender 5.3 renders natively.

Attributes of the point cloud, all on points: `position`; `scale` (linear sigma); `rotation` (quaternion wxyz);
`radiance:base` (x y z the raw degree-0 coefficient, w the opacity 0..1); `radiance:sh_0` ... (one RGB coefficient
each); `radius` (mean sigma: for exporters and point display); `swag:NAME` for each extra property (labels, scores);
`swag_shaped_at` (the position for which scale, rotation and harmonics are right: see moved_points.py).

The points keep the coordinates of training (the COLMAP world); the object's transform places them in Blender.
"""

import contextlib
import math
from collections.abc import Iterator
from typing import Any, cast

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.base.errors import InputError
from ..swag_engine.splats.follow_points import follow_points
from ..swag_engine.splats.splats import Splats, concatenate
from . import display
from .blender_types import present
from .nodes import splat_preview
from .nodes.splat_colors import BASE

OWN_PREFIX = "swag:"
SHAPED_AT = "swag_shaped_at"
"""Attribute with the positions for which sizes, rotations and harmonics are right; operators of Blender move others."""
ORIGIN_KEY = "swag_origin"
"""Property of splats far from the zero of their scene or file: what was subtracted from its coordinates, as doubles."""
FILE_FRAME = Matrix.Rotation(math.radians(-90), 4, "X")
"""Matrix from file to Blender world without an imported scene: a PLY has y down, which viewers show upright."""
_VALUE_PROPERTIES = ("color", "vector", "value")
"""Properties that hold the value of an attribute's element; a type of attribute has one of them."""

_changes: dict[int, int] = {}
"""Number of changes of each point cloud, by its session number."""


def is_splats(obj: bpy.types.Object | None) -> bool:
    """Whether the object is a point cloud that carries splats."""
    return obj is not None and isinstance(obj.data, bpy.types.PointCloud) and BASE in obj.data.attributes


def pointcloud_of(obj: bpy.types.Object) -> bpy.types.PointCloud:
    """The point cloud of a splat object."""
    assert isinstance(obj.data, bpy.types.PointCloud)
    return obj.data


def count(obj: bpy.types.Object) -> int:
    """Number of splats of a splat object, without its modifiers."""
    return len(pointcloud_of(obj).points)


def positions(obj: bpy.types.Object) -> np.ndarray:
    """Centres (N, 3) float32 of the splats in the object's own space, without its modifiers."""
    return _read(pointcloud_of(obj).attributes["position"], 3)


def scales(obj: bpy.types.Object) -> np.ndarray:
    """Standard deviations (N, 3) float32 of the splats in the object's own space, without its modifiers."""
    return _read(pointcloud_of(obj).attributes["scale"], 3)


def base(obj: bpy.types.Object) -> np.ndarray:
    """Coefficients of degree 0 and opacities 0..1, (N, 4) float32, of the splats, without the object's modifiers."""
    return _read(pointcloud_of(obj).attributes[BASE], 4)


def find_rows(positions: np.ndarray, known_positions: np.ndarray) -> np.ndarray | None:
    """Index (N,) of each splat among known ones, found by its position; None where one is not among them.

    Args:
        positions: (N, 3) float32 centres of some of the known splats.
        known_positions: (M, 3) float32 centres of the known splats.
    """
    own, known = _keys(positions), _keys(known_positions)
    if not len(known):
        return None
    order = np.argsort(known)
    found = order[np.minimum(np.searchsorted(known[order], own), len(order) - 1)]
    return found if np.array_equal(known_positions[found], positions) else None


def _keys(positions: np.ndarray) -> np.ndarray:
    """A number (N,) uint64 for each position (N, 3) float32, which is the same for equal positions."""
    bits = np.ascontiguousarray(positions + np.float32(0), np.float32).view(np.uint32).astype(np.uint64)
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    return (bits * factors).sum(axis=1, dtype=np.uint64)


def select_only(context: bpy.types.Context, objects: list[bpy.types.Object]) -> None:
    """Select these objects and no others, and make the last one active."""
    for obj in list(context.selected_objects):
        obj.select_set(False)
    for obj in objects:
        obj.select_set(True)
        present(context.view_layer).objects.active = obj


def new_splat_object(
    name: str, splats: Splats, collection: bpy.types.Collection, parent: bpy.types.Object | None = None
) -> bpy.types.Object:
    """Make an object of splats, with the nodes that show it.

    Args:
        name: of the object and its point cloud.
        splats: what it holds.
        collection: where it is linked.
        parent: usually the root of an imported scene, whose local frame is the COLMAP world.
    """
    obj = bpy.data.objects.new(name, _pointcloud(name, splats))
    collection.objects.link(obj)
    _remember_origin(obj, splats)
    obj.parent = parent
    splat_preview.ensure_modifier(obj)
    display.apply(obj)
    return obj


def replace_splats(obj: bpy.types.Object, splats: Splats) -> None:
    """Give the object other splats (any number of them); transform, parent, modifiers and object name stay."""
    _remember_origin(obj, splats)
    old = pointcloud_of(obj)
    if hasattr(old, "resize"):  # Blender 5.2 and later
        _fill(old, splats)
        mark_changed(old)
    else:
        _replace_data(obj, _pointcloud(old.name, splats))


def _remember_origin(obj: bpy.types.Object, splats: Splats) -> None:
    if any(splats.origin):
        obj[ORIGIN_KEY] = list(splats.origin)


def keep_splats(obj: bpy.types.Object, chosen: np.ndarray) -> None:
    """Remove all splats of an object but those of a mask (N,) bool; all point attributes and materials stay."""
    old = pointcloud_of(obj)
    made = new_pointcloud(old.name, positions(obj)[chosen])
    _make_native(made)
    for material in old.materials:
        made.materials.append(material)
    copy_attributes(old, made, chosen)
    _replace_data(obj, made)


def exchange_splats(obj: bpy.types.Object, kept: np.ndarray, added: Splats | None) -> None:
    """Remove all splats of an object but those of a mask, and append others.

    Further attributes of the kept splats, such as masks, stay; those of the appended ones are zero.

    Args:
        obj: a splat object.
        kept: mask (N,) bool.
        added: the splats to append, None for none.
    """
    old = pointcloud_of(obj)
    further = [
        (attribute.name, attribute.data_type, _values(attribute)[kept])
        for attribute in old.attributes
        if attribute.domain == "POINT" and attribute.data_type != "STRING" and not _is_of_splats(attribute)
    ]
    rest = read_splats(obj).subset(kept)
    # Without splats that stay, the degree and the extras are those of the new ones.
    parts = [part for part in (rest, added) if part is not None and len(part)] or [rest]
    replace_splats(obj, concatenate(parts))
    made = pointcloud_of(obj)
    attributes: Any = made.attributes
    for name, kind, _ in further:
        attributes.new(name, kind, "POINT")
    for name, _, values in further:
        padded = np.zeros((len(made.points), values.shape[1]), values.dtype)
        padded[: len(values)] = values
        attributes[name].data.foreach_set(_value_property(attributes[name]), padded.ravel())
    mark_changed(made)


def _is_of_splats(attribute: Any) -> bool:
    """Whether `_fill` writes an attribute of this name and type."""
    name = attribute.name
    own = name.startswith(OWN_PREFIX) and attribute.data_type in {"FLOAT", "INT"}
    return own or name.startswith("radiance:") or name in ("position", "scale", "rotation", "radius", SHAPED_AT)


def copy_attributes(source: bpy.types.PointCloud, target: bpy.types.PointCloud, chosen: np.ndarray) -> None:
    """Copy the point attributes of some points to a point cloud that has as many; text attributes are left out.

    Args:
        source: point cloud of N points.
        target: point cloud with as many points as are chosen.
        chosen: mask (N,) bool.
    """
    attributes: Any = target.attributes
    copied = [a for a in source.attributes if a.domain == "POINT" and a.data_type != "STRING"]
    # Adding an attribute can move the data of others: all are made before any is written.
    for attribute in copied:
        if attribute.name not in attributes:
            attributes.new(attribute.name, attribute.data_type, "POINT")
    for attribute in copied:
        values = _values(attribute)[chosen]
        attributes[attribute.name].data.foreach_set(_value_property(attribute), values.ravel())


def _values(attribute: Any) -> np.ndarray:
    """Values (N, components) of a point attribute of any type but text."""
    field = _value_property(attribute)
    described: Any = attribute.bl_rna.properties["data"].fixed_type.properties[field]
    dtype = {"BOOLEAN": bool, "INT": np.int32}.get(described.type, np.float32)
    width = max(described.array_length, 1)
    values = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(field, values)
    return values.reshape(-1, width)


def _replace_data(obj: bpy.types.Object, made: bpy.types.PointCloud) -> None:
    """Give the object another point cloud, which takes the name of the old one where nothing else uses that."""
    old = pointcloud_of(obj)
    name = old.name
    obj.data = made
    if old.users == 0:
        bpy.data.pointclouds.remove(old)
        made.name = name


def mark_changed(pointcloud: bpy.types.PointCloud) -> None:
    """Note that attributes of a point cloud were written, so that Blender and the viewport's drawing show it."""
    _changes[cast(Any, pointcloud).session_uid] = changes_of(pointcloud) + 1
    pointcloud.update_tag()


def changes_of(pointcloud: bpy.types.PointCloud) -> int:
    """Number of times that `mark_changed` was called for a point cloud in this session."""
    return _changes.get(cast(Any, pointcloud).session_uid, 0)


def read_splats(obj: bpy.types.Object) -> Splats:
    """The splats of the object in its own frame, without its transform and modifiers."""
    return splats_of(pointcloud_of(obj))


def read_modified_splats(obj: bpy.types.Object, *masks: str) -> tuple[Splats, list[np.ndarray]]:
    """The splats of the object in its own frame with its modifiers applied, except the preview; and masks of them.

    Modifiers that are off in the viewport do not count. Splats turn and scale with points that affine maps moved, and
    are only shifted by other modifiers.

    Args:
        obj: a splat object.
        *masks: names of BOOLEAN attributes.

    Returns:
        The splats, and the values (N,) bool of each of these attributes: False where the object does not have it.

    Raises:
        InputError: the modifiers leave no splats.
    """
    with _modified(obj) as pointcloud:
        return splats_of(pointcloud), [_read_mask(pointcloud, mask) for mask in masks]


def count_only_shifted(obj: bpy.types.Object) -> int:
    """Number of splats that the object's modifiers move by no affine map: their sizes and rotations are as before.

    Raises:
        InputError: the modifiers leave no splats.
    """
    with _modified(obj) as pointcloud:
        return len(_followed(pointcloud)[1])


@contextlib.contextmanager
def _modified(obj: bpy.types.Object) -> Iterator[bpy.types.PointCloud]:
    """The point cloud of a splat object with its modifiers applied, except the preview.

    Raises:
        InputError: the modifiers leave no splats.
    """
    previews = [each for each in obj.modifiers if each.show_viewport and splat_preview.is_preview(each)]
    if not has_other_modifiers(obj):
        yield pointcloud_of(obj)
        return
    try:
        for modifier in previews:
            modifier.show_viewport = False
        data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        if not isinstance(data, bpy.types.PointCloud) or BASE not in data.attributes or not len(data.points):
            raise InputError(f"The modifiers of {obj.name} leave no splats; turn them off in the viewport.")
        yield data
    finally:
        for modifier in previews:
            modifier.show_viewport = True


def shown_pointcloud(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bpy.types.PointCloud:
    """The point cloud of a splat object with its modifiers applied, where they leave splats in viewports."""
    if has_other_modifiers(obj):
        evaluated = obj.evaluated_get(depsgraph).data
        if isinstance(evaluated, bpy.types.PointCloud) and BASE in evaluated.attributes and len(evaluated.points):
            return evaluated
    return pointcloud_of(obj)


def has_other_modifiers(obj: bpy.types.Object) -> bool:
    """Whether a splat object has modifiers besides the preview that are on in viewports."""
    return any(modifier.show_viewport and not splat_preview.is_preview(modifier) for modifier in obj.modifiers)


def find_with(scene: bpy.types.Scene, active: bpy.types.Object | None, key: str) -> bpy.types.Object | None:
    """The active object if it has a custom property of that name, else the scene's first splat object that has it."""
    if active is not None and active.get(key) is not None:
        return active
    return next((obj for obj in scene.objects if obj.get(key) is not None and is_splats(obj)), None)


def splats_of(pointcloud: bpy.types.PointCloud) -> Splats:
    """The splats of a point cloud that has their attributes, turned and scaled with points that were moved."""
    return _followed(pointcloud)[0]


def _followed(pointcloud: bpy.types.PointCloud) -> tuple[Splats, np.ndarray]:
    """The splats of a point cloud, turned and scaled with their points, and the rows (M,) that could not follow."""
    own = _splats_as_stored(pointcloud)
    shaped_at = pointcloud.attributes.get(SHAPED_AT)
    return (own, np.empty(0, int)) if shaped_at is None else follow_points(own, _read(shaped_at, 3))


def follow_points_of(pointcloud: bpy.types.PointCloud) -> int:
    """Write the sizes, rotations and harmonics that follow the points of a point cloud of splats, where they moved.

    Points without size, which came from a point cloud that had no splats, become grey balls of their radius.

    Returns:
        Number of splats that were moved by no affine map, and are only shifted.
    """
    attributes: Any = pointcloud.attributes
    position = _read(attributes["position"], 3)
    if SHAPED_AT not in attributes:
        # Adding an attribute can move the data of others.
        _write(attributes.new(SHAPED_AT, "FLOAT_VECTOR", "POINT"), position)
        return 0
    shaped_at = _read(attributes[SHAPED_AT], 3)
    if np.array_equal(position, shaped_at):
        return 0
    own = _splats_as_stored(pointcloud)
    foreign = ~own.scales.any(axis=1)
    own.rotations[foreign] = (1, 0, 0, 0)
    if "radius" in attributes:
        own.scales[foreign] = _read(attributes["radius"], 1)[foreign]
    own.opacities[foreign] = 1
    shaped_at[foreign] = position[foreign]
    made, unexplained = follow_points(own, shaped_at)
    for name, _, values in _attribute_values(made):
        if name in attributes and not name.startswith(OWN_PREFIX):
            _write(attributes[name], values)
    mark_changed(pointcloud)
    return len(unexplained)


def _splats_as_stored(pointcloud: bpy.types.PointCloud) -> Splats:
    attributes = pointcloud.attributes
    base = _read(attributes[BASE], 4)
    sh = [base[:, :3]]
    while (attribute := attributes.get(f"radiance:sh_{len(sh) - 1}")) is not None:
        sh.append(_read(attribute, 3))
    # A modifier can remove coefficients: only complete degrees count.
    sh = sh[: math.isqrt(len(sh)) ** 2]
    own = [a for a in attributes if a.name.startswith(OWN_PREFIX) and a.data_type in {"FLOAT", "INT"}]
    return Splats(
        positions=_read(attributes["position"], 3),
        rotations=_read(attributes["rotation"], 4),
        scales=_read(attributes["scale"], 3),
        opacities=base[:, 3].copy(),
        sh=np.stack(sh, axis=1),
        extras={a.name.removeprefix(OWN_PREFIX): _read(a, 1)[:, 0] for a in own},
    )


def _read_mask(pointcloud: bpy.types.PointCloud, name: str) -> np.ndarray:
    values = np.zeros(len(pointcloud.points), bool)
    attribute: Any = pointcloud.attributes.get(name)
    if attribute is not None and attribute.data_type == "BOOLEAN":
        attribute.data.foreach_get("value", values)
    return values


def new_pointcloud(name: str, positions: np.ndarray) -> bpy.types.PointCloud:
    """A point cloud with `position` set from (N, 3) float32 and no further attributes."""
    pointcloud = bpy.data.pointclouds.new(name)
    if hasattr(pointcloud, "resize"):  # Blender 5.2 and later
        pointcloud.resize(len(positions))
    else:
        bpy.data.pointclouds.remove(pointcloud)
        pointcloud = _converted_from_mesh(name, len(positions))
    _write(pointcloud.attributes["position"], positions)
    return pointcloud


def _converted_from_mesh(name: str, count: int) -> bpy.types.PointCloud:
    # A mesh of loose vertices converts to a point cloud. The scene is separate so that the user's selection, view layer
    # and undo history stay as they are.
    scene = bpy.data.scenes.new(name)
    layer = scene.view_layers[0]
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(max(count, 1))
    obj = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(obj)
    layer.objects.active = obj
    selection: dict[str, Any] = {
        "active_object": obj,
        "object": obj,
        "selected_objects": [obj],
        "selected_editable_objects": [obj],
    }
    with bpy.context.temp_override(scene=scene, view_layer=layer, **selection):
        bpy.ops.object.convert(target="POINTCLOUD")
    pointcloud = pointcloud_of(obj)
    bpy.data.objects.remove(obj)
    bpy.data.scenes.remove(scene)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    for extra in [a.name for a in pointcloud.attributes if a.name != "position" and not a.is_required]:
        pointcloud.attributes.remove(pointcloud.attributes[extra])
    pointcloud.name = name
    return pointcloud


def _pointcloud(name: str, splats: Splats) -> bpy.types.PointCloud:
    pointcloud = new_pointcloud(name, splats.positions)
    _fill(pointcloud, splats)
    return pointcloud


def _fill(pointcloud: bpy.types.PointCloud, splats: Splats) -> None:
    """Give a point cloud the splats and no other attributes; before Blender 5.2 it has their number of points."""
    if hasattr(pointcloud, "resize"):
        pointcloud.resize(len(splats.positions))
    attributes: Any = pointcloud.attributes
    values = _attribute_values(splats)
    kept = {attribute for attribute, _, _ in values}
    for name in [a.name for a in attributes if a.name not in kept and not a.is_required]:
        attributes.remove(attributes[name])
    # Adding an attribute can move the data of others: all are made before any is written.
    for attribute, kind, _ in values:
        if attribute not in attributes:
            attributes.new(attribute, kind, "POINT")
    for attribute, _, value in values:
        _write(attributes[attribute], value)
    _make_native(pointcloud)


def fit_to_version(pointcloud: bpy.types.PointCloud) -> None:
    """Give a point cloud of splats the types that this version of Blender draws as splats."""
    attributes: Any = pointcloud.attributes
    if splat_preview.HAS_NATIVE and attributes[BASE].data_type != _base_type():
        values = _read(attributes[BASE], 4)
        attributes.remove(attributes[BASE])
        _write(attributes.new(BASE, _base_type(), "POINT"), values)
        mark_changed(pointcloud)
    _make_native(pointcloud)


def lacks_colors(obj: bpy.types.Object) -> bool:
    """Whether an object was splats and lost their colors, which have a type that this version does not know."""
    if not isinstance(obj.data, bpy.types.PointCloud):
        return False
    has = obj.data.attributes
    return BASE not in has and "scale" in has and "rotation" in has


def _base_type() -> str:
    types = cast(Any, bpy.types.Attribute).bl_rna.properties["data_type"].enum_items
    return "FLOAT4" if "FLOAT4" in types else "FLOAT_COLOR"


def _make_native(pointcloud: bpy.types.PointCloud) -> None:
    """Have Blender draw the points as splats where it can."""
    if splat_preview.HAS_NATIVE:
        cast(Any, pointcloud).type = "GAUSSIAN_SPLAT"


def _attribute_values(splats: Splats) -> list[tuple[str, str, np.ndarray]]:
    """Name, type and values of each attribute of splats."""
    base = np.concatenate([splats.sh[:, 0], splats.opacities[:, None]], axis=1)
    values = [
        ("position", "FLOAT_VECTOR", splats.positions),
        ("scale", "FLOAT_VECTOR", splats.scales),
        ("rotation", "QUATERNION", splats.rotations),
        (BASE, _base_type(), base),
        (SHAPED_AT, "FLOAT_VECTOR", splats.positions),
        ("radius", "FLOAT", splats.scales.mean(axis=1)),
    ]
    values += [(f"radiance:sh_{k - 1}", "FLOAT_VECTOR", splats.sh[:, k]) for k in range(1, splats.sh.shape[1])]
    for own, value in splats.extras.items():
        values.append((OWN_PREFIX + own, "INT" if np.issubdtype(value.dtype, np.integer) else "FLOAT", value))
    return values


def _value_property(attribute: Any) -> str:
    properties = attribute.bl_rna.properties["data"].fixed_type.properties
    return next(name for name in _VALUE_PROPERTIES if name in properties)


def _write(attribute: Any, values: np.ndarray) -> None:
    dtype = np.int32 if attribute.data_type == "INT" else np.float32
    attribute.data.foreach_set(_value_property(attribute), np.ascontiguousarray(values, dtype=dtype).ravel())


def _read(attribute: Any, width: int) -> np.ndarray:
    dtype = np.int32 if attribute.data_type == "INT" else np.float32
    values = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(_value_property(attribute), values)
    return values.reshape(-1, width)
