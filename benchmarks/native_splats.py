"""Measure the splats that Blender 5.3 draws itself against the engine's images: PSNR, time and memory.

Run: `python benchmarks/native_splats.py RUN`
Results: benchmarks/results/native_splats.json, docs/images/native_splats.webp

RUN is a finished training run with water, as for blender_preview.py. Its test view of median PSNR is rendered by each
way of WAYS, without and with the water, each way in a process of its own. The same ways render one splat, two behind
one another, and 300 in a heap.
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
    "native Workbench": ("BLENDER_WORKBENCH", False, False),
    "shapes in Cycles, light": ("CYCLES", False, True),
    "shapes in Cycles, display values": ("CYCLES", True, True),
}
"""Name of a way to render -> (render engine, blend display values, own shapes)."""


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
    """Render all inputs of the folder in one way; write the images and what they took."""
    import resource

    from demo.extension import blender_with_extension

    bpy = blender_with_extension(folder / f"user {way}")
    from bl_ext.user_default.swag_splatting.swag_blender import display, scene_import, splats, water
    from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
    from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
    from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

    renderer, display_values, shapes = WAYS[way]
    inputs = json.loads((folder / "inputs.json").read_text())
    figures = {}
    for name, one in inputs.items():
        bpy.ops.wm.read_homefile(use_empty=True)
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
        splat_preview.set_input(obj, splat_preview.BLEND_DISPLAY, display_values)
        scene.render.engine = renderer
        # Alphas of shapes are exact; a native splat is opaque in some samples and clear in the others.
        samples = 1 if shapes else SAMPLES
        scene.cycles.samples = scene.eevee.taa_render_samples = samples
        scene.display.render_aa = "32"
        scene.display.shading.light, scene.display.shading.color_type = "FLAT", "OBJECT"
        scene.render.filter_size = 0 if shapes else 1.0
        scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
        scene.render.filepath = str(folder / "out.exr")
        started, busy = time.perf_counter(), time.process_time()
        bpy.ops.render.render(write_still=True)
        seconds, busy = time.perf_counter() - started, time.process_time() - busy
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(camera["width"] * camera["height"] * 4, np.float32)
        image.pixels.foreach_get(pixels)
        light = pixels.reshape(camera["height"], camera["width"], 4)[::-1, :, :3]
        curved = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
        np.save(
            folder / f"{name}, {way}.npy",
            light if display_values else np.where(light <= 0.0031308, 12.92 * light, curved),
        )
        figures[name] = {"seconds": round(seconds, 1), "processor_seconds": round(busy, 1)}
    figures["peak MB"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    (folder / f"{way}.json").write_text(json.dumps(figures))


def main() -> None:
    """Render every way, compare with the engine, and write figures and picture."""
    import cv2
    import torch

    from benchmarks.blender_preview import engine_pictures
    from benchmarks.common import PICTURES, WEBP_QUALITY, processor, write_results
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
    result: dict = {"machine": processor(), "blender": "5.3.0", "samples": SAMPLES, "ways": {}}
    rows = []
    for way in WAYS:
        command = [str(blender / "python"), __file__, "--inside", str(folder), way]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(blender)}, stdout=subprocess.DEVNULL)
        figures = json.loads((folder / f"{way}.json").read_text())
        found = {"peak MB": figures.pop("peak MB")}
        for name, times in figures.items():
            drawn = np.load(folder / f"{name}, {way}.npy")
            error = np.mean((np.clip(drawn, 0, 1) - np.clip(expected[name], 0, 1)) ** 2)
            found[name] = {"psnr": round(float(-10 * np.log10(error)), 2), **times}
        rows.append(np.load(folder / f"demo, without water, {way}.npy"))
        result["ways"][way] = found
        print(way, found, flush=True)
    picture = np.clip(np.concatenate([expected["demo, without water"], *rows], axis=1), 0, 1)[..., ::-1] * 255
    quality = [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY]
    cv2.imwrite(str(PICTURES / "native_splats.webp"), picture.round().astype(np.uint8), quality)
    write_results("native_splats", result)


if __name__ == "__main__":
    if sys.argv[1] == "--inside":
        inside_blender(Path(sys.argv[2]), sys.argv[3])
    else:
        main()
