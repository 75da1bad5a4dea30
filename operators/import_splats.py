"""Open splat files: 3DGS PLY and glTF with KHR_gaussian_splatting, through the menu or dropped into the window."""

from pathlib import Path

import bpy
from bpy.props import CollectionProperty, EnumProperty, IntProperty, StringProperty

from ..swag_blender import scene_import, splats
from ..swag_blender.splat_formats import COLMAP_UP, FILE_ENDINGS, FILE_FILTER, find_format, menu_text
from ..swag_engine.base.errors import InputError


class SWAG_OT_import_splats(bpy.types.Operator):
    """Open Gaussian splats from PLY or GLB files"""

    bl_idname = "swag.import_splats"
    bl_label = "Import Gaussian Splats"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=FILE_FILTER, options={"HIDDEN"})

    frame: EnumProperty(
        name="Place",
        items=[
            ("UPRIGHT", "Upright", "As splat viewers show the file: a PLY has its y axis down, a GLB its y axis up"),
            ("SCENE", "In the Scene", "Where the file's splats were trained, in the imported scene they belong to"),
        ],
    )
    sh_degree: IntProperty(
        name="SH Degree", description="Less takes less memory: 0 keeps colours that do not change with the view",
        default=3, min=0, max=3,
    )  # fmt: skip

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath or self.files:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        names = [file.name for file in self.files if file.name]
        paths = [Path(bpy.path.abspath(self.directory)) / name for name in names]
        paths = paths or [Path(bpy.path.abspath(self.filepath))]
        opened, failed = [], []
        for path in paths:
            try:
                opened.append(self._open(context, path))
            except InputError as error:
                failed.append(str(error))
        for obj in context.selected_objects if opened else ():
            obj.select_set(False)
        for obj in opened:
            obj.select_set(True)
            context.view_layer.objects.active = obj
        for message in failed:
            self.report({"ERROR"}, message)
        if not opened:
            return {"CANCELLED"}
        count = sum(len(obj.data.points) for obj in opened)
        self.report({"INFO"}, f"{count} splats from {len(opened)} {'file' if len(opened) == 1 else 'files'}.")
        return {"FINISHED"}

    def _open(self, context: bpy.types.Context, path: Path) -> bpy.types.Object:
        format = find_format(path)
        root = scene_import.active_root(context) if self.frame == "SCENE" else None
        if self.frame == "SCENE" and root is None:
            raise InputError(f"{path.name} has no scene to stand in: import its COLMAP scene, or place it upright.")
        loaded = format.read(path, scene_import.up_of(root) if root else COLMAP_UP)
        loaded.sh = loaded.sh[:, : (self.sh_degree + 1) ** 2]
        obj = splats.new_splat_object(path.stem, loaded, context.collection, root)
        if root is None:
            obj.matrix_world = splats.FILE_FRAME
        return obj


class SWAG_FH_splats(bpy.types.FileHandler):
    """Splat files dropped into the 3D view"""

    bl_idname = "SWAG_FH_splats"
    bl_label = "Gaussian Splats"
    bl_import_operator = SWAG_OT_import_splats.bl_idname
    bl_file_extensions = FILE_ENDINGS

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


def _menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(SWAG_OT_import_splats.bl_idname, text=menu_text(), translate=False)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)


CLASSES = (SWAG_OT_import_splats, SWAG_FH_splats)
