"""What a user can do: one module a verb. Each names its CLASSES and may have register() and unregister()."""

import bpy

from . import (
    cancel,
    export_splats,
    import_scene,
    import_splats,
    inspect_scene,
    install_engine,
    labels,
    plan,
    prepare_render,
    show_log,
    train,
)

_MODULES = (
    inspect_scene,
    import_scene,
    plan,
    train,
    cancel,
    show_log,
    import_splats,
    labels,
    prepare_render,
    export_splats,
    install_engine,
)


def register() -> None:
    for module in _MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
