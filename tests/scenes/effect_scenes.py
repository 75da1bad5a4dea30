"""Scenes for the matrix of effects: three camera patterns over the reef and the wreck, rendered once, seen many ways.

Scenes that differ in water, lamp, exposure, caustics or lens share their clean renders, which are kept in a folder.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.scenes.make_scene import Rendered, Settings, focal_length  # noqa: E402
from tests.scenes.reef_model import Model, Passes, Renderer, camera_path  # noqa: E402

PATTERNS = ("orbit", "oblique", "nadir")
VIEWS = 20
SIZE = (320, 180)


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
    """
    if pattern == "orbit":
        return camera_path(views)
    poses, lines = [], 2 if pattern == "oblique" else 4
    for line in range(lines):
        for k in range(views // lines):
            along = (k / (views // lines - 1) - 0.5) * (1 if line % 2 else -1)
            if pattern == "oblique":
                centre = np.array([6 * along, -4.6 - 2.4 * line, 2.6 + 0.9 * line])
                target = np.array([6 * along * 0.9, 0.4, 0.3])
                poses.append(looking(centre, target, np.array([0.0, 0.0, 1.0])))
            else:
                centre = np.array([4 * along, -6.5 + 0.8 * line, 4.0])
                poses.append(looking(centre, centre - [0, 0, 1], np.array([0.0, 1.0, 0.0])))
    return poses


def settings_for(out: Path, **effects: object) -> Settings:
    """What `make_scene` takes for a scene of these effects at the matrix' size."""
    return Settings(out, views=VIEWS, width=SIZE[0], height=SIZE[1], points=1500, **effects)  # type: ignore[arg-type]


def render_clean(folder: Path, seed: int) -> None:
    """Render the model of this seed along all patterns without water to folder/PATTERN-SEED.npz."""
    settings = settings_for(folder)
    factor = settings.supersample
    width, height, focal = (n * factor for n in (settings.width, settings.height, focal_length(settings)))
    renderer = Renderer(Model(seed), width, height, focal, settings.samples)
    folder.mkdir(parents=True, exist_ok=True)
    for pattern in PATTERNS:
        path = folder / f"{pattern}-{seed}.npz"
        if path.exists():
            continue
        poses = camera_poses(pattern)
        passes = [renderer.still(pose) for pose in poses]
        arrays = {
            name: np.stack([getattr(view, name) for view in passes]).astype(kind)
            for name, kind in (("colour", "f2"), ("alpha", "f2"), ("range", "f4"), ("sun_share", "f2"))
        }
        np.savez(path, poses=np.stack(poses), **arrays)


def rendered(folder: Path, pattern: str, seed: int) -> Rendered:
    """The clean renders that `render_clean` left in `folder`."""
    with np.load(folder / f"{pattern}-{seed}.npz", allow_pickle=False) as arrays:
        poses, colour, alpha, distance, sun = (
            arrays[name] for name in ("poses", "colour", "alpha", "range", "sun_share")
        )
    nothing = np.zeros(alpha.shape[1:])
    still = [
        Passes(
            **dict(zip(("colour", "alpha", "range", "sun_share"), (v.astype(np.float32) for v in view), strict=True)),
            fish=nothing.astype(np.float32),
            label=nothing.astype(np.uint8),
        )
        for view in zip(colour, alpha, distance, sun, strict=True)
    ]
    return Rendered(list(poses), still, still, None)


if __name__ == "__main__":
    for number in sys.argv[2:]:
        render_clean(Path(sys.argv[1]), int(number))
