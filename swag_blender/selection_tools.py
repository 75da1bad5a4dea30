"""The selection tools in the toolbar of the 3D viewport, and their shortcuts."""

from typing import Any

import bpy
from gpu_extras.presets import draw_circle_2d

from .blender_types import present

AFTER = "builtin.select_box"
"""A tool of Blender; the group stands at the end of its section of the toolbar."""


def _keymap(operator: str) -> Any:
    """Items of a tool's keymap: a press of the left mouse button, alone, with Shift and with Ctrl."""
    press, properties = {"type": "LEFTMOUSE", "value": "PRESS"}, {"properties": [("wait_for_input", False)]}
    return tuple((operator, press | keys, properties) for keys in ({}, {"shift": True}, {"ctrl": True}))


class SelectionTool(bpy.types.WorkSpaceTool):
    """Tool of the toolbar that selects splats; it gives `operator`, `settings` and `key`."""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname: str
    bl_label: str
    bl_description: str
    operator: str
    settings: tuple[str, ...] = ("through",)
    key: str
    """Key that chooses the tool, with Shift and Alt."""

    # Blender calls it without the class.
    def draw_settings(context: bpy.types.Context, layout: bpy.types.UILayout, tool: Any) -> None:  # type: ignore[misc]  # noqa: N805
        """Draw the settings of the tool in the header; Blender calls this."""
        cls = next(one for one in TOOLS if one.bl_idname == tool.idname)
        for name in cls.settings:
            layout.prop(tool.operator_properties(cls.operator), name)


class SWAG_TOOL_box(SelectionTool):
    """Tool Box."""

    bl_idname = "swag.tool_box"
    bl_label = "Select Splats Box"
    bl_description = "Select splats by dragging a box in the viewport; Shift adds, Ctrl removes"
    bl_icon = "ops.generic.select_box"
    operator, key = "swag.select_box", "B"
    bl_keymap = _keymap(operator)


class SWAG_TOOL_circle(SelectionTool):
    """Tool Circle."""

    bl_idname = "swag.tool_circle"
    bl_label = "Select Splats Circle"
    bl_description = "Select splats by dragging a circle from its middle in the viewport; Shift adds, Ctrl removes"
    bl_icon = "ops.generic.select_circle"
    operator, key = "swag.select_circle", "C"
    bl_keymap = _keymap(operator)


class SWAG_TOOL_lasso(SelectionTool):
    """Tool Lasso."""

    bl_idname = "swag.tool_lasso"
    bl_label = "Select Splats Lasso"
    bl_description = "Select splats by drawing around them in the viewport; Shift adds, Ctrl removes"
    bl_icon = "ops.generic.select_lasso"
    operator, key = "swag.select_lasso", "L"
    bl_keymap = _keymap(operator)


class SWAG_TOOL_brush(SelectionTool):
    """Tool Brush."""

    bl_idname = "swag.tool_brush"
    bl_label = "Select Splats Brush"
    bl_description = "Select splats by painting with a brush in the viewport; the mouse wheel changes its size"
    bl_icon = "ops.generic.select_paint"
    operator, key = "swag.select_brush", "P"
    settings = ("radius", "through")
    bl_keymap = _keymap(operator)

    def draw_cursor(context: bpy.types.Context, tool: Any, position: tuple[int, int]) -> None:  # type: ignore[misc]  # noqa: N805
        """Draw the brush at the pointer; Blender calls this."""
        radius = tool.operator_properties("swag.select_brush").radius
        draw_circle_2d(position, (1.0, 1.0, 1.0, 1.0), radius, segments=48)


class SWAG_TOOL_sphere(SelectionTool):
    """Tool Sphere."""

    bl_idname = "swag.tool_sphere"
    bl_label = "Select Splats Sphere"
    bl_description = "Select the splats in a sphere around the one that you click; a drag or the wheel changes its size"
    bl_icon = "ops.mesh.primitive_sphere_add_gizmo"
    operator, key = "swag.select_sphere", "S"
    settings = ("radius",)
    bl_keymap = _keymap(operator)


class SWAG_TOOL_flood(SelectionTool):
    """Tool Flood."""

    bl_idname = "swag.tool_flood"
    bl_label = "Select Splats Flood"
    bl_description = "Select the connected splats of similar color and the same label around the one that you click"
    bl_icon = "brush.paint_texture.fill"
    operator, key = "swag.select_flood", "F"
    settings = ("tolerance", "same_label")
    bl_keymap = _keymap(operator)


TOOLS: tuple[type[SelectionTool], ...] = (
    SWAG_TOOL_box,
    SWAG_TOOL_circle,
    SWAG_TOOL_lasso,
    SWAG_TOOL_brush,
    SWAG_TOOL_sphere,
    SWAG_TOOL_flood,
)
_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


def register() -> None:
    """Add the tools to the toolbar, and a shortcut for each."""
    for number, tool in enumerate(TOOLS):
        after = TOOLS[number - 1].bl_idname if number else AFTER
        bpy.utils.register_tool(tool, after={after}, group=number == 0)
    keyconfig = present(bpy.context.window_manager).keyconfigs.addon
    if keyconfig is None:  # without a window
        return
    keymap: Any = keyconfig.keymaps.new("Object Mode")
    for tool in TOOLS:
        item: Any = keymap.keymap_items.new("wm.tool_set_by_id", tool.key, "PRESS", shift=True, alt=True)
        item.properties.name = tool.bl_idname
        _keys.append((keymap, item))


def unregister() -> None:
    """Undo `register`."""
    while _keys:
        keymap, item = _keys.pop()
        keymap.keymap_items.remove(item)
    for tool in reversed(TOOLS):
        bpy.utils.unregister_tool(tool)
