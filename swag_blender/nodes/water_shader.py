"""Shader nodes of a fitted water, for ordinary objects and for the world (world.py).

Each splat object has a node group that holds its water; the group of the asset library has it as inputs. Drivers set
the amount (the slider `scene.swag.water`) and the rotation and scale of the splats' own space, so that both can be
animated. Outputs of a group:
- Color: the light `Color` as seen through the water between the camera and the surface, exact;
- Transmission and Backscatter: seen = Color * Transmission + Backscatter, for surfaces whose light the renderer has not
  computed yet. Exact for a water that acts on linear light; for one that acts on sRGB values, exact at black and at
  middle grey.
- Background Light, and the same as sRGB values: what the camera sees without any surface.
The water acts only on what the camera sees: lamps and reflections are as in air.
"""

from collections.abc import Callable
from typing import Any, Literal, cast

import bpy

from ..blender_types import present
from ..water_values import WaterValues
from .build import Field, add, add_socket, arranged, combined, new_tree
from .formulas import Water, by_channel, mixed, to_display, to_light

Channel = Literal["ROT_X", "ROT_Y", "ROT_Z", "SCALE_AVG"]
NAME = "SWAG Water"
GROUP_KEY = "swag_water_group"
"""Property of a splat object: the node group of its water."""
LIGHT, DISPLAY_VALUES = "Background Light", "Background Light sRGB"
"""Outputs of a group: what the camera sees without any surface, as linear light and as sRGB values."""
MIDDLE_GREY = 0.21404114
"""Linear light of the sRGB value 0.5."""
_COLOR_INPUTS = {"Color", "Base Color", "Emission Color", "Specular Tint", "Sheen Tint"}
"""Inputs by which a shading node multiplies the light that it reflects or emits."""
_NO_SURFACES = {"ShaderNodeMixShader", "ShaderNodeAddShader", "ShaderNodeBsdfTransparent", "ShaderNodeHoldout"}


def node_group(obj: bpy.types.Object, scene: bpy.types.Scene, values: WaterValues) -> bpy.types.NodeTree:
    """The node group of a splat object's water, with these values; made once per object."""
    tree = obj.get(GROUP_KEY)
    if tree is None or not set(values.inputs()) <= set(tree.nodes.keys()):  # or the group of an earlier version
        tree = _new_group(obj, scene)
        obj[GROUP_KEY] = tree
    for name, value in values.inputs().items():
        node = tree.nodes[name]
        if isinstance(value, tuple):
            for socket, component in zip(node.inputs, value, strict=True):
                socket.default_value = component
        else:
            node.outputs[0].default_value = float(value)
    return tree


def free_group(values: WaterValues) -> bpy.types.NodeTree:
    """The node group whose water is in its inputs, with these values as defaults; made once per file."""
    if (tree := bpy.data.node_groups.get(NAME)) is None:
        tree = new_tree(NAME, "ShaderNodeTree")

        def figure(name: str, is_vector: bool) -> Field:
            add_socket(tree, name, "Vector" if is_vector else "Float")
            return Field(tree.nodes.new("NodeGroupInput").outputs[name])

        _build(tree, figure)
    defaults = {"Amount": 1.0, "Splats Scale": 1.0} | values.inputs()
    items: Any = present(tree.interface).items_tree
    for item in items:
        if item.in_out == "INPUT" and item.name in defaults:
            item.default_value = defaults[item.name]
    return tree


def drive(owner: bpy.types.ID, path: str, scene: bpy.types.Scene, index: int = -1, slider: str = "swag.water") -> None:
    """Let a slider of the scene, by default `scene.swag.water`, drive a property."""
    driver = _new_driver(owner, path, index)
    variable = driver.variables.new()
    variable.targets[0].id_type = "SCENE"
    variable.targets[0].id = scene
    variable.targets[0].data_path = slider


def add_water(material: bpy.types.Material, group: bpy.types.NodeTree) -> None:
    """Show the surface of a material through the water of the group; a second call changes the water."""
    remove_water(material)
    tree = present(material.node_tree)
    output = tree.get_output_node("ALL")
    if output is None or not output.inputs["Surface"].is_linked:
        return
    water: Any = tree.nodes.new("ShaderNodeGroup")
    water.node_tree = group
    water.name = water.label = NAME
    for node in list(tree.nodes):
        if not _is_surface(node):
            continue
        for socket in node.inputs:
            if socket.type == "RGBA" and socket.name in _COLOR_INPUTS:
                _multiply(tree, socket, water.outputs["Transmission"])
    surface = _source(output.inputs["Surface"])
    backscatter = add(tree, "ShaderNodeEmission", Color=Field(water.outputs["Backscatter"]))
    both = tree.nodes.new("ShaderNodeAddShader")
    tree.links.new(surface, both.inputs[0])
    tree.links.new(backscatter.outputs[0], both.inputs[1])
    tree.links.new(both.outputs[0], output.inputs["Surface"])
    backscatter.name, both.name = f"{NAME} Backscatter", f"{NAME} Sum"
    for node, shift in ((water, (-700, 300)), (backscatter, (-180, 300)), (both, (-20, 150))):
        node.location = output.location.x + shift[0], output.location.y + shift[1]


def remove_water(material: bpy.types.Material) -> bool:
    """Undo add_water; returns whether the material had water."""
    tree = present(material.node_tree)
    ours = [node for node in tree.nodes if node.name.startswith(NAME)]
    for node in ours:
        if node.bl_idname == "ShaderNodeEmission" or node.bl_idname == "ShaderNodeGroup":
            continue
        for link in list(present(node.outputs[0].links)):
            target: Any = link.to_socket
            if node.inputs[0].is_linked:
                tree.links.new(_source(node.inputs[0]), target)
            elif node.bl_idname == "ShaderNodeVectorMath":
                target.default_value = (*cast(Any, node.inputs[0]).default_value, 1.0)
    for node in ours:
        tree.nodes.remove(node)
    return bool(ours)


def has_water(material: bpy.types.Material) -> bool:
    """Whether the material has water."""
    return material.node_tree is not None and NAME in material.node_tree.nodes


def _new_group(obj: bpy.types.Object, scene: bpy.types.Scene) -> bpy.types.NodeTree:
    tree = new_tree(f"{NAME} {obj.name}", "ShaderNodeTree")

    def figure(name: str, is_vector: bool) -> Field:
        node = tree.nodes.new("ShaderNodeCombineXYZ" if is_vector else "ShaderNodeValue")
        node.name = node.label = name
        return Field(node.outputs[0])

    _build(tree, figure)
    drive(tree, 'nodes["Amount"].outputs[0].default_value', scene)
    _follow(tree, 'nodes["Splats Scale"].outputs[0].default_value', obj, "SCALE_AVG")
    channels: tuple[Channel, ...] = ("ROT_X", "ROT_Y", "ROT_Z")
    for index, channel in enumerate(channels):
        _follow(tree, f'nodes["Splats Rotation"].inputs[{index}].default_value', obj, channel)
    return tree


def _build(tree: bpy.types.NodeTree, figure: Callable[[str, bool], Field]) -> None:
    """Make the nodes of the group; figure(name, is_vector) gives each figure of the water."""
    add_socket(tree, "Color", "Color").description = "Light of the surface without water"
    for name in ("Color", "Transmission", "Backscatter", LIGHT, DISPLAY_VALUES):
        add_socket(tree, name, "Color", "OUTPUT")
    amount, turn, length = figure("Amount", False), figure("Splats Rotation", True), figure("Splats Scale", False)
    inputs = {name: figure(name, isinstance(value, tuple)) for name, value in WaterValues().inputs().items()}
    toward_eye = Field(add(tree, "ShaderNodeNewGeometry").outputs["Incoming"])
    local = add(
        tree,
        "ShaderNodeVectorRotate",
        {"rotation_type": "EULER_XYZ", "invert": True},
        Vector=toward_eye * -1.0,
        Rotation=turn,
    )
    direction = Field(local.outputs["Vector"])
    distance = Field(add(tree, "ShaderNodeCameraData").outputs["View Distance"]).math("DIVIDE", length)
    of_camera = Field(add(tree, "ShaderNodeLightPath").outputs["Is Camera Ray"])
    water = Water.of(inputs, amount)
    background = water.background_light(tree, direction)

    def seen(light: Field) -> Field:
        own = mixed(light, by_channel(tree, to_display, light), water.display)
        through = water.through(tree, own, distance, background)
        return mixed(through, by_channel(tree, to_light, through), water.display)

    own = Field(tree.nodes.new("NodeGroupInput").outputs["Color"])
    black, grey = seen(combined(tree, [0.0] * 3)), seen(combined(tree, [MIDDLE_GREY] * 3))
    transmission = (grey - black) * (1 / MIDDLE_GREY)
    white = combined(tree, [1.0] * 3)
    results = {
        "Color": mixed(own, seen(own), of_camera),
        "Transmission": mixed(white, transmission, of_camera),
        "Backscatter": black * of_camera,
        LIGHT: mixed(background, by_channel(tree, to_light, background), water.display),
        DISPLAY_VALUES: mixed(by_channel(tree, to_display, background), background, water.display),
    }
    output = tree.nodes.new("NodeGroupOutput")
    for name, field in results.items():
        tree.links.new(field.socket, output.inputs[name])
    arranged(tree)


def _new_driver(owner: bpy.types.ID, path: str, index: int = -1) -> bpy.types.Driver:
    owner.driver_remove(path, index)
    # A curve, not a list of them: the path and index are those of one number.
    driver = present(cast(bpy.types.FCurve, owner.driver_add(path, index)).driver)
    # Not a Python expression: Blender does not run those in untrusted files.
    driver.type = "AVERAGE"
    return driver


def _follow(tree: bpy.types.NodeTree, path: str, obj: bpy.types.Object, channel: Channel) -> None:
    variable = _new_driver(tree, path).variables.new()
    variable.type = "TRANSFORMS"
    target = variable.targets[0]
    target.id, target.transform_type, target.transform_space, target.rotation_mode = obj, channel, "WORLD_SPACE", "XYZ"


def _source(socket: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The output that is linked to an input."""
    return present(present(socket.links)[0].from_socket)


def _is_surface(node: bpy.types.Node) -> bool:
    shades = any(socket.type == "SHADER" for socket in node.outputs)
    return shades and node.bl_idname not in _NO_SURFACES and "Volume" not in node.bl_idname


def _multiply(tree: bpy.types.NodeTree, target: bpy.types.NodeSocket, factor: bpy.types.NodeSocket) -> None:
    node: Any = tree.nodes.new("ShaderNodeVectorMath")
    node.operation, node.name, node.hide = "MULTIPLY", f"{NAME} Tint", True
    location = present(target.node).location
    node.location = location.x - 180, location.y
    if target.is_linked:
        tree.links.new(_source(target), node.inputs[0])
    else:
        node.inputs[0].default_value = cast(Any, target).default_value[:3]
    tree.links.new(factor, node.inputs[1])
    tree.links.new(node.outputs[0], target)
