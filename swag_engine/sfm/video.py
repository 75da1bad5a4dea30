"""Frames chosen from a video for structure from motion."""

import os
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.foreign_files import refuse_foreign
from ..scene.image_files import IMAGE_SUFFIXES
from .image_motion import ImageMotion
from .photos import ChosenImages, copy_name, equalise, has_structure, write_jpeg
from .progress import Progress

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet: what cannot be decoded is said in a sentence

_STEP = 0.05
"""Motion of the image between two frames that are taken, as a fraction of its width, while the camera travels."""
_LARGEST_STEP = 0.15
"""The same in a long video: beyond it too few points are seen in three frames."""
_TURN_STEP = 0.25
"""The same while the camera only turns or zooms: views without parallax only have to overlap."""
_FEWEST_FRAMES = 40
"""Frames that are taken of a video, at least, where it has as many."""
_MOST_FRAMES = 300
"""Frames that are taken of a video, at most, unless they would be further apart than `_LARGEST_STEP`."""
_LIMIT = 1000
"""Frames that are taken of a video, at most."""
_CANDIDATES_PER_SECOND = 10
"""Frames that are examined in a second of video; all of a short one, see `_FEWEST_CANDIDATES`."""
_FEWEST_CANDIDATES = 600
"""Frames that are examined in a video, at least, where it has as many."""

_SHARPNESS_WIDTH = 960
"""Width in pixels at which sharpness is measured."""
_TRACKING_WIDTH = 480
"""Width in pixels at which corners are tracked."""
_REST = 0.01
"""Motion in a second, as a fraction of the image width, below which the camera rests."""


@dataclass
class _Examined:
    """What is known of the frames of a video that may be taken (arrays (N,)).

    Attributes:
        frames: Frames of the video.
        duration: Seconds that could be decoded.
        announced: Seconds that the file announces.
        open_water: Seconds without structure, of which no frame may be taken.
        numbers: Number of each frame.
        times: Time of each frame in seconds.
        sharpness: Variance of the Laplacian.
        motion: Motion of the image since the frame before, as a fraction of its width.
        turning: Whether the camera only turns or zooms.
    """

    frames: int
    duration: float
    announced: float
    open_water: float
    numbers: np.ndarray
    times: np.ndarray
    sharpness: np.ndarray
    motion: np.ndarray
    turning: np.ndarray


def pick_frames(video: Path, images: Path, pictures: Path, report: Progress) -> ChosenImages:
    """Write frames of a video, the sharpest one in each stretch of equal motion, and their equalised grey copies.

    A stretch is longer where the camera only turns or zooms, as that gives no parallax.

    Args:
        video: The video.
        images: Folder of the frames.
        pictures: Folder of the grey copies, numbered in the order of the frames (see `copy_name`).
        report: Called for each frame.

    Raises:
        InputError: When the video cannot be decoded, or its camera stays in one place.
    """
    if video.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"{video} is one photo: choose the folder of photos that it is in, or a video.")
    refuse_foreign(video)
    examined = _examine(video, report)
    travel = float(examined.motion[~examined.turning].sum())
    turn = float(examined.motion[examined.turning].sum())
    if travel + turn < _STEP:
        raise InputError(f"The camera hardly moves in {video}: poses need views from different places.")
    if travel < _STEP:
        raise InputError(f"The camera only turns or zooms in {video}: poses need views from different places.")
    step = min(np.clip(_STEP, travel / _MOST_FRAMES, travel / _FEWEST_FRAMES), _LARGEST_STEP)
    wanted = np.where(examined.turning, examined.motion / _TURN_STEP, examined.motion / step)
    excess = max(1.0, wanted.sum() / _LIMIT)
    step *= excess
    stretch = np.floor(np.cumsum(wanted) / excess)
    groups = [np.flatnonzero(stretch == number) for number in np.unique(stretch)]
    chosen = {int(examined.numbers[group[np.argmax(examined.sharpness[group])]]) for group in groups}
    names: list[str] = []
    with closing(_Reader(video)) as reader:
        while len(names) < len(chosen) and reader.next():
            if reader.number in chosen:
                frame = reader.frame()
                write_jpeg(pictures / copy_name(len(names)), equalise(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)))
                names.append(f"frame_{reader.number:06d}.jpg")
                write_jpeg(images / names[-1], frame)
            report("Choosing frames", 0.7 + 0.3 * min(1.0, (reader.number + 1) / examined.frames))
    return ChosenImages(names, [_describe(examined, len(names), step)], _doubts(examined, video, step))


def _describe(examined: _Examined, taken: int, step: float) -> str:
    """Say how many frames were taken and why."""
    seconds = np.diff(examined.times, append=examined.duration)
    travelled = np.cumsum(examined.motion)
    before, after = (np.interp(examined.times + half, examined.times, travelled) for half in (-0.25, 0.25))
    resting = 2 * (after - before) < _REST
    why = [
        f"{words} ({length:.0f} s)"
        for words, length in (
            ("fewer where the camera only turns or zooms", seconds[examined.turning & ~resting].sum()),
            ("none where it rests", seconds[resting].sum()),
            ("none of open water or darkness", examined.open_water),
        )
        if length >= 1
    ]
    return (
        f"Took {taken} of {examined.frames} frames, the sharpest of each stretch in which the image moves by "
        f"{step:.1%} of its width{': ' if why else ''}{', '.join(why)}."
    )


def _doubts(examined: _Examined, video: Path, step: float) -> list[str]:
    """Return sentences about a video that ends early or is too long."""
    doubts = []
    if examined.announced - examined.duration > max(0.5, 0.05 * examined.announced):
        doubts.append(
            f"Only the first {examined.duration:.0f} of {examined.announced:.0f} s of {video.name} can be read: the "
            "file is damaged, copy it again."
        )
    if step > 1.01 * _LARGEST_STEP:
        doubts.append(
            f"{video.name} is long: from frame to frame the image moves by {step:.0%} of its width, and above "
            f"{_LARGEST_STEP:.0%} cameras are easily lost. Cut the video into parts."
        )
    return doubts


class _Reader:
    """Frames of a video, one after the other; close it with `close`."""

    def __init__(self, video: Path):
        """Open a video; one that cannot be read has no frames."""
        self._capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # upright, as players show it; not every build's default
        self._rate = self._capture.get(cv2.CAP_PROP_FPS) or 25.0
        self._aspect = self._capture.get(cv2.CAP_PROP_SAR_NUM) / (self._capture.get(cv2.CAP_PROP_SAR_DEN) or 1) or 1
        if self._capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90:
            self._aspect = 1 / self._aspect
        self.announced = max(0.0, self._capture.get(cv2.CAP_PROP_FRAME_COUNT) / self._rate)
        """Duration that the file announces, in seconds."""
        self.number, self.time = -1, -1 / self._rate

    def close(self) -> None:
        """Close the video."""
        self._capture.release()

    def next(self) -> bool:
        """Decode the next frame, whose number and time in seconds become attributes; return whether there is one."""
        if not self._capture.grab():
            return False
        # Times of a file of variable frame rate differ from number / rate; some files have none.
        time = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        self.number, self.time = self.number + 1, time if time > self.time else self.time + 1 / self._rate
        return True

    def frame(self) -> np.ndarray:
        """Convert the frame to (H, W, 3) uint8 BGR with square pixels, which takes as long as to decode it."""
        frame = self._capture.retrieve()[1]
        return cv2.resize(frame, None, fx=max(1, self._aspect), fy=max(1, 1 / self._aspect))


def _examine(video: Path, report: Progress) -> _Examined:
    """Measure sharpness and motion of the frames of a video that may be taken.

    Raises:
        InputError: When no frame can be decoded or has structure.
    """
    numbers: list[int] = []
    times: list[float] = []
    sharpness: list[float] = []
    image_motion = ImageMotion()
    with closing(_Reader(video)) as reader:
        interval = min(1 / _CANDIDATES_PER_SECOND, reader.announced / _FEWEST_CANDIDATES)
        due, open_water = 0.0, 0
        while reader.next():
            if reader.time < due:
                continue
            due = reader.time + interval
            report("Choosing frames", min(0.7, 0.7 * reader.time / reader.announced) if reader.announced else 0.0)
            grey = cv2.cvtColor(_reduced(reader.frame(), _SHARPNESS_WIDTH), cv2.COLOR_BGR2GRAY)
            small = _reduced(grey, _TRACKING_WIDTH)
            if not has_structure(small):
                open_water += 1
                image_motion.interrupt()
                continue
            numbers.append(reader.number)
            times.append(reader.time)
            sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var()))
            image_motion.follow(equalise(small))
    image_motion.interrupt()
    if reader.number < 0:
        raise InputError(
            f"{video} cannot be read as a video: choose a folder of photos or a video, and convert a video of a type "
            "that is not read, such as AV1, to H.264 (MP4)."
        )
    if not numbers:
        raise InputError(f"{video} shows no structure, only open water or darkness.")
    return _Examined(
        frames=reader.number + 1,
        duration=reader.time,
        announced=reader.announced,
        open_water=reader.time * open_water / (open_water + len(numbers)),
        numbers=np.array(numbers),
        times=np.array(times),
        sharpness=np.array(sharpness),
        motion=np.array(image_motion.motion),
        turning=np.array(image_motion.turning),
    )


def _reduced(image: np.ndarray, width: int) -> np.ndarray:
    """Reduce an image to a width, never enlarging."""
    scale = min(1.0, width / image.shape[1])
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
