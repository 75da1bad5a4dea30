"""Measure seconds and memory of reading and writing splat files: one million splats of SH degree 3.

Run: `python benchmarks/formats.py [SPLATS]`, with nothing else on the machine
Results: benchmarks/results/formats.json

Each figure is from a process of its own: the median of ROUNDS runs, and the peak memory above that of the process with
numpy loaded, splats included. Writing counts until the file is on disk.
"""

import multiprocessing
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np

from benchmarks.common import processor, write_results
from swag_engine.formats.gltf import COLMAP_UP
from swag_engine.formats.registry import FORMATS
from swag_engine.splats.splats import Splats

ROUNDS = 5


def make_splats(count: int) -> Splats:
    """Make random splats of SH degree 3."""
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal((count, *shape), np.float32)

    rotations, scales, opacities = normal(4), normal(3), normal()
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    np.exp(scales, out=scales)
    return Splats(normal(3), rotations, scales, np.clip(np.abs(opacities), 0, 1), normal(16, 3))


def held() -> int:
    """Return the peak resident bytes of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def measure(work: Callable[[], object], before: int) -> dict[str, float]:
    """Measure ROUNDS runs: median wall-clock and processor seconds, and peak bytes above `before`."""
    seconds, processor_seconds = [], []
    for _ in range(ROUNDS):
        started, processor_started = time.perf_counter(), time.process_time()
        work()
        seconds.append(time.perf_counter() - started)
        processor_seconds.append(time.process_time() - processor_started)
    return {
        "seconds": statistics.median(seconds),
        "processor_seconds": statistics.median(processor_seconds),
        "bytes_held": held() - before,
    }


def write(name: str, path: Path, count: int) -> dict[str, float]:
    """Measure writing `count` splats."""
    before = held()
    splats = make_splats(count)
    return measure(lambda: FORMATS[name].write(path, splats, COLMAP_UP, ()), before)


def read(name: str, path: Path, count: int) -> dict[str, float]:
    """Measure reading the file that `write` made."""
    before = held()
    return measure(lambda: FORMATS[name].read(path, COLMAP_UP), before)


def main() -> None:
    """Measure every format, print and write the results."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    result: dict[str, object] = {"machine": processor(), "splats": count, "sh_degree": 3, "rounds": ROUNDS}
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            path = Path(folder) / f"million{FORMATS[name].suffix}"
            for work in (write, read):
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    figures = pool.apply(work, (name, path, count))
                size = path.stat().st_size
                figures |= {"file_bytes": size, "held_per_file_byte": round(figures["bytes_held"] / size, 2)}
                result[f"{work.__name__} {name}"] = figures
                clock, busy, memory = (figures[n] for n in ("seconds", "processor_seconds", "held_per_file_byte"))
                print(
                    f"{work.__name__} {name}: {clock:.2f} s by the clock, {busy:.2f} s of the processor, "
                    f"{size / 1e6:.0f} MB, memory {memory:.2f} x the file"
                )
    write_results("formats", result)


if __name__ == "__main__":
    main()
