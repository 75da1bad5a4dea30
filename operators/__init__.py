"""What a user can do: one module a verb. Each names its CLASSES and may have register() and unregister()."""

import bpy

from . import (
    cancel,
    export_splats,
    forecast,
    import_scene,
    import_splats,
    inspect_scene,
    install_engine,
    labels,
    node_assets,
    plan,
    prepare_render,
    set_scale,
    show_log,
    train,
    water_objects,
)

_MODULES = (
    inspect_scene,
    import_scene,
    plan,
    forecast,
    train,
    cancel,
    show_log,
    import_splats,
    labels,
    prepare_render,
    water_objects,
    set_scale,
    export_splats,
    node_assets,
    install_engine,
)


# These act on one line of the list of labels, and stand beside it alone.
_ON_A_LABEL = (labels.SWAG_OT_isolate_label, labels.SWAG_OT_select_label, labels.SWAG_OT_keep_mask)


class SWAG_MT_splatting(bpy.types.Menu):
    """Every operator, so that F3 finds it and a shortcut can be given to it"""

    bl_label = "SWAG Splatting"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.operator_context = "INVOKE_DEFAULT"
        for module in _MODULES:
            for cls in module.CLASSES:
                if issubclass(cls, bpy.types.Operator) and cls not in _ON_A_LABEL:
                    self.layout.operator(cls.bl_idname)
            self.layout.separator()


def _menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.menu(SWAG_MT_splatting.__name__)


def register() -> None:
    for module in _MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()
    bpy.utils.register_class(SWAG_MT_splatting)
    bpy.types.VIEW3D_MT_object.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object.remove(_menu)
    bpy.utils.unregister_class(SWAG_MT_splatting)
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
