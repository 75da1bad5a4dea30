"""What a training makes of fish that swim before some photographs: how right its masks are, and what they gain.

    python benchmarks/moving_objects.py [--clean FOLDER]

The reef and the wreck in green water along two camera patterns, with fish in four of ten photographs and without any.
Masks are compared with the true fish of the training photographs; held-out views are scored against photographs of the
same place without fish. Writes benchmarks/results/moving_objects.json.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.effects_matrix import GREEN  # noqa: E402
from swag_engine.evaluation.metrics import picture, score_picture  # noqa: E402
from swag_engine.evaluation.run import newest  # noqa: E402
from swag_engine.scene.colmap import load_scene  # noqa: E402
from swag_engine.scene.images import load_images  # noqa: E402
from swag_engine.scene.split import split_views  # noqa: E402
from swag_engine.training.checkpoint import load_checkpoint  # noqa: E402
from swag_engine.training.config import TrainSettings  # noqa: E402
from swag_engine.training.loop import train  # noqa: E402

PATTERNS, SEED = ("orbit", "oblique"), 0
WAYS = {"planned": "", "always": "moving_objects=on", "never": "moving_objects=off"}
SETTINGS = TrainSettings(iterations=1000, width=320, max_gaussians=20_000)


def made(clean: Path, pattern: str, fish: bool) -> tuple[Path, dict[str, np.ndarray]]:
    """The folder of a scene, and by photograph the pixels (H, W) bool where a fish is."""
    from tests.scenes.effect_scenes import rendered, settings_for
    from tests.scenes.make_scene import Water, averaged, make_scene

    passes = rendered(clean, pattern, SEED, fish)
    settings = settings_for(clean / f"fish_{fish}_{pattern}", seed=SEED, water=Water(**GREEN), truth="all")
    make_scene(settings, passes)
    shutil.rmtree(settings.out / "masks", ignore_errors=True)  # nobody tells where the fish are
    swimming = {
        f"reef_{k:03d}.jpg": averaged(view.fish[..., None], settings.supersample)[..., 0] > 0.5
        for k, view in enumerate(passes.seen)
    }
    return settings.out, swimming


def measured(folder: Path, still: Path, swimming: dict[str, np.ndarray], effects: str, seed: int) -> dict:
    """Train in `folder`, and score against the photographs in `still` and the fish in `swimming`."""
    with tempfile.TemporaryDirectory() as place:
        run = Path(place) / "run"
        settings = TrainSettings(**SETTINGS.to_json() | {"effects": effects, "seed": seed})
        metrics = train(folder, run, settings)["metrics"]
        cloud, simulated, _ = newest(run)
        tensors, _ = load_checkpoint(run) or ({}, {})
    scene = load_scene(still)
    split = split_views([view.name for view in scene.views])
    views = [view for view in scene.views if view.name in split.test]
    scores = []
    for image in load_images(scene, views, SETTINGS.width):
        shown = picture(cloud, image.camera, settings.sh_degree, "auto", simulated)
        scores.append(score_picture(image, shown).psnr)
    true = np.stack([swimming[name] for name in split.train])
    masks = np.zeros_like(true)
    for k, name in enumerate(split.train):
        if (bits := tensors.get(f"moved.{name}")) is not None:
            masks[k] = np.unpackbits(bits.numpy(), count=true[k].size).reshape(true[k].shape).astype(bool)
    both, fish, masked = (int(part.sum()) for part in (true & masks, true, masks))
    return {
        "found": bool(masked),
        "psnr_without_fish": round(float(np.mean(scores)), 2),
        "fish_masked": round(both / fish, 3) if fish else None,
        "mask_is_fish": round(both / masked, 3) if masked else None,
        "masked_share": round(masked / masks.size, 4),
        "seconds": round(metrics["seconds"], 1),
    }


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clean", type=Path, default=Path(tempfile.gettempdir()) / "swag_effects_clean")
    parser.add_argument("--seeds", type=int, default=3)
    asked = parser.parse_args()
    os.environ["SWAG_CACHE_DIR"] = str(asked.clean / "cache")
    generator = ROOT / "tests" / "scenes" / "effect_scenes.py"
    subprocess.run([sys.executable, str(generator), str(asked.clean), str(SEED)], check=True, stdout=subprocess.DEVNULL)
    rows = []
    for pattern in PATTERNS:
        still, _ = made(asked.clean, pattern, False)
        for fish in (True, False):
            folder, swimming = made(asked.clean, pattern, fish)
            for way, effects in WAYS.items():
                for seed in range(asked.seeds):
                    row = {"cameras": pattern, "fish": fish, "way": way, "seed": seed}
                    rows.append(row | measured(folder, still, swimming, effects, seed))
                    print(json.dumps(rows[-1]), flush=True)
    path = ROOT / "benchmarks" / "results" / "moving_objects.json"
    path.write_text(json.dumps({"settings": SETTINGS.to_json(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
