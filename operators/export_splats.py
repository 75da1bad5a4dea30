"""Save splats for other programs."""

from pathlib import Path
from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.operator_base import ReportingOperator
from ..swag_blender.splat_export import OPTION_PROPERTIES, ExportSettings, expected_size, save_splats
from ..swag_blender.splat_formats import FILE_FILTER, is_splat_file, menu_text


@with_properties
class SWAG_OT_export_splats(ReportingOperator, ExportHelper):
    """Save splat objects as one PLY, GLB or SPZ file, their transforms and modifiers applied"""

    bl_idname = "swag.export_splats"
    bl_label = "Export Gaussian Splats"
    bl_options = {"REGISTER", "PRESET"}

    filename_ext = ".ply"
    filter_glob: Annotated[str, StringProperty(default=FILE_FILTER, options={"HIDDEN"})]
    check_existing: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    use: Annotated[
        str,
        EnumProperty(
            name="Objects",
            items=[
                ("SELECTED", "Selected", "The selected splat objects"),
                ("VISIBLE", "Visible", "All splat objects that are visible in the viewport"),
            ],
        ),
    ]
    part: Annotated[
        str,
        EnumProperty(
            name="Splats",
            items=[
                ("ALL", "All", "All splats of the objects, hidden ones too"),
                ("VISIBLE", "Visible", "Splats that are not hidden and lie inside the crop box of their object"),
                ("SELECTED", "Selected", "The selected splats"),
            ],
            default="VISIBLE",
        ),
    ]
    frame: Annotated[
        str,
        EnumProperty(
            name="Axes",
            items=[
                ("UPRIGHT", "Upright", "Blender's up is up in other programs: y down in a PLY, y up in a GLB or SPZ"),
                ("Y_UP", "Y Up", "PLY with y up, for programs that do not turn a PLY; a GLB or SPZ always has y up"),
                ("Z_UP", "Z Up", "PLY with Blender's own axes; a GLB or SPZ always has y up"),
                ("SCENE", "COLMAP Scene", "PLY in the COLMAP coordinates of the imported scene"),
                (
                    "GEOREFERENCED",
                    "Georeferenced",
                    "Metric frame of the measured scale: metres with z up, with offset and coordinate reference system",
                ),
            ],
        ),
    ]
    metres_per_unit: Annotated[
        float,
        FloatProperty(
            name="Metres per Unit",
            description="Length of one Blender unit in metres; the file is in metres",
            default=1.0,
            min=1e-6,
            soft_max=100.0,
        ),
    ]
    crop_object: Annotated[
        str,
        StringProperty(
            name="Crop Box", description="Only splats inside the bounding box of this object; an empty has its cube"
        ),
    ]
    develop: Annotated[
        bool,
        BoolProperty(
            name="Development",
            description="Develop the colors as the panel Color says; highlights are not rolled off",
            default=True,
        ),
    ]
    # The options that the command line has, too, are added below the class.
    forecast: Annotated[str, StringProperty(options={"HIDDEN", "SKIP_SAVE"})]
    forecast_of: Annotated[str, StringProperty(options={"HIDDEN", "SKIP_SAVE"})]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Any:  # the bases declare two types
        """Open the file browser."""
        self.metres_per_unit = present(context.scene).unit_settings.scale_length
        self._update_forecast(context)
        return super().invoke(context, event)

    def check(self, context: bpy.types.Context) -> bool:
        """Update suffix and forecast after a change in the file browser; returns whether anything changed."""
        # The ending of any format is valid; ExportHelper would add .ply to .glb.
        changed = not is_splat_file(Path(self._filepath())) and super().check(context)
        return self._update_forecast(context) or changed

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the options; Blender calls this."""
        layout = present(self.layout)
        layout.use_property_split = True
        layout.use_property_decorate = False
        for names in (
            ("use", "part", "frame", "metres_per_unit"),
            ("labels", "crop_object", "min_opacity"),
            ("water", "develop", "sh_degree", "extras", "cameras"),
        ):
            column = layout.column(align=True)
            for name in names:
                if name == "crop_object":
                    column.prop_search(self, name, context.scene, "objects")
                else:
                    column.prop(self, name)
        layout.label(text=self.forecast, icon="INFO")

    def work(self, context: bpy.types.Context) -> str:
        """Save the file."""
        path = Path(bpy.path.abspath(self._filepath()))
        count, notes = save_splats(context, path, ExportSettings.from_dialog(self))
        for note in notes:
            self.report({"WARNING"}, note)
        return f"Saved {count} splats to {path}."

    def _filepath(self) -> str:
        """The chosen file, a property that ExportHelper has and fake-bpy-module does not declare."""
        return cast(Any, self).filepath

    def _update_forecast(self, context: bpy.types.Context) -> bool:
        """Show the size of the file; returns whether the options have changed."""
        path, settings = Path(self._filepath()), ExportSettings.from_dialog(self)
        of = f"{path.suffix.lower()} {path.parent.is_dir()} {settings}"
        if of == self.forecast_of:
            return False
        self.forecast_of, self.forecast = of, expected_size(context, path, settings)
        return True


SWAG_OT_export_splats.__annotations__ |= OPTION_PROPERTIES


def draw_export(layout: bpy.types.UILayout) -> None:
    """Draw the line in File > Export."""
    layout.operator(SWAG_OT_export_splats.bl_idname, text=menu_text(), translate=False)


CLASSES = (SWAG_OT_export_splats,)
