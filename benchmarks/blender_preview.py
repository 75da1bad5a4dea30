"""Measure PSNR of Blender's preview nodes against the engine in Cycles and EEVEE, and the time a million splats take.

Run: `python benchmarks/blender_preview.py RUN [COUNT]`
Results: benchmarks/results/blender_preview.json

RUN is a finished training run with water, such as `train tests/scenes/reef_wreck --width 320 --iterations 1000
--max-gaussians 20000`. The test view of median PSNR is rendered by the engine, by Cycles as trained (display values,
view transform Raw), in linear light (view transform Standard, saved as sRGB) and as solid ellipsoids, and by EEVEE as
trained, each without and with the fitted water. COUNT splats of SH degree 3 (one million unless given) are loaded into
Blender and evaluated for its viewport; 0 keeps the figures of the last run.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np
import torch

from benchmarks.common import RESULTS, processor, write_results
from benchmarks.formats import make_splats
from demo.extension import blender_with_extension
from swag_engine.experiments.evaluate_run import load_newest
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.rendering.render import render
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images

WAYS = {
    "as trained": ("CYCLES", True, True),
    "in light": ("CYCLES", False, True),
    "ellipsoids as trained": ("CYCLES", True, False),
    "EEVEE as trained": ("EEVEE", True, True),
}
"""Name of a way to render -> (render engine, blend display values, splats face the camera)."""


def engine_pictures(run: RunFolder) -> tuple[dict, dict[float, np.ndarray]]:
    """Return the test view's pinhole camera for the importer, and the engine's images by amount of water."""
    scene_folder, settings, _ = run.read_config()
    metrics = json.loads(run.metrics.read_text(encoding="utf-8"))
    held_out = sorted(metrics["views"], key=lambda name: metrics["views"][name]["psnr"])
    scene = load_scene(scene_folder)
    views = [view for view in scene.views if view.name == held_out[len(held_out) // 2]]
    camera = load_images(scene, views, settings.width)[0].camera
    cloud, effects, _ = load_newest(run.path)
    with torch.no_grad():
        pictures = {
            amount: render(cloud, camera, 3, effects.medium, amount=amount).color.numpy() for amount in (0.0, 1.0)
        }
    pinhole = {name: getattr(camera, name) for name in ("name", "width", "height", "fx", "fy", "cx", "cy")}
    return pinhole | {"world_to_camera": camera.world_to_camera.tolist()}, pictures


def rendered_picture(bpy, path: Path, width: int, height: int, display_values: bool) -> np.ndarray:
    """Render the scene at pixel centres; return display values (H, W, 3)."""
    scene = bpy.context.scene
    scene.cycles.samples = scene.eevee.taa_render_samples = 1
    scene.render.filter_size = 0
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    light = pixels.reshape(height, width, 4)[::-1, :, :3]
    if display_values:
        return light
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)


def into_blender(bpy, count: int) -> dict:
    """Measure the seconds to load `count` splats of SH degree 3 into Blender and to evaluate them for the viewport."""
    from bl_ext.user_default.swag_splatting.swag_blender import splats
    from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_colors, splat_preview

    made = make_splats(count)
    started, busy = time.perf_counter(), time.process_time()
    many = splats.new_splat_object("many", made, bpy.context.scene.collection)
    found = {"splats": count, "seconds": round(time.perf_counter() - started, 3)}
    found["processor_seconds"] = round(time.process_time() - busy, 3)
    for name, change in (
        ("evaluated for the viewport", lambda: None),
        ("evaluated again", many.update_tag),
        ("at a tenth", lambda: splat_preview.set_input(many, splat_colors.DENSITY, 10.0)),
    ):
        change()
        started, busy = time.perf_counter(), time.process_time()
        bpy.context.view_layer.update()
        seconds, busy = time.perf_counter() - started, time.process_time() - busy
        found[name] = {"seconds": round(seconds, 3), "processor_seconds": round(busy, 3)}
    return found


def main() -> None:
    """Render every way, compare with the engine, and write the figures."""
    run = RunFolder(Path(sys.argv[1]))
    million = int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000
    pinhole, expected = engine_pictures(run)
    folder = tempfile.TemporaryDirectory()
    bpy = blender_with_extension(Path(folder.name))
    from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats, water
    from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview

    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    root = bpy.data.objects.new("root", None)
    scene.collection.objects.link(root)
    scene_import.look_through(scene, scene_import.camera_object(pinhole, root, scene.collection))
    obj = splats.new_splat_object("splats", read_ply(run.ply), scene.collection, root)
    splat_preview.remember_training(obj, 1 / pinhole["fx"], [0, 0, 0])
    water.remember_water(obj, run.read_water(), run.read_config()[1].metres_per_unit)
    result = json.loads((RESULTS / "blender_preview.json").read_text(encoding="utf-8"))
    result |= {"machine": processor(), "blender": bpy.app.version_string, "splats": len(obj.data.points), "psnr": {}}
    for name, (renderer, display_values, facing) in WAYS.items():
        splat_preview.set_input(obj, splat_preview.FACE_CAMERA, facing)
        for amount, picture in expected.items():
            scene.swag.water = amount
            bpy.ops.swag.prepare_render(engine=renderer, display_values=display_values)
            started = time.perf_counter()
            drawn = rendered_picture(
                bpy, Path(folder.name) / "out.exr", pinhole["width"], pinhole["height"], display_values
            )
            seconds = time.perf_counter() - started
            error = np.mean((np.clip(drawn, 0, 1) - np.clip(picture, 0, 1)) ** 2)
            result["psnr"][f"{name}, water {amount:g}"] = round(float(-10 * np.log10(error)), 2)
            print(f"{name}, water {amount:g}: {-10 * np.log10(error):.2f} dB, {seconds:.1f} s", flush=True)
    if million:
        result["into blender"] = into_blender(bpy, million)
    print(result["into blender"])
    write_results("blender_preview", result)


if __name__ == "__main__":
    main()
