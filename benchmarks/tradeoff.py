"""Measure accuracy against time on the demo and on japanese_gardens: presets at two widths, the demo without water too.

Run: `python benchmarks/tradeoff.py FOLDER [WEIGHTS]`, with nothing else on the machine
Results: benchmarks/results/tradeoff_SCENE.json; of the demo docs/images/tradeoff_demo.webp, too

FOLDER receives the runs; started again with the same FOLDER the benchmark continues. WEIGHTS is a folder with the
networks of LPIPS. A scene that is not on this machine is skipped.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, PICTURES, SHARED, WEBP_QUALITY, write_results

SCENES = {"demo": DEMO, "japanese_gardens": SHARED / "japanese_gardens"}
GRID = ["--presets", "draft", "standard", "high", "--widths", "240", "480"]
EFFECTS = {"demo": ["default", "water=off"], "japanese_gardens": ["default"]}


def main(folder: Path, *weights: str) -> None:
    """Run `tradeoff` on every scene and store its results."""
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
        if name == "demo":
            picture = cv2.imread(str(out / "tradeoff.png"))
            cv2.imwrite(str(PICTURES / "tradeoff_demo.webp"), picture, [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
        store(name, json.loads((out / "tradeoff.json").read_text("utf-8")))


def store(name: str, document: dict) -> None:
    """Write the results of a scene without the settings of its runs, which their names tell apart."""
    rows = [{key: row[key] for key in row if key not in ("settings", "folder")} for row in document["rows"]]
    write_results(f"tradeoff_{name}", document | {"rows": rows})


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), *sys.argv[2:])
