"""Save splats for other programs: 3DGS PLY, or glTF with KHR_gaussian_splatting."""

from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ExportHelper
from mathutils import Matrix

from ..swag_blender import scene_import, splats
from ..swag_blender.cameras import cameras_of
from ..swag_blender.runs import RUN_KEY
from ..swag_blender.splat_formats import COLMAP_UP, FILE_FILTER, SUFFIXES, find_format, menu_text
from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.cameras import PosedImage, transform_camera, write_cameras
from ..swag_engine.formats.export import cameras_folder, with_water
from ..swag_engine.formats.run_folder import RunFolder, read_json, write_json
from ..swag_engine.formats.select import SplatSelection, label_ids, require_splats
from ..swag_engine.formats.water import transform_water
from ..swag_engine.splats.splats import Splats, concatenate
from ..swag_engine.splats.transform import rotation_to_y_up, transformed

# File to Blender world, for a PLY.
FRAMES = {
    "UPRIGHT": splats.FILE_FRAME,
    "Y_UP": Matrix.Rotation(np.radians(90), 4, "X"),
    "Z_UP": Matrix.Identity(4),
}
CHOICES = (
    "use", "water", "labels", "crop_object", "min_opacity", "sh_degree", "extras", "metres_per_unit", "cameras", "frame"
)  # fmt: skip


class SWAG_OT_export_splats(bpy.types.Operator, ExportHelper):
    """Save splat objects as one PLY or GLB file, their transforms and modifiers applied"""

    bl_idname = "swag.export_splats"
    bl_label = "Export Gaussian Splats"
    bl_options = {"REGISTER", "PRESET"}

    filename_ext = ".ply"
    filter_glob: StringProperty(default=FILE_FILTER, options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    use: EnumProperty(
        name="Objects",
        items=[
            ("SELECTED", "Selected", "The selected splat objects"),
            ("VISIBLE", "Visible", "All splat objects that can be seen in the viewport"),
        ],
    )
    frame: EnumProperty(
        name="Axes",
        items=[
            ("UPRIGHT", "Upright", "Blender's up is up in other programs: y down in a PLY, y up in a GLB"),
            ("Y_UP", "Y Up", "PLY with y up, for programs that show a PLY as it is; a GLB always has y up"),
            ("Z_UP", "Z Up", "PLY in Blender's own axes; a GLB always has y up"),
            ("SCENE", "Of the Scene", "PLY in the COLMAP frame of the scene that the splats hang from"),
        ],
    )
    metres_per_unit: FloatProperty(
        name="Metres per Unit", description="Length of one Blender unit in metres; the file is in metres",
        default=1.0, min=1e-6, soft_max=100.0,
    )  # fmt: skip
    water: FloatProperty(
        name="Water",
        description="How much water the colours show, from 0 (taken away) to 1, as each splat looked from where it was "
        "photographed; from elsewhere it is not right, and the open water behind the splats is not in the file",
        min=0.0, max=1.0, subtype="FACTOR",
    )  # fmt: skip
    labels: StringProperty(
        name="Labels", description="Only splats with these labels: names or numbers with commas; empty for all"
    )
    crop_object: StringProperty(
        name="Crop Box", description="Only splats inside the box around this object; an empty counts as its cube"
    )
    min_opacity: FloatProperty(
        name="Least Opacity", description="Only splats of at least this opacity", min=0.0, max=1.0, subtype="FACTOR"
    )
    sh_degree: IntProperty(
        name="SH Degree", description="0 keeps colours that do not change with the view: the smallest file",
        default=3, min=0, max=3,
    )  # fmt: skip
    extras: BoolProperty(
        name="Further Properties", description="Keep labels and other properties of the splats", default=True
    )
    cameras: BoolProperty(
        name="Cameras",
        description="Write the photographs' cameras too, without lens distortion: in a GLB, and beside the file as a "
        "COLMAP text model, transforms.json and, where the run has a water, water.json",
    )
    forecast: StringProperty(options={"HIDDEN", "SKIP_SAVE"})
    forecast_of: StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.metres_per_unit = context.scene.unit_settings.scale_length
        self._foresee(context)
        return super().invoke(context, event)

    def check(self, context: bpy.types.Context) -> bool:
        # The suffix of any format is good; ExportHelper would put .ply after .glb.
        known = Path(self.filepath).suffix.lower() in SUFFIXES
        changed = not known and super().check(context)
        return self._foresee(context) or changed

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        for names in (("use", "frame", "metres_per_unit"), ("labels", "crop_object", "min_opacity"),
                      ("water", "sh_degree", "extras", "cameras")):  # fmt: skip
            column = layout.column(align=True)
            for name in names:
                if name == "crop_object":
                    column.prop_search(self, name, context.scene, "objects")
                else:
                    column.prop(self, name)
        layout.label(text=self.forecast, icon="INFO")

    def execute(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.filepath))
        try:
            count = self._save(context, path)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Saved {count} splats to {path}.")
        return {"FINISHED"}

    def _foresee(self, context: bpy.types.Context) -> bool:
        """Say how large the file will be; whether that has changed."""
        path = Path(self.filepath)
        of = repr([path.suffix.lower(), *(getattr(self, name) for name in CHOICES)])
        if of == self.forecast_of:
            return False
        self.forecast_of = of
        try:
            together, up, _ = self._together(context, path, as_they_are=True)
            size = find_format(path).size(path, together, up, ())
            self.forecast = f"{len(together)} splats, {size / 1e6:.1f} MB"
        except InputError as error:
            self.forecast = str(error)
        return True

    def _save(self, context: bpy.types.Context, path: Path) -> int:
        format = find_format(path)
        together, up, into_file = self._together(context, path)
        seen = []
        if self.cameras:
            chosen = self._chosen(context)
            seen = [transform_camera(camera, into_file) for camera in cameras_of(context, _roots(chosen))]
            if not seen:
                raise InputError("There are no cameras to save: import the scene, add a camera, or leave them out.")
        format.write(path, together, up, seen)
        if seen:
            turn = np.eye(4)
            if "up" not in format.options:
                turn[:3, :3] = rotation_to_y_up(up)
            photographs = [PosedImage.from_camera(transform_camera(camera, turn)) for camera in seen]
            nowhere = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
            for note in write_cameras(cameras_folder(path), photographs, *nowhere)[1]:
                self.report({"WARNING"}, note)
            self._save_water(chosen[0], turn @ into_file, cameras_folder(path) / "water.json")
        return len(together)

    def _save_water(self, obj: bpy.types.Object, into_file: np.ndarray, path: Path) -> None:
        """The coefficients of the water that the object was trained in, in the file's axes and scale."""
        medium, metres = _water(obj)
        if medium:
            # From the frame of the training to that of the file.
            linear = (into_file @ np.array(obj.matrix_world, np.float64))[:3, :3]
            scale = float(np.cbrt(np.linalg.det(linear)))
            in_metres = bool(metres) or self.metres_per_unit != 1.0
            write_json(path, transform_water(medium, linear / scale, scale, metres, in_metres))

    def _chosen(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        if self.use == "VISIBLE":
            chosen = [obj for obj in context.visible_objects if splats.is_splats(obj)]
        else:
            chosen = [obj for obj in context.selected_objects if splats.is_splats(obj)]
        if not chosen:
            raise InputError(
                "No splats can be seen: show the splat objects to save."
                if self.use == "VISIBLE"
                else "No splats are selected: select the splat objects to save."
            )
        return chosen

    def _together(
        self, context: bpy.types.Context, path: Path, as_they_are: bool = False
    ) -> tuple[Splats, np.ndarray, np.ndarray]:
        """All splats to save in the file's frame, its up for a GLB, and the matrix from Blender's world to the file.

        as_they_are: in their own frames and without water, which is quick and enough to tell the size.
        """
        chosen = self._chosen(context)
        up = np.array(COLMAP_UP)
        if self.frame == "SCENE":
            root = scene_import.find_root(chosen[0])
            if root is None:
                raise InputError(f"{chosen[0].name} hangs from no imported scene: save it upright.")
            frame, up = root.matrix_world, scene_import.up_of(root)
        else:
            frame = FRAMES[self.frame if "up" in find_format(path).options else "UPRIGHT"]
        into_file = np.diag([self.metres_per_unit] * 3 + [1.0]) @ np.linalg.inv(np.array(frame, np.float64))
        depsgraph = context.evaluated_depsgraph_get()
        # Evaluated: parents, constraints and animation count.
        places = [np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64) for obj in chosen]
        parts = []
        for obj, place in zip(chosen, places, strict=True):
            kept = self._choice(obj, place).apply(splats.read_modified_splats(obj))
            if as_they_are:
                parts.append(kept)
                continue
            if self.water and len(kept):
                roots = _roots([obj])
                if not roots:
                    raise InputError(f"{obj.name} hangs from no imported scene, so its water is not known.")
                from_root = np.linalg.inv(np.array(roots[0].matrix_world, np.float64))
                seen = [transform_camera(camera, from_root) for camera in cameras_of(context, roots)]
                if not seen:
                    raise InputError(f"The scene of {obj.name} has no cameras left, so its water cannot be shown.")
                medium, metres = _water(obj)
                kept = with_water(kept, medium, seen, self.water, metres)
            parts.append(transformed(kept, into_file @ place))
        return require_splats(concatenate(parts)), up, into_file

    def _choice(self, obj: bpy.types.Object, place: np.ndarray) -> SplatSelection:
        """What to keep of the object that stands at `place`."""
        words = [word.strip() for word in self.labels.split(",") if word.strip()]
        names = Path(bpy.path.abspath(obj.get(RUN_KEY, ""))) / "labels.json"
        box = None
        if self.crop_object:
            cropping = bpy.context.scene.objects.get(self.crop_object)
            if cropping is None:
                raise InputError(f"There is no object {self.crop_object} to crop by: choose another or none.")
            box = _to_unit_box(cropping) @ place
        labels = label_ids(words, names) if words else None
        return SplatSelection(labels, box, self.min_opacity, self.sh_degree, self.extras)


def _roots(chosen: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """The imported scenes that the objects hang from, each once."""
    return list(dict.fromkeys(root for obj in chosen if (root := scene_import.find_root(obj))))


def _water(obj: bpy.types.Object) -> tuple[dict | None, float]:
    """The water of the run that the object is the result of, None where there is none, and its metres per unit."""
    run = RunFolder(Path(bpy.path.abspath(obj.get(RUN_KEY, ""))))
    if RUN_KEY not in obj or not run.water.exists():
        return None, 0.0
    return read_json(run.water, ""), run.read_config()[1].metres_per_unit


def _to_unit_box(obj: bpy.types.Object) -> np.ndarray:
    """From Blender's world to a space in which the box around the object reaches from -1 to 1."""
    corners = np.array(obj.bound_box)
    if obj.type == "EMPTY":
        corners = np.array([[-1.0] * 3, [1.0] * 3]) * obj.empty_display_size
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    half = np.diag([*np.maximum((upper - lower) / 2, 1e-9), 1.0])
    half[:3, 3] = (lower + upper) / 2
    return np.linalg.inv(np.array(obj.matrix_world, np.float64) @ half)


def _menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(SWAG_OT_export_splats.bl_idname, text=menu_text(), translate=False)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)


CLASSES = (SWAG_OT_export_splats,)
