"""Measure the cost of timing the parts of an iteration: time with the ledger over time without.

Run: `python benchmarks/ledger.py`
Results: benchmarks/results/ledger.json

Blocks of iterations of one run alternate, so that other load on the machine affects both.
"""

import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, write_results
from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import make_trainer

BLOCK, BLOCKS, WARM_UP = 5, 160, 200


def main() -> None:
    """Time alternating blocks, print and write the ratio."""
    settings = TrainSettings(iterations=WARM_UP + 2 * BLOCK * BLOCKS, width=320, max_gaussians=20_000)
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder(Path(folder) / "run")
        trainer = make_trainer(run, DEMO, settings, False, lambda event: None, None, time.monotonic())
        for _ in range(WARM_UP):
            trainer.iterate()
        ratios, plain_ms = [], []
        for block in range(BLOCKS):
            seconds = {}
            for measured in (
                bool(block % 2),
                not block % 2,
            ):  # the run slows down: each goes first in turn
                started = time.perf_counter()
                for _ in range(BLOCK):
                    with trainer.ledger.iteration() if measured else nullcontext():
                        trainer.iterate()
                seconds[measured] = time.perf_counter() - started
            ratios.append(seconds[True] / seconds[False])
            plain_ms.append(1000 * seconds[False] / BLOCK)
    document = {"ratio": round(median(ratios), 4), "ms_without": round(median(plain_ms), 2), "blocks": BLOCKS}
    print(document)
    write_results("ledger", document)


if __name__ == "__main__":
    main()
