"""Measure the splats that Blender 5.3 draws itself against the engine's images: PSNR, time and memory.

Run: `python benchmarks/native_splats.py RUN [WAY ...]`
Results: benchmarks/results/native_splats.json

RUN is a finished training run with water, as for blender_preview.py. Its test view of median PSNR is drawn in each way
of WAYS, without and with the water, each way in a process of its own. The same ways draw one splat, two behind one
another, and 300 in a heap. Ways that are not named keep the figures of the last run.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np

SAMPLES = 64
WAYS = {
    "native Cycles": ("CYCLES", False, False),
    "native Cycles, display values": ("CYCLES", True, False),
    "native EEVEE": ("BLENDER_EEVEE", False, False),
    "native EEVEE, display values": ("BLENDER_EEVEE", True, False),
    "native Solid": ("SOLID", False, False),
    "native Material Preview": ("MATERIAL", False, False),
    "own drawing in Solid": ("OWN", False, False),
    "shapes in Cycles, light": ("CYCLES", False, True),
    "shapes in Cycles, display values": ("CYCLES", True, True),
}
"""Name of a way to draw -> (render engine or shading of a viewport, blend display values, own shapes).

OWN: the extension's drawing in viewports.
"""


def scenes_of_few() -> dict[str, dict[str, np.ndarray]]:
    """One, two and 300 overlapping splats before a camera at the origin."""
    random = np.random.default_rng(5)
    made = {}
    for name, count in (("one", 1), ("two", 2), ("many", 300)):
        rotations = random.normal(size=(count, 4))
        made[name] = {
            "positions": np.c_[random.uniform(-0.6, 0.6, (count, 2)), np.linspace(3, 6, count)],
            "rotations": rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
            "scales": random.uniform(0.2, 0.5, (count, 3)),
            "opacities": random.uniform(0.3, 0.9, count),
            "sh": random.uniform(-1.5, 1.5, (count, 1, 3)),
        }
    return {name: {key: array.astype(np.float32) for key, array in one.items()} for name, one in made.items()}


def inside_blender(folder: Path, way: str) -> None:
    """Draw all inputs of the folder in one way; write the images and what they took."""
    import resource

    from demo.extension import blender_with_extension

    bpy = blender_with_extension(folder / f"user {way}")
    from bl_ext.user_default.swag_splatting.swag_blender import display, scene_import, splats, water
    from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
    from bl_ext.user_default.swag_splatting.swag_engine.base.transfer import linear_to_srgb
    from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
    from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

    renderer, display_values, shapes = WAYS[way]
    inputs = json.loads((folder / "inputs.json").read_text())
    figures = {}
    for name, one in inputs.items():
        bpy.ops.wm.read_homefile(use_empty=False)
        for obj in list(bpy.data.objects):
            bpy.data.objects.remove(obj)
        scene = bpy.context.scene
        root = bpy.data.objects.new("root", None)
        scene.collection.objects.link(root)
        camera = one["camera"]
        scene_import.look_through(scene, scene_import.camera_object(camera, root, scene.collection))
        if "ply" in one:
            made = read_ply(Path(one["ply"]))
        else:
            arrays = np.load(folder / f"{name}.npz")
            made = Splats(*(arrays[key] for key in ("positions", "rotations", "scales", "opacities", "sh")))
        obj = splats.new_splat_object("splats", made, scene.collection, root)
        splat_preview.remember_training(obj, 1 / camera["fx"], [0, 0, 0])
        if one.get("water"):
            water.remember_water(obj, one["water"], one["metres_per_unit"])
        scene.swag.water = one["amount"]
        bpy.ops.swag.prepare_render(display_values=display_values)
        display.use_shapes(obj, shapes)
        started, busy = time.perf_counter(), time.process_time()
        if renderer in ("SOLID", "MATERIAL", "OWN"):
            picture = viewport_picture(bpy, obj, camera["width"], camera["height"], renderer)
        else:
            picture = render_picture(bpy, folder / "out.exr", renderer, shapes)
            if not display_values:
                picture = linear_to_srgb(picture)
        seconds, busy = time.perf_counter() - started, time.process_time() - busy
        np.save(folder / f"{name}, {way}.npy", picture)
        figures[name] = {"seconds": round(seconds, 1), "processor_seconds": round(busy, 1)}
    figures["peak MB"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    (folder / f"{way}.json").write_text(json.dumps(figures))


def render_picture(bpy, path: Path, renderer: str, shapes: bool) -> np.ndarray:
    """Render the scene; return linear light or, under the view transform Raw, display values (H, W, 3)."""
    scene = bpy.context.scene
    scene.render.engine = renderer
    # Alphas of shapes are exact; a native splat is opaque in some samples and clear in the others.
    scene.cycles.samples = scene.eevee.taa_render_samples = 1 if shapes else SAMPLES
    scene.render.filter_size = 0 if shapes else 1.0
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


def viewport_picture(bpy, obj, width: int, height: int, shading: str) -> np.ndarray:
    """Draw what a viewport shows through the scene's camera over black; return display values (H, W, 3)."""
    import types

    import gpu
    from bl_ext.user_default.swag_splatting.swag_blender.viewport.drawing import ViewportDrawing
    from bl_ext.user_default.swag_splatting.swag_blender.viewport.shaders import OVERLAY_GAMMA

    gpu.init()
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    space = area.spaces.active
    space.overlay.show_overlays = False
    space.shading.type = "MATERIAL" if shading == "MATERIAL" else "SOLID"
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0, 0, 0)
    if shading != "OWN":
        obj.swag_display.style = "NATIVE"
    bpy.context.view_layer.update()
    camera = bpy.context.scene.camera
    projection = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=width, y=height)
    view = camera.matrix_world.inverted()
    picture = gpu.types.GPUOffScreen(width, height, format="RGBA16F")
    region = next(region for region in area.regions if region.type == "WINDOW")

    class Context:
        """The context of a viewport of that size and view."""

        region = types.SimpleNamespace(width=width, height=height, as_pointer=lambda: 1)
        region_data = types.SimpleNamespace(
            window_matrix=projection, view_matrix=view, use_clip_planes=False, clip_planes=[]
        )
        space_data = space

        def __getattr__(self, name: str):
            return getattr(bpy.context, name)

    with bpy.context.temp_override(window=window, area=area):
        if shading != "OWN":
            picture.draw_view3d(
                bpy.context.scene, bpy.context.view_layer, space, region, view, projection, do_color_management=True
            )
        with picture.bind():
            framebuffer = gpu.state.active_framebuffer_get()
            if shading == "OWN":
                framebuffer.clear(color=(0, 0, 0, 1), depth=1.0)
                ViewportDrawing().draw(Context(), [obj])
            drawn = np.array(framebuffer.read_color(0, 0, width, height, 4, 0, "FLOAT").to_list())
    drawn = np.maximum(drawn[::-1, :, :3], 0)
    return drawn ** (1 / OVERLAY_GAMMA) if shading == "OWN" else drawn


def main() -> None:
    """Draw in every way, compare with the engine, and write the figures."""
    import torch

    from benchmarks.blender_preview import engine_pictures
    from benchmarks.common import RESULTS, processor, write_results
    from swag_engine.formats.run_folder import RunFolder
    from swag_engine.rasterize.api import rasterize

    run = RunFolder(Path(sys.argv[1]))
    folder = Path(tempfile.mkdtemp())
    pinhole, pictures = engine_pictures(run)
    inputs, expected = {}, {}
    for amount, picture in pictures.items():
        name = "demo, with water" if amount else "demo, without water"
        expected[name] = picture
        inputs[name] = {
            "camera": pinhole, "ply": str(run.ply.resolve()), "water": run.read_water(), "amount": amount,
            "metres_per_unit": run.read_config()[1].metres_per_unit,
        }  # fmt: skip
    side, focal = 160, 120.0
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]], dtype=torch.float64)
    for name, arrays in scenes_of_few().items():
        np.savez(folder / f"{name}.npz", **arrays)
        t = {key: torch.tensor(array, dtype=torch.float64) for key, array in arrays.items()}
        colors = (0.5 + 0.28209479177387814 * t["sh"][:, 0]).clamp(min=0)
        expected[name] = rasterize(
            t["positions"], t["rotations"], t["scales"], t["opacities"], colors, torch.eye(4, dtype=torch.float64), K,
            side, side, torch.zeros(3, dtype=torch.float64), backend="torch",
        ).channels.numpy()  # fmt: skip
        camera = {"name": name, "width": side, "height": side, "fx": focal, "fy": focal, "cx": side / 2, "cy": side / 2}
        inputs[name] = {"camera": camera | {"world_to_camera": np.eye(4).tolist()}, "amount": 0.0}
    (folder / "inputs.json").write_text(json.dumps(inputs))
    blender = ROOT / ".venv" / "blender-5.3"
    path = RESULTS / "native_splats.json"
    ways = json.loads(path.read_text())["ways"] if path.exists() else {}
    for way in sys.argv[2:] or WAYS:
        command = [str(blender / "python"), __file__, "--inside", str(folder), way]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(blender)}, stdout=subprocess.DEVNULL)
        figures = json.loads((folder / f"{way}.json").read_text())
        found = {"peak MB": figures.pop("peak MB")}
        for name, times in figures.items():
            drawn = np.load(folder / f"{name}, {way}.npy")
            error = np.mean((np.clip(drawn, 0, 1) - np.clip(expected[name], 0, 1)) ** 2)
            found[name] = {"psnr": round(float(-10 * np.log10(error)), 2), **times}
        ways[way] = found
        print(way, found, flush=True)
    write_results("native_splats", {"machine": processor(), "blender": "5.3.0", "samples": SAMPLES, "ways": ways})


if __name__ == "__main__":
    if sys.argv[1] == "--inside":
        inside_blender(Path(sys.argv[2]), sys.argv[3])
    else:
        main()
