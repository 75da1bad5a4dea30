"""How the engine appears in Blender. Nothing here trains, and nothing here imports torch."""

# The extension's full name, such as bl_ext.user_default.swag_splatting.
EXTENSION = __package__.rpartition(".")[0]
