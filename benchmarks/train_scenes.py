"""What a training run reaches and costs: minutes, Gaussians, held-out PSNR and SSIM on the demo and the shared scenes.

    python benchmarks/train_scenes.py        prints a table, writes benchmarks/results/train_scenes.json

Scenes that are not on this machine are left out. Run it with nothing else on the machine.
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
SCENES = {
    "demo (reef and wreck, rendered)": ROOT / "tests" / "scenes" / "reef_wreck",
    "aqualoc_amphorae (photographs)": SHARED / "aqualoc_amphorae",
    "japanese_gardens (rendered by a NeRF)": SHARED / "japanese_gardens",
}
SETTINGS = ["--width", "480", "--max-gaussians", "60000"]
ITERATIONS = (500, 1500, 4500)


def main() -> None:
    rows = []
    print("| scene | iterations | minutes | Gaussians | held-out PSNR | SSIM | median image |")
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
    document = {"machine": f"{processor()}, {os.cpu_count()} cores", "settings": SETTINGS, "runs": rows}
    (ROOT / "benchmarks" / "results" / "train_scenes.json").write_text(json.dumps(document, indent=2) + "\n")


def train(scene: Path, iterations: int) -> dict[str, float]:
    """Train in a process of its own and return the figures that are reported."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "swag_engine", "train", scene, "--out", f"{folder}/run", "--json"]
        command += ["--iterations", iterations, *SETTINGS]
        done = subprocess.run([str(part) for part in command], cwd=ROOT, stdout=subprocess.PIPE, check=True)
    metrics = json.loads(done.stdout)["metrics"]
    return {key: metrics[key] for key in ("seconds", "gaussians", "test_psnr", "test_ssim", "control_psnr", "psnr")}


def processor() -> str:
    """The processor's name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
