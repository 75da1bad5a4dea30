"""Regions of images: found by a provider, embedded, and brought under the labels of the scene."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from ..base.errors import InputError
from ..scene.images import TrainingImage
from .cache import load_regions, save_regions
from .captions import Captioner, phrases
from .embed import Embedder, Projection, color_name, crop_to_mask

PHRASES_PER_IMAGE = 3
"""Phrases of an image's caption that are looked for in it."""
MAX_CLUSTERS = 8
"""Labels that are made for regions without one."""
MIN_PIXELS = 16
"""Pixels of the smallest region that is kept."""


@dataclass(frozen=True, eq=False)
class Region:
    """A part of one image.

    Attributes:
        mask: (H, W) bool.
        label: What it shows, "" where the provider has no label for it.
    """

    mask: np.ndarray
    label: str = ""


class RegionProvider(Protocol):
    """Finds regions.

    Attributes:
        name: Name for the user.
        key: Distinguishes the provider and its weights from others in the cache.
    """

    name: str
    key: str

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """Find the regions of one image.

        Args:
            image: The image.
            words: What to look for, for providers that can.

        Returns:
            Regions, the most certain first.

        Raises:
            InputError: If the regions cannot be found.
        """
        ...


@dataclass(frozen=True, eq=False)
class ImageRegions:
    """Regions of one image without overlap.

    Attributes:
        index: (H, W) uint16, 0 for no region, i for the i-th of `labels`.
        labels: R labels, "" for a region without one.
        embeddings: (R, D) float32 of length 1.
    """

    index: np.ndarray
    labels: tuple[str, ...]
    embeddings: np.ndarray


@dataclass(frozen=True, eq=False)
class SceneRegions:
    """Regions of a scene's images under common labels.

    Attributes:
        labels: L labels; labels[i - 1] is label number i, number 0 is no label.
        maps: Image name -> (H, W) uint16 numbers of labels, at the training size.
        features: Image name -> number of a label -> (32,) float32 of length 1, the projected embedding of its region.
        prototypes: (L, 32) float32 of length 1, mean feature of each label.
        projection: From embeddings to features.
        notes: Sentences for the user.
        described: Those of the labels that were named by the colors of their regions.
    """

    labels: tuple[str, ...]
    maps: dict[str, np.ndarray]
    features: dict[str, dict[int, np.ndarray]]
    prototypes: np.ndarray
    projection: Projection
    notes: tuple[str, ...]
    described: frozenset[str] = frozenset()

    def pixel_fractions(self) -> np.ndarray:
        """Return the fraction of the images' pixels that each label has, (L + 1,), label 0 first."""
        counts = sum(np.bincount(labels.ravel(), minlength=len(self.labels) + 1) for labels in self.maps.values())
        return np.asarray(counts / np.sum(counts))


def find_regions(
    images: Sequence[TrainingImage],
    provider: RegionProvider,
    embedder: Embedder,
    words: Sequence[str] = (),
    captioner: Captioner | None = None,
    cache: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SceneRegions:
    """Find the regions of a scene's training images, embed them, and bring them under common labels.

    Args:
        images: Training images.
        provider: Finds regions.
        embedder: Embeds them.
        words: What to look for; without words, phrases of each image's caption.
        captioner: Describes images where there are no words.
        cache: Folder that keeps the regions of each image; the key is made of the image's content, provider, weights
            and words.
        progress: Called with the number of images done, and of all.

    Returns:
        Regions under common labels.

    Raises:
        InputError: If no image has a region, a word is empty, or a network fails.
    """
    words = check_words(words)
    found: dict[str, ImageRegions] = {}
    for number, image in enumerate(images):
        try:
            found[image.camera.name] = _image_regions(image, provider, embedder, words, captioner, cache)
        except InputError as error:
            raise InputError(f"{str(error).rstrip('.')} (image {image.camera.name}).") from error
        if progress:
            progress(number + 1, len(images))
    if not any(entry.labels for entry in found.values()):
        asked = f" of {', '.join(words)}" if words else ""
        raise InputError(f"{provider.name} found no region{asked} in any of the {len(images)} images.")
    return common_labels(found, words)


def check_words(words: Sequence[str]) -> tuple[str, ...]:
    """Normalise blanks in words and drop repeated words.

    Args:
        words: Words or phrases to look for.

    Returns:
        The words, each once.

    Raises:
        InputError: If a word has no letter or digit.
    """
    stripped = [" ".join(word.split()) for word in words]
    if any(not any(character.isalnum() for character in word) for word in stripped):
        raise InputError("One of the words to look for is empty: write what to look for, such as coral, or remove it.")
    return tuple(dict.fromkeys(stripped))


def common_labels(found: Mapping[str, ImageRegions], words: Sequence[str] = ()) -> SceneRegions:
    """Bring the regions of a scene's images under common labels.

    Regions without a label are clustered by their embeddings (Ward 1963), and each cluster is labelled by its color.

    Args:
        found: Image name -> its regions; at least one region in all.
        words: Words that were looked for.

    Returns:
        Regions under common labels, in the order of `words`, then by decreasing number of pixels.
    """
    embeddings = np.concatenate([entry.embeddings for entry in found.values() if len(entry.labels)])
    projection = Projection.fit(embeddings)
    by_image = _labels_by_image(found, projection)
    pixels: Counter[str] = Counter()
    for image, entry in found.items():
        counts = np.bincount(entry.index.ravel(), minlength=len(entry.labels) + 1)[1:]
        for label, count in zip(by_image[image], counts, strict=True):
            pixels[label] += int(count)
    labels = [word for word in words if word in pixels]
    labels += [label for label, _ in pixels.most_common() if label not in labels]
    maps, features = {}, {}
    sums = np.zeros((len(labels), projection.dimensions), np.float32)
    for image, entry in found.items():
        ids = np.array([0] + [labels.index(label) + 1 for label in by_image[image]], np.uint16)
        maps[image] = ids[entry.index]
        # Two clustered regions of one image can have one label, whose feature is then that of the larger region.
        order = np.argsort(-np.bincount(entry.index.ravel(), minlength=len(ids))[1:], kind="stable")
        projected = projection(entry.embeddings)
        features[image] = {int(ids[i + 1]): projected[i] for i in order[::-1]}
        for number, feature in features[image].items():
            sums[number - 1] += feature
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    prototypes = sums / np.maximum(lengths, 1e-12)
    described = frozenset(labels) - {label for entry in found.values() for label in entry.labels}
    notes = tuple(_notes(found, words, labels))
    return SceneRegions(tuple(labels), maps, features, prototypes, projection, notes, described)


def _image_regions(
    image: TrainingImage,
    provider: RegionProvider,
    embedder: Embedder,
    words: Sequence[str],
    captioner: Captioner | None,
    cache: Path | None,
) -> ImageRegions:
    """Return the regions of one image, from the cache where it has them."""
    key = (provider.key, embedder.key, captioner.key if captioner and not words else "", *words)
    cached = load_regions(cache, image, key)
    if cached is not None:
        return ImageRegions(*cached)
    if captioner and not words:
        words = [phrase for caption in captioner.captions(image.pixels) for phrase in phrases(caption)]
        words = words[:PHRASES_PER_IMAGE]
    index, labels = flatten_regions(provider.regions(image, words), image)
    embeddings = [embedder.image(*crop_to_mask(image.pixels, index == number + 1)) for number in range(len(labels))]
    stacked = np.stack(embeddings) if embeddings else np.zeros((0, 1), np.float32)
    if not np.isfinite(stacked).all():
        raise InputError(f"The embedding {embedder.name} made numbers that are not finite: choose another.")
    save_regions(cache, image, key, index, labels, stacked)
    return ImageRegions(index, labels, stacked)


def flatten_regions(regions: Sequence[Region], image: TrainingImage) -> tuple[np.ndarray, tuple[str, ...]]:
    """Combine masks that may overlap into one index.

    Where masks overlap, the first one counts. Regions with the same label become one. Invalid pixels belong to none.
    Regions with fewer than MIN_PIXELS left are dropped.

    Args:
        regions: Regions, the most certain first.
        image: The image.

    Returns:
        Index (H, W) uint16 and labels, as in ImageRegions.

    Raises:
        InputError: If a mask has another size than the image.
    """
    index = np.zeros(image.valid.shape, np.uint16)
    labels: list[str] = []
    for region in regions:
        if region.mask.shape != image.valid.shape:
            rows, columns = region.mask.shape[:2]
            height, width = image.valid.shape
            raise InputError(
                f"The mask of {region.label or 'a region'} is {columns} x {rows} and not {width} x {height} pixels."
            )
        free = region.mask & image.valid & (index == 0)
        if region.label in labels and region.label:
            index[free] = labels.index(region.label) + 1
        elif free.sum() >= MIN_PIXELS:
            labels.append(region.label)
            index[free] = len(labels)
    return index, tuple(labels)


def _labels_by_image(found: Mapping[str, ImageRegions], projection: Projection) -> dict[str, list[str]]:
    """Return the labels of the regions by image, with new ones for the regions that have none."""
    unlabelled = [(image, i) for image, entry in found.items() for i, label in enumerate(entry.labels) if not label]
    by_image = {image: list(entry.labels) for image, entry in found.items()}
    if not unlabelled:
        return by_image
    features = projection(np.stack([found[image].embeddings[i] for image, i in unlabelled]))
    clusters = np.ones(len(unlabelled), int)
    if len(unlabelled) > 1:
        clusters = fcluster(linkage(features.astype(np.float64), "ward"), MAX_CLUSTERS, "maxclust")
    taken = {label for labels in by_image.values() for label in labels}
    for cluster in np.unique(clusters):
        members = [region for region, number in zip(unlabelled, clusters, strict=True) if number == cluster]
        colors = Counter(color_name(found[image].embeddings[i]) for image, i in members)
        label = color = colors.most_common(1)[0][0]
        number = 1
        while label in taken:
            number += 1
            label = f"{color} {number}"
        taken.add(label)
        for image, i in members:
            by_image[image][i] = label
    return by_image


def _notes(found: Mapping[str, ImageRegions], words: Sequence[str], labels: Sequence[str]) -> list[str]:
    """Return sentences for the user about what is missing."""
    notes = []
    empty = sum(not entry.labels for entry in found.values())
    if empty:
        notes.append(f"{empty} of {len(found)} images have no region.")
    if missing := [word for word in words if word not in labels]:
        notes.append(f"Nothing was found for {', '.join(missing)}.")
    covered = sum(len(entry.labels) == 1 and bool(entry.index.all()) for entry in found.values())
    if covered == len(found):
        notes.append("In every image one region covers all pixels, so the labels distinguish nothing.")
    return notes


def resized_labels(labels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize a map of labels.

    Args:
        labels: (H, W) integers.
        width: New width, pixels.
        height: New height, pixels.

    Returns:
        (height, width), for each pixel the label at its centre.
    """
    return cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
