"""Drawing of splats in every 3D viewport that is not in Rendered shading.

The splats go into a picture of their own, in display values and at the depth of what Blender has drawn, and the picture
is then laid over the viewport. While nothing changes the picture is laid over again, which costs little.
"""

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Color, Vector

from ...swag_engine.splats.development import NO_DEVELOPMENT
from .. import background, colors, display, water
from ..blender_types import present
from ..crop_box import world_to_box
from ..nodes import splat_preview
from ..properties import swag_of
from .depth_order import Part, Sorter
from .packing import HARMONICS_TEXELS, OBJECT_TEXELS, ObjectTexels
from .placements import Placement, placements
from .shaders import NEAR, NO_FLOOR, VIEW_FLOATS, Shaders, development_constants, floor_constants, frustum_limits
from .splat_store import SplatStore, float_buffer, new_texture

REST_SECONDS = 0.25
"""Time without a change of the view after which it counts as resting and all splats are drawn."""
TICK_SECONDS = 0.02
"""Time between two looks at sorts that are under way."""
BUDGET, SOFTWARE_BUDGET = 1_000_000, 50_000
"""Most splats drawn while the view moves: with a graphics card, and where the processor draws."""
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swiftshader", "lavapipe")
SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME"}
"""Types of objects that may have a surface in the floor."""
FLOOR_MARGIN = 0.02
"""Height above the floor that counts as in it, as a fraction of the distance from the eye."""
HUGE = 1e30
_CORNERS: Any = {"corner": [(-1, -1), (1, -1), (-1, 1), (1, 1)]}


class ViewportDrawing:
    """All that is drawn with: shaders, textures of the splats, a picture for each viewport.

    Attributes:
        store: The splats' textures.
        frames: Number of pictures drawn; for measurements.
    """

    def __init__(self) -> None:
        self.store = SplatStore()
        self.frames = 0
        self._shaders = Shaders()
        self._quads = {
            name: batch_for_shader(getattr(self._shaders, name), "TRI_STRIP", _CORNERS)
            for name in ("splats", "depth", "background", "composite")
        }
        self._views: dict[int, _View] = {}
        renderer = gpu.platform.renderer_get().lower()
        self._budget = SOFTWARE_BUDGET if any(name in renderer for name in SOFTWARE_RENDERERS) else BUDGET

    def draw(self, context: bpy.types.Context, objects: Sequence[bpy.types.Object]) -> None:
        """Draw these splat objects into the viewport of the context.

        Args:
            context: That of a draw handler of a 3D viewport.
            objects: The objects to upload, also those that this viewport does not show.
        """
        # Taken first: making a texture or a picture can bind another one.
        framebuffer = gpu.state.active_framebuffer_get()
        region = present(context.region)
        depth: Any = framebuffer.read_depth(0, 0, region.width, region.height)
        self.store.update(objects, context.evaluated_depsgraph_get())
        view = self._view(context)
        shown = [one for one in placements(context) if self.store.part(one.obj) is not None]
        texels = _object_texels(context, shown)
        view.follow_movement()
        self._update_order(view, [present(self.store.part(one.obj)) for one in shown], texels)
        if view.order is None:
            return
        if not view.is_order_of(self.store.splats_version):
            self._lay_over(view, framebuffer)
            return
        table = np.stack([one.texels() for one in texels]) if texels else np.zeros((1, OBJECT_TEXELS, 4), np.float32)
        behind = _behind(context, shown)
        key = (view.matrices, view.size, table.tobytes(), behind, self.store.version, view.orders, zlib.crc32(depth))
        if key != view.picture_key:
            floor = view.floor_constants(_objects_on_floor(context)) if _shows_grid(context) else NO_FLOOR
            self._draw_picture(view, table, behind, depth, floor)
            view.picture_key = key
        self._lay_over(view, framebuffer)

    def is_waiting(self) -> bool:
        """Whether a viewport waits for a sort, or for its view to rest."""
        return any(view.is_waiting for view in self._views.values())

    def tag_redraws(self) -> None:
        """Have the viewports redrawn whose order is ready or whose view has come to rest."""
        for window in present(bpy.context.window_manager).windows:
            for area in window.screen.areas:
                for region in area.regions:
                    view = self._views.get(region.as_pointer())
                    if view is not None and view.can_go_on:
                        region.tag_redraw()

    def _view(self, context: bpy.types.Context) -> "_View":
        region = present(context.region)
        pointer = region.as_pointer()
        if pointer not in self._views:
            regions = {
                region.as_pointer()
                for window in present(context.window_manager).windows
                for area in window.screen.areas
                for region in area.regions
            }
            self._views = {known: view for known, view in self._views.items() if known in regions}
            self._views[pointer] = _View()
        view = self._views[pointer]
        view.set(present(context.region_data), (region.width, region.height))
        view.background = _background_color(context)
        view.development = colors.picture_development(present(context.scene), context.active_object)
        return view

    def _update_order(self, view: "_View", parts: Sequence[Part], texels: Sequence[ObjectTexels]) -> None:
        count = sum(len(part.positions) for part in parts)
        limit = self._budget if view.is_moving and count > self._budget else None
        near = None if view.is_orthographic else NEAR
        rows = [-one.object_to_view[2] for one in texels]
        key = (self.store.splats_version, np.array(rows).tobytes(), [part.first for part in parts], near, limit)
        view.sorter.request(key, parts, rows, near, limit)
        view.wanted_order = key
        if (order := view.sorter.take()) is not None:
            view.order, view.order_count = self.store.order_texture(order), len(order)
            view.orders += 1

    def _draw_picture(
        self,
        view: "_View",
        table: np.ndarray,
        behind: "_Behind | None",
        depth: Any,
        floor: dict[str, tuple[float, ...]],
    ) -> None:
        store, shaders = self.store, self._shaders
        objects = new_texture(table, (OBJECT_TEXELS, len(table)), "RGBA32F")
        scene_depth = gpu.types.GPUTexture(view.size, format="R32F", data=depth)
        store.uploaded += table.nbytes + len(depth) * view.size[0] * 4
        block = view.block(store.width, HARMONICS_TEXELS[store.degree])
        picture = view.picture
        with picture.bind():
            buffer = gpu.state.active_framebuffer_get()
            buffer.clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.color_mask_set(False, False, False, False)
            gpu.state.depth_mask_set(True)
            gpu.state.depth_test_set("ALWAYS")
            shaders.depth.bind()
            shaders.depth.uniform_sampler("depths", scene_depth)
            for name, values in floor.items():
                shaders.depth.uniform_float(name, values)
            self._quads["depth"].draw(shaders.depth)
            gpu.state.color_mask_set(True, True, True, True)
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("LESS_EQUAL")
            if behind is not None:
                shaders.background.bind()
                shaders.background.uniform_block("view", block)
                shaders.background.uniform_sampler("objects", objects)
                shaders.background.uniform_int("water_object", behind.number)
                shaders.background.uniform_float("color", behind.color)
                self._quads["background"].draw(shaders.background)
            if view.order_count:
                gpu.state.blend_set("ALPHA_PREMULT")
                shaders.splats.bind()
                shaders.splats.uniform_block("view", block)
                for name, texture in (
                    ("geometry", store.geometry),
                    ("harmonic_data", store.harmonics),
                    ("states", store.states),
                    ("order", view.order),
                    ("objects", objects),
                ):
                    shaders.splats.uniform_sampler(name, present(texture))
                self._quads["splats"].draw_instanced(shaders.splats, instance_start=0, instance_count=view.order_count)
        self.frames += 1

    def _lay_over(self, view: "_View", framebuffer: Any) -> None:
        with framebuffer.bind():
            gpu.state.blend_set("ALPHA_PREMULT")
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
            composite = self._shaders.composite
            composite.bind()
            composite.uniform_float("background", (*view.background, 1.0))
            for name, values in development_constants(view.development).items():
                composite.uniform_float(name, values)
            composite.uniform_sampler("picture", view.picture.texture_color)
            self._quads["composite"].draw(composite)
            gpu.state.blend_set("NONE")


@dataclass(frozen=True)
class _Behind:
    """What is behind the splats of a viewport.

    Attributes:
        number: of the splat object that it is from, among those that are shown.
        color: display values and 1, or zeros where the object's open water is behind the splats.
    """

    number: int
    color: tuple[float, float, float, float]


class _View:
    """One viewport: its matrices, the order of its splats, its picture."""

    def __init__(self) -> None:
        self.sorter = Sorter()
        self.order: gpu.types.GPUTexture | None = None
        self.order_count, self.orders = 0, 0
        self.wanted_order: object = None
        self.background = (0.0, 0.0, 0.0)
        self.development = NO_DEVELOPMENT
        self.size = (0, 0)
        self.matrices = b""
        self.picture_key: object = None
        self.picture: Any = None
        self._followed = b""
        self._moved_at = -REST_SECONDS

    def set(self, region_data: bpy.types.RegionView3D, size: tuple[int, int]) -> None:
        """Take matrices and size of the viewport."""
        self._projection = np.array(region_data.window_matrix, np.float64)
        self._to_view = to_view = np.array(region_data.view_matrix, np.float64)
        self._clip = np.zeros((0, 4))
        if region_data.use_clip_planes:
            planes = np.array([list(plane) for plane in region_data.clip_planes][:4], np.float64)
            self._clip = planes @ np.linalg.inv(to_view)
        self.matrices = b"".join(matrix.tobytes() for matrix in (self._projection, to_view, self._clip))
        if size != self.size:
            self.size, self.picture_key = size, None
            self.picture = gpu.types.GPUOffScreen(*size, format="RGBA16F")

    def floor_constants(self, objects: tuple[float, float, float, float]) -> dict[str, tuple[float, ...]]:
        """Constants of the depth shader where objects of that part of the floor may be in it."""
        return floor_constants(self._projection, self._to_view, objects)

    def follow_movement(self) -> None:
        """Note whether the view has changed since the last call."""
        if self._followed and self._followed != self.matrices:
            self._moved_at = time.monotonic()
        self._followed = self.matrices

    def is_order_of(self, splats_version: int) -> bool:
        """Whether the order names the splats by the numbers that they have in the textures now."""
        taken: Any = self.sorter.taken
        return taken[0] == splats_version

    @property
    def is_orthographic(self) -> bool:
        """Whether rays are parallel."""
        return bool(self._projection[3, 3] == 1.0)

    @property
    def is_moving(self) -> bool:
        """Whether the view changed a moment ago."""
        return time.monotonic() - self._moved_at < REST_SECONDS

    @property
    def is_waiting(self) -> bool:
        """Whether the viewport shows an older order than it should, or is moving."""
        return self.sorter.is_sorting or self.sorter.taken != self.wanted_order or self.is_moving or self._shows_less

    @property
    def can_go_on(self) -> bool:
        """Whether a redraw would show something newer."""
        return self.sorter.is_done or (self._shows_less and not self.is_moving)

    @property
    def _shows_less(self) -> bool:
        """Whether only the splats of the largest contribution are shown."""
        taken: Any = self.sorter.taken
        return taken is not None and taken[-1] is not None

    def block(self, width: int, harmonics_texels: int) -> gpu.types.GPUUniformBuf:
        """The uniform buffer of the shaders, as shaders.py declares it."""
        values = np.zeros(VIEW_FLOATS, np.float32)
        projection = self._projection
        values[:16] = projection.T.ravel()
        values[16:20] = projection[0, 0] * self.size[0] / 2, projection[1, 1] * self.size[1] / 2, *self.size
        values[20:24] = frustum_limits(projection)
        layout = values[24:28].view(np.int32)
        layout[:] = width, harmonics_texels, len(self._clip), self.is_orthographic
        values[28 : 28 + self._clip.size] = self._clip.ravel()
        return gpu.types.GPUUniformBuf(float_buffer(values))


def _shows_grid(context: bpy.types.Context) -> bool:
    """Whether the viewport of the context shows lines in the floor."""
    overlay: Any = cast(bpy.types.SpaceView3D, context.space_data).overlay
    return overlay.show_overlays and (overlay.show_floor or overlay.show_axis_x or overlay.show_axis_y)


def _objects_on_floor(context: bpy.types.Context) -> tuple[float, float, float, float]:
    """Least x and y, and largest x and y, of the objects besides point clouds that may have a surface in the floor.

    Instances of collections may have one anywhere. What is near the floor counts, because the shader tells the two
    apart by their depth, less exactly with the distance from the eye.
    """
    eye = np.array(present(context.region_data).view_matrix.inverted().translation)
    boxes = []
    for obj in context.visible_objects:
        if obj.type == "EMPTY" and obj.instance_type == "COLLECTION":
            return -HUGE, -HUGE, HUGE, HUGE
        if obj.type in SURFACES:
            corners = np.array([obj.matrix_world @ Vector(corner) for corner in obj.bound_box])
            margin = FLOOR_MARGIN * np.linalg.norm(corners - eye, axis=1).max()
            if corners[:, 2].min() < margin and corners[:, 2].max() > -margin:
                boxes.append((corners.min(axis=0) - margin, corners.max(axis=0) + margin))
    if not boxes:
        return HUGE, HUGE, -HUGE, -HUGE
    (left, front, _), (right, back, _) = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    return left, front, right, back


def _object_texels(context: bpy.types.Context, shown: Sequence[Placement]) -> list[ObjectTexels]:
    """What the shaders need to know of each placement in the viewport of the context."""
    to_view = np.array(present(context.region_data).view_matrix, np.float64)
    amount = swag_of(context.scene).water
    made = []
    for one in shown:
        settings = display.display_of(one.obj)
        own_water = water.water_of(one.obj)
        to_box = world_to_box(one.obj)
        made.append(
            ObjectTexels(
                object_to_view=to_view @ one.to_world,
                sh_degree=settings.sh_degree,
                density=settings.density / 100,
                water=own_water,
                water_amount=amount if own_water else 0.0,
                haze_amount=water.shown_haze(present(context.scene)),
                pixel_size=splat_preview.pixel_size_of(one.obj),
                # An instance is cropped as its object is.
                crop=None if to_box is None else to_box @ np.array(one.obj.matrix_world, np.float64),
            )
        )
    return made


def _behind(context: bpy.types.Context, shown: Sequence[Placement]) -> _Behind | None:
    """What is behind these splats; None where that is unknown and the viewport's own background stays."""
    objects = [one.obj for one in shown]
    obj = background.find((o for o in objects if display.display_of(o).background), context.active_object)
    if obj is None:
        return None
    color = background.color_behind(obj)
    if color is None:
        return _Behind(objects.index(obj), (0.0,) * 4) if background.has_open_water(obj) else None
    return _Behind(objects.index(obj), (*color, 1.0))


def _background_color(context: bpy.types.Context) -> tuple[float, float, float]:
    """The sRGB color of the viewport's background where nothing is drawn; of a gradient, its upper color."""
    shading = cast(bpy.types.SpaceView3D, context.space_data).shading
    world = present(context.scene).world
    if shading.type in {"SOLID", "WIREFRAME"} and shading.background_type == "VIEWPORT":
        color = Color(shading.background_color[:]).from_scene_linear_to_srgb()
    elif shading.type in {"SOLID", "WIREFRAME"} and shading.background_type == "WORLD" and world is not None:
        color = Color(world.color[:]).from_scene_linear_to_srgb()
    else:
        color = present(context.preferences).themes[0].view_3d.space.gradients.high_gradient
    red, green, blue = color[:]
    return red, green, blue
