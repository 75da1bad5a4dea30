"""What the plan says of photographs taken on land, where there is no water.

    python -m pip download --no-deps --no-binary :all: kapture==1.1.12      its source distribution has the photographs
    python benchmarks/effects_land.py kapture-1.1.12/samples                writes benchmarks/results/effects_land.json

Few photographs each, those of the first and the last heavily compressed: 3 of a cathedral, 5 of a room in the sun,
whose cameras are found here by `sfm`, and 4 of a castle from the air with a COLMAP model.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from swag_engine.planning.plan import plan_scene
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.sfm import reconstruct

PHOTOGRAPHS = {
    "berlin": "berlin/kapture/sensors/records_data",
    "cour_carree": "cour_carree_markers/map/images",
    "maupertuis": "maupertuis/colmap/images",
}
MODELS = {"maupertuis": "maupertuis/colmap/reconstruction"}
SHOWN = ("attenuation", "backscatter", "lamp", "exposure", "caustics")


def scene_of(samples: Path, name: str, folder: Path) -> Path:
    """A scene folder of the photographs, with their COLMAP model or one made here."""
    out = folder / name
    if name in MODELS:
        shutil.copytree(samples / PHOTOGRAPHS[name], out / "images")
        shutil.copytree(samples / MODELS[name], out / "sparse" / "0")
    else:
        reconstruct(samples / PHOTOGRAPHS[name], out)
    return out


def main(samples: Path) -> None:
    document = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in PHOTOGRAPHS:
            place = scene_of(samples, name, Path(folder))
            scene, plan = load_scene(place), plan_scene(place)
            effects = {effect: plan.effects[effect] for effect in SHOWN}
            document[name] = {"photographs": len(scene.views), "points": len(scene.points.positions)} | {
                "states": {effect: found.state for effect, found in effects.items()},
                "reasons": {effect: found.reason for effect, found in effects.items()},
            }
            print(f"\n{name}: {len(scene.views)} photographs, {len(scene.points.positions)} points", flush=True)
            for effect, found in effects.items():
                print(f"  {effect:<12} {found.state:<8} {found.reason}")
    (ROOT / "benchmarks" / "results" / "effects_land.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
