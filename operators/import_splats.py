"""Open splat files, through the menu or dropped into the window."""

from pathlib import Path
from typing import Annotated

import bpy
from bpy.props import CollectionProperty, EnumProperty, IntProperty, StringProperty

from ..swag_blender import splats
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.splat_formats import FILE_ENDINGS, FILE_FILTER, menu_text
from ..swag_blender.splat_import import open_splats


@with_properties
class SWAG_OT_import_splats(bpy.types.Operator):
    """Open Gaussian splats from PLY, GLB or SPZ files"""

    bl_idname = "swag.import_splats"
    bl_label = "Import Gaussian Splats"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filepath: Annotated[str, StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})]
    directory: Annotated[str, StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})]
    files: Annotated[
        "bpy.types.bpy_prop_collection_idprop[bpy.types.OperatorFileListElement]",
        CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE"}),
    ]
    filter_glob: Annotated[str, StringProperty(default=FILE_FILTER, options={"HIDDEN"})]

    frame: Annotated[
        str,
        EnumProperty(
            name="Placement",
            items=[
                (
                    "UPRIGHT",
                    "Upright",
                    "As splat viewers show the file: a PLY has its y axis down, a GLB or SPZ its y axis up",
                ),
                ("SCENE", "COLMAP Scene", "In the COLMAP coordinates of the imported scene that the file belongs to"),
            ],
        ),
    ]
    sh_degree: Annotated[
        int,
        IntProperty(
            name="SH Degree",
            description="Highest degree of spherical harmonics; a lower one takes less memory, and 0 makes colors the "
            "same from every view",
            default=3,
            min=0,
            max=3,
        ),
    ]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for files where none are given."""
        if self.filepath or self.files:
            return self.execute(context)
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Open the files; those that cannot be opened are reported."""
        names = [file.name for file in self.files if file.name]
        paths = [Path(bpy.path.abspath(self.directory)) / name for name in names]
        paths = paths or [Path(bpy.path.abspath(self.filepath))]
        opened, failed = open_splats(context, paths, self.frame == "SCENE", self.sh_degree)
        for message in failed:
            self.report({"ERROR"}, message)
        if not opened:
            return {"CANCELLED"}
        count = sum(splats.count(obj) for obj in opened)
        self.report({"INFO"}, f"{count} splats from {len(opened)} {'file' if len(opened) == 1 else 'files'}.")
        return {"FINISHED"}


class SWAG_FH_splats(bpy.types.FileHandler):
    """Splat files dropped into the 3D view"""

    bl_idname = "SWAG_FH_splats"
    bl_label = "Gaussian Splats"
    bl_import_operator = SWAG_OT_import_splats.bl_idname
    bl_file_extensions = FILE_ENDINGS

    @classmethod
    def poll_drop(cls, context: bpy.types.Context | None) -> bool:
        """Whether files can be dropped here."""
        return context is not None and context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


def draw_import(layout: bpy.types.UILayout) -> None:
    """Draw the line in File > Import."""
    layout.operator(SWAG_OT_import_splats.bl_idname, text=menu_text(), translate=False)


CLASSES = (SWAG_OT_import_splats, SWAG_FH_splats)
