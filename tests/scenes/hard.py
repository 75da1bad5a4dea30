"""Extreme scenes and clouds: each a change of a tiny scene, or of the Gaussians that a run starts from."""

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from swag_engine.gaussians.cloud import GaussianCloud
from tests.scenes.tiny import make_tiny_scene


def _model(folder: Path, name: str) -> Path:
    return folder / "sparse" / "0" / name


def _points(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Return an edit that changes the sparse points (P, 7: x y z r g b error) of a scene."""

    def edit(folder: Path) -> None:
        path = _model(folder, "points3D.txt")
        rows = np.array([line.split()[1:] for line in path.read_text().splitlines()], float)
        lines = [f"{i + 1} {x!r} {y!r} {z!r} {int(r)} {int(g)} {int(b)} {e!r}\n"
                 for i, (x, y, z, r, g, b, e) in enumerate(change(rows).tolist())]  # fmt: skip
        path.write_text("".join(lines))

    return edit


def _shifted(points: np.ndarray, offset: tuple[float, float, float]) -> np.ndarray:
    return points + np.array([*offset, 0, 0, 0, 0])


def _placed(points: np.ndarray, position: tuple[float, float, float]) -> np.ndarray:
    return np.column_stack([np.tile(position, (len(points), 1)), points[:, 3:]])


def _scaled(factor: float, offset: float = 0.0) -> Callable[[Path], None]:
    """Return an edit that scales a scene by `factor`, then shifts it by `offset` along x."""

    def edit(folder: Path) -> None:
        _points(lambda p: np.column_stack([factor * p[:, :3] + [offset, 0, 0], p[:, 3:]]))(folder)
        path, lines = _model(folder, "images.txt"), []
        for line in path.read_text().splitlines():
            words = line.split()
            if words:
                w, y = float(words[1]), float(words[3])  # a rotation about y, as tiny.py makes them
                cos, sin = w * w - y * y, 2 * w * y
                shift = np.array([cos, 0, -sin]) * -offset
                words[5:8] = [repr(float(factor * float(t) + s)) for t, s in zip(words[5:8], shift, strict=True)]
            lines.append(" ".join(words))
        path.write_text("\n".join(lines) + "\n")

    return edit


def _field_of_view(degrees: float) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        path = _model(folder, "cameras.txt")
        words = path.read_text().split()
        words[4] = words[5] = repr(float(words[2]) / 2 / math.tan(math.radians(degrees / 2)))
        path.write_text(" ".join(words) + "\n")

    return edit


def _one_place(folder: Path) -> None:
    path = _model(folder, "images.txt")
    lines = path.read_text().splitlines()
    first = lines[0].split()[1:8]
    path.write_text("\n".join(" ".join([w[0], *first, *w[8:]]) if (w := line.split()) else "" for line in lines) + "\n")


def _images(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        for path in (folder / "images").iterdir():
            cv2.imwrite(str(path), change(cv2.imread(str(path))))

    return edit


def _noise(pixels: np.ndarray) -> np.ndarray:
    return np.random.default_rng(int(pixels.sum()) % 1000).integers(0, 256, pixels.shape, np.uint8)


def _with_alpha(pixels: np.ndarray) -> np.ndarray:
    alpha = np.zeros(pixels.shape[:2], np.uint8)
    alpha[:, : alpha.shape[1] // 2] = 255
    return np.dstack([pixels, alpha])


Edit = Callable[[Path], None]
Sizes = dict[str, int]

SCENES: dict[str, dict[str, Edit | Sizes]] = {
    "degenerate points": {
        "two points in one place": _points(lambda p: _placed(p[:2], (0.1, 0.1, 0.0))),
        "all points on a line": _points(lambda p: np.column_stack([p[:, :1], 0 * p[:, 1:3], p[:, 3:]])),
        "thousands of points in one place": _points(lambda p: _placed(np.repeat(p, 40, 0), (0.1, 0.1, 0.0))),
    },
    "number of points": {
        "one point": _points(lambda p: p[:1]),
        "two points": _points(lambda p: p[:2]),
    },
    "visibility of points": {
        "all points at one camera": _points(lambda p: _placed(p, (-1.37, 0.0, -3.76))),
        "all points out of view": _points(lambda p: _shifted(p, (300, 0, 0))),
        "all points behind the cameras": _points(lambda p: _shifted(p, (0, 0, -20))),
    },
    "distance of a point": {
        "a point at 1e12": _points(lambda p: np.vstack([p, _shifted(p[:1], (1e12, 1e12, 1e12))])),
        "a point at 1e60": _points(lambda p: np.vstack([p, _shifted(p[:1], (1e60, 1e60, 1e60))])),
    },
    "placement of cameras": {
        "cameras in one place": _one_place,
    },
    "scale": {
        "scene 1e6 wide": _scaled(1e6),
        "coordinates of 1e6": _scaled(1.0, 1e6),
        "scene 1e-6 wide": _scaled(1e-6),
    },
    "field of view": {
        "field of view 2 degrees": _field_of_view(2),
        "field of view 170 degrees": _field_of_view(170),
    },
    "content of images": {
        "black photographs": _images(lambda p: 0 * p),
        "photographs of one color": _images(lambda p: 0 * p + np.array([200, 90, 30], np.uint8)),
        "grey photographs": _images(lambda p: cv2.cvtColor(p, cv2.COLOR_BGR2GRAY)),
        "photographs of noise": _images(_noise),
        "white photographs": _images(lambda p: 0 * p + 255),
    },
    "format of images": {
        "photographs with an alpha channel": _images(_with_alpha),
        "photographs of 16 bits": _images(lambda p: p.astype(np.uint16) * 257),
    },
    "size of images": {
        "photographs of one pixel": {"width": 1, "height": 1},
        "photographs one pixel high": {"width": 32, "height": 1},
        "photographs one pixel wide": {"width": 1, "height": 24},
    },
    "number of images": {
        "two photographs": {"views": 2},
        "three photographs": {"views": 3},
    },
    "strength of water": {
        "water of beta r 1e4": {},
        "water of beta r 1e-6": {},
    },
}
"""Cases by the property that each varies: a change of the scene's files, or arguments of `make_tiny_scene`."""
WATER = {"water of beta r 1e4": ("10,10,10", 250.0), "water of beta r 1e-6": ("0.0000003,0.0000003,0.0000003", 1.0)}
"""Attenuation per metre, and metres per scene unit, that the run is asked for."""


def make_hard_scene(folder: Path, case: Edit | Sizes | None = None) -> Path:
    """Write a COLMAP scene of 32 x 24 pixels with one of SCENES' cases to `folder`, and return the folder."""
    sizes = case if isinstance(case, dict) else {}
    make_tiny_scene(folder, **({"views": 4, "width": 32, "height": 24, "points": 80} | sizes))
    if callable(case):
        case(folder)
    return folder


def _values(**values: float | Callable[[torch.Tensor], torch.Tensor]) -> Callable[[GaussianCloud], None]:
    """Return an edit that sets parameters of all Gaussians to a number, or changes them by a function."""

    def edit(cloud: GaussianCloud) -> None:
        for name, value in values.items():
            tensor = getattr(cloud, name)
            setattr(cloud, name, value(tensor).to(tensor) if callable(value) else torch.full_like(tensor, value))

    return edit


def _row(value: float) -> Callable[[torch.Tensor], torch.Tensor]:
    def change(tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.clone()
        tensor[1] = value
        return tensor

    return change


CLOUDS: dict[str, dict[str, Callable[[GaussianCloud], None]]] = {
    "opacity": {
        "opacity 0": _values(opacity_logits=-200.0),
        "opacity just above 1/255": _values(opacity_logits=math.log(1 / 254 * 1.0001)),
        "opacity 1": _values(opacity_logits=200.0),
    },
    "length of quaternions": {
        "zero quaternions": _values(quats=0.0),
        "quaternions of 1e-20": _values(quats=lambda q: q * 1e-20),
        "quaternions of 1e20": _values(quats=lambda q: q * 1e20),
    },
    "size of Gaussians": {
        "scales of e^80": _values(log_scales=80.0),
        "scales of 1e4": _values(log_scales=9.2),
        "scales of e^-80": _values(log_scales=-80.0),
    },
    "shape of Gaussians": {
        "needles": _values(log_scales=lambda s: s * 0 + torch.tensor([2.0, -9.0, -9.0])),
        "pancakes": _values(log_scales=lambda s: s * 0 + torch.tensor([2.0, 2.0, -16.0])),
    },
    "equal Gaussians": {
        "all Gaussians equal": _values(
            **{name: lambda t: t[:1].expand_as(t).clone() for name in ("means", "log_scales", "sh0")}
        ),
        "equal depths": _values(means=lambda m: m * torch.tensor([1.0, 1.0, 0.0])),
    },
    "color": {
        "colors of 1e10": _values(sh0=1e10),
        "colors of -1e10": _values(sh0=-1e10),
    },
    "position": {
        "positions of 1e30": _values(means=lambda m: m * 1e30),
    },
    "background": {
        "background logit of 1e4": _values(background=1e4),
    },
    **{
        f"{name} that are not finite": {f"{value} in {name}": _values(**{name: _row(float(value))}) for value in values}
        for name, values in {
            "means": ("nan", "inf", "-inf"),
            "quats": ("inf", "-inf", "nan"),
            "log_scales": ("-inf", "nan", "inf"),
            "opacity_logits": ("nan", "inf", "-inf"),
            "sh0": ("inf", "-inf", "nan"),
        }.items()
    },
}
"""Changes of the Gaussians that a run starts from, by the property that each varies."""
