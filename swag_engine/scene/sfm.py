"""Structure from motion: a COLMAP scene from images or a video.

Images are prepared here; COLMAP itself (pycolmap) runs in a child process, `python -m swag_engine.scene.sfm`, which
reports on its standard output and ends with its standard input, so that a crash or a cancel leaves no files.
"""

import json
import os
import queue
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.files import locked_folder
from .colmap import image_files_below
from .images import read_image

Progress = Callable[[str, float], None]
"""A function of the stage and its fraction (0..1)."""

_EXHAUSTIVE_UP_TO = 150
"""Images of which all pairs are matched; of more, only neighbours in the order of names, as pairs grow squared."""
_FEATURE_PIXELS = 2000
"""Longest side in pixels at which features are detected: water blurs finer detail."""
_FEATURES = 4096
"""Features of an image, at most: the time to match a pair grows with their square."""
_FEATURES_STAGE = "Detecting features"
"""Stage that the child process begins with."""
_FEWEST_FRAMES = 40
"""Frames that are taken of a video, at least."""
_MOST_FRAMES = 300
"""Frames that are taken of a video, at most."""
_VIDEO_STEP = 0.05
"""Motion between two frames that are taken, as a fraction of the image width."""


def reconstruct(source: Path, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Estimate the poses of images, or of the frames of a video, and make a COLMAP scene.

    The scene gets images/ (copies of the images, or the chosen frames) and sparse/0; it appears when all is done.
    Until then a hidden folder beside it holds the files; what a killed process left there is removed.
    Features are detected in copies with equalised contrast, because turbid water hides them.

    Args:
        source: Folder of images (those in images/ or input/ where it has one of these), or a video.
        out: Folder of the scene; it must not exist or be empty.
        progress: Called at least once a second with a stage (words for the user) and its fraction; what it raises ends
            the work.

    Returns:
        Numbers of images, registered images and points, `registered_share` (0..1), `reprojection_error` (pixels),
        seconds, and warnings (sentences; `inspect_scene` has those about the cameras).

    Raises:
        InputError: When the images cannot be used or no camera could be placed.
    """
    started = time.monotonic()
    report = progress or (lambda stage, fraction: None)
    source, out = Path(source).expanduser().absolute(), Path(out).expanduser().absolute()
    if not source.exists():
        raise InputError(f"There is no folder of photos or video {source}.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and is not an empty folder: choose another folder for the scene.")
    work = out.with_name(f".{out.name}.part")
    scene, scratch = work / "scene", work / "scratch"
    with locked_folder(work):
        try:
            _remove(scene, scratch)
            scratch.mkdir()
            (scene / "images").mkdir(parents=True)
            names = (_copy_images if source.is_dir() else _pick_frames)(source, scene, report)
            _equalise(scene / "images", names, scratch / "pictures", report)
            result = _run_colmap(scene, scratch, names, report)
            if out.exists():
                out.rmdir()
            os.replace(scene, out)
        except OSError as error:
            raise InputError(f"Cannot write {error.filename or out}: {error.strerror or error}.") from error
        finally:
            _remove(scene, scratch)
    groups = result.pop("groups")
    warnings = []
    if len(groups) > 1:
        warnings.append(
            f"The photos fall into {len(groups)} groups without connection, of {', '.join(map(str, groups[:-1]))} and "
            f"{groups[-1]} photos, and only the largest is used: photos between them would help."
        )
    return {
        "images": len(names),
        "registered_share": result["registered"] / len(names),
        **result,
        "seconds": time.monotonic() - started,
        "warnings": warnings,
    }


def _remove(*folders: Path) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


def _copy_images(source: Path, scene: Path, report: Progress) -> list[str]:
    source = next((source / name for name in ("images", "input") if (source / name).is_dir()), source)
    names = [path.relative_to(source).as_posix() for path in image_files_below(source)]
    if not names:
        raise InputError(f"There are no photos (JPEG, PNG, TIFF, BMP or WebP) in {source}.")
    if len(names) == 1:
        raise InputError(f"There is only one photo in {source}, and poses need several that overlap.")
    for number, name in enumerate(names):
        report("Copying photos", number / len(names))
        (scene / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source / name, scene / "images" / name)
    return names


def _equalise(images: Path, names: list[str], folder: Path, report: Progress) -> None:
    """Write grey copies with equalised local contrast (CLAHE), numbered in the order of `names`."""
    folder.mkdir()
    clahe = cv2.createCLAHE(clipLimit=4, tileGridSize=(8, 8))
    for number, name in enumerate(names):
        report("Preparing photos", number / len(names))
        grey = cv2.cvtColor(read_image(images / name)[0], cv2.COLOR_RGB2GRAY)
        _write_jpeg(folder / _copy_name(number), clahe.apply(grey))


def _copy_name(number: int) -> str:
    return f"{number:06d}.jpg"


def _write_jpeg(path: Path, image: np.ndarray) -> None:
    # cv2.imwrite cannot write to every path on Windows, and does not say why it failed.
    path.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


# Video ----------------------------------------------------------------------------------------------------------------


def _pick_frames(video: Path, scene: Path, report: Progress) -> list[str]:
    """Write frames of a video to scene/images, the sharpest one in each stretch of equal motion; return their names."""
    sharpness, motion = _measure_frames(video, report)
    if len(sharpness) == 0:
        raise InputError(f"{video} is neither a folder of photos nor a video that can be read.")
    travelled = np.cumsum(motion)
    if travelled[-1] < _VIDEO_STEP:
        raise InputError(f"The camera hardly moves in {video}: poses need views from different places.")
    step = np.clip(_VIDEO_STEP, travelled[-1] / _MOST_FRAMES, travelled[-1] / _FEWEST_FRAMES)
    stretch = (travelled / step).astype(int)
    chosen = {
        int(group[np.argmax(sharpness[group])]) for k in np.unique(stretch) for group in [np.flatnonzero(stretch == k)]
    }
    names = []
    for number, frame in _frames(video):
        if number in chosen:
            names.append(f"frame_{number:06d}.jpg")
            _write_jpeg(scene / "images" / names[-1], frame)
        report("Choosing frames", 0.7 + 0.3 * (number + 1) / len(sharpness))
    return names


def _frames(video: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the number of each frame and the frame (H, W, 3) uint8 BGR."""
    capture = cv2.VideoCapture(str(video))
    try:
        number = 0
        while True:
            there, frame = capture.read()
            if not there:
                return
            yield number, frame
            number += 1
    finally:
        capture.release()


def _measure_frames(video: Path, report: Progress) -> tuple[np.ndarray, np.ndarray]:
    """Return for each frame the sharpness (variance of the Laplacian) and the motion since the frame before.

    Motion is a fraction of the image width.
    """
    capture = cv2.VideoCapture(str(video))
    total = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    capture.release()
    clahe = cv2.createCLAHE(clipLimit=4, tileGridSize=(8, 8))
    sharpness, motion = [], []
    before: np.ndarray | None = None
    for number, frame in _frames(video):
        scale = min(1.0, 480 / frame.shape[1])
        small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
        sharpness.append(cv2.Laplacian(grey, cv2.CV_64F).var())
        equal = clahe.apply(grey)
        motion.append(0.0 if before is None else _motion(before, equal) / equal.shape[1])
        before = equal
        report("Choosing frames", min(0.7, 0.7 * number / max(total, 1)))
    return np.array(sharpness), np.array(motion)


def _motion(before: np.ndarray, after: np.ndarray) -> float:
    """Return the median motion of corners in pixels; that of one step when they cannot be tracked."""
    corners = cv2.goodFeaturesToTrack(before, 300, 0.01, 8)
    if corners is None or len(corners) < 20:
        return 0.0  # no structure, as in open water: no frame is taken for it
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    followed = found.ravel() > 0
    if followed.mean() < 0.3:
        return _VIDEO_STEP * before.shape[1]
    distance = float(np.median(np.linalg.norm((moved - corners).reshape(-1, 2)[followed], axis=1)))
    return distance if distance > 0.25 else 0.0  # less is noise, and would add up while the camera rests


# COLMAP, in a child process -------------------------------------------------------------------------------------------


def _run_colmap(scene: Path, scratch: Path, names: list[str], report: Progress) -> dict[str, Any]:
    job = scratch / "job.json"
    job.write_text(json.dumps({"scene": str(scene), "scratch": str(scratch), "names": names}), encoding="utf-8")
    package_root = Path(__file__).resolve().parents[2]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(package_root), os.environ.get("PYTHONPATH")])),
        "PYTHONIOENCODING": "utf-8",
    }
    command = [sys.executable, "-m", "swag_engine.scene.sfm", str(job)]
    result: dict[str, Any] | None = None
    with (
        open(scratch / "colmap.log", "wb") as log,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment, encoding="utf-8"
        ) as child,
    ):
        try:
            for message in _messages(child, scratch / "database.db"):
                if "stage" in message:
                    report(message["stage"], message["fraction"])
                elif "error" in message:
                    raise InputError(message["error"])
                else:
                    result = message
        finally:
            if result is None:
                child.kill()
    if result is None:
        raise InputError(f"COLMAP ended without a result (exit code {child.returncode}): free memory and try again.")
    return result


def _messages(child: subprocess.Popen[str], database: Path) -> Iterator[dict[str, Any]]:
    """Yield the messages of the child until it ends, the last one with a stage twice a second while it is silent.

    COLMAP reports no progress of features and matching, so the child sends the name of the table of COLMAP's database
    that they fill, and its rows are counted from here. (Not in the child: closing a second connection in one process
    would drop the locks of COLMAP's own copy of SQLite, and crash it: sqlite.org/howtocorrupt.html, section 2.2.)
    """
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    latest: dict[str, Any] = {"stage": _FEATURES_STAGE, "fraction": 0.0}
    while True:
        try:
            line = lines.get(timeout=0.5)
        except queue.Empty:
            if "table" in latest and (count := _rows(database, latest["table"])) is not None:
                latest["fraction"] = min(1.0, count / max(1, latest["total"]))
            yield latest
            continue
        if line is None:
            return
        message = json.loads(line)
        if "stage" in message:
            latest = message = {"fraction": 0.0} | message
        yield message


def _rows(database: Path, table: str) -> int | None:
    try:
        with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # not made yet, or being written to
        return None


def _child(job: Path) -> None:
    """Run COLMAP in the child process: features, matching, mapping; write the largest model with the images' names."""
    from .colmap_library import pycolmap

    task = json.loads(job.read_text(encoding="utf-8"))
    names: list[str] = task["names"]
    scene, scratch = Path(task["scene"]), Path(task["scratch"])
    database, pictures, models = scratch / "database.db", scratch / "pictures", scratch / "models"
    copies = [_copy_name(number) for number in range(len(names))]
    pycolmap.set_random_seed(0)

    # Images of one size and focal length (from EXIF) share a camera, which makes its calibration more certain.
    cameras: dict[tuple[int, int, str], list[str]] = {}
    for copy, name in zip(copies, names, strict=True):
        camera = pycolmap.infer_camera_from_image(str(scene / "images" / name))
        known = camera.params_to_string() if camera.has_prior_focal_length else ""
        cameras.setdefault((camera.width, camera.height, known), []).append(copy)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = _FEATURE_PIXELS
    extraction.sift.max_num_features = _FEATURES
    _say(stage=_FEATURES_STAGE, table="keypoints", total=len(names))
    for (_, _, known), group in cameras.items():
        pycolmap.extract_features(
            str(database),
            str(pictures),
            image_names=group,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=known),
            extraction_options=extraction,
        )

    if len(names) <= _EXHAUSTIVE_UP_TO:
        _say(stage="Matching photos", table="two_view_geometries", total=len(names) * (len(names) - 1) // 2)
        pycolmap.match_exhaustive(str(database))
    else:
        pairing = pycolmap.SequentialPairingOptions()
        _say(stage="Matching photos", table="two_view_geometries", total=len(names) * (pairing.overlap + 4))
        pycolmap.match_sequential(str(database), pairing_options=pairing)

    placed = 0

    def one_more() -> None:
        nonlocal placed
        placed += 1
        _say(stage="Placing cameras", fraction=min(1.0, placed / len(names)))

    models.mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.extract_colors = False  # they come from the images, not from the grey copies
    options.random_seed = 0
    found = pycolmap.incremental_mapping(
        str(database),
        str(pictures),
        str(models),
        options,
        initial_image_pair_callback=one_more,
        next_image_callback=one_more,
    )
    if not found:
        raise InputError(
            f"No camera could be placed from these {len(names)} photos: they need to overlap by half or more, be taken "
            "from different places, and show structure."
        )
    model = max(found.values(), key=lambda candidate: candidate.num_reg_images())
    for image in model.images.values():
        image.name = names[copies.index(image.name)]
    model.extract_colors_for_all_images(str(scene / "images"))
    sparse = scene / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    _say(
        registered=model.num_reg_images(),
        groups=sorted((candidate.num_reg_images() for candidate in found.values()), reverse=True),
        points=model.num_points3D(),
        reprojection_error=model.compute_mean_reprojection_error(),
    )


def _say(**message: Any) -> None:
    try:
        print(json.dumps(message), flush=True)
    except BrokenPipeError:  # the parent has ended
        os._exit(1)


def _end_with_parent() -> None:
    """Wait for the end of standard input, which the parent holds open as long as it lives, and end this process."""
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _child(Path(sys.argv[1]))
    except Exception as error:  # the parent turns it into the user's sentence
        reason = str(error) if isinstance(error, InputError) else f"COLMAP failed: {str(error).splitlines()[0]}"
        _say(error=reason)
        sys.exit(1)
