"""Splats as Blender objects, in the point-cloud schema that Blender 5.3 renders natively.

Attributes of the point cloud, all on points: `position`; `scale` (linear sigma); `rotation` (quaternion wxyz);
`radiance:base` (x y z the raw degree-0 coefficient, w the opacity 0..1); `radiance:sh_0` ... (one RGB coefficient
each); `radius` (mean sigma: for exporters and point display); `swag:NAME` for each extra property (labels, scores).

The points keep the coordinates of training (the COLMAP world); the object's transform places them in Blender.
"""

import math
from typing import Any, cast

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.base.errors import InputError
from ..swag_engine.splats.splats import Splats
from .blender_types import present
from .nodes import splat_preview

BASE = "radiance:base"
OWN_PREFIX = "swag:"
FILE_FRAME = Matrix.Rotation(math.radians(-90), 4, "X")
"""Matrix from file to Blender world without an imported scene: a PLY has y down, which viewers show upright."""
_VALUE_PROPERTIES = ("color", "vector", "value")
"""Properties that hold the value of an attribute's element; a type of attribute has one of them."""


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
    """Make an object of splats, with the preview where Blender has no native splats.

    Args:
        name: of the object and its point cloud.
        splats: what it holds.
        collection: where it is linked.
        parent: usually the root of an imported scene, whose local frame is the COLMAP world.
    """
    obj = bpy.data.objects.new(name, _pointcloud(name, splats))
    collection.objects.link(obj)
    obj.parent = parent
    if not hasattr(obj.data, "type"):
        splat_preview.add_modifier(obj)
    return obj


def replace_splats(obj: bpy.types.Object, splats: Splats) -> None:
    """Give the object other splats (any number of them); transform, parent, modifiers and object name stay."""
    old = pointcloud_of(obj)
    if hasattr(old, "resize"):  # Blender 5.2 and later
        _fill(old, splats)
        return
    name = old.name
    obj.data = _pointcloud(name, splats)
    if old.users == 0:
        bpy.data.pointclouds.remove(old)
        pointcloud_of(obj).name = name


def read_splats(obj: bpy.types.Object) -> Splats:
    """The splats of the object in its own frame, without its transform and modifiers."""
    return _splats_of(pointcloud_of(obj))


def read_modified_splats(obj: bpy.types.Object) -> Splats:
    """The splats of the object in its own frame with its modifiers applied, except the preview.

    Modifiers that are off in the viewport do not count. A modifier that moves points moves splats; sizes, rotations
    and colours are those of the attributes. Raises InputError when the modifiers leave no splats.
    """
    shown = [modifier for modifier in obj.modifiers if modifier.show_viewport]
    previews = [modifier for modifier in shown if _is_preview(modifier)]
    if len(previews) == len(shown):
        return read_splats(obj)
    try:
        for modifier in previews:
            modifier.show_viewport = False
        data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        if not isinstance(data, bpy.types.PointCloud) or BASE not in data.attributes or not len(data.points):
            raise InputError(f"The modifiers of {obj.name} leave no splats; turn them off in the viewport.")
        return _splats_of(data)
    finally:
        for modifier in previews:
            modifier.show_viewport = True


def _is_preview(modifier: bpy.types.Modifier) -> bool:
    group = modifier.node_group if isinstance(modifier, bpy.types.NodesModifier) else None
    return group is not None and group.name.startswith(splat_preview.NAME)


def _splats_of(pointcloud: bpy.types.PointCloud) -> Splats:
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
    base = np.concatenate([splats.sh[:, 0], splats.opacities[:, None]], axis=1)
    types = cast(Any, bpy.types.Attribute).bl_rna.properties["data_type"].enum_items
    attributes: Any = pointcloud.attributes
    values = [
        ("position", "FLOAT_VECTOR", splats.positions),
        ("scale", "FLOAT_VECTOR", splats.scales),
        ("rotation", "QUATERNION", splats.rotations),
        (BASE, "FLOAT4" if "FLOAT4" in types else "FLOAT_COLOR", base),
        ("radius", "FLOAT", splats.scales.mean(axis=1)),
    ]
    values += [(f"radiance:sh_{k - 1}", "FLOAT_VECTOR", splats.sh[:, k]) for k in range(1, splats.sh.shape[1])]
    for own, value in splats.extras.items():
        values.append((OWN_PREFIX + own, "INT" if np.issubdtype(value.dtype, np.integer) else "FLOAT", value))
    kept = {attribute for attribute, _, _ in values}
    for name in [a.name for a in attributes if a.name not in kept and not a.is_required]:
        attributes.remove(attributes[name])
    # Adding an attribute can move the data of others: all are made before any is written.
    for attribute, kind, _ in values:
        if attribute not in attributes:
            attributes.new(attribute, kind, "POINT")
    for attribute, _, value in values:
        _write(attributes[attribute], value)
    if hasattr(pointcloud, "type"):
        pointcloud.type = "GAUSSIAN_SPLAT"


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
