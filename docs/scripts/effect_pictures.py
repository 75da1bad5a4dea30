"""Make the pictures of the effects for Blender's panel: swag_blender/pictures/NAME.jpg, from the demo scene.

    python docs/scripts/effect_pictures.py

Each shows the wreck of the demo scene: left of the line without the effect, right of it with the effect.
"""

from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "tests" / "scenes" / "reef_wreck"
OUT = ROOT / "swag_blender" / "pictures"
NAME = "reef_000"
SIDE = 160
"""Width and height of a picture, pixels."""
QUALITY = 80
"""JPEG quality; a picture then has less than 20 kB."""
BETA_D, BETA_B = np.array([0.17, 0.062, 0.042]), np.array([0.13, 0.08, 0.068])
B_INF = np.array([0.03, 0.175, 0.255])
"""Water of the scene, red, green, blue, from its truth.json."""
FAR = 25.0
"""Range of open water, metres."""


def read(folder: str, suffix: str, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """Read a file of the shown view, cut to a square in its middle."""
    image = cv2.imread(str(SCENE / folder / f"{NAME}{suffix}"), flags)
    assert image is not None
    left = (image.shape[1] - image.shape[0]) // 2
    return image[:, left : left + image.shape[0]]


def light_of(image: np.ndarray) -> np.ndarray:
    """Linear light, red green blue, of an image as cv2 reads it."""
    values = image[..., ::-1].astype(np.float64) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def image_of(light: np.ndarray) -> np.ndarray:
    """Inverse of `light_of`."""
    light = light.clip(0, 1)
    values = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(values[..., ::-1] * 255).astype(np.uint8)


def main() -> None:
    """Write all pictures."""
    ranges = read("range", ".png", cv2.IMREAD_UNCHANGED).astype(np.float64)[..., None] / 1000
    ranges[ranges == 0] = FAR
    photo, clean = read("images", ".jpg"), light_of(read("clean", ".webp"))
    clean[ranges[..., 0] == FAR] = 0.25
    size = clean.shape[0]
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    radius = np.hypot(x - 0.5, y - 0.5)[..., None] * 2
    beam = np.exp(-((x - 0.7) ** 2 + (y - 0.5) ** 2) / 0.06)[..., None]

    absorbed = clean * np.exp(-BETA_D * ranges)
    hazy = absorbed + B_INF * -np.expm1(-BETA_D * ranges)
    hazy_by_own_rate = absorbed + B_INF * -np.expm1(-3 * BETA_B * ranges)
    waves = sum(
        np.sin(2 * np.pi * (frequency * (x * np.cos(angle) + y * np.sin(angle))) + 3 * np.sin(5 * y + angle))
        for frequency, angle in ((5, 0.3), (7, 1.4), (9, 2.6))
    )
    waves = np.where(ranges[..., 0] < FAR, waves, 0)
    body = (int(0.74 * size), int(0.45 * size))
    fish = cv2.ellipse(np.zeros(clean.shape[:2], np.uint8), body, (52, 20), 8, 0, 360, 1, -1)
    tail = np.array([[0.84, 0.47], [0.92, 0.40], [0.92, 0.56]]) * size
    waves = np.where(ranges[..., 0] < FAR, waves, 0)
    fish = cv2.fillPoly(fish, [tail.astype(np.int32)], 1)[..., None]
    numbers = read("labels", ".png", cv2.IMREAD_UNCHANGED)
    palette = np.random.default_rng(5).uniform(0.05, 0.9, (256, 3))
    depth = cv2.applyColorMap((255 * (1 - np.minimum(ranges / 16, 1))).astype(np.uint8), cv2.COLORMAP_TURBO)
    points = np.random.default_rng(1).random(clean.shape[:2]) < 0.004
    sparse = cv2.dilate(points.astype(np.uint8), np.ones((5, 5)))[..., None] * depth
    moved = np.roll(photo, size // 10, axis=1)
    plain = image_of(clean)
    pairs: dict[str, tuple[np.ndarray, np.ndarray]] = {
        "attenuation": (plain, image_of(absorbed)),
        "backscatter": (image_of(absorbed), image_of(hazy)),
        "separate_backscatter": (image_of(hazy), image_of(hazy_by_own_rate)),
        "lamp": (image_of(clean * 0.25), image_of(clean * 14 / (4 + ranges**2) * np.exp(-((radius / 1.1) ** 2)))),
        "beam": (image_of(clean * 0.8), image_of(clean * 1.6 * beam)),
        "exposure": (image_of(clean * 0.6), image_of(clean * 1.5 * np.array([1.05, 1.0, 0.9]))),
        "vignetting": (plain, image_of(clean * (1 - 0.62 * np.minimum(radius, 1.3) ** 2))),
        "caustics": (plain, image_of(clean * np.exp(0.55 * np.maximum(waves, 0)[..., None]))),
        "moving_objects": (plain, image_of(np.where(fish, np.array([0.7, 0.25, 0.05]), clean))),
        "interpolation": (photo, ((photo.astype(float) + moved) / 2).astype(np.uint8)),
        "semantics": (photo, image_of(0.35 * light_of(photo) + 0.65 * palette[numbers])),
        "depth_prior": (sparse, depth),
    }
    OUT.mkdir(exist_ok=True)
    for name, (without, with_effect) in pairs.items():
        write(name, without, with_effect)


def write(name: str, without: np.ndarray, with_effect: np.ndarray) -> None:
    """Write one picture."""
    picture, right = (cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for image in (without, with_effect))
    picture[:, SIDE // 2 :] = right[:, SIDE // 2 :]
    picture[:, SIDE // 2 - 1 : SIDE // 2 + 1] = 255
    cv2.imwrite(str(OUT / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])


if __name__ == "__main__":
    main()
