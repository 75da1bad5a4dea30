"""Measure how exact estimated cameras are, and the processor time they take.

Run: `python benchmarks/cameras.py [CASE ...] [--seeds 1] [--version current]`
Results: benchmarks/results/cameras.json; runs of other cases, seeds and versions stay in it.

`swag_engine.sfm` gets the photos of a generated scene, or of a COLMAP scene that is not part of the repository, and its
cameras are compared with the true ones, or with those of that scene. A similarity aligns the estimated positions with
them first, as photos alone tell neither scale nor place. `--version` names the code in the results: to compare with
another commit, run this file and tests/scenes/camera_paths.py in a checkout of it.
"""

import json
import resource
import sys
import tempfile
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, SHARED, machine, write_results
from swag_engine.base import threads  # noqa: F401
from swag_engine.base.errors import InputError
from swag_engine.scene.colmap import Scene, load_scene
from swag_engine.sfm.reconstruct import reconstruct
from tests.scenes.camera_paths import SCENES, make_camera_scene

CASES: dict[str, str | Path] = {
    **{name: name for name in SCENES if name != "large survey"},
    "japanese_gardens": SHARED / "japanese_gardens",
    "aqualoc_amphorae": SHARED / "aqualoc_amphorae",
}
"""Generated scenes, and folders of COLMAP scenes whose cameras are compared with."""


def main() -> None:
    """Run the cases one after the other, each in a process of its own, and write the results."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"all by default: {', '.join(CASES)}")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--version", default="current")
    arguments = parser.parse_args()
    path = RESULTS / "cameras.json"
    runs: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))["runs"] if path.exists() else []
    for name in arguments.cases or CASES:
        case = CASES[name]
        if isinstance(case, Path) and not case.is_dir():
            continue
        for seed in range(arguments.seeds if isinstance(case, str) else 1):
            key = {"version": arguments.version, "case": name, "seed": seed}
            with ProcessPoolExecutor(1, get_context("spawn")) as own_process:
                run = key | own_process.submit(measured, case, seed).result()
            runs = [other for other in runs if any(other[part] != key[part] for part in key)] + [run]
            print(json.dumps(run), flush=True)
            write_results("cameras", {"machine": machine(), "runs": runs})


def measured(case: str | Path, seed: int) -> dict[str, Any]:
    """Find the cameras of a case and compare them with the true ones."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "scene"
        if isinstance(case, str):
            made = make_camera_scene(case, Path(place) / "photos", seed)
            photos, names, focal = made.folder, made.names, made.lens.params[0]
            poses = dict(zip(names, made.world_to_camera, strict=True))
        else:
            given = load_scene(case)
            photos, names, focal = given.image_folder, tuple(view.name for view in given.views), _focal(given)
            poses = {view.name: view.camera.world_to_camera for view in given.views}
        before = processor_seconds()
        try:
            result = reconstruct(photos, out)
        except InputError as error:
            return {"images": len(names), "error": str(error), "processor_seconds": processor_seconds() - before}
        run = {
            "images": len(names),
            "registered": result["registered"],
            "processor_seconds": round(processor_seconds() - before, 1),
            "peak_mb": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024),
            "points": result["points"],
            "reprojection_error": result["reprojection_error"],
            "hypotheses": [each["name"] for each in result["hypotheses"]],
            "warnings": result["warnings"],
        }
        scene = load_scene(out)
        return run | compare(scene, names, poses) | {"focal_error": _focal(scene) / focal - 1}


def compare(scene: Scene, names: tuple[str, ...], poses: dict[str, np.ndarray]) -> dict[str, float]:
    """Compare poses after an alignment by a similarity.

    Args:
        scene: The scene with estimated poses.
        names: Names of all images in the order of the path.
        poses: True rigid transforms (4, 4) from world to camera by name.

    Returns:
        `path_length`; `position_error`: root of the mean squared distance between positions, as a fraction of the path
        length; `rotation_error`: median over images after an alignment of the rotations, degrees.
    """
    views = [view for view in scene.views if view.name in poses]
    found = np.stack([view.camera.centre for view in views])
    true = np.stack([_centre(poses[view.name]) for view in views])
    scale, rotation, shift = similarity(found, true)
    distance = np.linalg.norm(scale * found @ rotation.T + shift - true, axis=1)
    path = np.stack([_centre(poses[name]) for name in names])
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    # Rotations are aligned apart: positions on a straight path leave a rotation about it open.
    turns = np.stack([view.camera.world_to_camera[:3, :3].T @ poses[view.name][:3, :3] for view in views])
    u, _, vt = np.linalg.svd(turns.sum(0))
    cosines = (np.einsum("nij,ij->n", turns, u @ vt) - 1) / 2
    return {
        "path_length": length,
        "position_error": float(np.sqrt((distance**2).mean())) / length,
        "rotation_error": float(np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1))))),
    }


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return scale, rotation (3, 3) and shift (3,) that take points (N, 3) closest to others (Umeyama 1991)."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((singular * signs).sum() / (a**2).sum())
    return scale, rotation, target_mean - scale * rotation @ source_mean


def _centre(pose: np.ndarray) -> np.ndarray:
    return -pose[:3, :3].T @ pose[:3, 3]


def _focal(scene: Scene) -> float:
    """Return the median focal length of a scene's images, pixels."""
    return float(np.median([view.lens.camera.mean_focal_length() for view in scene.views]))


def processor_seconds() -> float:
    """Return the processor time of this process and its children that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


if __name__ == "__main__":
    main()
