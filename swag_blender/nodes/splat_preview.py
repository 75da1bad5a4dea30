"""Splats drawn by geometry nodes and a material, for Blender versions that have no native splats.

Colour is computed once per splat, as splat renderers do: 0.5 + spherical harmonics of the direction from the scene's
active camera. The shape is drawn in one of three ways:
- renders ("Face Camera"): a rectangle parallel to the image plane through each splat's centre, with the projected
  Gaussian on it (EWA splatting, Zwicker et al. 2001, as in Kerbl et al. 2023). Cycles then meets the splats in the
  order of their depth, with the alpha that the trainer gave them, and EEVEE blends them in the order in which they
  stand in the mesh, which is that of their depth: same picture as the engine's to rounding. EEVEE draws one splat
  object as a whole before or behind another.
- otherwise: a sphere turned and scaled to the three-sigma ellipsoid, right from every direction. With p the hit point
  in the sphere's own space (there 1 is three sigma) and v the unit viewing direction,
      alpha = opacity exp(-4.5 d^2),   d^2 = p.p - (p.v)^2,
  d being the distance of the ray from the centre: the largest value of the 3D Gaussian along the ray.
- in the viewport ("Points in Viewport"): coloured points, the fainter the smaller, fast at any number.

Splat trainers blend display (sRGB) values. Two ways to blend here:
- linear light (default): colours are converted by the exact sRGB curve and blended as light, as Cycles and EEVEE do
  with everything. Right beside other objects, under view transform Standard, but half-transparent splats over others
  come out lighter than in the trainer.
- display values ("Blend Display Values"): the values go through unconverted; under view transform Raw the picture is
  the trainer's. For pictures of splats alone, such as comparisons with photographs.
"""

from collections.abc import Sequence
from typing import Any

import bpy
from mathutils import Color

from ..water_values import OF_DISPLAY, WaterValues
from . import point_material, splat_shapes
from .build import Field, add, arranged
from .formulas import SH_0, Water, by_channel, harmonics, mixed, to_display, to_light
from .splat_shapes import attribute, stored
from .water_shader import background_node

NAME = "SWAG Splat Preview"
HIDDEN, TINT = "swag:hidden", "swag:tint"  # splats left out, and a colour mixed in by its alpha: see labels.py
BACKGROUND_KEY = "swag_background"  # on a splat object: the display colour that the training had behind the splats

SH_DEGREE = "SH Degree"
BLEND_DISPLAY = "Blend Display Values"
PIXEL_SIZE = "Pixel Size"
FACE_CAMERA = "Face Camera"
POINTS_IN_VIEWPORT = "Points in Viewport"
DENSITY = "Viewport Density"
WATER = "Water"
SHOWN_INPUTS = (POINTS_IN_VIEWPORT, DENSITY, SH_DEGREE, FACE_CAMERA)


def add_modifier(obj: bpy.types.Object) -> bpy.types.NodesModifier:
    """Give a splat object the preview."""
    modifier = obj.modifiers.new(NAME, "NODES")
    modifier.node_group = node_group()
    return modifier


def modifier_of(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The preview of a splat object; None where it has none: taken off, or Blender draws the splats itself."""
    ours = (m for m in obj.modifiers if m.type == "NODES" and m.node_group and m.node_group.name.startswith(NAME))
    return next(ours, None)


def set_input(obj: bpy.types.Object, name: str, value: float | bool | Sequence[float]) -> None:
    """Set an input of the object's preview by its name; does nothing where there is no preview."""
    if (found := _input(obj, name)) is not None:
        owner, path, _ = found
        if path == "value":
            owner.value = value
        else:
            owner[path] = value
        obj.update_tag()


def input_path(obj: bpy.types.Object, name: str) -> str:
    """Where an input of the object's preview is, for drivers; empty where there is no preview."""
    if (found := _input(obj, name)) is None:
        return ""
    return f'modifiers["{bpy.utils.escape_identifier(modifier_of(obj).name)}"]{found[2]}'


def draw_input(layout: bpy.types.UILayout, obj: bpy.types.Object, name: str) -> None:
    """An input of the object's preview, for panels."""
    if (found := _input(obj, name)) is not None:
        owner, path, _ = found
        layout.prop(owner, path if path == "value" else f'["{path}"]', text=name)


def _input(obj: bpy.types.Object, name: str) -> tuple[Any, str, str] | None:
    """Who holds the value, under which name ("value": as a property, else as a key), and its path in the modifier."""
    if (modifier := modifier_of(obj)) is None:
        return None
    items = modifier.node_group.interface.items_tree
    key = next(i.identifier for i in items if i.name == name and getattr(i, "in_out", "") == "INPUT")
    if hasattr(modifier, "properties"):  # Blender 5.2 and later
        return getattr(modifier.properties.inputs, key), "value", f".properties.inputs.{key}.value"
    return modifier, key, f'["{key}"]'


def copy_inputs(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Let the preview of one splat object draw as that of another."""
    if (modifier := modifier_of(source)) is None:
        return
    for item in modifier.node_group.interface.items_tree:
        if getattr(item, "in_out", "") == "INPUT" and item.socket_type != "NodeSocketGeometry":
            owner, path, _ = _input(source, item.name)
            set_input(target, item.name, owner.value if path == "value" else owner[path])


def remember_training(obj: bpy.types.Object, pixel_size: float, background: Sequence[float]) -> None:
    """Keep with the splats what they were trained with, so that renders look the same.

    pixel_size: 1 / focal length in pixels of the training images; background: the display colour (3,) behind them.
    """
    set_input(obj, PIXEL_SIZE, pixel_size)
    obj[BACKGROUND_KEY] = [float(value) for value in background]


def prepare_render(scene: bpy.types.Scene, display_values: bool, engine: str = "CYCLES") -> None:
    """Settings with which Cycles or EEVEE draws splats fully and in their own colours, before their trained background.

    `display_values`: see the module text; the splat objects of the scene are switched to the same way of blending.
    `engine`: CYCLES or EEVEE.
    """
    if engine == "EEVEE":
        scene.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"
    else:
        scene.render.engine = "CYCLES"
    # A pixel sees hundreds of half-transparent splats. The minimum keeps Cycles from ending rays by chance: the alphas
    # are blended exactly, and samples are needed for the edges of pixels only.
    scene.cycles.transparent_max_bounces = scene.cycles.min_transparent_bounces = 1024
    scene.cycles.max_bounces = 0
    scene.cycles.use_denoising = False
    scene.view_settings.view_transform = "Raw" if display_values else "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0
    for obj in scene.objects:
        set_input(obj, BLEND_DISPLAY, display_values)
    background = next((obj[BACKGROUND_KEY] for obj in scene.objects if BACKGROUND_KEY in obj), None)
    if background is not None:
        node = background_node(scene)
        for link in node.inputs["Color"].links:
            node.id_data.links.remove(link)
        color = Color(background)
        node.inputs["Color"].default_value = (*(color if display_values else color.from_srgb_to_scene_linear()), 1.0)
        node.inputs["Strength"].default_value = 1.0


def node_group() -> bpy.types.NodeTree:
    """The preview's geometry nodes; made once per file."""
    if (known := bpy.data.node_groups.get(NAME)) is not None:
        return known
    tree = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    tree.is_modifier = True
    _interface(tree.interface)
    inputs = {s.name: Field(s) for s in add(tree, "NodeGroupInput").outputs if s.name}
    in_viewport = Field(add(tree, "GeometryNodeIsViewport").outputs[0])
    geometry = _kept(tree, inputs, in_viewport)
    position = Field(add(tree, "GeometryNodeInputPosition").outputs[0])
    camera = Field(add(tree, "GeometryNodeInputActiveCamera").outputs[0])
    # Relative: in the splat object's own space, where positions, spherical harmonics and the water's unit are.
    view = add(tree, "GeometryNodeObjectInfo", {"transform_space": "RELATIVE"}, Object=camera).outputs
    ray = position - Field(view["Location"])

    color = _color(tree, ray.vector("NORMALIZE"), inputs[SH_DEGREE])
    light = by_channel(tree, to_light, color)
    watery, watery_light = _through_water(tree, inputs, ray, color)
    water = inputs[WATER].math("GREATER_THAN", 0.0)
    color, light = (
        _switch(tree, water, clear, seen, "VECTOR") for clear, seen in ((color, watery), (light, watery_light))
    )
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

    shown = _switch(tree, inputs[POINTS_IN_VIEWPORT], ellipsoids, points)
    rendered = _switch(tree, inputs[FACE_CAMERA], ellipsoids, facing)
    add(tree, "NodeGroupOutput", Geometry=_switch(tree, in_viewport, rendered, shown))
    arranged(tree)
    return tree


def _interface(interface: bpy.types.NodeTreeInterface) -> None:
    interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")

    def number(name: str, kind: str, text: str, default: float, low: float, high: float, subtype: str = "NONE") -> None:
        socket = interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
        socket.subtype = subtype
        socket.default_value, socket.min_value, socket.max_value, socket.description = default, low, high, text

    def switch(name: str, default: bool, text: str, parent: bpy.types.NodeTreeInterfacePanel | None = None) -> None:
        socket = interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketBool", parent=parent)
        socket.default_value, socket.description = default, text

    number(SH_DEGREE, "Int", "Spherical harmonics used for colours that change with the active camera's view", 3, 0, 3)
    switch(
        BLEND_DISPLAY, False, "Blend as the trainer does; needs the view transform Raw and splats alone in the picture"
    )
    text = "1 / focal length in pixels of the training images: widens splats as in training (0: off)"
    number(PIXEL_SIZE, "Float", text, 0.0, 0.0, 1.0)
    switch(
        FACE_CAMERA, True, "In renders, draw what the active camera sees exactly; off: solid ellipsoids from everywhere"
    )
    switch(POINTS_IN_VIEWPORT, True, "Draw coloured points in the viewport (fast); renders always show the splats")
    number(DENSITY, "Float", "Share of the splats in the viewport; renders show all", 100.0, 0.0, 100.0, "PERCENTAGE")
    number(WATER, "Float", "How much of the water to show: 0 none, 1 as photographed", 0.0, 0.0, 1.0, "FACTOR")
    panel = interface.new_panel("Water", default_closed=True)
    panel.description = "What the training found of the water, per unit of the splats' own space"
    for name, value in WaterValues().inputs().items():
        if isinstance(value, tuple):
            interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketVector", parent=panel)
        else:
            switch(name, value, "The water acts on display values, not on light", panel)


def _kept(tree: bpy.types.NodeTree, inputs: dict[str, Field], in_viewport: Field) -> Field:
    """The splats that are drawn at all."""
    hidden = attribute(tree, HIDDEN, "BOOLEAN")
    geometry = add(tree, "GeometryNodeDeleteGeometry", Geometry=inputs["Geometry"], Selection=hidden)
    geometry = Field(geometry.outputs["Geometry"])
    share = inputs[DENSITY] * 0.01
    random = add(tree, "FunctionNodeRandomValue", {"data_type": "FLOAT"})
    drawn = Field(next(socket for socket in random.outputs if socket.enabled))
    dropped = drawn.math("GREATER_THAN", share)
    thinned = add(tree, "GeometryNodeDeleteGeometry", Geometry=geometry, Selection=dropped)
    thin = in_viewport * share.math("LESS_THAN", 1.0)
    return _switch(tree, thin, geometry, Field(thinned.outputs["Geometry"]))


def _through_water(tree: bpy.types.NodeTree, inputs: dict[str, Field], ray: Field, color: Field) -> tuple[Field, Field]:
    """Display values and light of the splats of that display colour seen along `ray`, through the water."""
    display = inputs[OF_DISPLAY]
    water = Water.of(inputs, inputs[WATER])
    own = mixed(by_channel(tree, to_light, color), color, display)
    veil = water.open_water(tree, ray.vector("NORMALIZE"))
    seen = water.through(tree, own, ray.vector("LENGTH", output="Value"), veil)
    as_display = mixed(by_channel(tree, to_display, seen), seen, display)
    return as_display, mixed(seen, by_channel(tree, to_light, seen), display)


def _switch(tree: bpy.types.NodeTree, switch: Field, off: Field, on: Field, kind: str = "GEOMETRY") -> Field:
    """One of two; only that one is computed, where `switch` is the same for all points."""
    node = add(tree, "GeometryNodeSwitch", {"input_type": kind}, Switch=switch, **{"False": off, "True": on})
    return Field(node.outputs["Output"])


def _color(tree: bpy.types.NodeTree, direction: Field, degree: Field) -> Field:
    """max(0, 0.5 + sum of coefficient times basis), the display colour of each splat seen along `direction`."""
    base = attribute(tree, "radiance:base", "FLOAT_COLOR")
    total = base * SH_0 + (0.5, 0.5, 0.5)
    index = 0
    for level, functions in enumerate(harmonics(direction), start=1):
        more = total
        for function in functions:
            # Coefficients that the splats do not have read as zero.
            coefficient = attribute(tree, f"radiance:sh_{index}", "FLOAT_VECTOR")
            more = coefficient.vector("MULTIPLY_ADD", function, more)
            index += 1
        total = _switch(tree, degree.math("GREATER_THAN", level - 0.5), total, more, "VECTOR")
    return total.vector("MAXIMUM", (0.0, 0.0, 0.0))
