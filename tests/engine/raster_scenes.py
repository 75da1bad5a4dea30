"""Scenes for the rasteriser, its results by any backend, and blending by its definition."""

import itertools
import math

import torch

from swag_engine.kernels.reference.projection import project
from swag_engine.rasterize.api import rasterize

GRADIENTS = ("means", "quats", "scales", "opacities", "channels", "background")


def make_scene(n, channels=3, width=40, height=29, seed=0, size=0.25):
    """Arguments of rasterize() in float64, exact in float32: Gaussians in front of a turned camera."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    turn = torch.linalg.qr(normal(3, 3)).Q
    turn = turn * torch.linalg.det(turn)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = turn, normal(3)
    seen = normal(n, 3) * torch.tensor([1.2, 0.9, 1.0]) + torch.tensor([0.0, 0.0, 3.5])
    scene = {
        "means": (seen - viewmat[:3, 3]) @ turn,
        "quats": normal(n, 4),
        "scales": size * torch.exp(0.7 * normal(n, 3)),
        "opacities": torch.sigmoid(2 * normal(n) + 0.5),
        "channels": normal(n, channels),
        "viewmat": viewmat,
        "K": torch.tensor([[0.8 * width, 0, 0.52 * width], [0, 0.85 * width, 0.47 * height], [0, 0, 1]]),
        "background": normal(channels),
    }
    return {key: value.float().double() for key, value in scene.items()} | {"width": width, "height": height}


def orthographic(scene):
    """The scene seen by an orthographic camera, as large as before at the distance where most of it is."""
    return scene | {"kind": "orthographic", "K": scene["K"] / torch.tensor([[3.5, 1, 1], [1, 3.5, 1], [1, 1, 1]])}


def run(scene, backend, dtype=torch.float32, device="cpu"):
    """Image, alpha and the gradients of a fixed random functional of both, float64 on the CPU; and the rendering."""
    tensors = {k: v.to(device, dtype, copy=True) for k, v in scene.items() if isinstance(v, torch.Tensor)}
    for name in GRADIENTS:
        tensors[name].requires_grad_()
    rendering = rasterize(**{**scene, **tensors}, backend=backend)
    generator = torch.Generator().manual_seed(99)
    losses = []
    for output in (rendering.channels, rendering.alpha):
        weights = 1 + torch.randn(output.shape, generator=generator, dtype=torch.float64)
        losses.append((output * weights.to(output)).sum())
    torch.stack(losses).sum().backward()
    results = {"channels_out": rendering.channels, "alpha": rendering.alpha, "means2d": rendering.means2d.grad}
    results |= {name: tensors[name].grad for name in GRADIENTS}
    return {key: value.detach().double().cpu() for key, value in results.items()}, rendering


def blend_by_definition(scene):
    """Image, alpha, and the distance of the nearest comparison to a tie: one Gaussian after the other on all pixels."""
    projected = project(**{name: value for name, value in scene.items() if name != "background"})
    height, width = scene["height"], scene["width"]
    rows, columns = (torch.arange(size, dtype=torch.float64) + 0.5 for size in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    out = torch.zeros(height, width, scene["channels"].shape[1], dtype=torch.float64)
    transmittance = torch.ones(height, width, dtype=torch.float64)
    going = torch.ones(height, width, dtype=torch.bool)
    order = torch.argsort(projected.depths, stable=True).tolist()
    gaps = projected.depths[order].diff()
    margin = gaps.min().item() if len(gaps) else 1.0
    for i in order:
        if projected.depths[i] <= 0 or projected.radii[i] == 0:
            continue
        a, b, c = projected.conics[i]
        dx, dy = x - projected.means2d[i, 0], y - projected.means2d[i, 1]
        unclamped = scene["opacities"][i] * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        alpha = unclamped.clamp(max=0.99)
        seen = (alpha >= 1 / 255) & going
        after = transmittance * (1 - alpha)
        ends = seen & (after <= 1e-4)
        margin = min(margin, (unclamped * 255 - 1)[going].abs().min().item(), (unclamped / 0.99 - 1).abs().min().item())
        if seen.any():
            margin = min(margin, (after / 1e-4 - 1)[seen].abs().min().item())
        going &= ~ends
        seen &= ~ends
        out += torch.where(seen, alpha * transmittance, 0)[..., None] * scene["channels"][i]
        transmittance = torch.where(seen, after, transmittance)
        if not going.any():
            break
    return out + transmittance[..., None] * scene["background"], 1 - transmittance, margin


def clear_scenes(count, change=lambda scene: scene, **options):
    """Scenes in which rounding to float32 cannot change a comparison (1/255, 1e-4, .99, depth order)."""
    seeds = itertools.count()
    while count:
        scene = change(make_scene(**options, seed=next(seeds)))
        if blend_by_definition(scene)[2] > 1e-5:
            count -= 1
            yield scene


def relative_error(value, truth):
    """Largest difference as a fraction of the largest value of the truth."""
    return ((value - truth).abs().max() / truth.abs().max().clamp(min=1e-30)).item()


def changed(n=5, width=40, height=29, **values):
    """A small scene in front of the camera, with tensors replaced by values or by functions of them."""
    scene = make_scene(n, width=width, height=height)
    scene["viewmat"] = torch.eye(4, dtype=torch.float64)
    scene["means"] = torch.randn(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.3
    scene["means"] += torch.tensor([0.0, 0.0, 3.0])
    for key, value in values.items():
        scene[key] = value(scene[key]) if callable(value) else value
    return scene


def one_row(value):
    def change(tensor):
        tensor = tensor.clone()
        tensor[1] = value
        return tensor

    return change


def first_row(tensor):
    return tensor[:1].expand_as(tensor).clone()


def focal(pixels):
    return torch.tensor([[pixels, 0, 20], [0, pixels, 14.5], [0, 0, 1]], dtype=torch.float64)


HARD = {
    "no Gaussian": changed(n=0),
    "one Gaussian": changed(n=1),
    "two Gaussians": changed(n=2),
    "one pixel": changed(width=1, height=1),
    "all behind the camera": changed(means=lambda m: m * torch.tensor([1, 1, -1.0])),
    "all on the near plane": changed(means=lambda m: m * torch.tensor([0, 0, 0.0]) + torch.tensor([0, 0, 0.01])),
    "just beyond the near plane": changed(
        means=lambda m: m * 1e-2 * torch.tensor([1, 1, 0]) + torch.tensor([0, 0, 0.0101])
    ),
    "all off screen": changed(means=lambda m: m + torch.tensor([100.0, 0, 0])),
    "huge scales": changed(scales=lambda s: s * 0 + math.exp(10)),
    "vanishing scales": changed(scales=lambda s: s * 0 + math.exp(-20)),
    "zero scales": changed(scales=lambda s: s * 0),
    "needles": changed(scales=lambda s: s * 0 + torch.tensor([1e3, 1e-3, 1e-3])),
    "pancakes": changed(scales=lambda s: s * 0 + torch.tensor([1e2, 1e2, 1e-5])),
    "zero quaternions": changed(quats=lambda q: q * 0),
    "tiny quaternions": changed(quats=lambda q: q * 1e-9),
    "huge quaternions": changed(quats=lambda q: q * 1e25),
    "opacity 0": changed(opacities=lambda o: o * 0),
    "opacity 1": changed(opacities=lambda o: o * 0 + 1),
    "opacity 2": changed(opacities=lambda o: o * 0 + 2),
    "field of view 2 degrees": changed(K=focal(20 / math.tan(math.radians(1)))),
    "field of view 170 degrees": changed(K=focal(20 / math.tan(math.radians(85)))),
    "coordinates of 1e6": changed(means=lambda m: m * 1e6, scales=lambda s: s * 1e6),
    "far away": changed(means=lambda m: m + torch.tensor([0, 0, 1e6])),
    "far aside": changed(means=lambda m: m * torch.tensor([1e30, 1e30, 1])),
    "thousands of equals": changed(n=1500, means=first_row, quats=first_row, scales=first_row),
}
for bad_name, bad_value in (("nan", math.nan), ("inf", math.inf), ("-inf", -math.inf)):
    for field in ("means", "quats", "scales", "opacities", "channels"):
        HARD[f"{bad_name} in {field}"] = changed(**{field: one_row(bad_value)})
