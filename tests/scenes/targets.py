"""A COLMAP scene of a textured sea floor with coded targets on it, whose true size in metres is known."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear

SIZE = (800, 600)
FOCAL = 700.0


@dataclass(frozen=True)
class TargetScene:
    """What was written: scene = rotation^T (metres - translation) / metres_per_unit."""

    folder: Path
    metres_per_unit: float
    rotation: np.ndarray
    translation: np.ndarray
    centres: dict[str, np.ndarray]
    corners: dict[int, np.ndarray]

    def project(self, name: str, place: np.ndarray) -> np.ndarray:
        """Pixels (2,) of a place in metres in the photo of that name."""
        seen = self.poses[name][:, :3] @ place + self.poses[name][:, 3]
        return FOCAL * seen[:2] / seen[2] + np.array(SIZE) / 2

    @property
    def poses(self) -> dict[str, np.ndarray]:
        return {name: look_at(centre) for name, centre in self.centres.items()}


def look_at(centre: np.ndarray, at: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """World to camera (3, 4) in metres, x to the right and y down in the photo; z is up in the world."""
    forward = np.array(at) - centre
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.02, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ centre])


def target_corners(size: float, numbers: tuple[int, ...], seed: int = 3) -> dict[int, np.ndarray]:
    """Corners (4, 3) in metres of targets beside each other on the floor, some of them tilted."""
    random = np.random.default_rng(seed)
    corners = {}
    for index, number in enumerate(numbers):
        square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * size / 2
        turn, tilt = random.uniform(0, 2 * np.pi), 0.4 * (index % 2)
        z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        x = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        middle = [0.75 * (index % 3 - 1), 0.7 * (index // 3 - 0.5), 0.15 + 0.1 * (index % 2)]
        corners[number] = square @ (z @ x).T + middle
    return corners


def ring(count: int = 8, radius: float = 1.6, height: float = 1.5) -> dict[str, np.ndarray]:
    """Places of cameras around the middle, at different heights."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return {
        f"photo_{i:02d}.png": np.array([radius * np.cos(a), radius * np.sin(a), height + 0.3 * np.sin(3 * a + 1)])
        for i, a in enumerate(angles)
    }


def make_target_scene(
    folder: Path,
    dictionary: int = cv2.aruco.DICT_4X4_50,
    corners: dict[int, np.ndarray] | None = None,
    centres: dict[str, np.ndarray] | None = None,
    metres_per_unit: float = 0.37,
    distortion: float = 0.0,
    draw: bool = True,
) -> TargetScene:
    """Write photos and a COLMAP text model, whose world is turned, moved and scaled against metres.

    `distortion` is k1 of SIMPLE_RADIAL. Without `draw` the photos are small grey pictures with cameras of large ones.
    """
    random = np.random.default_rng(11)
    corners = target_corners(0.15, (0, 3, 7, 11)) if corners is None else corners
    centres = centres or ring()
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    made = TargetScene(folder, metres_per_unit, rotation, np.array([3.0, -2.0, 1.0]), centres, corners)
    images, model = folder / "images", folder / "sparse" / "0"
    images.mkdir(parents=True)
    model.mkdir(parents=True)
    floor = cv2.resize(random.normal(120, 25, (150, 150, 3)), (600, 600), interpolation=cv2.INTER_CUBIC)
    floor_corners = np.array([[-3, 3, 0], [3, 3, 0], [3, -3, 0], [-3, -3, 0]], float)
    lines = []
    for index, (name, pose) in enumerate(made.poses.items()):
        if draw:
            picture = np.full((2 * SIZE[1], 2 * SIZE[0], 3), 60, np.uint8)
            warp(picture, np.clip(floor, 0, 255).astype(np.uint8), floor_corners, pose)
            for number, places in corners.items():
                cells = cv2.aruco.getPredefinedDictionary(dictionary).markerSize + 2
                marker = cv2.aruco.generateImageMarker(
                    cv2.aruco.getPredefinedDictionary(dictionary), number, 20 * cells
                )
                margin = 1 + 2 / cells
                wide = places.mean(0) + (places - places.mean(0)) * margin
                marker = cv2.copyMakeBorder(marker, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=[255])
                warp(picture, cv2.cvtColor(marker, cv2.COLOR_GRAY2BGR), wide, pose)
            if distortion:
                picture = distort(picture, distortion)
            light = srgb_to_linear(picture / 255).astype(np.float32)  # what a lens blurs
            picture = 255 * linear_to_srgb(cv2.resize(light, SIZE, interpolation=cv2.INTER_AREA))
            picture = picture * [0.45, 0.4, 0.2] + [40, 35, 5] + random.normal(0, 2, picture.shape)
        else:
            picture = np.full((SIZE[1] // 20, SIZE[0] // 20, 3), 90.0)
        (images / name).write_bytes(cv2.imencode(".png", picture.clip(0, 255).astype(np.uint8))[1].tobytes())
        # x_camera = R x_metres + t, x_metres = s Q x_scene + T, and the camera's units are the scene's.
        turn = pose[:, :3] @ rotation
        shift = (pose[:, :3] @ made.translation + pose[:, 3]) / metres_per_unit
        x, y, z, w = quaternion(turn)
        lines.append(f"{index + 1} {w} {x} {y} {z} {' '.join(map(repr, map(float, shift)))} 1 {name}\n\n")
    model_name = "SIMPLE_RADIAL" if distortion else "SIMPLE_PINHOLE"
    radial = f" {distortion}" if distortion else ""
    (model / "cameras.txt").write_text(
        f"1 {model_name} {SIZE[0]} {SIZE[1]} {FOCAL} {SIZE[0] / 2} {SIZE[1] / 2}{radial}\n"
    )
    (model / "images.txt").write_text("".join(lines))
    places = np.column_stack([random.uniform(-2, 2, (200, 2)), np.zeros(200)])
    points = (places - made.translation) @ rotation / metres_per_unit
    (model / "points3D.txt").write_text(
        "".join(f"{i + 1} {p[0]} {p[1]} {p[2]} 90 90 90 0.5\n" for i, p in enumerate(points))
    )
    return made


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Quaternion xyzw of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat()


def warp(picture: np.ndarray, texture: np.ndarray, places: np.ndarray, pose: np.ndarray) -> None:
    """Draw a texture with its corners, clockwise from the top left, at places (4, 3) in metres, twice as large."""
    seen = places @ pose[:, :3].T + pose[:, 3]
    if (seen[:, 2] < 0.1).any():
        return
    pixels = 2 * (FOCAL * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2)
    rows, columns = texture.shape[:2]
    source = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float32)
    matrix = cv2.getPerspectiveTransform(source - 0.5, pixels.astype(np.float32) - 0.5)
    size = (picture.shape[1], picture.shape[0])
    cv2.warpPerspective(texture, matrix, size, picture, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)


def distort(picture: np.ndarray, k1: float) -> np.ndarray:
    """A pinhole picture, twice as large as the photo, as a lens with radial distortion k1 shows it."""
    return cv2.remap(picture, *distorted_places(k1, *picture.shape[:2]), cv2.INTER_LINEAR)


@lru_cache
def distorted_places(k1: float, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of a lens with radial distortion k1 is in the pinhole picture."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    x, y = x / (2 * FOCAL), y / (2 * FOCAL)
    u, v = x, y
    for _ in range(20):
        factor = 1 + k1 * (u * u + v * v)
        u, v = x / factor, y / factor
    return (2 * FOCAL * u + width / 2 - 0.5).astype(np.float32), (2 * FOCAL * v + height / 2 - 0.5).astype(np.float32)
