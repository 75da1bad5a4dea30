"""Comparison of photos and splats in the viewport: the photo is drawn over the camera's image, left of a movable line.

Photos are drawn in display values, as they are in their files, without the view transform. Nothing of the comparison
stays when it ends: draw handler and texture are removed, and camera, image size and view are as before.
"""

from typing import Any, cast

import blf
import bpy
import gpu
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from gpu_extras.batch import batch_for_shader

from ..swag_engine.base.transfer import linear_to_srgb
from . import scene_import
from .blender_types import OperatorResult, present
from .camera_moves import by_name

LARGEST_TEXTURE = 2048
"""Pixels of the longer side of a photo's texture: more than a viewport shows, and quickly loaded."""
OVERLAY_GAMMA = 2.2
"""Blender decodes what is drawn over a viewport as sRGB, and encodes it for the screen by this power (versions 4.5
to 5.2, gpu_shader_display_transform): dark values would become 5 of 255 too light."""
HANDLE = 9.0
"""Half the size of the line's handle, in pixels at an interface scale of 1."""
STEPS = {
    "RIGHT_ARROW": 1, "UP_ARROW": 1, "WHEELDOWNMOUSE": 1, "LEFT_ARROW": -1, "DOWN_ARROW": -1, "WHEELUPMOUSE": -1,
}  # fmt: skip
"""How many photos an event goes forward."""
WHEEL = {"WHEELUPMOUSE", "WHEELDOWNMOUSE"}
PASSED = {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE", "MIDDLEMOUSE", "WINDOW_DEACTIVATE", "NONE"}
"""Events over the viewport that keep their meaning; others would change the scene under the comparison."""
RENDER_NAMES = ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y")
HELP = "Drag: move the line    Arrow keys, wheel: other photo    Escape: end"

Frame = tuple[float, float, float, float]
"""Left, bottom, right and top of the camera's image in a region, in pixels."""


class PhotoWipe:
    """One comparison in a 3D viewport; `end` must be called.

    Attributes:
        place: where the line is in the camera's image, 0 (left) to 1 (right).

    Args:
        context: its 3D viewport is used; its scene has photos.
    """

    def __init__(self, context: bpy.types.Context) -> None:
        global _running
        scene, self.area = present(context.scene), present(context.area)
        self.space = cast(bpy.types.SpaceView3D, context.space_data)
        self.region = next(region for region in self.area.regions if region.type == "WINDOW")
        self.scene, self.place = scene, 0.5
        self.names = [obj.name for obj in photos(scene)]
        self._dragging = False
        stop()
        view = present(self.space.region_3d)
        self._before: dict[str, Any] = {
            "camera": scene.camera.name if scene.camera else "",
            "render": {name: getattr(scene.render, name) for name in RENDER_NAMES},
            "perspective": view.view_perspective,
            "place": (view.view_rotation.copy(), view.view_location.copy(), view.view_distance),
        }
        self._texture: gpu.types.GPUTexture | None = None
        self._background: tuple[str, bool] | None = None
        self._handler = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        _running = self
        chosen = context.active_object or scene.camera
        self.show(self.names.index(chosen.name) if chosen and chosen.name in self.names else 0)
        present(context.workspace).status_text_set(HELP)

    @property
    def camera(self) -> bpy.types.Object | None:
        """The camera of the photo that is shown; None if it was removed."""
        return self.scene.objects.get(self.names[self.index])

    def handle(self, event: bpy.types.Event) -> OperatorResult:
        """Act on an event of a modal operator; returns what the operator returns."""
        if _running is not self:
            return {"CANCELLED"}
        over, pressed = self.is_over_view(event.mouse_x, event.mouse_y), event.value == "PRESS"
        if event.type in {"ESC", "RET", "NUMPAD_ENTER"} and pressed:
            self.end()
            return {"FINISHED"}
        if event.type in STEPS and pressed and (over or event.type not in WHEEL):
            self.step(STEPS[event.type])
        elif event.type == "LEFTMOUSE" and (over or self._dragging):
            self._dragging = pressed
            self.drag_to(event.mouse_x - self.region.x)
        elif event.type == "MOUSEMOVE" and self._dragging:
            self.drag_to(event.mouse_x - self.region.x)
        elif not over or event.type in PASSED or event.type.startswith("TIMER"):
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def step(self, by: int) -> None:
        """Show another photo, after the last one the first."""
        self.show((self.index + by) % len(self.names))

    def show(self, index: int) -> None:
        """Look through the camera of a photo and load the photo."""
        self._restore_background()
        self.index = index
        self._texture, self._message = None, ""
        camera = self.camera
        if camera is None:
            self._message = f"The camera {self.names[index]} was removed."
            return
        data = cast(bpy.types.Camera, camera.data)
        # Blender would draw the photo over the whole image, too.
        self._background = (camera.name, data.show_background_images)
        data.show_background_images = False
        scene_import.look_through(self.scene, camera)
        present(self.space.region_3d).view_perspective = "CAMERA"
        image = next((background.image for background in data.background_images if background.image), None)
        pixels = None if image is None else overlay_pixels(image)
        if pixels is None:
            self._message = f"The photo of {camera.name} cannot be read."
        else:
            height, width = pixels.shape[:2]
            buffer = gpu.types.Buffer("FLOAT", pixels.size, cast(Any, pixels.ravel()))
            self._texture = gpu.types.GPUTexture((width, height), format="RGBA16F", data=buffer)
        self.area.tag_redraw()

    def drag_to(self, x: float) -> None:
        """Move the line to a position in the region, in pixels."""
        if (frame := self.frame()) is not None:
            left, _, right, _ = frame
            self.place = min(max((x - left) / (right - left), 0.0), 1.0)
            self.area.tag_redraw()

    def frame(self) -> Frame | None:
        """Where the camera's image is in the region; None unless the viewport looks through the camera."""
        view = present(self.space.region_3d)
        if self.camera is None or self.scene.camera != self.camera or view.view_perspective != "CAMERA":
            return None
        matrix = self.camera.matrix_world.normalized()
        # In the order upper right, lower right, lower left, upper left.
        corners = cast(bpy.types.Camera, self.camera.data).view_frame(scene=self.scene)
        upper_right, lower_left = (
            location_3d_to_region_2d(self.region, view, matrix @ corners[corner]) for corner in (0, 2)
        )
        if upper_right is None or lower_left is None or upper_right.x <= lower_left.x:
            return None
        return (lower_left.x, lower_left.y, upper_right.x, upper_right.y)

    def is_over_view(self, x: int, y: int) -> bool:
        """Whether a position in the window, in pixels, is in the viewport and not over its sidebar or header."""

        def inside(region: bpy.types.Region) -> bool:
            return region.x <= x < region.x + region.width and region.y <= y < region.y + region.height

        return inside(self.region) and not any(
            inside(region) for region in self.area.regions if region.type != "WINDOW" and region.width > 1
        )

    def end(self) -> None:
        """Remove what is drawn, and restore camera, image size and view."""
        global _running
        if _running is not self:
            return
        _running = None
        bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
        self._texture = None
        present(bpy.context.workspace).status_text_set(None)
        try:
            self._restore_background()
            self.scene.camera = self.scene.objects.get(self._before["camera"])
            for name, value in self._before["render"].items():
                setattr(self.scene.render, name, value)
            view = present(self.space.region_3d)
            view.view_perspective = self._before["perspective"]
            view.view_rotation, view.view_location, view.view_distance = self._before["place"]
            self.area.tag_redraw()
        except ReferenceError:  # the scene or the viewport was removed
            pass

    def _restore_background(self) -> None:
        if self._background is not None:
            name, shown = self._background
            camera = self.scene.objects.get(name)
            if camera is not None:
                cast(bpy.types.Camera, camera.data).show_background_images = shown
            self._background = None

    def _draw(self) -> None:
        """Draw photo, line and name; Blender calls this for every 3D viewport."""
        if bpy.context.space_data != self.space or (frame := self.frame()) is None:
            return
        left, bottom, right, top = frame
        middle = left + self.place * (right - left)
        if self._texture is not None and middle > left:
            image = gpu.shader.from_builtin("IMAGE")
            image.bind()
            image.uniform_sampler("image", self._texture)
            corners = ((left, bottom), (middle, bottom), (left, top), (middle, top))
            places = ((0.0, 0.0), (self.place, 0.0), (0.0, 1.0), (self.place, 1.0))
            batch_for_shader(image, "TRI_STRIP", {"pos": corners, "texCoord": places}).draw(image)
        scale = present(bpy.context.preferences).system.ui_scale
        size, centre = HANDLE * scale, (bottom + top) / 2
        handle = ((middle - size, centre), (middle, centre - size), (middle + size, centre), (middle, centre + size))
        line = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
        line.bind()
        line.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
        parts = (((middle, bottom), (middle, centre - size)), ((middle, centre + size), (middle, top)))
        for width, color in ((4.0, (0.0, 0.0, 0.0, 1.0)), (2.0, (1.0, 1.0, 1.0, 1.0))):
            line.uniform_float("lineWidth", width * scale)
            line.uniform_float("color", color)
            for points in (*parts, (*handle, handle[0])):
                batch_for_shader(line, "LINE_STRIP", {"pos": [(*point, 0.0) for point in points]}).draw(line)
        text = self._message or f"{self.names[self.index]}    {self.index + 1} / {len(self.names)}"
        blf.size(0, 12 * scale)
        blf.enable(0, blf.SHADOW)
        blf.shadow(0, 3, 0.0, 0.0, 0.0, 1.0)
        blf.color(0, 1.0, 1.0, 1.0, 1.0)
        blf.position(0, max(left, 0.0) + size, max(bottom, 0.0) + size, 0.0)
        blf.draw(0, text)
        blf.disable(0, blf.SHADOW)


_running: PhotoWipe | None = None
"""The comparison that is going on."""


def photos(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The cameras of imported photos in the order of their names."""
    return sorted((obj for obj in scene.objects if obj.get(scene_import.SIZE_KEY) is not None), key=by_name)


def overlay_pixels(image: bpy.types.Image) -> np.ndarray | None:
    """The pixels of an image, at most LARGEST_TEXTURE wide and high, as values that a viewport shows as they are.

    Returns:
        (H, W, 4) float32, the lowest row first; None when its file cannot be read.
    """
    copy: Any = image.copy()
    try:
        width, height = copy.size
        if not width or not height:
            return None
        factor = LARGEST_TEXTURE / max(width, height)
        if factor < 1:
            width, height = max(1, round(width * factor)), max(1, round(height * factor))
            copy.scale(width, height)
        pixels = np.empty((height, width, 4), np.float32)
        copy.pixels.foreach_get(pixels.ravel())
        color = pixels[..., :3]
        if copy.is_float:  # linear light, of files with 16 bits and more
            color = linear_to_srgb(color)
        in_8_bits = (color.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        shown = linear_to_srgb((np.arange(256) / 255) ** OVERLAY_GAMMA).astype(np.float32)
        pixels[..., :3], pixels[..., 3] = shown[in_8_bits], 1.0
        return pixels
    finally:
        bpy.data.images.remove(copy)


def stop() -> None:
    """End the comparison that is going on, if there is one."""
    if _running is not None:
        _running.end()
