"""Set-up of the scene for renders of its splats, and what such a render needs."""

from typing import Any

import bpy
import gpu

from . import background, colors, scene_import
from .cameras import render_size
from .nodes import splat_preview

SAMPLES = 32
"""Samples of a pixel: the splats' own alpha is exact with one, more of them only smooth edges."""
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swiftshader", "swrast", "basic render")
"""Parts of the names, in lower case, of OpenGL and Vulkan drivers that draw on the processor."""
EEVEE_SECONDS = 5e-5
"""Seconds that EEVEE takes for a pixel and sample without a graphics card: 4e-5 to 8e-5 with llvmpipe on two cores, the
same for 2 000 and for 20 000 splats."""


def prepare_render(
    scene: bpy.types.Scene,
    display_values: bool,
    engine: str,
    samples: int = SAMPLES,
    keep_world: bool = False,
) -> None:
    """Set up render engine, world, development and image size of a scene, so that its splats look as in the engine.

    Args:
        scene: a scene with splats.
        display_values: whether to blend sRGB values and not linear light (see nodes/splat_preview.py).
        engine: "CYCLES" or "EEVEE".
        samples: samples of a pixel, for both engines.
        keep_world: whether to leave the scene's world as it is.
    """
    splat_preview.prepare_render(scene, display_values, engine)
    own: Any = scene
    own.cycles.samples = own.eevee.taa_render_samples = samples
    if not keep_world:
        background.set_world(scene, display_values)
    colors.set_up_render(scene, display_values)
    if scene.camera and scene.camera.get(scene_import.SIZE_KEY) is not None:
        scene_import.look_through(scene, scene.camera)


def software_renderer() -> str:
    """Name of the driver where Blender draws without a graphics card; "" where it has one or draws nothing."""
    try:
        name = gpu.platform.renderer_get()
    except SystemError:  # without a window
        return ""
    return name if any(part in name.lower() for part in SOFTWARE_RENDERERS) else ""


def eevee_warning(scene: bpy.types.Scene, samples: int) -> str:
    """What a render by EEVEE takes on this machine, in sentences; "" where a graphics card draws it."""
    renderer = software_renderer()
    if not renderer:
        return ""
    width, height, _ = render_size(scene)
    minutes = max(1, round(EEVEE_SECONDS * width * height * samples / 60))
    return (
        f"EEVEE has no graphics card here ({renderer.split('(')[0].strip()}): {width} x {height} pixels with {samples} "
        f"samples take about {minutes} min, in which Blender does not respond. Cycles and Render Film can be cancelled."
    )
