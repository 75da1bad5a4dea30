"""Geometry nodes with which an object shows its splats, and how a scene renders them.

Two node groups show the colors of splat_colors.py:
- native (NATIVE), from Blender 5.3: Blender itself draws the splats, by chance where they are transparent, so that a
  picture has noise that more samples remove, and in linear light.
- own shapes (NAME), in earlier versions, and in 5.3 where the user asks for "Exact Shapes": the nodes make shapes whose
  material is the Gaussian.

An own shape is one of:
- renders ("Face Camera"): a rectangle parallel to the image plane through each splat's centre, with the projected
  Gaussian on it (EWA splatting, Zwicker et al. 2001, as in Kerbl et al. 2023). Cycles blends the splats by depth, with
  the alpha of the training, and EEVEE blends them in the order of the mesh's faces, which are sorted by depth: the
  image is that of the engine up to rounding. EEVEE draws one splat object completely in front of another.
- otherwise: a sphere scaled and rotated to the three-sigma ellipsoid, right from every direction. With the hit point p
  in the sphere's own space (where 1 is three sigma) and the unit viewing direction v,
      alpha = opacity exp(-4.5 d^2),   d^2 = p.p - (p.v)^2,
  with the distance d of the ray from the centre: the largest value of the 3D Gaussian along the ray.
- in the viewport ("Points in Viewport"): colored points, smaller for fainter splats, fast for any number.

Both groups give viewports the points without anything to draw unless an input asks for more: swag_blender/viewport
draws the splats there, as trained and without noise.

Training blends sRGB values. Two ways to blend the own shapes:
- linear light (default): colors are converted from sRGB and blended as light, as Cycles and EEVEE do with everything.
  Right beside other objects, under the view transform Standard, but semi-transparent splats in front of others are
  lighter than in training.
- sRGB values ("Blend Display Values"): the values are not converted; under the view transform Raw the image is that of
  training. For images of splats alone, such as comparisons with photos.
"""

from collections.abc import Sequence
from typing import Any, cast

import bpy

from ..blender_types import present
from . import point_material, splat_colors, splat_shapes
from .build import Field, add, add_input, add_socket, alpha, arranged, attribute, by_name, new_tree, stored, switch
from .formulas import by_channel, to_light
from .splat_colors import BLEND_DISPLAY

NAME = "SWAG Splat Preview"
NATIVE = "SWAG Native Splats"
HAS_NATIVE = "type" in bpy.types.PointCloud.bl_rna.properties
"""Whether this Blender draws splats itself: from 5.3."""
BACKGROUND_KEY = "swag_background"
"""Property of a splat object: the sRGB background color of its training (see background.py)."""

PIXEL_SIZE = "Pixel Size"
FACE_CAMERA = "Face Camera"
POINTS_IN_VIEWPORT = "Points in Viewport"
RENDERED_IN_VIEWPORT = "Rendered in Viewport"


def ensure_modifier(obj: bpy.types.Object) -> None:
    """Give a splat object the nodes that show it, where it has none; native ones where Blender draws splats itself."""
    if modifier_of(obj) is None:
        modifier = cast(bpy.types.NodesModifier, obj.modifiers.new("SWAG Splats", "NODES"))
        modifier.node_group = node_group(HAS_NATIVE)


def modifier_of(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The modifier that shows a splat object; None where it was removed or never added."""
    for modifier in obj.modifiers:
        if is_preview(modifier):
            return cast(bpy.types.NodesModifier, modifier)
    return None


def is_preview(modifier: bpy.types.Modifier) -> bool:
    """Whether a modifier shows splats, also one of an earlier version."""
    group = modifier.node_group if isinstance(modifier, bpy.types.NodesModifier) else None
    return group is not None and group.name.startswith((NAME, NATIVE))


def is_native(obj: bpy.types.Object) -> bool:
    """Whether Blender itself draws the splats of an object in renders."""
    modifier = modifier_of(obj)
    return HAS_NATIVE and (modifier is None or present(modifier.node_group).name.startswith(NATIVE))


def use_shapes(obj: bpy.types.Object, shapes: bool) -> bool:
    """Have renders draw a splat object by own shapes, or natively, with the present node groups.

    Returns:
        Whether the modifier has other nodes now. Its inputs keep their values; if the nodes were those of an earlier
        version, drivers have to be made again.
    """
    modifier, group = modifier_of(obj), node_group(HAS_NATIVE and not shapes)
    if modifier is None or modifier.node_group == group:
        return False
    values = read_inputs(obj)
    modifier.node_group = group
    for name, value in values.items():
        set_input(obj, name, value)
    return True


def set_input(
    obj: bpy.types.Object, name: str, value: float | bool | Sequence[float] | bpy.types.Object | None
) -> None:
    """Set an input of the object's preview by its name; does nothing without a preview."""
    if (found := _input(obj, name)) is not None:
        owner, path, _ = found
        if path == "value":
            owner.value = value
        else:
            owner[path] = value
        obj.update_tag()


def follow_objects(obj: bpy.types.Object) -> None:
    """Make the preview follow the objects that its inputs name, when these change.

    Blender looks for such objects when a modifier gets a node group, and not when a script sets an input.
    """
    if (modifier := modifier_of(obj)) is not None:
        modifier.node_group = modifier.node_group


def input_path(obj: bpy.types.Object, name: str) -> str:
    """Data path of an input of the object's preview, for drivers; "" without a preview."""
    if (found := _input(obj, name)) is None:
        return ""
    return f'modifiers["{bpy.utils.escape_identifier(present(modifier_of(obj)).name)}"]{found[2]}'


def draw_input(layout: bpy.types.UILayout, obj: bpy.types.Object, name: str) -> None:
    """Draw an input of the object's preview in a panel."""
    if (found := _input(obj, name)) is not None:
        owner, path, _ = found
        layout.prop(owner, path if path == "value" else f'["{path}"]', text=name)


def _input(obj: bpy.types.Object, name: str) -> tuple[Any, str, str] | None:
    """Owner of an input's value, its name there ("value": a property, else a key), its data path in the modifier."""
    if (modifier := modifier_of(obj)) is None:
        return None
    items: Any = _items(modifier)
    key = next((i.identifier for i in items if i.name == name and getattr(i, "in_out", "") == "INPUT"), None)
    if key is None:  # a preview of an earlier version, which lacks this input
        return None
    if hasattr(modifier, "properties"):  # Blender 5.2 and later
        return getattr(cast(Any, modifier).properties.inputs, key), "value", f".properties.inputs.{key}.value"
    return modifier, key, f'["{key}"]'


def _items(modifier: bpy.types.NodesModifier) -> Any:
    """The inputs and outputs of the preview; their types differ by kind."""
    return present(present(modifier.node_group).interface).items_tree


def read_inputs(obj: bpy.types.Object) -> dict[str, Any]:
    """Values of the inputs of the object's preview by name; empty without a preview."""
    values = {}
    for item in _items(modifier) if (modifier := modifier_of(obj)) is not None else ():
        if getattr(item, "in_out", "") == "INPUT" and item.socket_type != "NodeSocketGeometry":
            owner, path, _ = present(_input(obj, item.name))
            value = owner.value if path == "value" else owner[path]
            values[item.name] = tuple(value) if hasattr(value, "__len__") else value
    return values


def copy_inputs(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Copy the inputs of the preview of one splat object to another."""
    for name, value in read_inputs(source).items():
        set_input(target, name, value)


def remember_training(obj: bpy.types.Object, pixel_size: float, background: Sequence[float]) -> None:
    """Store with the splats how they were trained, so that renders look the same.

    Args:
        obj: a splat object.
        pixel_size: 1 / focal length in pixels of the training images.
        background: sRGB background color (3,) of the training.
    """
    set_input(obj, PIXEL_SIZE, pixel_size)
    obj[BACKGROUND_KEY] = [float(value) for value in background]


def pixel_size_of(obj: bpy.types.Object) -> float:
    """1 / focal length in pixels of the training images of a splat object; 0 where that is not known."""
    if (found := _input(obj, PIXEL_SIZE)) is None:
        return 0.0
    owner, path, _ = found
    return owner.value if path == "value" else owner[path]


def prepare_render(scene: bpy.types.Scene, display_values: bool, engine: str = "CYCLES") -> None:
    """Set up Cycles or EEVEE so that renders show splats completely and in their own colors.

    Args:
        scene: its splat objects are set to the same way of blending.
        display_values: whether to blend sRGB values and not linear light.
        engine: "CYCLES" or "EEVEE".
    """
    eevee = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"
    cast(Any, scene.render).engine = eevee if engine == "EEVEE" else "CYCLES"
    # A ray crosses hundreds of semi-transparent splats. The minimum prevents Cycles from ending rays at random, so that
    # alphas are blended exactly and samples only antialias.
    cycles = cast(Any, scene).cycles
    cycles.transparent_max_bounces = cycles.min_transparent_bounces = 1024
    cycles.max_bounces = 0
    cycles.use_denoising = False
    view_settings: Any = scene.view_settings
    view_settings.view_transform = "Raw" if display_values else "Standard"
    view_settings.look = "None"
    view_settings.exposure, view_settings.gamma = 0.0, 1.0
    for obj in scene.objects:
        if display_values or read_inputs(obj).get(BLEND_DISPLAY):
            use_shapes(obj, display_values)
        set_input(obj, BLEND_DISPLAY, display_values)


def node_group(native: bool) -> bpy.types.NodeTree:
    """The geometry nodes of native splats or of own shapes; made once per file."""
    name = NATIVE if native else NAME
    known = bpy.data.node_groups.get(name)
    if known is not None and known.library is None:
        if _is_current(known):
            return known
        known.name = f"{name} of an earlier version"
    tree = new_tree(name, "GeometryNodeTree")
    cast(bpy.types.GeometryNodeTree, tree).is_modifier = True
    # The same inputs in the same order in both groups: Blender keeps their values and drivers when one replaces the
    # other.
    add_socket(tree, "Geometry", "Geometry", "OUTPUT")
    add_socket(tree, "Geometry", "Geometry")
    splat_colors.add_inputs(tree)
    _add_inputs(tree)
    inputs = by_name(add(tree, "NodeGroupInput").outputs)
    in_viewport = Field(add(tree, "GeometryNodeIsViewport").outputs[0])
    plain = splat_shapes.no_shape(tree, _as_points(tree, inputs["Geometry"]))
    colored = splat_colors.colored(tree, inputs, for_shapes=True)
    if native:
        rendered = in_rendered = splat_colors.colored(tree, inputs, for_shapes=False)
    else:
        in_rendered, rendered = _shapes(tree, inputs, _as_points(tree, colored))
    shown = switch(tree, inputs[POINTS_IN_VIEWPORT], plain, _points(tree, colored))
    shown = switch(tree, inputs[RENDERED_IN_VIEWPORT], shown, in_rendered)
    add(tree, "NodeGroupOutput", Geometry=switch(tree, in_viewport, rendered, shown))
    arranged(tree)
    return tree


def has_current_nodes(obj: bpy.types.Object) -> bool:
    """Whether the modifier of a splat object has nodes of this version of Blender and of the extension."""
    modifier = modifier_of(obj)
    return modifier is not None and _is_current(present(modifier.node_group))


def _is_current(group: bpy.types.NodeTree) -> bool:
    """Whether a node group is of this version: earlier ones compute colors without a group, or have other types."""
    kinds = {node.bl_idname for node in group.nodes}
    return "GeometryNodeGroup" in kinds and ("GeometryNodePointsSetType" in kinds) == HAS_NATIVE


def _add_inputs(tree: bpy.types.NodeTree) -> None:
    text = "Blend sRGB values as training does; needs the view transform Raw, and no other objects"
    add_input(tree, BLEND_DISPLAY, "Bool", text, False)
    text = "1 / focal length in pixels of the training images: widens splats as in training; 0: off"
    add_input(tree, PIXEL_SIZE, "Float", text, 0.0, 0.0, 1.0)
    text = "Render splats exactly as seen from the active camera; off: ellipsoids, for every direction"
    add_input(tree, FACE_CAMERA, "Bool", text, True)
    add_input(tree, POINTS_IN_VIEWPORT, "Bool", "Draw colored points in viewports", False)
    text = "Have viewports draw the splats as renders do, for Rendered shading"
    add_input(tree, RENDERED_IN_VIEWPORT, "Bool", text, False)


def _as_points(tree: bpy.types.NodeTree, geometry: Field) -> Field:
    """The points of splats as ordinary points, which Blender does not draw as splats."""
    if not HAS_NATIVE:
        return geometry
    return Field(add(tree, "GeometryNodePointsSetType", Points=geometry, Type="Points").outputs["Points"])


def _points(tree: bpy.types.NodeTree, geometry: Field) -> Field:
    """Colored splats as opaque points."""
    base = attribute(tree, splat_colors.BASE, "FLOAT_COLOR")
    light = by_channel(tree, to_light, splat_colors.display_color(base))
    geometry = stored(tree, _as_points(tree, geometry), point_material.COLOR, "FLOAT_VECTOR", light)
    return splat_shapes.points(tree, geometry, alpha(tree, base))


def _shapes(tree: bpy.types.NodeTree, inputs: dict[str, Field], geometry: Field) -> tuple[Field, Field]:
    """The shapes of colored splats in viewports, and those in renders."""
    base = attribute(tree, splat_colors.BASE, "FLOAT_COLOR")
    color, opacity = splat_colors.display_color(base), alpha(tree, base)
    color = switch(tree, inputs[BLEND_DISPLAY], by_channel(tree, to_light, color), color, "VECTOR")
    geometry = stored(tree, geometry, point_material.COLOR, "FLOAT_VECTOR", color)
    geometry = stored(tree, geometry, splat_shapes.OPACITY, "FLOAT", opacity)
    position = Field(add(tree, "GeometryNodeInputPosition").outputs[0])
    camera = Field(add(tree, "GeometryNodeInputActiveCamera").outputs[0])
    view = add(tree, "GeometryNodeObjectInfo", {"transform_space": "RELATIVE"}, Object=camera).outputs
    ray = position - Field(view["Location"])
    ellipsoids = splat_shapes.ellipsoids(tree, geometry, ray, view, inputs[PIXEL_SIZE])
    facing = splat_shapes.rectangles(tree, geometry, position, camera, opacity, inputs[PIXEL_SIZE])
    # The view of a viewport is seldom the active camera's, which rectangles face.
    return ellipsoids, switch(tree, inputs[FACE_CAMERA], ellipsoids, facing)
