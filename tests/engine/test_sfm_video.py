import subprocess
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene.colmap import load_scene
from swag_engine.sfm import video
from swag_engine.sfm.photos import ChosenImages, write_jpeg
from swag_engine.sfm.reconstruct import reconstruct
from tests.scenes.panels import SIZE, render

seen = cache(render)  # all films together show few poses


def film(path: Path, poses: Iterable[tuple[float, ...]], codec: str = "MJPG", blur_all_but: int = 1) -> Path:
    """A video, 25 frames a second, of the panels from each pose (see `render`); each n-th frame is sharp."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25, SIZE)
    for number, pose in enumerate(poses):
        frame = seen(*pose)
        writer.write(frame if number % blur_all_but == 0 else cv2.GaussianBlur(frame, (0, 0), 1.5))
    writer.release()
    return path


def ffmpeg(*arguments: str | Path) -> None:
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *map(str, arguments)], check=True)


def pick(path: Path, tmp_path: Path) -> tuple[ChosenImages, np.ndarray]:
    """What was chosen, and the numbers of the frames."""
    images, pictures = tmp_path / "images", tmp_path / "pictures"
    images.mkdir()
    pictures.mkdir()
    fractions: list[float] = []
    chosen = video.pick_frames(path, images, pictures, lambda stage, fraction: fractions.append(fraction))
    assert [path.name for path in sorted(images.iterdir())] == chosen.names
    assert len(list(pictures.iterdir())) == len(chosen.names)
    assert fractions == sorted(fractions) and fractions[0] >= 0 and fractions[-1] <= 1
    return chosen, np.array([int(name[6:12]) for name in chosen.names])


def along(*places: float, count: int = 40) -> list[tuple[float, ...]]:
    """Poses at equal distances from each place to the next; equal places are a pause."""
    return [(x,) for a, b in zip(places, places[1:], strict=False) for x in np.linspace(a, b, count)]


@pytest.mark.parametrize(("codec", "suffix"), [("mp4v", ".mp4"), ("MJPG", ".avi")])
def test_frames_are_the_sharp_ones_evenly_spaced_in_motion(tmp_path: Path, codec: str, suffix: str) -> None:
    places = along(-1, 0) + along(0, 0, count=50) + along(0, 1)
    chosen, numbers = pick(film(tmp_path / f"Film ü{suffix}", places, codec, blur_all_but=3), tmp_path)
    assert 35 <= len(numbers) <= 45
    assert ((numbers > 40) & (numbers < 90)).sum() <= 1  # the camera rests
    assert (numbers % 3 == 0).mean() > 0.6
    assert np.diff([places[number][0] for number in numbers]).max() < 0.15
    assert chosen.warnings == []
    (note,) = chosen.notes
    assert note.startswith(f"Took {len(numbers)} of 130 frames, the sharpest of each stretch in which the image moves")
    assert note.endswith("% of its width: none where it rests (2 s).")


def test_fewer_frames_are_taken_where_the_camera_only_turns(tmp_path: Path) -> None:
    turn: list[tuple[float, ...]] = [(0.0, 0.3 * np.sin(angle)) for angle in np.linspace(0, 2 * np.pi, 40)]
    chosen, numbers = pick(film(tmp_path / "dive.avi", along(-1, 0) + turn + along(0, 1)), tmp_path)
    assert 4 <= ((numbers > 42) & (numbers < 78)).sum() <= 8  # the image moves by 1.3 widths, and by 0.2 in each travel
    assert (numbers <= 40).sum() > 10 and (numbers >= 80).sum() > 10
    assert "fewer where the camera only turns or zooms (" in chosen.notes[0]


@pytest.mark.parametrize(
    ("poses", "finding"),
    [
        ([(0.0,)] * 10, "hardly moves"),
        ([(0.0, yaw) for yaw in np.linspace(-0.2, 0.2, 40)], "only turns or zooms"),
        ([(0.0, 0.0, zoom) for zoom in np.linspace(1, 1.8, 60)], "only turns or zooms"),
    ],
)
def test_a_video_from_one_place_is_refused(tmp_path: Path, poses: list[tuple[float, ...]], finding: str) -> None:
    path = film(tmp_path / "still.avi", poses)
    with pytest.raises(InputError, match=f"{finding} in .*still.avi: poses need views from different places."):
        reconstruct(path, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["still.avi"]


def test_travel_along_a_flat_wall_is_not_taken_for_a_rotation(tmp_path: Path) -> None:
    """A homography explains both."""
    random = np.random.default_rng(3)
    wall = cv2.resize(random.integers(0, 255, (60, 200), np.uint8), None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    writer = cv2.VideoWriter(str(tmp_path / "wall.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE)
    for x in range(0, 600, 8):
        writer.write(cv2.cvtColor(wall[100 : 100 + SIZE[1], x : x + SIZE[0]], cv2.COLOR_GRAY2BGR))
    writer.release()
    chosen, numbers = pick(tmp_path / "wall.avi", tmp_path)
    assert len(numbers) >= 35 and "turns" not in chosen.notes[0]


def test_no_frame_of_open_water_is_taken(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE)
    for number, (x,) in enumerate(along(-1, 1, count=75)):
        water = np.clip(random.normal([90, 70, 10], 1, (SIZE[1], SIZE[0], 3)), 0, 255).astype(np.uint8)
        writer.write(water if 25 <= number < 55 else seen(x))
    writer.release()
    chosen, numbers = pick(tmp_path / "film.avi", tmp_path)
    assert len(numbers) > 10 and not ((numbers >= 25) & (numbers < 55)).any()
    assert "none of open water or darkness (1 s)" in chosen.notes[0]


def test_a_long_video_has_its_frames_further_apart_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = film(tmp_path / "long.avi", along(-1, 1))
    monkeypatch.setattr(video, "_FEWEST_FRAMES", 1)
    monkeypatch.setattr(video, "_MOST_FRAMES", 4)
    chosen, numbers = pick(path, tmp_path)
    assert len(numbers) <= 5 and chosen.warnings == []
    monkeypatch.setattr(video, "_LIMIT", 2)
    (tmp_path / "again").mkdir()
    chosen, numbers = pick(path, tmp_path / "again")
    assert len(numbers) <= 3
    assert "Cut the video into parts" in chosen.warnings[0] and "long.avi" in chosen.warnings[0]


def test_ten_bits_rotation_flag_and_variable_rate(tmp_path: Path) -> None:
    """As phones and action cameras write: the pictures have a rotation flag, and the rate falls midway."""
    film(tmp_path / "film.avi", along(-1, 1, count=60))
    ten, turned = tmp_path / "ten.mp4", tmp_path / "turned.mp4"
    slower = ("-vf", "select='lt(n,30)+not(mod(n,5))'", "-fps_mode", "vfr")
    bits = ("-c:v", "libx265", "-pix_fmt", "yuv420p10le", "-preset", "ultrafast", "-x265-params", "log-level=error")
    ffmpeg("-i", tmp_path / "film.avi", *slower, *bits, ten)
    ffmpeg("-display_rotation", "-90", "-i", ten, "-c", "copy", turned)  # to be turned clockwise
    chosen, numbers = pick(turned, tmp_path)
    assert chosen.notes[0].startswith(f"Took {len(numbers)} of 36 frames")
    assert numbers.max() >= 33
    assert chosen.warnings == []
    picture = cv2.imread(str(tmp_path / "images" / chosen.names[0]))
    expected = cv2.rotate(seen(*along(-1, 1, count=60)[numbers[0]]), cv2.ROTATE_90_CLOCKWISE)
    assert picture.shape == expected.shape
    difference, upside_down = (
        np.abs(picture - turned.astype(float)).mean() for turned in (expected, expected[::-1, ::-1])
    )
    assert difference < 0.5 * upside_down


def test_pixels_that_are_not_square_become_so(tmp_path: Path) -> None:
    film(tmp_path / "film.avi", along(-1, 1, count=30))
    ffmpeg("-i", tmp_path / "film.avi", "-vf", "setsar=4/3", "-c:v", "libx264", tmp_path / "hdv.mp4")
    chosen, _ = pick(tmp_path / "hdv.mp4", tmp_path)
    assert cv2.imread(str(tmp_path / "images" / chosen.names[0])).shape[:2] == (240, 427)


def test_a_video_that_was_cut_short(tmp_path: Path) -> None:
    film(tmp_path / "film.avi", along(-1, 1))
    ffmpeg("-i", tmp_path / "film.avi", "-c:v", "libx264", "-movflags", "faststart", tmp_path / "film.mp4")
    data = (tmp_path / "film.mp4").read_bytes()
    (tmp_path / "half.mp4").write_bytes(data[: len(data) // 2])
    chosen, numbers = pick(tmp_path / "half.mp4", tmp_path)
    assert 5 < numbers.max() < 30
    assert "of 2 s of half.mp4 can be read: the file is damaged" in chosen.warnings[0]


def test_files_that_are_no_video(tmp_path: Path) -> None:
    photo = tmp_path / "photo_001.jpg"
    photo.write_bytes(cv2.imencode(".jpg", render(0))[1].tobytes())
    with pytest.raises(InputError, match="photo_001.jpg is one photo: choose the folder"):
        reconstruct(photo, tmp_path / "out")
    film(tmp_path / "film.avi", along(-1, 1, count=5))
    ffmpeg("-i", tmp_path / "film.avi", "-c:v", "libsvtav1", tmp_path / "film.mp4")
    with pytest.raises(InputError, match="film.mp4 cannot be read as a video: .*convert"):
        reconstruct(tmp_path / "film.mp4", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_video_becomes_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_FEWEST_FRAMES", 8)
    monkeypatch.setattr(video, "_MOST_FRAMES", 9)
    result = reconstruct(film(tmp_path / "film.avi", along(-1.5, 1.5)), tmp_path / "out")
    scene = load_scene(tmp_path / "out")
    assert 7 <= result["images"] <= 10 and len(scene.views) == result["registered"] >= 0.75 * result["images"]
    assert result["notes"][0].startswith(f"Took {result['images']} of 40 frames")


def test_frames_keep_the_colors_of_details(tmp_path):
    image = np.full((64, 64, 3), (140, 150, 60), np.uint8)
    image[:, ::2, 2] = 90  # lines of red, one pixel wide
    write_jpeg(tmp_path / "frame.jpg", image)
    read = cv2.imread(str(tmp_path / "frame.jpg"))
    assert np.abs(read[4:-4, 4:-4].astype(int) - image[4:-4, 4:-4]).mean((0, 1)).max() < 3
