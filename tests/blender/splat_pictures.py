"""Splats, and their image rendered by the engine."""

import numpy as np


def heap():
    """A heap of splats in front of a camera at the origin, with degree-3 harmonics."""
    random = np.random.default_rng(3)
    count = 400
    rotations = random.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    sh = random.normal(size=(count, 16, 3)) * 0.2
    sh[:, 0] = random.uniform(-1.5, 1.5, (count, 3))
    arrays = {
        "positions": np.c_[random.uniform(-3, 3, (count, 2)), random.uniform(3, 9, count)],
        "rotations": rotations,
        "scales": np.exp(random.uniform(np.log(0.01), np.log(0.3), (count, 3))),
        "opacities": random.uniform(0.1, 1, count),
        "sh": sh,
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def render_by_engine(arrays, width, height, focal, through=lambda colors, offsets: colors, matrix=None):
    """Render from a camera at the origin whose principal point is (-3, +2) pixels off the centre.

    Args:
        arrays: what heap() returns.
        width: of the image, in pixels.
        height: of the image, in pixels.
        focal: focal length in pixels.
        through: changes display colors (N, 3), given the splats' offsets from the camera (N, 3).
        matrix: affine 4x4 matrix that moves the splats, or None.

    Returns:
        Display color (height, width, 3) and alpha (height, width).
    """
    import torch

    from swag_engine.gaussians.sh import evaluate_sh
    from swag_engine.rasterize.api import rasterize
    from swag_engine.splats.splats import Splats
    from swag_engine.splats.transform import transformed

    t = {name: torch.tensor(array, dtype=torch.float64) for name, array in arrays.items()}
    eye = np.zeros(3) if matrix is None else np.linalg.inv(matrix)[:3, 3]
    offsets = t["positions"] - torch.tensor(eye)
    directions = torch.nn.functional.normalize(offsets, dim=1)
    colors = evaluate_sh(t["sh"][:, :1], t["sh"][:, 1:], directions, 3)
    colors = torch.tensor(through(colors.numpy(), offsets.numpy())).double()
    if matrix is not None:
        moved = transformed(
            Splats(*(arrays[n] for n in ("positions", "rotations", "scales", "opacities", "sh"))), matrix
        )
        t |= {name: torch.tensor(getattr(moved, name)).double() for name in ("positions", "rotations", "scales")}
    K = torch.tensor([[focal, 0, width / 2 - 3], [0, focal, height / 2 + 2], [0, 0, 1]], dtype=torch.float64)
    image = rasterize(
        t["positions"], t["rotations"], t["scales"], t["opacities"], colors, torch.eye(4, dtype=torch.float64), K,
        width, height, torch.zeros(3, dtype=torch.float64), backend="torch",
    )  # fmt: skip
    return image.channels.numpy(), image.alpha.numpy()


def apply_water(medium, display, offsets, amount=1.0):
    """Display colors (N, 3) of splats at offsets (N, 3) from the camera, seen through the water."""
    import torch

    from swag_engine.water.medium import through_water

    colors, offsets = torch.tensor(display).float(), torch.tensor(offsets).float()
    return through_water(colors, offsets, medium, amount=amount, backend="torch").detach().numpy()


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-12))
