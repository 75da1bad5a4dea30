"""The whole way, once, through Blender: photographs with COLMAP poses -> splats in a .blend, a render, PLY and GLB.

    python demo/run.py [SCENE]        SCENE: a COLMAP folder; left out: the reef and wreck that ships with the project

The bpy package is the Blender that runs here, without a window; each step is the operator that a button in Blender's
sidebar calls. Everything is written to demo/output.
"""

import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from demo.extension import blender_with_extension

OUTPUT = ROOT / "demo" / "output"
# What two cores train in a minute; twice as much brings nothing on 21 photographs.
ITERATIONS, WIDTH, MAX_GAUSSIANS = 1500, 640, 50_000
# One sample looks at the middle of each pixel, as the trainer does, and blends exactly: there is no noise.
SAMPLES = 1


def main() -> None:
    scene_folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "tests" / "scenes" / "reef_wreck").resolve()
    started = time.monotonic()
    shutil.rmtree(OUTPUT, ignore_errors=True)
    OUTPUT.mkdir(parents=True)
    user = tempfile.TemporaryDirectory()
    bpy = blender_with_extension(Path(user.name))
    from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats

    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene

    print("1. Import: cameras, photographs, sparse points", flush=True)
    bpy.ops.swag.import_scene(directory=str(scene_folder))
    print(f"   {scene.swag.found}")

    print(f"2. Train: {ITERATIONS} iterations at {WIDTH} px", flush=True)
    scene.swag.run_folder = str(OUTPUT / "run")
    scene.swag.iterations, scene.swag.width, scene.swag.max_gaussians = ITERATIONS, WIDTH, MAX_GAUSSIANS
    bpy.ops.swag.train()

    print("3. Render in Cycles, from a camera that the training never saw", flush=True)
    trained = next(obj for obj in scene.objects if splats.is_splats(obj))
    metrics = json.loads((OUTPUT / "run" / "metrics.json").read_text())
    # The held-out view in the middle: neither the best nor the worst.
    held_out = sorted(metrics["views"], key=lambda name: metrics["views"][name]["psnr"])
    camera = scene.objects[held_out[len(held_out) // 2]]
    scene_import.look_through(scene, camera)
    bpy.ops.swag.prepare_render(display_values=True)
    scene.cycles.samples = SAMPLES
    scene.render.filepath = str(OUTPUT / "render.png")
    bpy.ops.render.render(write_still=True)
    photograph = Path(bpy.path.abspath(camera.data.background_images[0].image.filepath))
    print(f"   {metrics['water']}")
    compared = compare(photograph, OUTPUT / "render.png", scene_folder, (OUTPUT / "run" / "water.json").exists())

    print("4. Save: .blend, PLY, GLB", flush=True)
    # In a window photographs and other objects stand beside the splats, all in the usual light.
    bpy.ops.swag.prepare_render(display_values=False)
    bpy.ops.wm.save_as_mainfile(filepath=str(OUTPUT / "scene.blend"))
    bpy.ops.object.select_all(action="DESELECT")
    trained.select_set(True)
    for suffix in ("ply", "glb"):
        bpy.ops.swag.export_splats(filepath=str(OUTPUT / f"splats.{suffix}"))

    print(f"""
Done in {time.monotonic() - started:.0f} s: {len(trained.data.points)} Gaussians{compared}.
  {OUTPUT / "compare.png"}
      a photograph and the Cycles render from the same place side by side, in any picture viewer
  {OUTPUT / "scene.blend"}
      cameras, photographs, points and splats: open it in Blender 4.5 or later, press 0 on the number pad for the
      camera and F12 to render
  {OUTPUT / "splats.ply"}
      for splat viewers: drop it into superspl.at/editor, or into Blender with this extension
  {OUTPUT / "splats.glb"}
      glTF with KHR_gaussian_splatting: drop it into sandbox.babylonjs.com or another viewer that knows the extension
  {OUTPUT / "run"}
      the training run: its settings, its figures (metrics.jsonl), its checkpoints""")


def compare(photograph: Path, render: Path, scene_folder: Path, without_water: bool) -> str:
    """Write compare.png: photograph, render and, where the scene ships it, the truth without water; says how near."""
    clean = scene_folder / "clean" / f"{photograph.stem}.webp"
    pictures = {photograph: "Photograph (never trained on)", render: "Splats in Cycles"}
    truth, name = (clean, "the truth without water") if without_water else (photograph, "the photograph")
    if without_water:
        pictures[render] += ", water taken away"
        if clean.exists():
            pictures[clean] = "Truth, without water"
    side_by_side(pictures, OUTPUT / "compare.png")
    if not truth.exists():
        return ""
    drawn, true = (cv2.imread(str(path), cv2.IMREAD_COLOR) for path in (render, truth))
    return f"; the render of {photograph.name} has {cv2.PSNR(drawn, true):.1f} dB against {name}"


def side_by_side(pictures: dict[Path, str], out: Path) -> None:
    """Write pictures of one size beside each other, each under its label."""
    labelled = []
    for path, text in pictures.items():
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        scale = picture.shape[1] / 640
        bar = np.zeros((round(28 * scale), picture.shape[1], 3), np.uint8)
        at = (round(8 * scale), round(19 * scale))
        cv2.putText(bar, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, (255, 255, 255), 1, cv2.LINE_AA)
        labelled.append(np.concatenate([bar, picture]))
    cv2.imwrite(str(out), np.concatenate(labelled, axis=1))


if __name__ == "__main__":
    main()
