"""The engine in Blender: objects, panels, the engine's process. Nothing here trains or imports torch."""

EXTENSION = __package__.rpartition(".")[0]
"""Full name of the extension, such as bl_ext.user_default.swag_splatting."""
