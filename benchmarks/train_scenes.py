"""Measure what training reaches and takes: minutes, Gaussians, test PSNR and SSIM on the demo and the shared scenes.

Run: `python benchmarks/train_scenes.py`, with nothing else on the machine
Results: benchmarks/results/train_scenes.json

Scenes that are not on this machine are skipped.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, SHARED, machine, write_results

SCENES = {
    "demo (reef and wreck, rendered)": DEMO,
    "aqualoc_amphorae (photographs)": SHARED / "aqualoc_amphorae",
    "japanese_gardens (rendered by a NeRF)": SHARED / "japanese_gardens",
}
SETTINGS = ["--width", "480", "--max-gaussians", "60000"]
ITERATIONS = (500, 1500, 4500)


def main() -> None:
    """Train every scene for each number of iterations, print a table and write the results."""
    rows = []
    print("| scene | iterations | minutes | Gaussians | test PSNR | SSIM | median-image baseline |")
    print("|---|---|---|---|---|---|---|")
    for name, scene in SCENES.items():
        if not scene.exists():
            continue
        for iterations in ITERATIONS:
            rows.append({"scene": name, "iterations": iterations} | train(scene, iterations))
            row = rows[-1]
            print(
                f"| {name} | {iterations} | {row['seconds'] / 60:.1f} | {row['gaussians']} | {row['test_psnr']:.2f} dB "
                f"| {row['test_ssim']:.3f} | {row['control_psnr']:.2f} dB |",
                flush=True,
            )
    write_results("train_scenes", {"machine": machine(), "settings": SETTINGS, "runs": rows})


def train(scene: Path, iterations: int) -> dict[str, float]:
    """Train in a separate process and return the reported figures."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "swag_engine", "train", scene, "--out", f"{folder}/run", "--json"]
        command += ["--iterations", iterations, *SETTINGS]
        done = subprocess.run([str(part) for part in command], cwd=ROOT, stdout=subprocess.PIPE, check=True)
    metrics = json.loads(done.stdout)["metrics"]
    return {key: metrics[key] for key in ("seconds", "gaussians", "test_psnr", "test_ssim", "control_psnr", "psnr")}


if __name__ == "__main__":
    main()
