"""COLMAP scenes of bright dots on a dark bumpy floor, written by pycolmap: any camera model, binary or text, rigs."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap


def dot_positions(count: int = 60) -> np.ndarray:
    """Return positions (count, 3) float64 on a jittered grid, so that dots do not overlap; depth 0 +- 0.4."""
    random = np.random.default_rng(3)
    side = int(np.ceil(count**0.5))
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, side), np.linspace(-1.5, 1.5, side)), -1).reshape(-1, 2)[:count]
    return np.column_stack([grid + random.uniform(-0.05, 0.05, grid.shape), random.uniform(-0.4, 0.4, count)])


def draw_dots(width: int, height: int, centres: np.ndarray, sigma: float = 1.5) -> np.ndarray:
    """Return an image (height, width, 3) uint8 with a Gaussian blob at each of `centres` (N, 2) in COLMAP pixels."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    picture = np.full((height, width), 20.0)
    for centre in centres[np.isfinite(centres).all(1)]:
        picture += 200 * np.exp(-((x - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2) / (2 * sigma**2))
    return np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, -1)


def make_dot_scene(
    folder: Path,
    camera: pycolmap.Camera | None = None,
    views: int = 4,
    cameras_per_rig: int = 1,
    model: str = "sparse/0",
    images: str = "images",
    name: str = "view_{:02d}.png",
    text: bool = False,
) -> Path:
    """Write images and a model to `folder`; the cameras of a rig are side by side and have `views` frames each."""
    positions = dot_positions()
    camera = camera or pycolmap.Camera(model="PINHOLE", width=200, height=150, params=[150.0, 150.0, 100.0, 75.0])
    scene = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for index in range(cameras_per_rig):
        sensor = pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params, camera_id=index + 1
        )
        scene.add_camera(sensor)
        if index == 0:
            rig.add_ref_sensor(sensor.sensor_id)
        else:
            rig.add_sensor(sensor.sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(), [-0.3 * index, 0.0, 0.0]))
    scene.add_rig(rig)
    observations: dict[int, list[tuple[int, int]]] = {point: [] for point in range(len(positions))}
    for frame_index in range(views):
        angle = np.radians(-10 + 20 * frame_index / max(1, views - 1))
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), [0.0, 0.1 * frame_index, 3.0])
        frame = pycolmap.Frame(frame_id=frame_index + 1, rig_id=1, rig_from_world=pose)
        taken = []
        for index in range(cameras_per_rig):
            image_id = frame_index * cameras_per_rig + index + 1
            sensor = scene.camera(index + 1)
            in_camera = positions @ rotation.T + pose.translation - [0.3 * index, 0, 0]
            pixels = sensor.img_from_cam(in_camera)
            inside = ((pixels > 0) & (pixels < [sensor.width, sensor.height])).all(1)
            path = folder / images / name.format(image_id)
            path.parent.mkdir(parents=True, exist_ok=True)
            picture = draw_dots(sensor.width, sensor.height, pixels[inside])
            path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())
            for row, point in enumerate(np.flatnonzero(inside)):
                observations[int(point)].append((image_id, row))
            image = pycolmap.Image(
                name=name.format(image_id), keypoints=pixels[inside], camera_id=index + 1, image_id=image_id
            )
            image.frame_id = frame.frame_id
            frame.add_data_id(image.data_id)
            taken.append(image)
        scene.add_frame(frame)
        for image in taken:
            scene.add_image(image)
        scene.register_frame(frame.frame_id)
    for point, seen in observations.items():
        track = pycolmap.Track([pycolmap.TrackElement(image_id, row) for image_id, row in seen])
        scene.add_point3D(positions[point], track, np.array([200, 180, point], np.uint8))
    (folder / model).mkdir(parents=True, exist_ok=True)
    (scene.write_text if text else scene.write_binary)(str(folder / model))
    return folder
