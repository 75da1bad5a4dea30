"""Count what a step of the backend wgpu moves and computes, and what cards can be expected to take for it.

Run: `SWAG_WGPU_SOFTWARE=1 python benchmarks/wgpu_cost.py` (a minute; any adapter will do, also one in software)
Results: benchmarks/results/wgpu_cost.json

Pairs of a Gaussian and a tile and dispatches are counted on the adapter. Bytes and operations follow from the kernels'
sources. The milliseconds are no measurement: they are the time in which a card moves the bytes at MEMORY_USE of its
bandwidth, plus that in which it computes at ARITHMETIC_USE of its peak.
"""

import math
import sys
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import gpu_check
from benchmarks.common import write_results
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.kernels.webgpu_tiles import RADIX_BITS, TILE

CARDS = {
    "NVIDIA H200": (4800, 67.0),
    "NVIDIA RTX 4090": (1008, 82.6),
    "NVIDIA RTX 3060": (360, 12.7),
    "AMD RX 6600": (224, 8.9),
    "Intel Arc A770": (560, 17.2),
    "Apple M2": (100, 3.6),
}
"""Memory bandwidth in GB/s and single precision in TFLOP/s, as their makers give them."""
MEMORY_USE = 0.7
"""Fraction of the bandwidth that is assumed."""
ARITHMETIC_USE = 0.25
"""Fraction of the peak that is assumed: blending waits for workgroup memory and takes branches."""
SORT_PASS = 5
"""Numbers that a pass of the sort reads and writes for each key."""
DEPTH_PASSES = 32 // RADIX_BITS
"""Passes of the sort by depth."""
NUMBERS = {
    "to the image plane, colors": (120, 0, 0),
    "sort by depth": (SORT_PASS * DEPTH_PASSES, 0, 0),
    "lists of tiles": (27, 3, 0),
    "blend": (0, 15, 6),
    "compare": (0, 0, 85),
    "blend, backward": (10, 35, 7),
    "to the parameters": (138, 0, 0),
    "Adam, statistics": (420, 0, 0),
}
"""32-bit numbers that each stage reads and writes for a Gaussian, for a pair and for a pixel; the sort of the pairs is
added."""
PAIR_OPERATIONS = 22 + 60
"""Operations of blending, forward and backward, for a pair and one pixel of its tile, if no pixel ends early."""
GAUSSIAN_OPERATIONS = 3000
"""Operations of all that is done for a Gaussian, both ways."""


def count_pairs(kernels: WebGpuKernels, n: int) -> int:
    """Return how many pairs of a Gaussian and a tile the scene of gpu_check.py has."""
    with torch.no_grad():
        means, quats, scales, opacities = gpu_check.activated(gpu_check.make_parameters(n, *gpu_check.SIZE))
        camera = gpu_check.make_camera(*gpu_check.SIZE)
        projected = kernels.project(means, quats, scales, opacities, torch.zeros(n, 3), *camera, *gpu_check.SIZE)
        return int(kernels.tile_pairs(projected, opacities, *gpu_check.SIZE).ids.size // 4)


def cost(n: int, pairs: int) -> dict[str, object]:
    """Return bytes, operations and expected milliseconds of a step with n Gaussians."""
    width, height = gpu_check.SIZE
    pixels, tiles = width * height, math.ceil(width / TILE) * math.ceil(height / TILE)
    passes = math.ceil(tiles.bit_length() / RADIX_BITS)
    stages = {
        name: 4 * (of_gaussian * n + of_pair * pairs + of_pixel * pixels)
        for name, (of_gaussian, of_pair, of_pixel) in NUMBERS.items()
    }
    stages["lists of tiles"] += 4 * SORT_PASS * passes * pairs
    operations = PAIR_OPERATIONS * TILE**2 * pairs + GAUSSIAN_OPERATIONS * n
    moved = sum(stages.values())
    expected = {
        card: round(moved / (MEMORY_USE * bandwidth * 1e6) + operations / (ARITHMETIC_USE * peak * 1e9), 1)
        for card, (bandwidth, peak) in CARDS.items()
    }
    megabytes = {name: round(size / 1e6) for name, size in stages.items()}
    return {
        "pairs": pairs, "megabytes": megabytes, "gigaflop": round(operations / 1e9, 1), "expected_ms": expected
    }  # fmt: skip


def main() -> None:
    """Count, and write the results."""
    kernels = KERNELS["wgpu"]
    assert isinstance(kernels, WebGpuKernels)
    if reason := kernels.unavailable_reason():
        sys.exit(f"There is no adapter: {reason}")
    gpu_check.DEVICE = torch.device("cpu")
    document = {
        "width": gpu_check.SIZE[0],
        "height": gpu_check.SIZE[1],
        "gaussians": {str(n): cost(n, count_pairs(kernels, n)) for n in gpu_check.GAUSSIANS},
    }
    write_results("wgpu_cost", document)


if __name__ == "__main__":
    main()
