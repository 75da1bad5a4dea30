"""Shader nodes of a fitted water, for ordinary objects and for the world: they stand in the same water as the splats.

One node group per splat object holds its water; one of no object, for the asset library, has it as inputs. The slider
`scene.swag.water` and the object's place (which says what direction and length are in the splats' own space) reach it
by drivers, so that it follows animation. Its outputs:
- Color: the light `Color` as seen through the water between the camera and the surface, exactly;
- Transmission and Veil: seen = Color * Transmission + Veil, for surfaces whose light a renderer has yet to find. Exact
  for a water of light; a water of display values is met at black and at middle grey.
- Open Water, and the same in display values: what is seen where nothing is.
Only what the camera sees goes through the water: lamps and reflections are as they would be in air.
"""

from collections.abc import Callable

import bpy

from ..water_values import WaterValues
from .build import Field, add, arranged, combined
from .formulas import Water, by_channel, mixed, to_display, to_light

NAME = "SWAG Water"
GROUP_KEY = "swag_water_group"  # on a splat object: the node group of its water
MIDDLE_GREY = 0.21404114  # light of display value .5
# Colours by which a shading node multiplies what it gives back or gives off.
_COLOR_INPUTS = {"Color", "Base Color", "Emission Color", "Specular Tint", "Sheen Tint"}
_NO_SURFACES = {"ShaderNodeMixShader", "ShaderNodeAddShader", "ShaderNodeBsdfTransparent", "ShaderNodeHoldout"}


def node_group(obj: bpy.types.Object, scene: bpy.types.Scene, values: WaterValues) -> bpy.types.NodeTree:
    """The node group of the object's water, with these values; made once per object."""
    tree = obj.get(GROUP_KEY)
    if tree is None:
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
    """A node group of no splats: its water is in its inputs, which begin as these values; made once per file."""
    if (tree := bpy.data.node_groups.get(NAME)) is None:
        tree = bpy.data.node_groups.new(NAME, "ShaderNodeTree")

        def held(name: str, is_vector: bool) -> Field:
            kind = "NodeSocketVector" if is_vector else "NodeSocketFloat"
            tree.interface.new_socket(name, in_out="INPUT", socket_type=kind)
            return Field(tree.nodes.new("NodeGroupInput").outputs[name])

        _build(tree, held)
    begin = {"Amount": 1.0, "Splats Scale": 1.0} | values.inputs()
    for item in tree.interface.items_tree:
        if item.in_out == "INPUT" and item.name in begin:
            item.default_value = begin[item.name]
    return tree


def drive(owner: bpy.types.ID, path: str, scene: bpy.types.Scene, index: int = -1) -> None:
    """Let the slider `scene.swag.water` drive a property of the owner."""
    driver = _new_driver(owner, path, index)
    variable = driver.variables.new()
    variable.targets[0].id_type, variable.targets[0].id = "SCENE", scene
    variable.targets[0].data_path = "swag.water"


def put_under_water(material: bpy.types.Material, group: bpy.types.NodeTree) -> None:
    """Let what the material shows be seen through the water of the group; a second call changes the water."""
    take_out_of_water(material)
    tree = material.node_tree
    output = tree.get_output_node("ALL")
    if output is None or not output.inputs["Surface"].is_linked:
        return
    water = tree.nodes.new("ShaderNodeGroup")
    water.node_tree = group
    water.name = water.label = NAME
    for node in list(tree.nodes):
        if not _is_surface(node):
            continue
        for socket in node.inputs:
            if socket.type == "RGBA" and socket.name in _COLOR_INPUTS:
                _multiply(tree, socket, water.outputs["Transmission"])
    surface = output.inputs["Surface"].links[0].from_socket
    veil = add(tree, "ShaderNodeEmission", Color=Field(water.outputs["Veil"]))
    both = tree.nodes.new("ShaderNodeAddShader")
    tree.links.new(surface, both.inputs[0])
    tree.links.new(veil.outputs[0], both.inputs[1])
    tree.links.new(both.outputs[0], output.inputs["Surface"])
    veil.name, both.name = f"{NAME} Veil", f"{NAME} Sum"
    for node, shift in ((water, (-700, 300)), (veil, (-180, 300)), (both, (-20, 150))):
        node.location = output.location.x + shift[0], output.location.y + shift[1]


def take_out_of_water(material: bpy.types.Material) -> bool:
    """Undo put_under_water; returns whether there was anything to undo."""
    tree = material.node_tree
    ours = [node for node in tree.nodes if node.name.startswith(NAME)]
    for node in ours:
        if node.bl_idname == "ShaderNodeEmission" or node.bl_idname == "ShaderNodeGroup":
            continue
        incoming = node.inputs[0].links
        for link in list(node.outputs[0].links):
            target = link.to_socket
            if incoming:
                tree.links.new(incoming[0].from_socket, target)
            elif node.bl_idname == "ShaderNodeVectorMath":
                target.default_value = (*node.inputs[0].default_value, 1.0)
    for node in ours:
        tree.nodes.remove(node)
    return bool(ours)


def is_under_water(material: bpy.types.Material) -> bool:
    """Whether put_under_water was called for the material."""
    return material.node_tree is not None and NAME in material.node_tree.nodes


def set_world(scene: bpy.types.Scene, group: bpy.types.NodeTree, display_values: bool) -> None:
    """Let the scene's world be the open water of the group, as light or as display values."""
    background = background_node(scene)
    tree = background.id_data
    water = tree.nodes.get(NAME) or tree.nodes.new("ShaderNodeGroup")
    water.name = water.label = NAME
    water.node_tree = group
    water.location = background.location.x - 260, background.location.y
    tree.links.new(water.outputs["Open Water Display" if display_values else "Open Water"], background.inputs["Color"])
    background.inputs["Strength"].default_value = 1.0


def background_node(scene: bpy.types.Scene) -> bpy.types.Node:
    """The Background node of the scene's world; both are made where they are missing."""
    scene.world = scene.world or bpy.data.worlds.new("World")
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    node = next((n for n in tree.nodes if n.bl_idname == "ShaderNodeBackground"), None)
    if node is None:
        node = tree.nodes.new("ShaderNodeBackground")
        add(tree, "ShaderNodeOutputWorld", Surface=Field(node.outputs[0]))
    return node


def _new_group(obj: bpy.types.Object, scene: bpy.types.Scene) -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new(f"{NAME} {obj.name}", "ShaderNodeTree")

    def held(name: str, is_vector: bool) -> Field:
        node = tree.nodes.new("ShaderNodeCombineXYZ" if is_vector else "ShaderNodeValue")
        node.name = node.label = name
        return Field(node.outputs[0])

    _build(tree, held)
    drive(tree, 'nodes["Amount"].outputs[0].default_value', scene)
    _follow(tree, 'nodes["Splats Scale"].outputs[0].default_value', obj, "SCALE_AVG")
    for index, axis in enumerate("XYZ"):
        _follow(tree, f'nodes["Splats Rotation"].inputs[{index}].default_value', obj, f"ROT_{axis}")
    return tree


def _build(tree: bpy.types.NodeTree, held: Callable[[str, bool], Field]) -> None:
    """Fill the tree with nodes; held(name, is_vector) gives it each figure of the water."""
    color = tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    color.description = "Light of the surface without water"
    for name in ("Color", "Transmission", "Veil", "Open Water", "Open Water Display"):
        tree.interface.new_socket(name, in_out="OUTPUT", socket_type="NodeSocketColor")
    amount, turn, length = held("Amount", False), held("Splats Rotation", True), held("Splats Scale", False)
    inputs = {name: held(name, isinstance(value, tuple)) for name, value in WaterValues().inputs().items()}
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
    open_water = water.open_water(tree, direction)

    def seen(light: Field) -> Field:
        own = mixed(light, by_channel(tree, to_display, light), water.display)
        through = water.through(tree, own, distance, open_water)
        return mixed(through, by_channel(tree, to_light, through), water.display)

    own = Field(tree.nodes.new("NodeGroupInput").outputs["Color"])
    black, grey = seen(combined(tree, [0.0] * 3)), seen(combined(tree, [MIDDLE_GREY] * 3))
    transmission = (grey - black) * (1 / MIDDLE_GREY)
    white = combined(tree, [1.0] * 3)
    results = {
        "Color": mixed(own, seen(own), of_camera),
        "Transmission": mixed(white, transmission, of_camera),
        "Veil": black * of_camera,
        "Open Water": mixed(open_water, by_channel(tree, to_light, open_water), water.display),
        "Open Water Display": mixed(by_channel(tree, to_display, open_water), open_water, water.display),
    }
    output = tree.nodes.new("NodeGroupOutput")
    for name, field in results.items():
        tree.links.new(field.socket, output.inputs[name])
    arranged(tree)


def _new_driver(owner: bpy.types.ID, path: str, index: int = -1) -> bpy.types.Driver:
    owner.driver_remove(path, index)
    driver = owner.driver_add(path, index).driver
    # No Python expression: those do not run in files from elsewhere.
    driver.type = "AVERAGE"
    return driver


def _follow(tree: bpy.types.NodeTree, path: str, obj: bpy.types.Object, channel: str) -> None:
    variable = _new_driver(tree, path).variables.new()
    variable.type = "TRANSFORMS"
    target = variable.targets[0]
    target.id, target.transform_type, target.transform_space, target.rotation_mode = obj, channel, "WORLD_SPACE", "XYZ"


def _is_surface(node: bpy.types.Node) -> bool:
    shades = any(socket.type == "SHADER" for socket in node.outputs)
    return shades and node.bl_idname not in _NO_SURFACES and "Volume" not in node.bl_idname


def _multiply(tree: bpy.types.NodeTree, target: bpy.types.NodeSocket, factor: bpy.types.NodeSocket) -> None:
    node = tree.nodes.new("ShaderNodeVectorMath")
    node.operation, node.name, node.hide = "MULTIPLY", f"{NAME} Tint", True
    node.location = target.node.location.x - 180, target.node.location.y
    if target.is_linked:
        tree.links.new(target.links[0].from_socket, node.inputs[0])
    else:
        node.inputs[0].default_value = target.default_value[:3]
    tree.links.new(factor, node.inputs[1])
    tree.links.new(node.outputs[0], target)
