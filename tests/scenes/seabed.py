"""Generated surveys of a seabed whose heights, labels and scale are exactly known: to measure maps.

    bed = Seabed()
    survey = write_survey(Path("/tmp/first"), bed)
    write_survey(Path("/tmp/later"), bed.changed(), water=COAST, seed=1)

Sand, corals, sponges and a meadow are a height field, which is ray-traced along lanes from above and in a ring of
oblique views. Coded targets lie flat in the corners. Units of the seabed are metres, z is up; the COLMAP model has
another unit and is turned.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from tests.scenes.make_scene import srgb, write_model
from tests.scenes.targets import look_at

SIZE = (480, 360)
"""Width and height of the photos."""
FOCAL = 360.0
"""Focal length of the photos, pixels."""
CELL = 0.005
"""Spacing of the height field, metres."""
EXTENT = (4.0, 3.0)
"""Edges of the surveyed area, whose middle is at x = y = 0, metres."""
MARGIN = 1.5
"""Width of the sand around it, metres."""
LABELS = ("sand", "coral", "sponge", "seagrass")
"""Names of the labels 1, 2, ...; 1 is sand."""
TARGET_SIZE = 0.2
"""Edge of the coded targets, metres."""
TARGETS = {0: (-1.7, -1.2), 1: (1.7, -1.2), 2: (1.7, 1.2), 3: (-1.7, 1.2)}
"""Middles of the targets by number (aruco_4x4_50), metres."""
METRES_PER_UNIT = 0.37
STEPS = 60
"""Places along a ray at which it is compared with the height field, before the crossing is refined."""


@dataclass(frozen=True)
class Water:
    """Revised image formation: attenuation and build-up of backscatter per metre, background light, linear RGB.

    Attributes:
        beta_D: Attenuation of the direct signal.
        beta_B: Build-up of backscatter.
        B_inf: Background light.
        lamp: Light of a lamp at the camera at 1 m, relative to that from above, which falls with the squared range.
    """

    beta_D: tuple[float, float, float] = (0.0, 0.0, 0.0)
    beta_B: tuple[float, float, float] = (0.0, 0.0, 0.0)
    B_inf: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lamp: float = 0.0


AIR = Water()
OCEAN = Water((0.35, 0.09, 0.06), (0.30, 0.11, 0.085), (0.02, 0.16, 0.30))
COAST = Water((0.45, 0.16, 0.22), (0.40, 0.18, 0.24), (0.05, 0.22, 0.16))
LAMP = Water((0.35, 0.09, 0.06), (0.30, 0.11, 0.085), (0.01, 0.05, 0.08), lamp=3.0)
WATERS = {"air": AIR, "ocean": OCEAN, "coast": COAST, "lamp": LAMP}


@dataclass(frozen=True)
class Thing:
    """A coral, sponge or meadow: its label, middle, mean radius and height in metres, and color."""

    label: int
    x: float
    y: float
    radius: float
    height: float
    color: tuple[float, float, float]


def _things() -> tuple[Thing, ...]:
    """Nine corals, three sponges and a meadow, none over another or over a target."""
    orange, pink, yellow, violet, green = (
        (0.62, 0.30, 0.12), (0.60, 0.24, 0.34), (0.62, 0.52, 0.16), (0.34, 0.22, 0.48), (0.14, 0.34, 0.10),
    )  # fmt: skip
    return (
        Thing(2, -1.10, -0.75, 0.26, 0.22, orange), Thing(2, -0.35, -1.05, 0.16, 0.14, pink),
        Thing(2, 0.55, -0.95, 0.30, 0.26, orange), Thing(2, 1.15, -0.45, 0.20, 0.18, yellow),
        Thing(2, -1.50, 0.10, 0.18, 0.15, yellow), Thing(2, -0.55, -0.15, 0.28, 0.24, pink),
        Thing(2, 0.30, 0.15, 0.14, 0.12, orange), Thing(2, 1.60, 0.25, 0.24, 0.20, pink),
        Thing(2, -0.95, 0.75, 0.22, 0.18, orange),
        Thing(3, 0.75, 0.55, 0.20, 0.30, violet), Thing(3, -0.20, 0.65, 0.15, 0.22, violet),
        Thing(3, 1.05, 1.10, 0.16, 0.18, violet),
        Thing(4, 0.25, 1.15, 0.30, 0.03, green),
    )  # fmt: skip


@dataclass(frozen=True)
class Seabed:
    """What lies there.

    Attributes:
        things: What lies on the sand.
        bank: Middle of a bank of sand 7 cm high.
        texture: Seed of the texture.
    """

    things: tuple[Thing, ...] = field(default_factory=_things)
    bank: tuple[float, float] = (-1.0, -0.1)
    texture: int = 5

    @staticmethod
    def scattered(seed: int) -> "Seabed":
        """Another seabed: each thing elsewhere within 6 cm, 10 % smaller to 20 % larger, and another texture."""
        random = np.random.default_rng(seed)
        things = []
        for thing in _things():
            x, y = random.uniform(-0.06, 0.06, 2) + (thing.x, thing.y)
            size = random.uniform(0.9, 1.2)
            things.append(replace(thing, x=x, y=y, radius=size * thing.radius, height=size * thing.height))
        return Seabed(tuple(things), texture=100 + seed)

    def changed(self) -> "Seabed":
        """The same place later: corals 1, 4 and 6 are gone, coral 2 has grown by 10 %, and the bank has moved."""
        kept = [thing for number, thing in enumerate(self.things) if number not in (1, 4, 6)]
        grown = self.things[2]
        larger = replace(grown, radius=1.1 * grown.radius, height=1.1 * grown.height)
        return Seabed(tuple(larger if thing == grown else thing for thing in kept), (1.4, -0.95), self.texture)

    @cached_property
    def _grid(self) -> tuple[np.ndarray, np.ndarray]:
        """x of the columns and y of the rows (from the highest down), metres."""
        width, height = (side + 2 * MARGIN for side in EXTENT)
        x = (np.arange(round(width / CELL)) + 0.5) * CELL - width / 2
        y = height / 2 - (np.arange(round(height / CELL)) + 0.5) * CELL
        return x.astype(np.float32), y.astype(np.float32)

    @cached_property
    def fields(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights (H, W) float32, labels (H, W) uint8 and colors (H, W, 3) float32 on the grid."""
        x, y = self._grid[0][None, :], self._grid[1][:, None]
        heights = 0.04 * np.sin(1.9 * x + 0.4) * np.cos(1.6 * y) + 0.02 * np.sin(4.3 * y + x)
        heights = heights + 0.07 * np.exp(-((x - self.bank[0]) ** 2 + (y - self.bank[1]) ** 2) / (2 * 0.12**2))
        labels = np.ones(heights.shape, np.uint8)
        colors = np.tile(np.array([0.42, 0.37, 0.28], np.float32), (*heights.shape, 1))
        for thing in self.things:
            angle = np.arctan2(y - thing.y, x - thing.x)
            outline = 1 + 0.1 * np.sin(3 * angle + 7 * thing.x) + 0.06 * np.sin(5 * angle + 9 * thing.y)
            distance = np.hypot(x - thing.x, y - thing.y) / (thing.radius * outline)
            inside = distance < 1
            heights = heights + np.where(inside, thing.height * np.sqrt(np.clip(1 - distance**2, 0, 1)), 0)
            labels[inside], colors[inside] = thing.label, thing.color
        random = np.random.default_rng(self.texture)
        detail = np.zeros(heights.shape, np.float32)
        for size in (0.012, 0.03, 0.08, 0.25):
            cells = [max(2, round(side * CELL / size)) for side in heights.shape]
            noise = random.standard_normal(cells).astype(np.float32)
            detail += cv2.resize(noise, heights.shape[::-1], interpolation=cv2.INTER_CUBIC)
        colors *= np.exp(0.28 * detail)[..., None]
        for number, (tx, ty) in TARGETS.items():
            dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
            edge = round(TARGET_SIZE / CELL)
            marker = cv2.aruco.generateImageMarker(dictionary, number, 6 * 50)
            marker = cv2.copyMakeBorder(marker, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=[255])
            whole = round(edge * 420 / 300)
            marker = cv2.resize(marker, (whole, whole), interpolation=cv2.INTER_AREA)
            column = round((tx - self._grid[0][0]) / CELL - (whole - 1) / 2)
            row = round((self._grid[1][0] - ty) / CELL - (whole - 1) / 2)
            place = slice(row, row + whole), slice(column, column + whole)
            colors[place] = 0.03 + 0.6 * (marker / 255)[..., None]
            heights[place] = heights[place].mean()
        return heights.astype(np.float32), labels, np.clip(colors, 0, 0.9).astype(np.float32)

    def sample(self, values: np.ndarray, x: np.ndarray, y: np.ndarray, method: int = cv2.INTER_LINEAR) -> np.ndarray:
        """Read one of the fields at places (H, W) in metres."""
        columns = ((x - float(self._grid[0][0])) / CELL).astype(np.float32)
        rows = ((float(self._grid[1][0]) - y) / CELL).astype(np.float32)
        return cv2.remap(values, columns, rows, method, borderMode=cv2.BORDER_REPLICATE)

    def target_centres(self) -> dict[int, np.ndarray]:
        """Middles (3,) of the targets, metres."""
        heights = self.fields[0]
        return {
            number: np.array([x, y, float(self.sample(heights, np.array([[x]]), np.array([[y]]))[0, 0])])
            for number, (x, y) in TARGETS.items()
        }


@dataclass(frozen=True, eq=False)
class Survey:
    """Photos of a seabed as a scene.

    Attributes:
        folder: Folder of the scene: images, sparse/0, labels (masks of all photos), and points.csv (the targets).
        metres_per_unit: Length of a unit of its model.
    """

    folder: Path
    metres_per_unit: float


def camera_poses(turned: bool) -> list[np.ndarray]:
    """World-to-camera transforms (3, 4) of lanes from above and a ring of oblique views, which `turned` changes."""
    poses = []
    xs, ys = np.linspace(-1.8, 1.8, 6), np.linspace(-1.2, 1.2, 4)
    if turned:
        xs, ys = np.linspace(-1.7, 1.7, 5), np.linspace(-1.3, 1.3, 5)
    for row, y in enumerate(ys):
        for column, x in enumerate(xs):
            height = 2.1 + 0.15 * np.sin(2.3 * row + 1.7 * column + turned)
            shift = 0.12 * np.cos(3.1 * column + row)
            poses.append(look_at(np.array([x + shift, y, height]), (x + 0.1, y + 0.15 * np.sin(column), 0)))
    for number in range(10):
        angle = 2 * np.pi * (number + 0.5 * turned) / 10
        at = np.array([2.3 * np.cos(angle), 1.9 * np.sin(angle), 1.5 + 0.2 * turned])
        poses.append(look_at(at, (0.35 * at[0], 0.35 * at[1], 0.0)))
    return poses


def write_survey(
    folder: Path, bed: Seabed, water: Water = AIR, turned: bool = False, light: float = 0.0, seed: int = 0
) -> Survey:
    """Photograph a seabed and write the photos as a scene with exact cameras.

    Args:
        folder: The new folder.
        bed: What is photographed.
        water: The water.
        turned: Whether the camera takes the other path.
        light: How far the sun has moved, radians; it also becomes weaker and warmer.
        seed: Of noise, and of the frame of the model.
    """
    random = np.random.default_rng(seed)
    heights, labels, _ = bed.fields
    images, masks = folder / "images", folder / "labels"
    images.mkdir(parents=True)
    masks.mkdir()
    (masks / "labels.txt").write_text("\n".join(LABELS) + "\n")
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    names, poses, photos, ranges = [], [], [], []
    for number, pose in enumerate(camera_poses(turned)):
        pose = np.vstack([pose, [0, 0, 0, 1]])
        photo, mask, distance = _photograph(bed, heights, labels, pose, water, light, random)
        name = f"photo_{number:02d}.jpg"
        names.append(name)
        photos.append(photo)
        ranges.append(distance / METRES_PER_UNIT)
        quality = [cv2.IMWRITE_JPEG_QUALITY, 92]
        (images / name).write_bytes(cv2.imencode(".jpg", photo[..., ::-1], quality)[1].tobytes())
        (masks / f"photo_{number:02d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
        in_units = pose.copy()
        in_units[:3, :3] = pose[:3, :3] @ turn
        in_units[:3, 3] /= METRES_PER_UNIT
        poses.append(in_units)
    write_model(folder / "sparse" / "0", names, poses, FOCAL, photos, ranges, 4000, random)
    rows = [f"{number},{x:.4f},{y:.4f},{z:.4f}" for number, (x, y, z) in bed.target_centres().items()]
    (folder / "points.csv").write_text("name,x,y,z\n" + "\n".join(rows) + "\n")
    return Survey(folder, METRES_PER_UNIT)


def _photograph(
    bed: Seabed,
    heights: np.ndarray,
    labels: np.ndarray,
    pose: np.ndarray,
    water: Water,
    light: float,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a photo (H, W, 3) uint8 RGB, its labels (H, W) and its ranges (H, W) in metres."""
    rays = _rays(pose, 2)
    centre = -pose[:3, :3].T @ pose[:3, 3]
    distance = _hit(bed, heights, centre, rays.astype(np.float32))
    points = centre + rays * distance[..., None]
    x, y = points[..., 0], points[..., 1]
    down, right = np.gradient(heights, CELL)
    slope_x, slope_y = bed.sample(right, x, y), -bed.sample(down, x, y)
    normal = np.dstack([-slope_x, -slope_y, np.ones_like(slope_x)])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    sun = np.array([0.45 * np.cos(0.6 + light), 0.45 * np.sin(0.6 + light), 0.89])
    shade = 0.45 + 0.55 * np.clip(normal @ sun, 0, 1)[..., None] * np.array([1, 1 - 0.1 * light, 1 - 0.2 * light])
    illumination = (1 - 0.25 * light) * shade
    z = distance[..., None]
    if water.lamp:
        illumination = 0.25 * illumination + water.lamp * np.clip(-(normal * rays).sum(2), 0, 1)[..., None] / z**2
    color = bed.sample(bed.fields[2], x, y) * illumination
    direct = color * np.exp(-np.array(water.beta_D) * z)
    linear = direct + np.array(water.B_inf) * (1 - np.exp(-np.array(water.beta_B) * z))
    linear = cv2.resize(linear.astype(np.float32), SIZE, interpolation=cv2.INTER_AREA)
    shown = 255 * srgb(linear) + random.normal(0, 1.5, linear.shape)
    rays = _rays(pose, 1)
    points = centre + rays * _hit(bed, heights, centre, rays.astype(np.float32))[..., None]
    mask = bed.sample(labels, points[..., 0], points[..., 1], cv2.INTER_NEAREST)
    middle = cv2.resize(distance.astype(np.float32), SIZE, interpolation=cv2.INTER_AREA)
    return np.clip(shown + 0.5, 0, 255).astype(np.uint8), mask, middle


def _rays(pose: np.ndarray, samples: int) -> np.ndarray:
    """Return the directions (samples H, samples W, 3) of the middles of equal parts of pixels."""
    width, height = SIZE[0] * samples, SIZE[1] * samples
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.dstack([(u - width / 2) / (FOCAL * samples), (v - height / 2) / (FOCAL * samples), np.ones_like(u)])
    return (rays / np.linalg.norm(rays, axis=2, keepdims=True)) @ pose[:3, :3]


def _hit(bed: Seabed, heights: np.ndarray, centre: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the ranges (H, W) at which rays from a point meet the height field."""
    low, high = float(heights.min()) - 0.01, float(heights.max()) + 0.01
    near, far = (high - centre[2]) / rays[..., 2], (low - centre[2]) / rays[..., 2]
    near, far = near.astype(np.float32), far.astype(np.float32)
    before, after, found = near.copy(), far.copy(), np.zeros(near.shape, bool)
    x, y, z = (np.ascontiguousarray(rays[..., axis]) for axis in range(3))

    def below(distance: np.ndarray) -> np.ndarray:
        at = (float(middle) + ray * distance for middle, ray in zip(centre, (x, y, z), strict=True))
        place_x, place_y, height = at
        return height <= bed.sample(heights, place_x, place_y)

    for step in range(1, STEPS + 1):
        distance = near + (far - near) * step / STEPS
        hit = below(distance) & ~found
        after[hit] = distance[hit]
        found |= hit
        before = np.where(found, before, distance)
    for _ in range(8):
        middle = (before + after) / 2
        hit = below(middle)
        after, before = np.where(hit, middle, after), np.where(hit, before, middle)
    return after
