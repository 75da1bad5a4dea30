"""Embeddings of image regions and of words, and their projection to what a Gaussian carries."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from ..base.errors import InputError
from ..weights.onnx import Graph
from .cache import file_key
from .tokenizer import BytePairTokenizer

DIMENSIONS = 32
"""Of a Gaussian's feature (docs/method.md section 5)."""
MARGIN = 0.1
"""Of a region's bounding box, on each side, that its crop shows beside it."""


CLIP_MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)
CLIP_STD = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)


class Embedder(Protocol):
    """Turns regions and, where it can, words into vectors of one space. `name` and `key` as in RegionProvider."""

    name: str
    key: str

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """(D,) float32 of length 1 for a crop (h, w, 3) uint8 sRGB, of which mask (h, w) bool is the region."""
        ...

    def words(self, words: Sequence[str]) -> np.ndarray:
        """(M, D) float32 of length 1. Raises InputError where the embedder knows no words."""
        ...


def cropped(pixels: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of pixels (H, W, 3) and mask (H, W) about the mask, which must not be empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    spans = []
    for first, last in ((rows[0], rows[-1]), (columns[0], columns[-1])):
        margin = int(MARGIN * (last - first + 1))
        spans.append(slice(max(0, first - margin), last + margin + 1))
    return pixels[spans[0], spans[1]], mask[spans[0], spans[1]]


@dataclass(frozen=True, eq=False)
class Projection:
    """Embeddings (M, D) to (M, 32): matrix (32, D) of what is beyond the mean (D,) of the scene's regions, then to
    length 1. Without the mean all regions of one scene would look alike."""

    matrix: np.ndarray
    mean: np.ndarray

    @classmethod
    def fit(cls, embeddings: np.ndarray) -> "Projection":
        """The principal components of a scene's embeddings (R, D); a seeded orthonormal matrix where R or D are too
        few for 32 of them."""
        count, width = embeddings.shape
        data = embeddings.astype(np.float64)
        mean = data.mean(0) if count > 1 else np.zeros(width)
        if min(count - 1, width) >= DIMENSIONS:
            matrix = np.linalg.svd(data - mean, full_matrices=False)[2][:DIMENSIONS]
        else:
            long, short = max(width, DIMENSIONS), min(width, DIMENSIONS)
            orthonormal = np.linalg.qr(np.random.default_rng(0).normal(size=(long, short)))[0]
            matrix = orthonormal.T if width >= DIMENSIONS else orthonormal
        return cls(matrix.astype(np.float32), mean.astype(np.float32))

    @property
    def dimensions(self) -> int:
        return len(self.matrix)

    def __call__(self, embeddings: np.ndarray, mean: np.ndarray | None = None) -> np.ndarray:
        """(M, 32) float32 of length 1; `mean` (D,) in place of the regions' where the embeddings are of words."""
        if not len(embeddings):
            return np.zeros((0, self.dimensions), np.float32)
        projected = (embeddings - (self.mean if mean is None else mean)) @ self.matrix.T
        return np.asarray(projected / np.maximum(np.linalg.norm(projected, axis=1, keepdims=True), 1e-12), np.float32)


class Clip:
    """CLIP (Radford et al. 2021, arXiv 2103.00020) in two ONNX files, with its vocabulary.

    Image: (1, 3, 224, 224) to (1, D) or, of several outputs, `image_embeds`. Text: token ids (M, 77) to (M, D) or
    `text_embeds`. The sizes are the files' own where they name them.
    """

    name = "clip"
    TEMPLATES = ("a photo of {}", "an underwater photo of {}", "a close-up photo of {}")

    def __init__(self, image: Path, text: Path, vocabulary: Path) -> None:
        """Raises InputError when a file is absent or of another kind."""
        pixels, tokens = {"pixel_values": (None, 3, None, None)}, {"input_ids": (None, None)}
        self.image_network = Graph(image, "CLIP's image network", pixels, ["image_embeds"])
        self.text_network = Graph(text, "CLIP's text network", tokens, ["text_embeds"], ["attention_mask"])
        self.tokenizer = BytePairTokenizer(vocabulary)
        self.key = f"clip:{file_key(image)}:{file_key(text)}"

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """As in Embedder; what is not of the region is the mean colour of CLIP's training."""
        side = self.image_network.shapes["pixel_values"][-1] or 224
        height, width = mask.shape
        shown = np.where(mask[..., None], pixels / np.float32(255), CLIP_MEAN)
        longest = max(height, width)
        square = np.broadcast_to(CLIP_MEAN, (longest, longest, 3)).copy()
        top, left = (longest - height) // 2, (longest - width) // 2
        square[top : top + height, left : left + width] = shown
        method = cv2.INTER_AREA if longest > side else cv2.INTER_CUBIC
        resized = cv2.resize(square, (side, side), interpolation=method)
        made = self.image_network(pixel_values=((resized - CLIP_MEAN) / CLIP_STD).transpose(2, 0, 1)[None])
        return _unit(made["image_embeds"], self.image_network)[0]

    def words(self, words: Sequence[str]) -> np.ndarray:
        """As in Embedder; each word is embedded in several sentences, whose mean counts."""
        rows, length = self.text_network.shapes["input_ids"]
        embedded = []
        for word in words:
            sentences = [template.format(word.lower()) for template in self.TEMPLATES]
            tokens = np.stack([self.tokenizer.padded(sentence, length or 77) for sentence in sentences])
            parts = np.split(tokens, len(tokens)) if rows == 1 else [tokens]
            made = [self.text_network(input_ids=part, attention_mask=part > 0)["text_embeds"] for part in parts]
            embedded.append(_unit(np.concatenate(made), self.text_network).mean(0, keepdims=True))
        return _unit(np.concatenate(embedded), self.text_network)


class Descriptor:
    """Colour and texture, no network: 8 x 8 classes of CIE a*b*, 16 of L*, and 8 directions of edges at 3 scales.

    It tells regions of different looks apart, but knows no words.
    """

    name = "colour and texture"
    key = "descriptor:1"
    AB, LIGHT, DIRECTIONS, SCALES = 8, 16, 8, (1.0, 2.0, 4.0)

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """As in Embedder: square roots of histograms, whose product is the Bhattacharyya coefficient."""
        lab = cv2.cvtColor((pixels / np.float32(255)).astype(np.float32), cv2.COLOR_RGB2Lab)
        a, b = ((lab[..., i][mask] / 160 + 0.5).clip(0, 1 - 1e-6) * self.AB for i in (1, 2))
        light = (lab[..., 0][mask] / 100).clip(0, 1 - 1e-6) * self.LIGHT
        parts = [
            np.bincount(a.astype(int) * self.AB + b.astype(int), minlength=self.AB**2),
            np.bincount(light.astype(int), minlength=self.LIGHT),
        ]
        for sigma in self.SCALES:
            smooth = cv2.GaussianBlur(lab[..., 0], (0, 0), sigma)
            dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[mask], cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[mask]
            direction = (np.arctan2(dy, dx) / np.pi % 1 * self.DIRECTIONS).astype(int) % self.DIRECTIONS
            # One further class for what has no edge makes smooth and rough regions differ.
            edges = np.bincount(direction, np.hypot(dx, dy), self.DIRECTIONS)
            parts.append(np.append(edges, 8.0 * mask.sum()))
        histograms = [np.sqrt(part / max(part.sum(), 1e-9)) for part in parts]
        joined = np.concatenate([histograms[0] * 1.4, *histograms[1:]])
        return np.asarray(joined / np.linalg.norm(joined), np.float32)

    def words(self, words: Sequence[str]) -> np.ndarray:
        raise InputError(
            f"Without CLIP only labels can be searched by name, and none is called {words[-1]}: see the labels of the "
            "run, or label it again with CLIP."
        )


COLOURS = {
    "black": (20, 20, 20), "grey": (120, 120, 120), "white": (240, 240, 240), "red": (190, 40, 40),
    "orange": (235, 130, 30), "brown": (110, 70, 40), "yellow": (235, 215, 60), "olive": (110, 110, 40),
    "green": (60, 150, 60), "turquoise": (70, 190, 180), "teal": (40, 100, 110), "blue": (40, 80, 190),
    "light blue": (130, 180, 230), "dark blue": (20, 40, 90), "violet": (130, 60, 170), "pink": (240, 150, 170),
}  # fmt: skip
"""sRGB of colours by their names."""


def colour_name(descriptor: np.ndarray) -> str:
    """What a region of this Descriptor is called for its colour; "region" for other embeddings."""
    expected = Descriptor.AB**2 + Descriptor.LIGHT + len(Descriptor.SCALES) * (Descriptor.DIRECTIONS + 1)
    if len(descriptor) != expected:
        return "region"
    ab = descriptor[: Descriptor.AB**2].astype(np.float64) ** 2
    light = descriptor[Descriptor.AB**2 :][: Descriptor.LIGHT].astype(np.float64) ** 2
    middles = ((np.arange(Descriptor.AB) + 0.5) / Descriptor.AB - 0.5) * 160
    grid = ab.reshape(Descriptor.AB, -1) / ab.sum()
    lab = (
        (light / light.sum()) @ ((np.arange(Descriptor.LIGHT) + 0.5) / Descriptor.LIGHT * 100),
        grid.sum(1) @ middles,
        grid.sum(0) @ middles,
    )
    known = cv2.cvtColor(np.array([list(COLOURS.values())], np.float32) / 255, cv2.COLOR_RGB2Lab)[0]
    return list(COLOURS)[int(np.linalg.norm(known - np.array(lab), axis=1).argmin())]


def _unit(embeddings: np.ndarray, network: Graph) -> np.ndarray:
    lengths = np.linalg.norm(embeddings, axis=-1, keepdims=True)
    if embeddings.ndim != 2 or not (np.isfinite(lengths).all() and (lengths > 0).all()):
        raise InputError(
            f"{network.path} makes embeddings that are no directions: get it again or choose another file."
        )
    return np.asarray(embeddings / lengths, np.float32)
