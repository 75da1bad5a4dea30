"""Train scenes by the presets on the graphics card of this machine.

Run: `python benchmarks/card_runs.py [--presets draft standard] [--backend cuda]`, alone on the machine
Results: benchmarks/results/card_runs.json, to which rows are added
"""

import json
import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, write_results
from benchmarks.presets import SCENES
from swag_engine.kernels.backends import KERNELS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train


def main() -> None:
    """Train, print and write the figures."""
    parser = ArgumentParser(description="Train scenes by the presets on the graphics card of this machine.")
    parser.add_argument("--presets", nargs="+", default=["draft", "standard"])
    parser.add_argument("--backend", choices=("cuda", "wgpu"), default="cuda")
    arguments = parser.parse_args()
    if reason := KERNELS[arguments.backend].unavailable_reason():
        sys.exit(f"There is no card to train on: {reason}")
    device = KERNELS[arguments.backend].details()["device"]
    earlier = RESULTS / "card_runs.json"
    rows = json.loads(earlier.read_text())["rows"] if earlier.exists() else []
    for preset in arguments.presets:
        for name, scene in SCENES.items():
            if not scene.exists():
                continue
            with tempfile.TemporaryDirectory() as folder:
                settings = TrainSettings(preset=preset, backend=arguments.backend)
                metrics = train(scene, Path(folder) / "run", settings)["metrics"]
                width = json.loads((Path(folder) / "run" / "config.json").read_text())["settings"]["width"]
            kept = ("iterations", "gaussians", "seconds", "test_psnr", "test_ssim")
            row = {"card": device, "scene": name, "preset": preset, "others": 0, "width": width}
            rows.append(row | {key: metrics[key] for key in kept})
            print(rows[-1], flush=True)
            write_results("card_runs", {"rows": rows})


if __name__ == "__main__":
    main()
