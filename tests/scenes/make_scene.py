"""Make an underwater scene with known truth: images, a COLMAP model, clean images, ranges, coefficients.

    python tests/scenes/make_scene.py --out DIR [--water.beta-D R G B] [--lamp 1] [--exposure 0.15] [--caustics 0.5] ...

A reef and a wreck (reef_model.py) are rendered without water; the water is applied to every rendered sample by the
image formation model I = J exp(-beta_D z) + B (1 - exp(-beta_B z)), z the Euclidean range in metres; then the image is
averaged down to its size. With `--volume` Cycles renders a real absorbing and scattering volume instead, so that truth
does not share that equation.

Files in DIR:
    images/NAME.jpg       the images (with `--lossless` NAME.png)
    sparse/0/             the COLMAP model (binary): exact poses, points triangulated from observations with noise
    clean/NAME.webp       what the held-out views (every eighth) look like without water and fish, on black
    range/NAME.png        their ranges, 16 bit, millimetres, 0 in open water
    labels/NAME.png       what each pixel shows: the number of a line in labels/labels.txt, counted from 1
    masks/NAME.png        black where a moving object is, white elsewhere, for the images that have one
    truth.json            every coefficient and setting
"""

import json
import shutil
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2  # before pycolmap
import numpy as np
import pycolmap
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.scenes.reef_model import LABELS, SUN, Model, Passes, Renderer, camera_path

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Water:
    beta_D: RGB = (0.17, 0.062, 0.042)
    """Attenuation of the direct signal, per metre, red green blue."""
    beta_B: RGB = (0.13, 0.08, 0.068)
    """Build-up of backscatter, per metre."""
    B_inf: RGB = (0.03, 0.175, 0.255)
    """Color of open water, in the values that `light` names."""
    light: Literal["linear", "srgb"] = "linear"
    """The values the model holds in: linear light, as physics asks, or displayed sRGB values."""


@dataclass(frozen=True)
class Settings:
    out: Path
    """Folder to write; what an earlier run left there is replaced."""
    views: int = 24
    width: int = 640
    height: int = 360
    supersample: int = 2
    """Rendered pixels per image pixel, along each axis."""
    samples: int = 3
    """Cycles samples per rendered pixel (denoised)."""
    seed: int = 0
    """Of everything: the model, the points, the gains, the fish."""
    points: int = 2500
    """At most; fewer where the images are small."""
    water: Water = field(default_factory=Water)
    lamp: float = 0.0
    """Fraction of the light at the median range from a lamp at the camera, which falls as 1 / (lamp_tau + r^2)."""
    lamp_tau: float = 1.0
    beam: float = 0.0
    """How narrow the lamp's beam is: all light falls as exp(-beam d^2), d from BEAM_AXIS in half diagonals."""
    exposure: float = 0.0
    """Standard deviation of the images' log gains."""
    caustics: float = 0.0
    """Strength of the light pattern that waves throw on what the sun lights; 1 is the pattern as lenses make it."""
    vignetting: float = 0.0
    """Fraction of the light that the lens loses at the corners; it rises with the squared distance to the middle."""
    phone: float = 0.0
    """Strength of the processing in the camera, 1 as in telephones: see `process_as_phone`."""
    moving_object: float = 0.0
    """Fraction of the images that fish swim through."""
    lossless: bool = False
    """Write PNG files, as if the images were reduced from larger photos: a JPEG keeps color at half the size alone."""
    chart: bool = False
    """Stand a 24-patch color chart on the sand."""
    volume: bool = False
    """Render a scattering volume instead of applying the model. See `VOLUME`; `water` and `lamp` are not used."""
    truth: Literal["held-out", "all"] = "held-out"
    """The views whose clean image and range are written."""


VOLUME: dict[str, Any] = {  # per metre; beam attenuation is absorption + scattering
    "absorption": (0.17, 0.045, 0.025),
    "scattering": (0.05, 0.05, 0.05),
    "anisotropy": 0.6,
    "surface": 5.0,  # height of the water's surface, metres above the sand
    "light": 1.4,  # above the water, times the light of the clean images
}

HELD_OUT = 8  # every eighth image of sorted names, from index 0
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 91, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 9]
LOSSLESS_WEBP = [cv2.IMWRITE_WEBP_QUALITY, 101]  # a quarter smaller than PNG
BEAM_AXIS = (0.3, -0.2)  # where the lamp points: right of the image's middle and above it, half diagonals
PIXEL_NOISE = 0.3  # standard deviation of an observation, pixels


def srgb(linear: np.ndarray) -> np.ndarray:
    """Displayed sRGB value 0..1 of linear light (IEC 61966-2-1), without clipping above 1."""
    linear = np.maximum(linear, 0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def process_as_phone(shown: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Return a displayed image (H,W,3) as a telephone processes it: glare of bright parts over the rest, noise, a white
    balance of its own, local contrast, an S-shaped tone curve and sharpened edges."""
    shown = shown.clip(0, 1)
    light = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    glare = 0.04 * strength
    light = (1 - glare) * light + glare * cv2.GaussianBlur(light, (0, 0), shown.shape[1] / 12)
    light *= np.exp(rng.normal(0, 0.03 * strength, 3))
    light += rng.normal(0, 0.012 * strength, light.shape) * np.sqrt(light)
    lab = cv2.cvtColor(srgb(light).clip(0, 1).astype(np.float32), cv2.COLOR_RGB2LAB)
    level = lab[..., 0] / 100
    even = cv2.createCLAHE(2.0, (4, 4)).apply((level * 65535).astype(np.uint16)) / np.float32(65535)
    level = level + strength * (0.35 * (even - level) - 0.06 * np.sin(2 * np.pi * level))
    level += 0.5 * strength * (level - cv2.GaussianBlur(level, (0, 0), 1.2))
    lab[..., 0] = 100 * level.clip(0, 1)
    return cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)


def to_8bit(values: np.ndarray) -> np.ndarray:
    return (values.clip(0, 1) * 255).round().astype(np.uint8)


def averaged(values: np.ndarray, factor: int) -> np.ndarray:
    h, w = values.shape[0] // factor, values.shape[1] // factor
    return values.reshape(h, factor, w, factor, *values.shape[2:]).mean((1, 3))


def nearest_range(distance: np.ndarray, alpha: np.ndarray, factor: int) -> np.ndarray:
    """Range per image pixel: the mean of the rendered ones within 5 % of the nearest; inf where open water prevails."""
    h, w = distance.shape[0] // factor, distance.shape[1] // factor
    blocks = distance.reshape(h, factor, w, factor).transpose(0, 2, 1, 3).reshape(h, w, -1)
    near = blocks <= blocks.min(-1, keepdims=True) * 1.05
    mean = np.where(near, np.where(np.isinf(blocks), 0, blocks), 0).sum(-1) / near.sum(-1)
    return np.where((averaged(alpha, factor) < 0.5) | np.isinf(blocks.min(-1)), np.inf, mean).astype(np.float32)


def majority(labels: np.ndarray, factor: int) -> np.ndarray:
    """Per image pixel the label of most of its rendered ones."""
    fractions = np.stack([averaged(labels == label, factor) for label in range(len(LABELS) + 1)])
    return fractions.argmax(0).astype(np.uint8)


def through_water(clean: np.ndarray, alpha: np.ndarray, distance: np.ndarray, water: Water) -> np.ndarray:
    """The image formation model.

    `clean` (H,W,3) in the values of `water.light`, multiplied by `alpha` (H,W), the fraction of each pixel that
    surfaces cover; `distance` (H,W) Euclidean range in metres, inf where alpha is 0. Open water shows B_inf.
    """
    z = np.where(np.isinf(distance), 0, distance)[..., None].astype(np.float64)
    alpha = alpha[..., None]
    direct = clean * np.exp(-np.array(water.beta_D) * z)
    backscatter = alpha * (1 - np.exp(-np.array(water.beta_B) * z)) + (1 - alpha)
    return direct + np.array(water.B_inf) * backscatter


def lamp_light(distance: np.ndarray, fraction: float, tau: float, reference: float) -> np.ndarray:
    """Factor on the clean color: an ambient part and a lamp's, together 1 at the reference range."""
    return (1 - fraction) + fraction * (tau + reference**2) / (tau + distance**2)


def caustic_pattern(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Relative sunlight (mean about 1) at world points (..., 3) under one random state of the waves.

    Rays that waves of slope grad h bend by d grad h crowd where |det(I + d Hess h)| is small.
    """
    over = points[..., :2] - SUN[:2] / SUN[2] * points[..., 2:]  # where the ray crosses z = 0
    xx, yy, xy = (np.zeros(over.shape[:-1]) for _ in range(3))
    for _ in range(14):
        length, angle, phase = rng.uniform(0.35, 1.3), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        k = 2 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
        bend = 0.2 * np.sin(over @ k + phase) / (k @ k)
        xx, yy, xy = xx - bend * k[0] ** 2, yy - bend * k[1] ** 2, xy - bend * k[0] * k[1]
    light = 1 / np.maximum(np.abs((1 + xx) * (1 + yy) - xy**2), 0.25)
    return light / light.mean()


def squared_radius(shape: tuple[int, ...], centre: tuple[float, float] = (0, 0)) -> np.ndarray:
    """(H,W) squared distance to a place right of and below the image's middle, in half diagonals."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    half = np.hypot(shape[0], shape[1]) / 2
    middle_x, middle_y = shape[1] / 2 + half * centre[0], shape[0] / 2 + half * centre[1]
    return ((x + 0.5 - middle_x) ** 2 + (y + 0.5 - middle_y) ** 2) / half**2


def world_points(distance: np.ndarray, focal: float, world_to_camera: np.ndarray) -> np.ndarray:
    """(H,W,3) points seen at pixel centres, for ranges (H,W); open water gives the camera's centre."""
    h, w = distance.shape
    rays = np.stack(
        np.broadcast_arrays((np.arange(w) + 0.5 - w / 2) / focal, ((np.arange(h) + 0.5 - h / 2) / focal)[:, None], 1.0),
        -1,
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    local = rays * np.where(np.isinf(distance), 0, distance)[..., None]
    return (local - world_to_camera[:3, 3]) @ world_to_camera[:3, :3]


def photograph(
    passes: Passes,
    settings: Settings,
    focal: float,
    pose: np.ndarray,
    reference: float,
    gain: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """The displayed image (H,W,3), sRGB 0..1 before clipping, of one view's passes (`focal` in rendered pixels)."""
    light = np.ones_like(passes.alpha)
    if settings.lamp:
        light = light * lamp_light(
            np.where(np.isinf(passes.range), reference, passes.range), settings.lamp, settings.lamp_tau, reference
        )
        light = light * np.exp(-settings.beam * squared_radius(light.shape, BEAM_AXIS))
    if settings.caustics:
        pattern = caustic_pattern(world_points(passes.range, focal, pose), rng)
        light = light * (1 + settings.caustics * passes.sun_share * (pattern - 1))
    gain = gain * (1 - settings.vignetting * squared_radius(passes.alpha.shape))[..., None]
    clean = passes.color * light[..., None]
    if settings.water.light == "linear":
        seen = through_water(clean, passes.alpha, passes.range, settings.water) * gain
        return srgb(averaged(seen, settings.supersample))
    alpha = passes.alpha[..., None]
    shown = srgb(clean * gain / np.maximum(alpha, 1e-6)).clip(0, 1) * alpha
    return averaged(through_water(shown, passes.alpha, passes.range, settings.water), settings.supersample)


# ---------------------------------------------------------------------------------------------------- COLMAP


def triangulated(
    start: np.ndarray, poses: list[np.ndarray], observed: np.ndarray, focal: float, size: tuple[int, int]
) -> np.ndarray:
    """The point whose reprojections are nearest to `observed` (n,2) pixels in `poses`, by Gauss-Newton from `start`."""
    point = start.astype(np.float64)
    for _ in range(3):
        rows, errors = [], []
        for pose, pixel in zip(poses, observed, strict=True):
            x, y, z = pose[:3, :3] @ point + pose[:3, 3]
            rows.append(focal / z * np.array([[1, 0, -x / z], [0, 1, -y / z]]) @ pose[:3, :3])
            errors.append(pixel - (focal * np.array([x, y]) / z + np.array(size) / 2))
        point = point + np.linalg.lstsq(np.concatenate(rows), np.concatenate(errors), rcond=None)[0]
    return point


def write_model(
    folder: Path,
    names: list[str],
    poses: list[np.ndarray],
    focal: float,
    images: list[np.ndarray],
    ranges: list[np.ndarray],
    count: int,
    rng: np.random.Generator,
) -> int:
    """Writes a COLMAP model of points found where the images have contrast; returns their number.

    A point starts in one view, is seen in the others where their range agrees within 1 %, and is found there with a
    chance that grows with the contrast, as a feature detector would; at least three views make a track.
    """
    height, width = ranges[0].shape
    contrast, strength = [], []
    for image, distance in zip(images, ranges, strict=True):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        gradient = cv2.GaussianBlur(
            np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)), (0, 0), 1.5
        )
        filled = np.where(np.isinf(distance), 1e3, distance).astype(np.float32)
        # A silhouette is no point of the world: it slides along the object as the camera moves.
        flat = cv2.dilate(filled, np.ones((3, 3))) < 1.04 * cv2.erode(filled, np.ones((3, 3)))
        contrast.append(np.where(flat & np.isfinite(distance), gradient, 0))
        strength.append(np.clip(gradient / 80, 0.05, 0.6))

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=width, height=height, params=[focal, focal, width / 2, height / 2], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    rotations, translations = (np.array(poses)[:, :3, part] for part in (slice(3), 3))
    reach = np.array([width, height]) / 2 + 1  # from the middle of the image, pixels
    tracks: list[tuple[np.ndarray, list[int], np.ndarray, np.ndarray]] = []  # point, views, observations, color
    for view in range(len(names)):
        chance = contrast[view].ravel().astype(np.float64)
        if not chance.any():
            continue
        wanted = min(3 * count // len(names) + 1, np.count_nonzero(chance))
        world = world_points(ranges[view], focal, poses[view]).reshape(-1, 3)
        for pixel in rng.choice(len(chance), wanted, replace=False, p=chance / chance.sum()):
            seen, where = [], []
            in_cameras = rotations @ world[pixel] + translations
            depth = np.maximum(in_cameras[:, 2], 1e-9)
            ahead = (in_cameras[:, 2] >= 0.05) & (np.abs(in_cameras[:, :2]) * focal <= depth[:, None] * reach).all(1)
            for other in np.flatnonzero(ahead):
                x, y, z = local = in_cameras[other]
                u, v = focal * x / z + width / 2, focal * y / z + height / 2
                column, row = int(np.floor(u)), int(np.floor(v))
                if (
                    not (0 <= column < width and 0 <= row < height)
                    or abs(ranges[other][row, column] / np.linalg.norm(local) - 1) > 0.01
                ):
                    continue
                if other == view or rng.random() < strength[other][row, column]:
                    seen.append(other)
                    where.append(np.array([u, v]) + rng.normal(0, PIXEL_NOISE, 2))
            if len(seen) < 3:
                continue
            where = np.array(where)
            point = triangulated(world[pixel], [poses[k] for k in seen], where, focal, (width, height))
            if np.linalg.norm(point - world[pixel]) > 0.1 * np.linalg.norm(
                world[pixel] - np.linalg.inv(poses[view])[:3, 3]
            ):
                continue  # too little parallax
            row, column = divmod(pixel, width)
            tracks.append((point, seen, where, images[view][row, column]))
    tracks = [tracks[k] for k in rng.permutation(len(tracks))[:count]]

    observations: list[list[np.ndarray]] = [[] for _ in names]
    elements = []
    for _, seen, where, _ in tracks:
        elements.append([pycolmap.TrackElement(k + 1, len(observations[k])) for k in seen])
        for k, at in zip(seen, where, strict=True):
            observations[k].append(at)
    for k, (name, pose) in enumerate(zip(names, poses, strict=True)):
        image = pycolmap.Image(
            name=name, camera_id=1, image_id=k + 1, keypoints=np.array(observations[k]).reshape(-1, 2)
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    for (point, _, _, color), track in zip(tracks, elements, strict=True):
        model.add_point3D(point, pycolmap.Track(track), color)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
    return len(tracks)


# ---------------------------------------------------------------------------------------------------- the scene


@dataclass
class Rendered:
    """What Cycles gives; one entry a view in every list."""

    poses: list[np.ndarray]  # world_to_camera (4,4), OpenCV axes
    still: list[Passes]
    seen: list[Passes]  # with the fish
    volume: list[np.ndarray] | None  # photographs in linear light (H,W,3)


def render(settings: Settings) -> Rendered:
    factor = settings.supersample
    width, height = settings.width * factor, settings.height * factor
    focal = focal_length(settings) * factor
    renderer = Renderer(Model(settings.seed, settings.chart), width, height, focal, settings.samples)
    poses = camera_path(settings.views)
    still = []
    for k, pose in enumerate(poses):
        still.append(renderer.still(pose))
        print(f"rendered view {k + 1} of {len(poses)}", file=sys.stderr)
    seen = list(still)
    fish = np.random.default_rng((settings.seed, 1))
    for k in fish.permutation(len(poses))[: round(settings.moving_object * len(poses))]:
        seen[k] = renderer.with_fish(still[k], poses[k], fish)
    volume = renderer.volume(poses, factor, 16 * settings.samples, **VOLUME) if settings.volume else None
    return Rendered(poses, still, seen, volume)


def focal_length(settings: Settings) -> float:
    return settings.width * 500 / 640


def make_scene(settings: Settings, rendered: Rendered | None = None) -> dict:
    """Writes the scene and returns what truth.json holds. `rendered` (from `render`) is used where it is given."""
    rendered = rendered or render(settings)
    poses, volume = rendered.poses, rendered.volume
    factor, focal = settings.supersample, focal_length(settings)
    names = [f"reef_{k:03d}.{'png' if settings.lossless else 'jpg'}" for k in range(settings.views)]
    gains = np.exp(np.random.default_rng((settings.seed, 2)).normal(0, settings.exposure, len(names)))
    finite = np.concatenate([p.range[np.isfinite(p.range)][::97] for p in rendered.still])
    reference = float(np.median(finite))

    for part in ("images", "sparse", "clean", "range", "masks", "labels"):
        shutil.rmtree(settings.out / part, ignore_errors=True)
    for part in ("images", "clean", "range", "labels"):
        (settings.out / part).mkdir(parents=True)
    (settings.out / "labels" / "labels.txt").write_text("\n".join(LABELS) + "\n")
    images, ranges, with_object = [], [], []
    for k, (name, still, seen) in enumerate(zip(names, rendered.still, rendered.seen, strict=True)):
        if volume:
            shown = srgb(volume[k] * gains[k])
        else:
            waves = np.random.default_rng((settings.seed, 3, k))
            shown = photograph(seen, settings, focal * factor, poses[k], reference, gains[k], waves)
        if settings.phone:
            shown = process_as_phone(shown, settings.phone, np.random.default_rng((settings.seed, 5, k)))
        images.append(to_8bit(shown))
        ranges.append(nearest_range(seen.range, seen.alpha, factor))
        cv2.imwrite(str(settings.out / "images" / name), images[-1][..., ::-1], PNG if settings.lossless else JPEG)
        png = Path(name).with_suffix(".png").name
        cv2.imwrite(str(settings.out / "labels" / png), majority(seen.label, factor), PNG)
        if settings.truth == "all" or k % HELD_OUT == 0:
            clean = to_8bit(srgb(averaged(still.color, factor)))[..., ::-1]
            cv2.imwrite(str((settings.out / "clean" / png).with_suffix(".webp")), clean, LOSSLESS_WEBP)
            distance = nearest_range(still.range, still.alpha, factor)
            millimetres = np.where(np.isinf(distance), 0, distance * 1000).round().clip(0, 65535)
            cv2.imwrite(str(settings.out / "range" / png), millimetres.astype(np.uint16), PNG)
        if seen.fish.any():
            with_object.append(name)
            (settings.out / "masks").mkdir(exist_ok=True)
            cv2.imwrite(
                str(settings.out / "masks" / png), np.where(averaged(seen.fish, factor) > 0.5, 0, 255).astype(np.uint8)
            )

    rng = np.random.default_rng((settings.seed, 4))
    points = write_model(settings.out / "sparse" / "0", names, poses, focal, images, ranges, settings.points, rng)
    low, high = np.percentile(finite, [2, 98])
    truth = {
        "water": None if volume else {**asdict(settings.water), "per": "metre"},
        "volume": VOLUME if volume else None,
        "units": "1 unit of the COLMAP model is 1 metre; ranges are Euclidean, camera centre to surface; z is up",
        "range": {"p2": float(low), "median": reference, "p98": float(high)},
        "lamp": {"fraction": settings.lamp, "tau": settings.lamp_tau, "reference_range": reference}
        if settings.lamp
        else None,
        "exposure": {"sd_log_gain": settings.exposure, "gains": dict(zip(names, gains.tolist(), strict=True))},
        "caustics": {"strength": settings.caustics, "towards_sun": SUN.tolist()} if settings.caustics else None,
        "moving_objects": with_object,
        "held_out": names[::HELD_OUT],
        "points": points,
        "observation_noise_px": PIXEL_NOISE,
        "settings": {k: v for k, v in asdict(settings).items() if k not in ("out", "water")},
    }
    (settings.out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return truth


if __name__ == "__main__":
    made = make_scene(tyro.cli(Settings, description=__doc__))
    print(f"{made['points']} points, range {made['range']['p2']:.2f} to {made['range']['p98']:.2f} m")
