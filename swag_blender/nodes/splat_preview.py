"""Preview of splats by geometry nodes and a material, for Blender versions without native splats.

Color is computed once per splat, as splat renderers do: 0.5 + spherical harmonics of the direction from the scene's
active camera. The shape is drawn in one of three ways:
- renders ("Face Camera"): a rectangle parallel to the image plane through each splat's centre, with the projected
  Gaussian on it (EWA splatting, Zwicker et al. 2001, as in Kerbl et al. 2023). Cycles blends the splats by depth, with
  the alpha of the training, and EEVEE blends them in the order of the mesh's faces, which are sorted by depth: the
  image is that of the engine up to rounding. EEVEE draws one splat object completely in front of another.
- otherwise: a sphere scaled and rotated to the three-sigma ellipsoid, right from every direction. With the hit point p
  in the sphere's own space (where 1 is three sigma) and the unit viewing direction v,
      alpha = opacity exp(-4.5 d^2),   d^2 = p.p - (p.v)^2,
  with the distance d of the ray from the centre: the largest value of the 3D Gaussian along the ray.
- in the viewport ("Points in Viewport"): colored points, smaller for fainter splats, fast for any number.

In viewports the nodes give the points without any shape unless an input asks for points or shapes:
swag_blender/viewport draws the splats there, except in Rendered shading.

Training blends sRGB values. Two ways to blend here:
- linear light (default): colors are converted from sRGB and blended as light, as Cycles and EEVEE do with everything.
  Right beside other objects, under the view transform Standard, but semi-transparent splats in front of others are
  lighter than in training.
- sRGB values ("Blend Display Values"): the values are not converted; under the view transform Raw the image is that of
  training. For images of splats alone, such as comparisons with photos.
"""

from collections.abc import Sequence
from typing import Any, cast

import bpy
from mathutils import Color

from ..blender_types import present
from ..water_values import OF_DISPLAY, WaterValues
from . import point_material, splat_shapes
from .build import Field, add, add_socket, arranged, new_tree
from .formulas import SH_0, Water, by_channel, harmonics, mixed, to_display, to_light
from .splat_shapes import attribute, stored
from .water_shader import background_node

NAME = "SWAG Splat Preview"
HIDDEN, TINT = "swag:hidden", "swag:tint"
"""Point attributes: splats that are not drawn, and a color that is mixed in by its alpha (see labels.py)."""
BACKGROUND_KEY = "swag_background"
"""Property of a splat object: the sRGB background color of its training."""

SH_DEGREE = "SH Degree"
BLEND_DISPLAY = "Blend Display Values"
PIXEL_SIZE = "Pixel Size"
FACE_CAMERA = "Face Camera"
POINTS_IN_VIEWPORT = "Points in Viewport"
SHAPES_IN_VIEWPORT = "Shapes in Viewport"
DENSITY = "Viewport Density"
WATER = "Water"
CROP_BOX, CROP_HALF_EDGE = "Crop Box", "Crop Half Edge"


def add_modifier(obj: bpy.types.Object) -> bpy.types.NodesModifier:
    """Give a splat object the preview."""
    modifier = cast(bpy.types.NodesModifier, obj.modifiers.new(NAME, "NODES"))
    modifier.node_group = node_group()
    return modifier


def modifier_of(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The preview of a splat object; None if it was removed, or Blender draws the splats itself."""
    for modifier in obj.modifiers:
        if not isinstance(modifier, bpy.types.NodesModifier) or modifier.node_group is None:
            continue
        if modifier.node_group.name.startswith(NAME):
            return modifier
    return None


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


def copy_inputs(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Copy the inputs of the preview of one splat object to another."""
    if (modifier := modifier_of(source)) is None:
        return
    for item in _items(modifier):
        if getattr(item, "in_out", "") == "INPUT" and item.socket_type != "NodeSocketGeometry":
            owner, path, _ = present(_input(source, item.name))
            set_input(target, item.name, owner.value if path == "value" else owner[path])


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
    """Set up Cycles or EEVEE so that renders show splats completely, in their own colors, with their background.

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
        set_input(obj, BLEND_DISPLAY, display_values)
    stored_colors = (obj.get(BACKGROUND_KEY) for obj in scene.objects)
    background = next((color for color in stored_colors if color is not None), None)
    if background is not None:
        inputs: Any = background_node(scene).inputs
        for link in inputs["Color"].links:
            inputs["Color"].id_data.links.remove(link)
        color = Color(background)
        inputs["Color"].default_value = (*(color if display_values else color.from_srgb_to_scene_linear())[:], 1.0)
        inputs["Strength"].default_value = 1.0


def node_group() -> bpy.types.NodeTree:
    """The preview's geometry nodes; made once per file."""
    if (known := bpy.data.node_groups.get(NAME)) is not None:
        return known
    tree = new_tree(NAME, "GeometryNodeTree")
    cast(bpy.types.GeometryNodeTree, tree).is_modifier = True
    _interface(tree)
    inputs = {s.name: Field(s) for s in add(tree, "NodeGroupInput").outputs if s.name}
    in_viewport = Field(add(tree, "GeometryNodeIsViewport").outputs[0])
    geometry = _drawn(tree, inputs, in_viewport)
    position = Field(add(tree, "GeometryNodeInputPosition").outputs[0])
    camera = Field(add(tree, "GeometryNodeInputActiveCamera").outputs[0])
    # Relative: in the splat object's own space, as positions, spherical harmonics and the water's unit of length.
    view = add(tree, "GeometryNodeObjectInfo", {"transform_space": "RELATIVE"}, Object=camera).outputs
    ray = position - Field(view["Location"])

    color = _color(tree, ray.vector("NORMALIZE"), inputs[SH_DEGREE])
    light = by_channel(tree, to_light, color)
    seen, seen_light = _through_water(tree, inputs, ray, color)
    has_water = inputs[WATER].math("GREATER_THAN", 0.0)
    color = _switch(tree, has_water, color, seen, "VECTOR")
    light = _switch(tree, has_water, light, seen_light, "VECTOR")
    color = _switch(tree, inputs[BLEND_DISPLAY], light, color, "VECTOR")
    tint = attribute(tree, TINT, "FLOAT_COLOR")
    color = mixed(color, tint, Field(add(tree, "FunctionNodeSeparateColor", Color=tint).outputs["Alpha"]))
    opacity = attribute(tree, "radiance:base", "FLOAT_COLOR")
    opacity = Field(add(tree, "FunctionNodeSeparateColor", Color=opacity).outputs["Alpha"])
    geometry = stored(tree, geometry, point_material.COLOR, "FLOAT_VECTOR", color)
    geometry = stored(tree, geometry, splat_shapes.OPACITY, "FLOAT", opacity)

    ellipsoids = splat_shapes.ellipsoids(tree, geometry, ray, view, inputs[PIXEL_SIZE])
    facing = splat_shapes.rectangles(tree, geometry, position, camera, opacity, inputs[PIXEL_SIZE])
    points = splat_shapes.points(tree, geometry, opacity)

    rendered = _switch(tree, inputs[FACE_CAMERA], ellipsoids, facing)
    shown = _switch(tree, inputs[POINTS_IN_VIEWPORT], splat_shapes.no_shape(tree, inputs["Geometry"]), points)
    # The view of a viewport is seldom the active camera's, which rectangles face.
    shown = _switch(tree, inputs[SHAPES_IN_VIEWPORT], shown, ellipsoids)
    add(tree, "NodeGroupOutput", Geometry=_switch(tree, in_viewport, rendered, shown))
    arranged(tree)
    return tree


def _interface(tree: bpy.types.NodeTree) -> None:
    add_socket(tree, "Geometry", "Geometry", "OUTPUT")
    add_socket(tree, "Geometry", "Geometry")

    def number(name: str, kind: str, text: str, default: float, low: float, high: float, subtype: str = "NONE") -> None:
        socket = add_socket(tree, name, kind)
        socket.subtype = subtype
        socket.default_value, socket.min_value, socket.max_value, socket.description = default, low, high, text

    def switch(name: str, default: bool, text: str, parent: bpy.types.NodeTreeInterfacePanel | None = None) -> None:
        socket = add_socket(tree, name, "Bool", parent=parent)
        socket.default_value, socket.description = default, text

    text = "Highest degree of spherical harmonics that is used for the view from the active camera"
    number(SH_DEGREE, "Int", text, 3, 0, 3)
    switch(
        BLEND_DISPLAY, False, "Blend sRGB values as training does; needs the view transform Raw, and no other objects"
    )
    text = "1 / focal length in pixels of the training images: widens splats as in training; 0: off"
    number(PIXEL_SIZE, "Float", text, 0.0, 0.0, 1.0)
    switch(
        FACE_CAMERA, True, "Render splats exactly as seen from the active camera; off: ellipsoids, for every direction"
    )
    switch(POINTS_IN_VIEWPORT, False, "Draw colored points in viewports")
    switch(SHAPES_IN_VIEWPORT, False, "Draw ellipsoids in viewports, for Rendered shading")
    number(
        DENSITY, "Float", "Percentage of the splats in the viewport; renders show all", 100.0, 0.0, 100.0, "PERCENTAGE"
    )
    number(WATER, "Float", "Fraction of the water to show: 0 none, 1 as photographed", 0.0, 0.0, 1.0, "FACTOR")
    add_socket(tree, CROP_BOX, "Object").description = "Splats outside the box of this object are not drawn"
    number(CROP_HALF_EDGE, "Float", "Half the edge of the crop box in its own space", 1.0, 0.0, 1e6)
    panel = present(tree.interface).new_panel("Water", default_closed=True)
    panel.description = "Coefficients of the fitted water, per unit of the splats' own space"
    for name, value in WaterValues().inputs().items():
        if isinstance(value, tuple):
            add_socket(tree, name, "Vector", parent=panel)
        else:
            switch(name, value, "The water acts on sRGB values, not on linear light", panel)


def _drawn(tree: bpy.types.NodeTree, inputs: dict[str, Field], in_viewport: Field) -> Field:
    """The splats that are drawn: none hidden or cropped, and in the viewport only the chosen percentage."""
    hidden = attribute(tree, HIDDEN, "BOOLEAN").math("MAXIMUM", _outside_crop(tree, inputs))
    visible = add(tree, "GeometryNodeDeleteGeometry", Geometry=inputs["Geometry"], Selection=hidden)
    geometry = Field(visible.outputs["Geometry"])
    fraction = inputs[DENSITY] * 0.01
    random = add(tree, "FunctionNodeRandomValue", {"data_type": "FLOAT"})
    drawn = Field(next(socket for socket in random.outputs if socket.enabled))
    dropped = drawn.math("GREATER_THAN", fraction)
    thinned = add(tree, "GeometryNodeDeleteGeometry", Geometry=geometry, Selection=dropped)
    thin = in_viewport * fraction.math("LESS_THAN", 1.0)
    return _switch(tree, thin, geometry, Field(thinned.outputs["Geometry"]))


def _outside_crop(tree: bpy.types.NodeTree, inputs: dict[str, Field]) -> Field:
    """1 for splats outside the crop box, else 0; 0 for all where no object is chosen."""
    settings = {"transform_space": "RELATIVE"}
    box = add(tree, "GeometryNodeObjectInfo", settings, Object=inputs[CROP_BOX]).outputs
    inverse = add(tree, "FunctionNodeInvertMatrix", Matrix=Field(box["Transform"])).outputs
    position = Field(add(tree, "GeometryNodeInputPosition").outputs[0])
    local = add(tree, "FunctionNodeTransformPoint", Vector=position, Transform=Field(inverse["Matrix"])).outputs
    x, y, z = Field(local["Vector"]).vector("ABSOLUTE").xyz()
    farthest = x.math("MAXIMUM", y).math("MAXIMUM", z)
    # The scale of no object is zero.
    has_box = Field(box["Scale"]).vector("LENGTH", output="Value").math("GREATER_THAN", 0.0)
    return has_box * Field(inverse["Invertible"]) * farthest.math("GREATER_THAN", inputs[CROP_HALF_EDGE])


def _through_water(tree: bpy.types.NodeTree, inputs: dict[str, Field], ray: Field, color: Field) -> tuple[Field, Field]:
    """Compute sRGB values and linear light of splats with that sRGB color, seen along `ray` through the water."""
    display = inputs[OF_DISPLAY]
    water = Water.of(inputs, inputs[WATER])
    own = mixed(by_channel(tree, to_light, color), color, display)
    background = water.background_light(tree, ray.vector("NORMALIZE"))
    seen = water.through(tree, own, ray.vector("LENGTH", output="Value"), background)
    as_display = mixed(by_channel(tree, to_display, seen), seen, display)
    return as_display, mixed(seen, by_channel(tree, to_light, seen), display)


def _switch(tree: bpy.types.NodeTree, switch: Field, off: Field, on: Field, kind: str = "GEOMETRY") -> Field:
    """One of two fields; only that one is computed if `switch` is the same for all points."""
    node = add(tree, "GeometryNodeSwitch", {"input_type": kind}, Switch=switch, **{"False": off, "True": on})
    return Field(node.outputs["Output"])


def _color(tree: bpy.types.NodeTree, direction: Field, degree: Field) -> Field:
    """Compute the sRGB color of each splat along `direction`: max(0, 0.5 + sum of coefficients times harmonics)."""
    base = attribute(tree, "radiance:base", "FLOAT_COLOR")
    total = base * SH_0 + (0.5, 0.5, 0.5)
    index = 0
    for level, functions in enumerate(harmonics(direction), start=1):
        more = total
        for function in functions:
            # Attributes that the splats do not have are zero.
            coefficient = attribute(tree, f"radiance:sh_{index}", "FLOAT_VECTOR")
            more = coefficient.vector("MULTIPLY_ADD", function, more)
            index += 1
        total = _switch(tree, degree.math("GREATER_THAN", level - 0.5), total, more, "VECTOR")
    return total.vector("MAXIMUM", (0.0, 0.0, 0.0))
