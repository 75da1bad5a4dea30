"""Scenes for the matrix of effects: camera patterns over places, rendered once, seen many ways.

    python tests/scenes/effect_scenes.py FOLDER SEED [SEED ...]

Scenes that differ in water, lamp, exposure, caustics, lens or fish share their clean renders, which are kept in a
folder. Places: the reef and the wreck by Cycles, and those of boxes.py.
"""

import sys
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from swag_engine.base.files import atomic_path
from tests.scenes.boxes import ground, passes_of, room, street
from tests.scenes.make_scene import Rendered, Settings, Water, focal_length, make_scene
from tests.scenes.reef_model import Model, Passes, Renderer, camera_path

PATTERNS = ("orbit", "oblique", "nadir")
"""Of the cameras over the reef and the wreck."""
PLACES = {"walk": street, "around": room, "survey": ground}
"""Patterns over places of boxes."""
FISHY = 0.4
"""Fraction of the images that fish swim through in scenes with fish."""
VIEWS = 20
SIZE = (320, 180)
SMALL = (12, 160, 90)
"""Views, width and height of scenes that are made in seconds."""


def looking(centre: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """world_to_camera (4,4), OpenCV axes, of a camera at `centre` (3,) that looks at `target`."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def camera_poses(pattern: str, views: int = VIEWS) -> list[np.ndarray]:
    """world_to_camera (4,4) per view.

    orbit: the demo scene's loop before the wreck. oblique: two lines past it, looking down and across, the second
    farther off. nadir: four lines of a survey straight down at constant height over the flat sand before the wreck.
    walk: along a street, swaying. around: along the walls of a room, looking in. survey: as nadir, over flat ground.
    """
    if pattern == "orbit":
        return camera_path(views)
    up = np.array([0.0, 0.0, 1.0])
    if pattern in ("walk", "around"):
        poses = []
        for k in range(views):
            along, turn = k / (views - 1), 2 * np.pi * k / views
            if pattern == "walk":
                centre = np.array([-14 + 18 * along, 1.5 * np.sin(9 * along), 1.7 + 0.3 * np.sin(5 * along)])
                target = centre + [10, 4 * np.sin(4 * along), 0.6]
            else:
                centre = np.array([4.2 * np.cos(turn), 3.2 * np.sin(turn), 1.6 + 0.3 * np.sin(3 * turn)])
                target = np.array([-2.5 * np.cos(turn), -1.5 * np.sin(turn), 0.8])
            poses.append(looking(centre, target, up))
        return poses
    poses, lines = [], 2 if pattern == "oblique" else 4
    for line in range(lines):
        for k in range(views // lines):
            along = (k / (views // lines - 1) - 0.5) * (1 if line % 2 else -1)
            if pattern == "oblique":
                centre = np.array([6 * along, -4.6 - 2.4 * line, 2.6 + 0.9 * line])
                target = np.array([6 * along * 0.9, 0.4, 0.3])
                poses.append(looking(centre, target, up))
            else:
                centre = np.array([4 * along, -6.5 + 0.8 * line, 4.0])
                poses.append(looking(centre, centre - [0, 0, 1], np.array([0.0, 1.0, 0.0])))
    return poses


def settings_for(out: Path, **effects: object) -> Settings:
    """What `make_scene` takes for a scene of these effects at the matrix' size."""
    return Settings(out, views=VIEWS, width=SIZE[0], height=SIZE[1], points=1500, **effects)  # type: ignore[arg-type]


def small_scene(out: Path, pattern: str, seed: int, **effects: object) -> Path:
    """Write a scene over a place of boxes that is made in seconds, in air or with the given water; returns `out`."""
    air = Water((0, 0, 0), (0, 0, 0), (0, 0, 0))
    chosen: dict = {"water": air} | effects
    make_scene(Settings(out, *SMALL, seed=seed, points=500, **chosen), _small_passes(pattern, seed))
    return out


@cache
def _small_passes(pattern: str, seed: int) -> Rendered:
    settings = Settings(Path(), *SMALL)
    poses, place = camera_poses(pattern, settings.views), PLACES[pattern](seed)
    size = (settings.width * settings.supersample, settings.height * settings.supersample)
    still = [passes_of(place, pose, *size, focal_length(settings) * settings.supersample) for pose in poses]
    return Rendered(poses, still, still, None)


PASSES = {"color": "f2", "alpha": "f2", "range": "f4", "sun_share": "f2", "fish": "f2"}


def render_clean(folder: Path, seed: int) -> None:
    """Render the model of this seed along all patterns without water to folder/PATTERN-SEED.npz, with fish before some
    of the views."""
    settings = settings_for(folder)
    factor = settings.supersample
    width, height = settings.width * factor, settings.height * factor
    focal = focal_length(settings) * factor
    renderer = Renderer(Model(seed), width, height, focal, settings.samples)
    folder.mkdir(parents=True, exist_ok=True)
    for pattern in PATTERNS:
        path = folder / f"{pattern}-{seed}.npz"
        if path.exists():
            continue
        poses = camera_poses(pattern)
        still = [renderer.still(pose) for pose in poses]
        random = np.random.default_rng((seed, 1))
        chosen = np.sort(random.permutation(len(poses))[: round(FISHY * len(poses))])
        fishy = [renderer.with_fish(still[k], poses[k], random) for k in chosen]
        arrays = {
            f"{part}{name}": np.stack([getattr(view, name) for view in views]).astype(kind)
            for part, views in (("", still), ("fishy_", fishy))
            for name, kind in PASSES.items()
        }
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez(file, poses=np.stack(poses), fishy_views=chosen, **arrays)


def render_boxes(folder: Path, pattern: str, seed: int) -> None:
    """As render_clean, of a place of boxes; without fish."""
    settings, poses = settings_for(folder), camera_poses(pattern)
    size = (settings.width * settings.supersample, settings.height * settings.supersample)
    place = PLACES[pattern](seed)
    still = [passes_of(place, pose, *size, focal_length(settings) * settings.supersample) for pose in poses]
    arrays = {name: np.stack([getattr(view, name) for view in still]).astype(kind) for name, kind in PASSES.items()}
    fishy = {f"fishy_{name}": values[:0] for name, values in arrays.items()}
    with atomic_path(folder / f"{pattern}-{seed}.npz") as temporary, temporary.open("wb") as file:
        np.savez(file, poses=np.stack(poses), fishy_views=np.zeros(0, int), **arrays, **fishy)


def rendered(folder: Path, pattern: str, seed: int, fish: bool = False) -> Rendered:
    """The clean renders that `render_clean` left in `folder`."""
    if pattern in PLACES and not (folder / f"{pattern}-{seed}.npz").exists():
        render_boxes(folder, pattern, seed)
    with np.load(folder / f"{pattern}-{seed}.npz", allow_pickle=False) as arrays:
        poses, chosen = list(arrays["poses"]), arrays["fishy_views"]
        still, fishy = ([arrays[f"{part}{name}"] for name in PASSES] for part in ("", "fishy_"))

    def passes(views: list[np.ndarray]) -> list[Passes]:
        label = np.zeros(views[0].shape[1:3], np.uint8)
        by_name = ({name: values.astype(np.float32) for name, values in zip(PASSES, view, strict=True)}
                   for view in zip(*views, strict=True))  # fmt: skip
        return [Passes(**view, label=label) for view in by_name]

    seen = clean = passes(still)
    if fish:
        swimming = dict(zip(chosen.tolist(), passes(fishy), strict=True))
        seen = [swimming.get(k, view) for k, view in enumerate(clean)]
    return Rendered(poses, clean, seen, None)


if __name__ == "__main__":
    for number in sys.argv[2:]:
        render_clean(Path(sys.argv[1]), int(number))
