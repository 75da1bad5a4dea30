"""The shapes that splats are drawn with, and their materials: see splat_preview.py."""

import math
from typing import Any, cast

import bpy

from ..blender_types import present
from . import point_material
from .build import Field, add, arranged, attribute, combined, stored

OPACITY, REACH, PLACE = "swag:opacity", "swag:reach", "swag:place"
RADIUS_IN_SIGMA = 3.0
"""Radius of the ellipsoids in standard deviations."""
POINT_IN_SIGMA = 1.5
"""Radius of an opaque point in standard deviations of its middle axis."""
MIN_ALPHA = 1 / 255
"""Splat renderers do not draw smaller alphas."""
FRUSTUM_MARGIN = 1.3
"""The projection is linearised at most this far from the centre, in half images (Kerbl et al. 2023, code)."""
PIXEL_VARIANCE = 0.3
"""Variance in pixels squared that is added to the projected covariance (Zwicker et al. 2001, Kerbl et al. 2023)."""
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def points(tree: bpy.types.NodeTree, geometry: Field, opacity: Field) -> Field:
    """The points as opaque discs, so small that faint and long splats do not hide those behind them."""
    x, y, z = attribute(tree, "scale", "FLOAT_VECTOR").xyz()
    largest, smallest = (x.math(which, y).math(which, z) for which in ("MAXIMUM", "MINIMUM"))
    middle = x + y + z - largest - smallest
    made = add(tree, "GeometryNodeSetPointRadius", Points=geometry, Radius=middle * opacity * POINT_IN_SIGMA)
    made = add(
        tree, "GeometryNodeSetMaterial", Geometry=Field(made.outputs["Points"]), Material=point_material.material()
    )
    return Field(made.outputs["Geometry"])


def no_shape(tree: bpy.types.NodeTree, geometry: Field) -> Field:
    """The points with all attributes and a radius of 0, so that nothing of them is drawn."""
    return Field(add(tree, "GeometryNodeSetPointRadius", Points=geometry, Radius=0.0).outputs["Points"])


def ellipsoids(
    tree: bpy.types.NodeTree, points: Field, ray: Field, view: bpy.types.NodeOutputs, pixel_size: Field
) -> Field:
    """The three-sigma ellipsoid of each point, a scaled sphere.

    Args:
        tree: where the nodes are made.
        points: the point cloud.
        ray: from the camera to the points, in the points' own space.
        view: outputs of the Object Info of the camera, in the same space.
        pixel_size: 1 / focal length in pixels.
    """
    widened = ray.dot(_turned(tree, (0.0, 0.0, -1.0), Field(view["Rotation"]))) * pixel_size
    sigma, rotation = _sigma_and_rotation(tree)
    wide = combined(tree, [(s * s + widened * widened * PIXEL_VARIANCE).math("SQRT") for s in sigma.xyz()])
    # The flat faces are inside the sphere's radius: with 1.05 they are outside the unit sphere.
    sphere = Field(add(tree, "GeometryNodeMeshIcoSphere", Radius=1.05, Subdivisions=2).outputs["Mesh"])
    sphere = _shaded(tree, sphere, material(facing=False))
    scale = wide * RADIUS_IN_SIGMA
    made = add(tree, "GeometryNodeInstanceOnPoints", Points=points, Instance=sphere, Rotation=rotation, Scale=scale)
    return Field(made.outputs["Instances"])


def rectangles(
    tree: bpy.types.NodeTree, points: Field, position: Field, camera: Field, opacity: Field, pixel_size: Field
) -> Field:
    """A rectangle for each point, parallel to the image plane, that covers the splat where its alpha is visible.

    It is computed in the world and transformed to the points' own space, because an object may be rotated, scaled
    unevenly or sheared.
    """
    # In standard deviations, 0 for invisible splats: Cycles' time grows with the rectangles that a ray crosses.
    reach = ((opacity * (1 / MIN_ALPHA)).math("MAXIMUM", 1.0).math("LOGARITHM", math.e) * 2.0).math("SQRT")
    own = add(tree, "GeometryNodeObjectInfo", Object=Field(add(tree, "GeometryNodeSelfObject").outputs[0]))
    to_world = Field(own.outputs["Transform"])
    to_own = Field(add(tree, "FunctionNodeInvertMatrix", Matrix=to_world).outputs["Matrix"])
    longest, widest, depth = _half_axes(tree, position, camera, to_world, pixel_size)
    columns = [_direction(tree, axis * reach, to_own) for axis in (longest, widest)]
    columns.append(columns[0].vector("CROSS_PRODUCT", columns[1]).vector("NORMALIZE"))
    matrix = tree.nodes.new("FunctionNodeCombineMatrix")
    for number, column in enumerate((*columns, position), start=1):
        for row, value in enumerate(column.xyz(), start=1):
            tree.links.new(value.socket, matrix.inputs[f"Column {number} Row {row}"])
    points, place = _captured(tree, points, Field(matrix.outputs["Matrix"]))
    points = stored(tree, points, REACH, "FLOAT", reach)
    # EEVEE blends the faces of a mesh in the order of their indices.
    ordered = add(tree, "GeometryNodeSortElements", Geometry=points, Sort_Weight=depth * -1.0)
    points = Field(ordered.outputs["Geometry"])

    quad = Field(add(tree, "GeometryNodeMeshGrid", Size_X=2.0, Size_Y=2.0, Vertices_X=2, Vertices_Y=2).outputs["Mesh"])
    quad = stored(tree, quad, PLACE, "FLOAT_VECTOR", Field(add(tree, "GeometryNodeInputPosition").outputs[0]))
    quad = _shaded(tree, quad, material(facing=True))
    made = Field(add(tree, "GeometryNodeInstanceOnPoints", Points=points, Instance=quad).outputs["Instances"])
    moved = add(tree, "GeometryNodeSetInstanceTransform", Instances=made, Transform=place)
    made = Field(moved.outputs["Instances"])
    # One mesh: Cycles traces it much faster than as many instances.
    return Field(add(tree, "GeometryNodeRealizeInstances", Geometry=made).outputs["Geometry"])


def _half_axes(
    tree: bpy.types.NodeTree, position: Field, camera: Field, to_world: Field, pixel_size: Field
) -> tuple[Field, Field, Field]:
    """Half axes of each splat's projection and its depth: one standard deviation, in its plane of depth, in the world.

    With the camera's axes r, u, f and the centre at (X, Y, Z) along them, a step d from the centre moves the projection
    by ((r - X/Z f).d, (u - Y/Z f).d) in that plane, whatever the focal length.
    """
    view = add(tree, "GeometryNodeObjectInfo", Object=camera).outputs
    right, up, back = (_turned(tree, axis, Field(view["Rotation"])) for axis in _AXES)
    forward = back * -1.0
    centre = Field(add(tree, "FunctionNodeTransformPoint", Vector=position, Transform=to_world).outputs["Vector"])
    ray = centre - Field(view["Location"])
    depth = ray.dot(forward)
    widened = depth * pixel_size
    lens = add(tree, "GeometryNodeCameraInfo", Camera=camera).outputs
    projection = add(tree, "FunctionNodeSeparateMatrix", Matrix=Field(lens["Projection Matrix"])).outputs
    perspective = Field(lens["Is Orthographic"]) * -1.0 + 1.0

    def image_axis(axis: Field, scale: bpy.types.NodeSocket) -> Field:
        # Entry (i, i) of a projection matrix is the inverse of half the image's extent at depth one.
        limit = Field(scale).math("DIVIDE", FRUSTUM_MARGIN).math("POWER", -1.0)
        slope = ray.dot(axis).math("DIVIDE", depth)
        slope = slope.math("MINIMUM", limit).math("MAXIMUM", limit * -1.0) * perspective
        return axis - forward * slope

    across = image_axis(right, projection["Column 1 Row 1"])
    along = image_axis(up, projection["Column 2 Row 2"])
    xx = yy = widened * widened * PIXEL_VARIANCE
    products = []
    sigma, rotation = _sigma_and_rotation(tree)
    for axis, size in zip(_AXES, sigma.xyz(), strict=True):
        half_axis = _direction(tree, _turned(tree, axis, rotation) * size, to_world)
        x, y = half_axis.dot(across), half_axis.dot(along)
        xx, yy = xx + x * x, yy + y * y
        products.append(x * y)
    xy = products[0] + products[1] + products[2]
    # Eigenvalues and first eigenvector of [[xx, xy], [xy, yy]].
    middle, difference = (xx + yy) * 0.5, (xx - yy) * 0.5
    spread = (difference * difference + xy * xy).math("SQRT")
    angle = xy.math("ARCTAN2", difference) * 0.5
    cosine, sine = angle.math("COSINE"), angle.math("SINE")
    # A splat seen edge-on keeps a small width: the matrix of its rectangle must be invertible.
    least = (middle - spread).math("MAXIMUM", (middle + spread) * 1e-10)
    longest = (right * cosine + up * sine) * (middle + spread).math("SQRT")
    return longest, (up * cosine - right * sine) * least.math("SQRT"), depth


def material(facing: bool) -> bpy.types.Material:
    """The material of the rectangles (`facing`) or of the ellipsoids; made once per file."""
    name = "SWAG Splats Facing" if facing else "SWAG Splats"
    if (known := bpy.data.materials.get(name)) is not None:
        return known
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = present(made.node_tree)
    tree.nodes.clear()
    owner = "GEOMETRY" if facing else "INSTANCER"
    opacity = _shader_attribute(tree, owner, OPACITY, "Fac")
    if facing:
        point = _shader_attribute(tree, owner, PLACE, "Vector")
        reach = _shader_attribute(tree, owner, REACH, "Fac")
        alpha = opacity * (point.dot(point) * reach * reach * -0.5).math("EXPONENT")
        alpha = alpha * alpha.math("GREATER_THAN", MIN_ALPHA)
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
    # EEVEE's other method is stochastic transparency, which is noisy.
    made.surface_render_method = "BLENDED"
    cast(Any, made).cycles.emission_sampling = "NONE"  # there are too many to sample them as lamps
    add(tree, "ShaderNodeOutputMaterial", Surface=Field(mix.outputs[0]))
    arranged(tree)
    return made


def _captured(tree: bpy.types.NodeTree, points: Field, matrix: Field) -> tuple[Field, Field]:
    """The points with the matrix of each captured, and the captured matrix."""
    node: Any = add(tree, "GeometryNodeCaptureAttribute", {"domain": "POINT"}, Geometry=points)
    node.capture_items.new("MATRIX", "Place")
    tree.links.new(matrix.socket, node.inputs["Place"])
    return Field(node.outputs["Geometry"]), Field(node.outputs["Place"])


def _sigma_and_rotation(tree: bpy.types.NodeTree) -> tuple[Field, Field]:
    return attribute(tree, "scale", "FLOAT_VECTOR"), attribute(tree, "rotation", "QUATERNION")


def _turned(tree: bpy.types.NodeTree, axis: tuple[float, float, float], rotation: Field) -> Field:
    return Field(add(tree, "FunctionNodeRotateVector", Vector=axis, Rotation=rotation).outputs["Vector"])


def _direction(tree: bpy.types.NodeTree, vector: Field, matrix: Field) -> Field:
    node = add(tree, "FunctionNodeTransformDirection", Direction=vector, Transform=matrix)
    return Field(node.outputs["Direction"])


def _shaded(tree: bpy.types.NodeTree, mesh: Field, shading: bpy.types.Material) -> Field:
    return Field(add(tree, "GeometryNodeSetMaterial", Geometry=mesh, Material=shading).outputs["Geometry"])


def _shader_attribute(tree: bpy.types.NodeTree, owner: str, name: str, output: str) -> Field:
    node = add(tree, "ShaderNodeAttribute", {"attribute_type": owner, "attribute_name": name})
    return Field(node.outputs[output])
