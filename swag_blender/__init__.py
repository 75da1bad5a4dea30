"""The engine in Blender: objects, panels, the engine's process. Nothing here trains or imports torch."""

EXTENSION = __package__.rpartition(".")[0]
"""Full name of the extension, such as bl_ext.user_default.swag_splatting."""
WORDS = "SWAG"
"""Context of translations where Blender's own word for the same English one would be wrong: Scale is no verb here."""
