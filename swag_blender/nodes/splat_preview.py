"""Splats drawn by geometry nodes and a material, for Blender versions that have no native splats.

Colour is computed once per splat, as splat renderers do: 0.5 + spherical harmonics of the direction from the scene's
active camera. The shape is drawn in one of three ways:
- renders ("Face Camera"): a rectangle parallel to the image plane through each splat's centre, with the projected
  Gaussian on it (EWA splatting, Zwicker et al. 2001, as in Kerbl et al. 2023). Cycles then meets the splats in the
  order of their depth, with the alpha that the trainer gave them: same picture as the engine's to rounding.
- otherwise: a sphere turned and scaled to the three-sigma ellipsoid, right from every direction. With p the hit point
  in the sphere's own space (there 1 is three sigma) and v the unit viewing direction,
      alpha = opacity exp(-4.5 d^2),   d^2 = p.p - (p.v)^2,
  d being the distance of the ray from the centre: the largest value of the 3D Gaussian along the ray.
- in the viewport ("Points in Viewport"): coloured points, fast at any number.

Splat trainers blend display (sRGB) values. Two ways to blend here:
- linear light (default): colours are converted by the exact sRGB curve and blended as light, as Cycles and EEVEE do
  with everything. Right beside other objects, under view transform Standard, but half-transparent splats over others
  come out lighter than in the trainer.
- display values ("Blend Display Values"): the values go through unconverted; under view transform Raw the picture is
  the trainer's. For pictures of splats alone, such as comparisons with photographs.
"""

import math
from collections.abc import Sequence

import bpy
from mathutils import Color

from . import point_material
from .build import Field, add, arranged, combined

NAME = "SWAG Splat Preview"
OPACITY, REACH, PLACE = "swag:opacity", "swag:reach", "swag:place"
HIDDEN, TINT = "swag:hidden", "swag:tint"  # splats left out, and a colour mixed in by its alpha: see labels.py
RADIUS_IN_SIGMA = 3.0
BACKGROUND_KEY = "swag_background"  # on a splat object: the display colour that the training had behind the splats
# Splat renderers leave out what is fainter.
LEAST_ALPHA = 1 / 255
# Kerbl et al. evaluate the projection's derivative at most this far outside the picture: beyond, it is of no use.
FRUSTUM_MARGIN = 1.3
# Renderers of the 3DGS family widen the projected covariance by this many square pixels (Kerbl et al. 2023, "Gaussian
# Splatting", and Zwicker et al. 2001 before it); trained splats rely on it.
PIXEL_VARIANCE = 0.3

SH_DEGREE = "SH Degree"
BLEND_DISPLAY = "Blend Display Values"
PIXEL_SIZE = "Pixel Size"
FACE_CAMERA = "Face Camera"
POINTS_IN_VIEWPORT = "Points in Viewport"

# Real spherical harmonics in the order and with the signs of 3DGS files: 1 / (2 sqrt(pi)) and so on.
_SH_0 = 0.28209479177387814
_SH_1 = 0.4886025119029199
_SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def add_modifier(obj: bpy.types.Object) -> bpy.types.NodesModifier:
    """Give a splat object the preview."""
    modifier = obj.modifiers.new(NAME, "NODES")
    modifier.node_group = node_group()
    return modifier


def set_input(obj: bpy.types.Object, name: str, value: float | bool) -> None:
    """Set an input of the object's preview by its name; does nothing where Blender draws the splats itself."""
    for modifier in obj.modifiers:
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith(NAME):
            item = next(i for i in modifier.node_group.interface.items_tree if i.name == name)
            if hasattr(modifier, "properties"):  # Blender 5.2 and later
                getattr(modifier.properties.inputs, item.identifier).value = value
            else:
                modifier[item.identifier] = value
            obj.update_tag()


def copy_inputs(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Let the preview of one splat object draw as that of another."""
    for modifier in source.modifiers:
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith(NAME):
            for item in modifier.node_group.interface.items_tree:
                if item.in_out == "INPUT" and item.socket_type != "NodeSocketGeometry":
                    if hasattr(modifier, "properties"):  # Blender 5.2 and later
                        value = getattr(modifier.properties.inputs, item.identifier).value
                    else:
                        value = modifier[item.identifier]
                    set_input(target, item.name, value)


def remember_training(obj: bpy.types.Object, pixel_size: float, background: Sequence[float]) -> None:
    """Keep with the splats what they were trained with, so that renders look the same.

    pixel_size: 1 / focal length in pixels of the training images; background: the display colour (3,) behind them.
    """
    set_input(obj, PIXEL_SIZE, pixel_size)
    obj[BACKGROUND_KEY] = [float(value) for value in background]


def prepare_cycles(scene: bpy.types.Scene, display_values: bool) -> None:
    """Settings with which Cycles draws splats fully and in their own colours, before their trained background.

    `display_values`: see the module text; the splat objects of the scene are switched to the same way of blending.
    """
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
        scene.world = scene.world or bpy.data.worlds.new("World")
        scene.world.use_nodes = True
        tree = scene.world.node_tree
        node = next((n for n in tree.nodes if n.bl_idname == "ShaderNodeBackground"), None)
        if node is None:
            node = tree.nodes.new("ShaderNodeBackground")
            add(tree, "ShaderNodeOutputWorld", Surface=Field(node.outputs[0]))
        color = Color(background)
        node.inputs["Color"].default_value = (*(color if display_values else color.from_srgb_to_scene_linear()), 1.0)
        node.inputs["Strength"].default_value = 1.0


def node_group() -> bpy.types.NodeTree:
    """The preview's geometry nodes; made once per file."""
    if (known := bpy.data.node_groups.get(NAME)) is not None:
        return known
    tree = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    tree.is_modifier = True
    interface = tree.interface
    interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    degree = interface.new_socket(SH_DEGREE, in_out="INPUT", socket_type="NodeSocketInt")
    degree.default_value, degree.min_value, degree.max_value = 3, 0, 3
    degree.description = "Spherical harmonics used for colours that change with the view of the active camera"
    blend = interface.new_socket(BLEND_DISPLAY, in_out="INPUT", socket_type="NodeSocketBool")
    blend.description = "Blend as the trainer does; needs the view transform Raw and splats alone in the picture"
    pixel = interface.new_socket(PIXEL_SIZE, in_out="INPUT", socket_type="NodeSocketFloat")
    pixel.min_value = 0.0
    pixel.description = "1 / focal length in pixels of the training images: widens splats as in training (0: off)"
    facing = interface.new_socket(FACE_CAMERA, in_out="INPUT", socket_type="NodeSocketBool")
    facing.default_value = True
    facing.description = "In renders, draw what the active camera sees exactly; off: solid ellipsoids from everywhere"
    points = interface.new_socket(POINTS_IN_VIEWPORT, in_out="INPUT", socket_type="NodeSocketBool")
    points.default_value = True
    points.description = "Draw coloured points in the viewport (fast); renders always show the splats"

    inputs = {s.name: Field(s) for s in add(tree, "NodeGroupInput").outputs if s.name}
    position = Field(add(tree, "GeometryNodeInputPosition").outputs[0])
    camera = add(tree, "GeometryNodeInputActiveCamera").outputs[0]
    # Relative: in the splat object's own space, where positions and spherical harmonics are.
    view = add(tree, "GeometryNodeObjectInfo", {"transform_space": "RELATIVE"}, Object=Field(camera)).outputs
    ray = position - Field(view["Location"])

    color = _color(tree, ray.vector("NORMALIZE"), inputs[SH_DEGREE])
    linear = combined(tree, [_srgb_to_linear(channel) for channel in color.xyz()])
    color = linear + (color - linear) * inputs[BLEND_DISPLAY]
    tint = Field(_attribute(tree, TINT, "FLOAT_COLOR").outputs["Attribute"])
    strength = Field(add(tree, "FunctionNodeSeparateColor", Color=tint).outputs["Alpha"])
    color = color + (tint - color) * strength
    opacity = Field(_attribute(tree, "radiance:base", "FLOAT_COLOR").outputs["Attribute"])
    opacity = Field(add(tree, "FunctionNodeSeparateColor", Color=opacity).outputs["Alpha"])
    hidden = Field(_attribute(tree, HIDDEN, "BOOLEAN").outputs["Attribute"])
    geometry = add(tree, "GeometryNodeDeleteGeometry", Geometry=inputs["Geometry"], Selection=hidden)
    geometry = Field(geometry.outputs["Geometry"])
    geometry = _stored(tree, geometry, point_material.COLOR, "FLOAT_VECTOR", color)
    geometry = _stored(tree, geometry, OPACITY, "FLOAT", opacity)

    widened = _depth(tree, ray, view) * inputs[PIXEL_SIZE]
    widening = widened * widened * PIXEL_VARIANCE
    sigma = Field(_attribute(tree, "scale", "FLOAT_VECTOR").outputs["Attribute"])
    rotation = Field(_attribute(tree, "rotation", "QUATERNION").outputs["Attribute"])

    # The flat faces of the sphere lie inside its radius: 1.05 keeps them about the unit sphere.
    sphere = Field(add(tree, "GeometryNodeMeshIcoSphere", Radius=1.05, Subdivisions=2).outputs["Mesh"])
    wide = combined(tree, [(s * s + widening).math("SQRT") for s in sigma.xyz()])
    ellipsoids = _instances(tree, geometry, sphere, rotation, wide * RADIUS_IN_SIGMA, material(facing=False))
    quad = Field(add(tree, "GeometryNodeMeshGrid", Size_X=2.0, Size_Y=2.0, Vertices_X=2, Vertices_Y=2).outputs["Mesh"])
    turn, extent = _projected(tree, ray, view, camera, sigma, rotation, widening)
    # As far as the splat is worth drawing, in sigma: Cycles pays for each rectangle that a ray meets. 0: nowhere.
    reach = ((opacity * (1 / LEAST_ALPHA)).math("MAXIMUM", 1.0).math("LOGARITHM", math.e) * 2.0).math("SQRT")
    geometry = _stored(tree, geometry, REACH, "FLOAT", reach)
    quad = _stored(tree, quad, PLACE, "FLOAT_VECTOR", Field(add(tree, "GeometryNodeInputPosition").outputs[0]))
    facing = _instances(tree, geometry, quad, turn, extent * reach, material(facing=True))
    # One mesh: Cycles meets its rectangles much faster than as many instances.
    facing = Field(add(tree, "GeometryNodeRealizeInstances", Geometry=facing).outputs["Geometry"])
    points = add(tree, "GeometryNodeSetMaterial", Geometry=geometry, Material=point_material.material())
    points = Field(points.outputs["Geometry"])

    in_viewport = Field(add(tree, "GeometryNodeIsViewport").outputs[0])
    shown = _switch(tree, inputs[POINTS_IN_VIEWPORT], ellipsoids, points)
    rendered = _switch(tree, inputs[FACE_CAMERA], ellipsoids, facing)
    add(tree, "NodeGroupOutput", Geometry=_switch(tree, in_viewport, rendered, shown))
    arranged(tree)
    return tree


def material(facing: bool) -> bpy.types.Material:
    """The material of the rectangles (`facing`) or of the ellipsoids; made once per file."""
    name = "SWAG Splats Facing" if facing else "SWAG Splats"
    if (known := bpy.data.materials.get(name)) is not None:
        return known
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    owner = "GEOMETRY" if facing else "INSTANCER"
    opacity = _shader_attribute(tree, owner, OPACITY, "Fac")
    if facing:
        point = _shader_attribute(tree, owner, PLACE, "Vector")
        reach = _shader_attribute(tree, owner, REACH, "Fac")
        alpha = opacity * (point.dot(point) * reach * reach * -0.5).math("EXPONENT")
        alpha = alpha * alpha.math("GREATER_THAN", LEAST_ALPHA)
    else:
        point = Field(add(tree, "ShaderNodeTexCoord").outputs["Object"])
        geometry = add(tree, "ShaderNodeNewGeometry")
        toward_eye = add(
            tree,
            "ShaderNodeVectorTransform",
            {"vector_type": "VECTOR", "convert_from": "WORLD", "convert_to": "OBJECT"},
            Vector=Field(geometry.outputs["Incoming"]),
        )
        along = point.dot(Field(toward_eye.outputs["Vector"]).vector("NORMALIZE"))
        distance_squared = point.dot(point) - along * along
        front = Field(geometry.outputs["Backfacing"]).math("LESS_THAN", 0.5)
        alpha = opacity * (distance_squared * (-0.5 * RADIUS_IN_SIGMA**2)).math("EXPONENT") * front
    emission = add(tree, "ShaderNodeEmission", Color=_shader_attribute(tree, owner, point_material.COLOR, "Color"))
    mix = tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(alpha.socket, mix.inputs[0])
    tree.links.new(tree.nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
    tree.links.new(emission.outputs[0], mix.inputs[2])
    made.cycles.emission_sampling = "NONE"  # splats are looked at; they light nothing
    add(tree, "ShaderNodeOutputMaterial", Surface=Field(mix.outputs[0]))
    arranged(tree)
    return made


def _axis(tree: bpy.types.NodeTree, rotation: Field, axis: tuple[float, float, float]) -> Field:
    return Field(add(tree, "FunctionNodeRotateVector", Vector=axis, Rotation=rotation).outputs["Vector"])


def _depth(tree: bpy.types.NodeTree, ray: Field, view: bpy.types.NodeInputs) -> Field:
    return ray.dot(_axis(tree, Field(view["Rotation"]), (0.0, 0.0, -1.0)))


def _projected(
    tree: bpy.types.NodeTree,
    ray: Field,
    view: bpy.types.NodeInputs,
    camera: bpy.types.NodeSocket,
    sigma: Field,
    rotation: Field,
    widening: Field,
) -> tuple[Field, Field]:
    """Rotation, and standard deviations along its x and y axes, of each splat's image in the plane of its depth.

    With the camera's axes r, u, f and the centre at (X, Y, Z) on them, a step d from the centre moves the image by
    ((r - X/Z f).d, (u - Y/Z f).d) in that plane, whatever the focal length.
    """
    axes = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)]
    right, up, forward = (_axis(tree, Field(view["Rotation"]), axis) for axis in axes)
    depth = ray.dot(forward)
    lens = add(tree, "GeometryNodeCameraInfo", Camera=Field(camera)).outputs
    projection = add(tree, "FunctionNodeSeparateMatrix", Matrix=Field(lens["Projection Matrix"])).outputs
    perspective = Field(lens["Is Orthographic"]) * -1.0 + 1.0

    def image_axis(axis: Field, scale: bpy.types.NodeSocket) -> Field:
        # Entry (i, i) of a projection matrix is the inverse of half the picture's extent at depth one.
        limit = Field(scale).math("DIVIDE", FRUSTUM_MARGIN).math("POWER", -1.0)
        slope = ray.dot(axis).math("DIVIDE", depth)
        slope = slope.math("MINIMUM", limit).math("MAXIMUM", limit * -1.0) * perspective
        return axis - forward * slope

    across = image_axis(right, projection["Column 1 Row 1"])
    along = image_axis(up, projection["Column 2 Row 2"])
    xx, xy, yy = widening, None, widening
    for axis, size in zip([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)], sigma.xyz(), strict=True):
        half_axis = _axis(tree, rotation, axis) * size
        x, y = half_axis.dot(across), half_axis.dot(along)
        xx, yy = xx + x * x, yy + y * y
        xy = x * y if xy is None else xy + x * y
    # Eigenvalues and first eigenvector of [[xx, xy], [xy, yy]].
    middle, difference = (xx + yy) * 0.5, (xx - yy) * 0.5
    spread = (difference * difference + xy * xy).math("SQRT")
    angle = xy.math("ARCTAN2", difference) * 0.5
    longest = right * angle.math("COSINE") + up * angle.math("SINE")
    turn = add(
        tree,
        "FunctionNodeAxesToRotation",
        {"primary_axis": "Z", "secondary_axis": "X"},
        Primary_Axis=forward * -1.0,
        Secondary_Axis=longest,
    )
    extent = combined(tree, [(middle + spread).math("SQRT"), (middle - spread).math("MAXIMUM", 0.0).math("SQRT"), 1.0])
    return Field(turn.outputs["Rotation"]), extent


def _instances(
    tree: bpy.types.NodeTree,
    points: Field,
    instance: Field,
    rotation: Field,
    scale: Field,
    material: bpy.types.Material,
) -> Field:
    shaded = add(tree, "GeometryNodeSetMaterial", Geometry=instance, Material=material)
    node = add(
        tree,
        "GeometryNodeInstanceOnPoints",
        Points=points,
        Instance=Field(shaded.outputs["Geometry"]),
        Rotation=rotation,
        Scale=scale,
    )
    return Field(node.outputs["Instances"])


def _switch(tree: bpy.types.NodeTree, switch: Field, off: Field, on: Field) -> Field:
    node = add(tree, "GeometryNodeSwitch", {"input_type": "GEOMETRY"}, Switch=switch, **{"False": off, "True": on})
    return Field(node.outputs["Output"])


def _color(tree: bpy.types.NodeTree, direction: Field, degree: Field) -> Field:
    """max(0, 0.5 + sum of coefficient times basis), the display colour of each splat seen along `direction`."""
    x, y, z = direction.xyz()
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    around = zz * 4.0 - xx - yy
    basis = [
        [y * -_SH_1, z * _SH_1, x * -_SH_1],
        [xy * _SH_2[0], yz * -_SH_2[0], (zz * 2.0 - xx - yy) * _SH_2[1], xz * -_SH_2[0], (xx - yy) * _SH_2[2]],
        [
            y * (xx * 3.0 - yy) * -_SH_3[0],
            xy * z * _SH_3[1],
            y * around * -_SH_3[2],
            z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * _SH_3[3],
            x * around * -_SH_3[2],
            z * (xx - yy) * _SH_3[4],
            x * (xx - yy * 3.0) * -_SH_3[0],
        ],
    ]
    base = Field(_attribute(tree, "radiance:base", "FLOAT_COLOR").outputs["Attribute"])
    total = base * _SH_0 + (0.5, 0.5, 0.5)
    index = 0
    for level, functions in enumerate(basis, start=1):
        used = degree.math("GREATER_THAN", level - 0.5)
        for function in functions:
            # Coefficients that the splats do not have read as zero.
            coefficient = Field(_attribute(tree, f"radiance:sh_{index}", "FLOAT_VECTOR").outputs["Attribute"])
            total = total + coefficient * (function * used)
            index += 1
    return total.vector("MAXIMUM", (0.0, 0.0, 0.0))


def _srgb_to_linear(value: Field) -> Field:
    """The piecewise curve of IEC 61966-2-1; above one it goes on by the same formula."""
    curved = ((value + 0.055) * (1 / 1.055)).math("POWER", 2.4)
    straight = value * (1 / 12.92)
    return straight + (curved - straight) * value.math("GREATER_THAN", 0.04045)


def _attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> bpy.types.Node:
    return add(tree, "GeometryNodeInputNamedAttribute", {"data_type": kind}, Name=name)


def _shader_attribute(tree: bpy.types.NodeTree, owner: str, name: str, output: str) -> Field:
    node = add(tree, "ShaderNodeAttribute", {"attribute_type": owner, "attribute_name": name})
    return Field(node.outputs[output])


def _stored(tree: bpy.types.NodeTree, geometry: Field, name: str, kind: str, value: Field) -> Field:
    node = add(
        tree,
        "GeometryNodeStoreNamedAttribute",
        {"data_type": kind, "domain": "POINT"},
        Geometry=geometry,
        Name=name,
        Value=value,
    )
    return Field(node.outputs["Geometry"])
