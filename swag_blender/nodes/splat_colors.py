"""Geometry nodes that compute what each splat shows, the same in every version of Blender.

Color is computed once per splat, as splat renderers do: 0.5 + spherical harmonics of the direction from the scene's
active camera, through the water, developed, mixed with the tint of a label or selection. The result is stored where the
degree-0 coefficient of the splat was, and the other coefficients are removed: whatever draws the splats then, Blender
itself or the shapes of splat_shapes.py, needs no more than this color. Splats that are hidden, outside the crop box or
beyond the density of viewports are removed.

Where nothing depends on the active camera, native splats keep their coefficients: Blender evaluates them for each ray,
so that viewports, instances and reflections have the right colors, too.
"""

from collections.abc import Mapping
from typing import Any

import bpy

from ...swag_engine.splats import haze
from ..blender_types import present
from ..water_values import ATTENUATION, BACKSCATTER, OF_DISPLAY, WaterValues
from .build import Field, add, add_input, add_socket, alpha, arranged, attribute, by_name, new_tree, stored, switch
from .formulas import SH_0, Development, Water, by_channel, harmonics, mixed, to_display, to_light

NAME = "SWAG Splat Colors"
BASE = "radiance:base"
"""Point attribute of the degree-0 coefficient (red, green, blue) and the opacity of each splat."""
HIDDEN, TINT = "swag:hidden", "swag:tint"
"""Point attributes: splats that are not drawn, and linear light that is mixed in by its alpha (labels.py)."""
HAZE_SCORE = f"swag:{haze.HAZE}"
"""Point attribute: how sure it is that a splat is open water (swag_engine/splats/haze.py)."""
SH_DEGREE = "SH Degree"
DENSITY = "Viewport Density"
WATER, HAZE = "Water", "Haze"
CROP_BOX, CROP_HALF_EDGE = "Crop Box", "Crop Half Edge"
DEVELOP = "Develop in Viewport"
GAINS, CONTRAST = "Gains", "Contrast"
RESTORED_ROWS = ("Restored to Red", "Restored to Green", "Restored to Blue")
RESTORED_CONTRAST = "Restored Contrast"
BLEND_DISPLAY = "Blend Display Values"
_FOR_SHAPES = "For Shapes"
_MAX_DEGREE = 3
_ROWS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def colored(tree: bpy.types.NodeTree, inputs: Mapping[str, Field], for_shapes: bool) -> Field:
    """The splats with their colors, from a node group that has the inputs of `add_inputs` and a geometry.

    Args:
        tree: the node group.
        inputs: its inputs.
        for_shapes: whether shapes are drawn, which cannot evaluate spherical harmonics.
    """
    group: Any = add(tree, "GeometryNodeGroup", {"node_tree": node_group()})
    for socket in group.inputs:
        # Shapes have a material that blends sRGB values as such.
        if socket.name in inputs and not (for_shapes and socket.name == BLEND_DISPLAY):
            tree.links.new(inputs[socket.name].socket, socket)
    group.inputs[_FOR_SHAPES].default_value = for_shapes
    return Field(group.outputs["Geometry"])


def node_group() -> bpy.types.NodeTree:
    """The node group; made once per file."""
    if (known := bpy.data.node_groups.get(NAME)) is not None:
        return known
    tree = new_tree(NAME, "GeometryNodeTree")
    add_socket(tree, "Geometry", "Geometry", "OUTPUT")
    add_socket(tree, "Geometry", "Geometry")
    add_inputs(tree)
    add_input(tree, _FOR_SHAPES, "Bool", "Compute all colors for the active camera", False)
    add_input(tree, BLEND_DISPLAY, "Bool", "Have Blender take the sRGB values for light", False)
    inputs = by_name(add(tree, "NodeGroupInput").outputs)
    in_viewport = Field(add(tree, "GeometryNodeIsViewport").outputs[0])
    geometry = _drawn(tree, inputs, in_viewport)
    developed = in_viewport * inputs[DEVELOP]
    tint = alpha(tree, attribute(tree, TINT, "FLOAT_COLOR"))
    tints = add(tree, "GeometryNodeAttributeStatistic", Geometry=geometry, Attribute=tint)
    for_camera = inputs[_FOR_SHAPES]
    for reason in (
        inputs[BLEND_DISPLAY],
        inputs[SH_DEGREE].math("LESS_THAN", _MAX_DEGREE),
        inputs[WATER].math("MAXIMUM", inputs[HAZE]).math("GREATER_THAN", 0.0),
        developed,
        Field(tints.outputs["Max"]).math("GREATER_THAN", 0.0),
    ):
        for_camera = for_camera.math("MAXIMUM", reason)
    color = _color(tree, inputs, developed)
    # Blender converts the colors of its splats from sRGB to light.
    color = switch(tree, inputs[BLEND_DISPLAY], color, by_channel(tree, to_display, color), "VECTOR")
    seen = _with_color(tree, geometry, color, _opacity(tree, inputs))
    add(tree, "NodeGroupOutput", Geometry=switch(tree, for_camera, geometry, seen))
    arranged(tree)
    return tree


def add_inputs(tree: bpy.types.NodeTree) -> None:
    """Give a node group the inputs of a splat object's display."""
    add_input(tree, SH_DEGREE, "Int", "Highest degree of spherical harmonics that is used", _MAX_DEGREE, 0, _MAX_DEGREE)
    text = "Percentage of the splats in the viewport; renders show all"
    add_input(tree, DENSITY, "Float", text, 100.0, 0.0, 100.0).subtype = "PERCENTAGE"
    text = "Fraction of the water to show: 0 none, 1 as photographed"
    add_input(tree, WATER, "Float", text, 0.0, 0.0, 1.0).subtype = "FACTOR"
    text = "Fraction of the haze in open water to show: 0 none, 1 as trained; at least that of the water is shown"
    add_input(tree, HAZE, "Float", text, 0.0, 0.0, 1.0).subtype = "FACTOR"
    add_socket(tree, CROP_BOX, "Object").description = "Splats outside the box of this object are not drawn"
    add_input(tree, CROP_HALF_EDGE, "Float", "Half the edge of the crop box in its own space", 1.0, 0.0, 1e6)
    panel = present(tree.interface).new_panel("Water", default_closed=True)
    panel.description = "Coefficients of the fitted water, per unit of the splats' own space"
    for name, value in WaterValues().inputs().items():
        if isinstance(value, tuple):
            add_socket(tree, name, "Vector", parent=panel)
        else:
            add_input(tree, name, "Bool", "The water acts on sRGB values, not on linear light", value, parent=panel)
    panel = present(tree.interface).new_panel("Development", default_closed=True)
    panel.description = "What the panel Color does, without the roll-off of highlights"
    add_input(tree, DEVELOP, "Bool", "Develop the colors in viewports", False, parent=panel)
    for name, row in zip(RESTORED_ROWS, _ROWS, strict=True):
        text = "Weights of red, green and blue light of restored colors"
        add_input(tree, name, "Vector", text, row, parent=panel)
    add_input(tree, RESTORED_CONTRAST, "Float", "Contrast of restored colors", 1.0, parent=panel)
    add_input(tree, GAINS, "Vector", "Gains of red, green and blue light", (1.0, 1.0, 1.0), parent=panel)
    add_input(tree, CONTRAST, "Float", "Contrast about middle grey", 1.0, parent=panel)


def _drawn(tree: bpy.types.NodeTree, inputs: Mapping[str, Field], in_viewport: Field) -> Field:
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
    return switch(tree, thin, geometry, Field(thinned.outputs["Geometry"]))


def _outside_crop(tree: bpy.types.NodeTree, inputs: Mapping[str, Field]) -> Field:
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


def _color(tree: bpy.types.NodeTree, inputs: Mapping[str, Field], developed: Field) -> Field:
    """The sRGB color that each splat shows to the active camera."""
    # Relative: in the splat object's own space, as positions, spherical harmonics and the water's unit of length.
    camera = Field(add(tree, "GeometryNodeInputActiveCamera").outputs[0])
    view = add(tree, "GeometryNodeObjectInfo", {"transform_space": "RELATIVE"}, Object=camera).outputs
    ray = Field(add(tree, "GeometryNodeInputPosition").outputs[0]) - Field(view["Location"])
    color = _own_color(tree, ray.vector("NORMALIZE"), inputs[SH_DEGREE])
    seen = _through_water(tree, inputs, ray, color)
    color = switch(tree, inputs[WATER].math("GREATER_THAN", 0.0), color, seen, "VECTOR")
    color = switch(tree, developed, color, _developed(tree, inputs, color), "VECTOR")
    tint = attribute(tree, TINT, "FLOAT_COLOR")
    return mixed(color, by_channel(tree, to_display, tint), alpha(tree, tint))


def _own_color(tree: bpy.types.NodeTree, direction: Field, degree: Field) -> Field:
    """Compute the sRGB color of each splat along `direction`: max(0, 0.5 + sum of coefficients times harmonics)."""
    total = display_color(attribute(tree, BASE, "FLOAT_COLOR"))
    index = 0
    for level, functions in enumerate(harmonics(direction), start=1):
        more = total
        for function in functions:
            # Attributes that the splats do not have are zero.
            coefficient = attribute(tree, f"radiance:sh_{index}", "FLOAT_VECTOR")
            more = coefficient.vector("MULTIPLY_ADD", function, more)
            index += 1
        total = switch(tree, degree.math("GREATER_THAN", level - 0.5), total, more, "VECTOR")
    return total.vector("MAXIMUM", (0.0, 0.0, 0.0))


def _through_water(tree: bpy.types.NodeTree, inputs: Mapping[str, Field], ray: Field, color: Field) -> Field:
    """Compute the sRGB color of splats with that sRGB color, seen along `ray` through the water."""
    display = inputs[OF_DISPLAY]
    water = Water.of(inputs, inputs[WATER])
    own = mixed(by_channel(tree, to_light, color), color, display)
    background = water.background_light(tree, ray.vector("NORMALIZE"))
    seen = water.through(tree, own, ray.vector("LENGTH", output="Value"), background)
    return mixed(by_channel(tree, to_display, seen), seen, display)


def _developed(tree: bpy.types.NodeTree, inputs: Mapping[str, Field], color: Field) -> Field:
    """Develop sRGB colors. Highlights are not rolled off: see bake_development in develop_splats.py of the engine."""
    rows = [inputs[name] for name in RESTORED_ROWS]
    # Splats without water show none of it at any amount.
    lengths = [inputs[name].vector("LENGTH", output="Value") for name in (ATTENUATION, BACKSCATTER)]
    shown = inputs[WATER] * (lengths[0] + lengths[1]).math("GREATER_THAN", 0.0)
    development = Development(shown, rows, inputs[RESTORED_CONTRAST], inputs[GAINS], inputs[CONTRAST])
    return by_channel(tree, to_display, development.apply(tree, by_channel(tree, to_light, color)))


def display_color(base: Field) -> Field:
    """The sRGB color of splats whose attribute BASE holds it alone."""
    return base * SH_0 + (0.5, 0.5, 0.5)


def _opacity(tree: bpy.types.NodeTree, inputs: Mapping[str, Field]) -> Field:
    """The opacity with as much haze as is shown, as `haze.haze_gain` computes it."""
    score, amount = attribute(tree, HAZE_SCORE, "FLOAT"), inputs[WATER].math("MAXIMUM", inputs[HAZE])
    gain = (amount * score).math("DIVIDE", score * -1.0 + 1.0) + 1.0
    return (alpha(tree, attribute(tree, BASE, "FLOAT_COLOR")) * gain).math("MINIMUM", 1.0)


def _with_color(tree: bpy.types.NodeTree, geometry: Field, color: Field, opacity: Field) -> Field:
    """The splats with an sRGB color as their degree-0 coefficient, without other coefficients."""
    red, green, blue = ((color - (0.5, 0.5, 0.5)) * (1 / SH_0)).xyz()
    base = Field(add(tree, "FunctionNodeCombineColor", Red=red, Green=green, Blue=blue, Alpha=opacity).outputs["Color"])
    geometry = stored(tree, geometry, BASE, "FLOAT_COLOR", base)
    removed: Any = add(tree, "GeometryNodeRemoveAttribute", Geometry=geometry, Name="radiance:sh_*")
    if hasattr(removed, "pattern_mode"):  # Blender 4.5
        removed.pattern_mode = "WILDCARD"
    else:
        removed.inputs["Pattern Mode"].default_value = "Wildcard"
    return Field(removed.outputs["Geometry"])
