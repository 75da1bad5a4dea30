"""Embeddings of image regions and of words, and their projection to the features of Gaussians."""

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
"""Numbers in a Gaussian's feature (docs/method.md section 5)."""
MARGIN = 0.1
"""Margin of a region's crop on each side, as a fraction of the bounding box."""
CLIP_MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)
"""Mean of CLIP's training images, sRGB in 0..1."""
CLIP_STD = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)
"""Their standard deviation."""


class Embedder(Protocol):
    """Embeds regions of images and, where it can, words in one vector space.

    Attributes:
        name: Name for the user.
        key: Distinguishes the embedder and its weights from others in the cache.
    """

    name: str
    key: str

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Embed a region.

        Args:
            pixels: (h, w, 3) uint8 sRGB, a crop of the image around the region.
            mask: (h, w) bool, the region in the crop.

        Returns:
            Vector (D,) float32 of length 1.
        """
        ...

    def words(self, words: Sequence[str]) -> np.ndarray:
        """Embed M words or phrases.

        Returns:
            Vectors (M, D) float32 of length 1.

        Raises:
            InputError: If the embedder cannot embed words.
        """
        ...


def crop_to_mask(pixels: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Crop pixels (H, W, 3) and mask (H, W) to the mask, which must not be empty, plus MARGIN."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    spans = []
    for first, last in ((rows[0], rows[-1]), (columns[0], columns[-1])):
        margin = int(MARGIN * (last - first + 1))
        spans.append(slice(max(0, first - margin), last + margin + 1))
    return pixels[spans[0], spans[1]], mask[spans[0], spans[1]]


@dataclass(frozen=True, eq=False)
class Projection:
    """Projection of embeddings to features: matrix times (embedding - mean), then to length 1.

    Without subtracting the mean all regions of one scene would be nearly equal.

    Attributes:
        matrix: (32, D).
        mean: (D,), mean embedding of the scene's regions.
    """

    matrix: np.ndarray
    mean: np.ndarray

    @classmethod
    def fit(cls, embeddings: np.ndarray) -> "Projection":
        """Find the principal components of a scene's embeddings.

        Args:
            embeddings: (R, D) of its regions.

        Returns:
            The projection; its matrix is a fixed random orthonormal one where R or D is too small for 32 components.
        """
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
        """Numbers in a feature."""
        return len(self.matrix)

    def __call__(self, embeddings: np.ndarray, mean: np.ndarray | None = None) -> np.ndarray:
        """Project embeddings.

        Args:
            embeddings: (M, D).
            mean: (D,), subtracted instead of the regions' mean; that of neutral words for embeddings of words.

        Returns:
            Features (M, 32) float32 of length 1.
        """
        if not len(embeddings):
            return np.zeros((0, self.dimensions), np.float32)
        projected = (embeddings - (self.mean if mean is None else mean)) @ self.matrix.T
        return np.asarray(projected / np.maximum(np.linalg.norm(projected, axis=1, keepdims=True), 1e-12), np.float32)


class Clip:
    """CLIP (Radford et al. 2021, arXiv 2103.00020) in two ONNX files, with its vocabulary.

    Image network: (1, 3, 224, 224) to (1, D), the output `image_embeds` where there are several. Text network: token
    ids (M, 77) to (M, D), or `text_embeds`. Where a file has other fixed sizes, these are used.

    Args:
        image: File of the image network.
        text: File of the text network.
        vocabulary: CLIP's bpe_simple_vocab_16e6.txt.gz.

    Raises:
        InputError: If a file is absent or of another kind.
    """

    name = "clip"
    TEMPLATES = ("a photo of {}", "an underwater photo of {}", "a close-up photo of {}")
    """Sentences in which a word is embedded."""

    def __init__(self, image: Path, text: Path, vocabulary: Path) -> None:
        pixels, tokens = {"pixel_values": (None, 3, None, None)}, {"input_ids": (None, None)}
        self.image_network = Graph(image, "CLIP's image network", pixels, ["image_embeds"])
        self.text_network = Graph(text, "CLIP's text network", tokens, ["text_embeds"], ["attention_mask"])
        self.tokenizer = BytePairTokenizer(vocabulary)
        self.key = f"clip:{file_key(image)}:{file_key(text)}"

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Embed a region as in Embedder; pixels outside the region get the mean color of CLIP's training images."""
        side = self.image_network.shapes["pixel_values"][-1] or 224
        height, width = mask.shape
        masked = np.where(mask[..., None], pixels / np.float32(255), CLIP_MEAN)
        longest = max(height, width)
        square = np.broadcast_to(CLIP_MEAN, (longest, longest, 3)).copy()
        top, left = (longest - height) // 2, (longest - width) // 2
        square[top : top + height, left : left + width] = masked
        method = cv2.INTER_AREA if longest > side else cv2.INTER_CUBIC
        resized = cv2.resize(square, (side, side), interpolation=method)
        made = self.image_network(pixel_values=((resized - CLIP_MEAN) / CLIP_STD).transpose(2, 0, 1)[None])
        return _unit(made["image_embeds"], self.image_network)[0]

    def words(self, words: Sequence[str]) -> np.ndarray:
        """Embed words as in Embedder; each is the mean over several sentences."""
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
    """Histograms of color and texture, without a network; it cannot embed words.

    The color histogram is of CIE a* and b*, the brightness histogram of L*, the texture histograms of the directions of
    edges at several scales.
    """

    name = "color and texture"
    key = "descriptor:1"
    AB = 8
    """Classes of a*, and of b*."""
    LIGHT = 16
    """Classes of L*."""
    DIRECTIONS = 8
    """Classes of the direction of edges."""
    SCALES = (1.0, 2.0, 4.0)
    """Standard deviations of the blur before edges are found, pixels."""

    def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Embed a region as in Embedder.

        The vector holds square roots of the histograms, so that a scalar product is their Bhattacharyya coefficient.
        """
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
            # One further class for pixels without an edge makes smooth and rough regions differ.
            edges = np.bincount(direction, np.hypot(dx, dy), self.DIRECTIONS)
            parts.append(np.append(edges, 8.0 * mask.sum()))
        histograms = [np.sqrt(part / max(part.sum(), 1e-9)) for part in parts]
        joined = np.concatenate([histograms[0] * 1.4, *histograms[1:]])
        return np.asarray(joined / np.linalg.norm(joined), np.float32)

    def words(self, words: Sequence[str]) -> np.ndarray:
        """Raise InputError: words cannot be embedded."""
        raise InputError(
            f"Without CLIP only labels can be searched by name, and none is called {words[-1]}: see the labels of the "
            "run, or label it again with CLIP."
        )


COLORS = {
    "black": (20, 20, 20), "grey": (120, 120, 120), "white": (240, 240, 240), "red": (190, 40, 40),
    "orange": (235, 130, 30), "brown": (110, 70, 40), "yellow": (235, 215, 60), "olive": (110, 110, 40),
    "green": (60, 150, 60), "turquoise": (70, 190, 180), "teal": (40, 100, 110), "blue": (40, 80, 190),
    "light blue": (130, 180, 230), "dark blue": (20, 40, 90), "violet": (130, 60, 170), "pink": (240, 150, 170),
}  # fmt: skip
"""Name of a color -> 8-bit sRGB."""


def color_name(descriptor: np.ndarray) -> str:
    """Label a region by its color.

    Args:
        descriptor: Vector that a Descriptor made, or another embedding.

    Returns:
        The name of the nearest of COLORS; "region" for other embeddings.
    """
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
    return _nearest(np.array(lab))


def nearest_color(color: np.ndarray) -> str:
    """Return the name of the nearest of COLORS to display values (3,) in 0..1."""
    return _nearest(cv2.cvtColor(color.astype(np.float32)[None, None], cv2.COLOR_RGB2Lab)[0, 0])


def _nearest(lab: np.ndarray) -> str:
    """Return the name of the nearest of COLORS to L*a*b* (3,)."""
    known = cv2.cvtColor(np.array([list(COLORS.values())], np.float32) / 255, cv2.COLOR_RGB2Lab)[0]
    return list(COLORS)[int(np.linalg.norm(known - lab, axis=1).argmin())]


def _unit(embeddings: np.ndarray, network: Graph) -> np.ndarray:
    """Return embeddings (M, D) at length 1."""
    lengths = np.linalg.norm(embeddings, axis=-1, keepdims=True)
    if embeddings.ndim != 2 or not (np.isfinite(lengths).all() and (lengths > 0).all()):
        raise InputError(
            f"{network.path} makes embeddings that are zero or not finite: get it again or choose another file."
        )
    return np.asarray(embeddings / lengths, np.float32)
