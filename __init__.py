"""SWAG Splatting: underwater photographs become 3D Gaussians in Blender. Registers the extension, nothing else."""

from . import operators
from .swag_blender import assets, commands, engine_process, job, panels, preferences, properties, translations, water

_MODULES = (properties, preferences, engine_process, job, operators, panels, water, assets, commands, translations)


def register() -> None:
    """Register everything with Blender."""
    for module in _MODULES:
        module.register()


def unregister() -> None:
    """Take everything out of Blender again."""
    for module in reversed(_MODULES):
        module.unregister()
