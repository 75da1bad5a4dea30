"""Splats in a script for Blender, and the same splats drawn by the engine."""

import numpy as np

SETUP = """
import json, sys, time
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

bpy.ops.wm.read_homefile(use_empty=True)
scene = bpy.context.scene

def random_splats(count, coefficients, seed=0):
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    return Splats(
        random.normal(size=(count, 3)).astype("f4"), rotations.astype("f4"),
        random.uniform(0.01, 0.1, (count, 3)).astype("f4"), random.uniform(0, 1, count).astype("f4"),
        random.normal(size=(count, coefficients, 3)).astype("f4"),
        {"label": random.integers(-5, 9, count).astype("i4"), "importance": random.random(count).astype("f4")},
    )

def saved(path):
    held = np.load(path)
    return Splats(*(held[name] for name in ("positions", "rotations", "scales", "opacities", "sh")))

def failure(call):
    try:
        call()
    except Exception as error:
        return error
    raise AssertionError("it went well")

def point_sampled(width, height, transparent=True):
    # The first sample of a pixel is at its centre: no filter between the formula and the figure.
    scene.cycles.samples = scene.eevee.taa_render_samples = 1
    scene.render.filter_size = 0
    scene.render.film_transparent = transparent
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = sys.argv[-1] + "/render.exr"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.empty(width * height * 4, "f4")
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]

def view(width, height, focal):
    root = bpy.data.objects.new("root", None)
    scene.collection.objects.link(root)
    pinhole = {"name": "view", "width": width, "height": height, "fx": focal, "fy": focal, "cx": width / 2 - 3,
               "cy": height / 2 + 2}
    camera = scene_import.camera_object(pinhole | {"world_to_camera": np.eye(4).tolist()}, root, scene.collection)
    scene_import.look_through(scene, camera)
"""


def heap():
    """A heap of splats in front of a camera at the origin, with degree-3 harmonics."""
    random = np.random.default_rng(3)
    count = 400
    rotations = random.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    sh = random.normal(size=(count, 16, 3)) * 0.2
    sh[:, 0] = random.uniform(-1.5, 1.5, (count, 3))
    held = {
        "positions": np.c_[random.uniform(-3, 3, (count, 2)), random.uniform(3, 9, count)],
        "rotations": rotations,
        "scales": np.exp(random.uniform(np.log(0.01), np.log(0.3), (count, 3))),
        "opacities": random.uniform(0.1, 1, count),
        "sh": sh,
    }
    return {name: array.astype(np.float32) for name, array in held.items()}


def drawn_by_the_engine(held, width, height, focal, through=lambda colors, offsets: colors, matrix=None):
    """Display colour and alpha from a camera at the origin; `through` changes colours by offsets from the camera, and
    the affine `matrix` moves the splats."""
    import torch

    from swag_engine.gaussians.sh import evaluate_sh
    from swag_engine.rasterize.api import rasterize
    from swag_engine.splats.splats import Splats
    from swag_engine.splats.transform import transformed

    t = {name: torch.tensor(array, dtype=torch.float64) for name, array in held.items()}
    eye = np.zeros(3) if matrix is None else np.linalg.inv(matrix)[:3, 3]
    offsets = t["positions"] - torch.tensor(eye)
    directions = torch.nn.functional.normalize(offsets, dim=1)
    colors = evaluate_sh(t["sh"][:, :1], t["sh"][:, 1:], directions, 3)
    colors = torch.tensor(through(colors.numpy(), offsets.numpy())).double()
    if matrix is not None:
        moved = transformed(Splats(*(held[n] for n in ("positions", "rotations", "scales", "opacities", "sh"))), matrix)
        t |= {name: torch.tensor(getattr(moved, name)).double() for name in ("positions", "rotations", "scales")}
    K = torch.tensor([[focal, 0, width / 2 - 3], [0, focal, height / 2 + 2], [0, 0, 1]], dtype=torch.float64)
    drawn = rasterize(
        t["positions"], t["rotations"], t["scales"], t["opacities"], colors, torch.eye(4, dtype=torch.float64), K,
        width, height, torch.zeros(3, dtype=torch.float64), backend="torch",
    )  # fmt: skip
    return drawn.channels.numpy(), drawn.alpha.numpy()


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))
