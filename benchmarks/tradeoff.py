"""What accuracy costs in time on the demo and on japanese_gardens: presets and two widths, the demo without water too.

    python benchmarks/tradeoff.py FOLDER [WEIGHTS]        WEIGHTS: a folder with the networks of LPIPS

Makes the runs in FOLDER, prints a table for each scene, and writes docs/tradeoff_SCENE.png and
benchmarks/results/tradeoff_SCENE.json. Stopped and started again with the same FOLDER it goes on. A scene that is not
on this machine is left out. Run it with nothing else on the machine: its seconds are those of the clock.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCENES = {
    "demo": ROOT / "tests" / "scenes" / "reef_wreck",
    "japanese_gardens": ROOT.parent / "shared" / "data" / "japanese_gardens",
}
GRID = ["--presets", "draft", "standard", "high", "--widths", "240", "480"]
EFFECTS = {"demo": ["default", "water=off"], "japanese_gardens": ["default"]}


def main(folder: Path, *weights: str) -> None:
    for name, scene in SCENES.items():
        if not scene.exists():
            continue
        out = folder / name
        command = [
            sys.executable,
            "-m",
            "swag_engine",
            "tradeoff",
            os.path.relpath(scene, ROOT),
            "--out",
            str(out),
            *GRID,
            "--effects",
            *EFFECTS[name],
            *(word for path in weights for word in ("--weights-dir", path)),
        ]
        print(f"\n{name}\n", flush=True)
        subprocess.run(command, cwd=ROOT, check=True)
        shutil.copy(out / "tradeoff.png", ROOT / "docs" / f"tradeoff_{name}.png")
        shutil.copy(out / "tradeoff.json", ROOT / "benchmarks" / "results" / f"tradeoff_{name}.json")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), *sys.argv[2:])
