"""Save the selected splats for other programs: 3DGS PLY, or glTF with KHR_gaussian_splatting."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..swag_blender import scene_import, splats
from ..swag_engine.errors import InputError
from ..swag_engine.formats.gltf import write_glb
from ..swag_engine.formats.ply import write_ply
from ..swag_engine.gaussians.splats import concatenate

SUFFIXES = (".ply", ".glb")


class SWAG_OT_export_splats(bpy.types.Operator, ExportHelper):
    """Save the selected splat objects as one PLY or GLB file, their transforms applied"""

    bl_idname = "swag.export_splats"
    bl_label = "Export Gaussian Splats"
    bl_options = {"REGISTER", "PRESET"}

    filename_ext = ".ply"
    filter_glob: StringProperty(default="*.ply;*.glb", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    frame: EnumProperty(
        name="Axes",
        items=[
            ("UPRIGHT", "Upright", "Blender's up is up in other programs: y down in a PLY, y up in a GLB"),
            ("SCENE", "Of the Scene", "PLY in the COLMAP frame of the scene that the splats hang from"),
        ],
    )

    def check(self, context: bpy.types.Context) -> bool:
        # Either suffix is good; ExportHelper would put .ply after .glb.
        if Path(self.filepath).suffix.lower() in SUFFIXES:
            return False
        return super().check(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.filepath))
        try:
            count = self._save(context, path)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Saved {count} splats to {path}.")
        return {"FINISHED"}

    def _save(self, context: bpy.types.Context, path: Path) -> int:
        chosen = [obj for obj in context.selected_objects if splats.is_splats(obj)]
        if not chosen:
            raise InputError("No splats are selected: select the splat objects to save.")
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"{path.name} cannot be saved: give the file a name that ends in .ply or .glb.")
        frame, up = splats.FILE_FRAME, {}
        if self.frame == "SCENE":
            root = scene_import.find_root(chosen[0])
            if root is None:
                raise InputError(f"{chosen[0].name} hangs from no imported scene: save it upright.")
            frame, up = root.matrix_world, {"up": scene_import.up_of(root)}
        depsgraph = context.evaluated_depsgraph_get()
        together = concatenate([splats.read_splats_in(obj, frame, depsgraph) for obj in chosen])
        if path.suffix.lower() == ".glb":
            write_glb(path, together, **up)
        else:
            write_ply(path, together)
        return len(together)


def _menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(SWAG_OT_export_splats.bl_idname, text="Gaussian Splats (.ply, .glb)")


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)


CLASSES = (SWAG_OT_export_splats,)
