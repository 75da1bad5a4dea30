"""Regions of photographs: what providers find, and what a scene makes of it."""

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
from .cache import load_found, save_found
from .captions import Captioner, phrases
from .embed import Embedder, Projection, colour_name, cropped

PER_IMAGE = 3
"""Phrases of a caption that are looked for in its photograph (docs/method.md section 5)."""
MOST_CLUSTERS = 8
"""Names that regions without one are given at most."""
MIN_PIXELS = 16
"""Smaller regions are left out."""


@dataclass(frozen=True, eq=False)
class Region:
    """A part of one photograph: mask (H, W) bool, what it is called ("" where the provider has no name for it)."""

    mask: np.ndarray
    name: str = ""


class RegionProvider(Protocol):
    """Finds regions. `name` is what it is called, `key` tells it and its weights from others in the cache."""

    name: str
    key: str

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """The regions of one photograph, the surest first; `words` are what to look for, for providers that can.

        Raises InputError when the provider cannot do its work.
        """
        ...


@dataclass(frozen=True, eq=False)
class Found:
    """What was found in one photograph: index (H, W) uint16, 0 for no region and i for the i-th of `names`;
    embeddings (R, D) float32 of length 1."""

    index: np.ndarray
    names: tuple[str, ...]
    embeddings: np.ndarray


@dataclass(frozen=True, eq=False)
class SceneRegions:
    """Regions of a scene's photographs under common labels.

    labels: label i (1, 2, ...) is called labels[i - 1]; 0 is no label. maps: by photograph, (H, W) uint16 labels at
    the training size. features: by photograph, label -> (32,) float32 of length 1, the region's embedding through
    `projection`. prototypes (L, 32) float32 of length 1: the mean feature of each label. notes: sentences for the user.
    """

    labels: tuple[str, ...]
    maps: dict[str, np.ndarray]
    features: dict[str, dict[int, np.ndarray]]
    prototypes: np.ndarray
    projection: Projection
    notes: tuple[str, ...]

    def shares(self) -> np.ndarray:
        """(L + 1,) share of the photographs' pixels that each label has, label 0 first."""
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
    """Find the regions of a scene's training photographs, embed them, and bring them under common labels.

    words: what to look for; without them the captions of `captioner` say it, per photograph. What is found is kept in
    the folder `cache`, by the content of the photograph, provider, weights and words. `progress` is called with how
    many photographs are done and how many there are. Raises InputError when no photograph has a region, a word is
    empty, or a network fails.
    """
    words = checked_words(words)
    found: dict[str, Found] = {}
    for number, image in enumerate(images):
        try:
            found[image.camera.name] = _found(image, provider, embedder, words, captioner, cache)
        except InputError as error:
            raise InputError(f"{str(error).rstrip('.')} (photograph {image.camera.name}).") from error
        if progress:
            progress(number + 1, len(images))
    if not any(entry.names for entry in found.values()):
        asked = f" of {', '.join(words)}" if words else ""
        raise InputError(f"{provider.name} found no region{asked} in any of the {len(images)} photographs.")
    return common_labels(found, words)


def checked_words(words: Sequence[str]) -> tuple[str, ...]:
    """The words without surrounding blanks, each once. Raises InputError for an empty one."""
    stripped = [" ".join(word.split()) for word in words]
    if any(not any(character.isalnum() for character in word) for word in stripped):
        raise InputError(
            "One of the words to look for is empty: write what to look for, such as coral, or leave it out."
        )
    return tuple(dict.fromkeys(stripped))


def common_labels(found: Mapping[str, Found], words: Sequence[str] = ()) -> SceneRegions:
    """One list of labels for regions of many photographs (at least one region).

    Regions of one name are one label. Those without a name are put together where their embeddings are alike, and
    called by their colour. Labels are in the order of `words`, then by falling share of the pixels.
    """
    embeddings = np.concatenate([entry.embeddings for entry in found.values() if len(entry.names)])
    projection = Projection.fit(embeddings)
    names = _named(found, projection)
    pixels: Counter[str] = Counter()
    for image, entry in found.items():
        counts = np.bincount(entry.index.ravel(), minlength=len(entry.names) + 1)[1:]
        for name, count in zip(names[image], counts, strict=True):
            pixels[name] += int(count)
    labels = [word for word in words if word in pixels]
    labels += [name for name, _ in pixels.most_common() if name not in labels]
    maps, features = {}, {}
    sums = np.zeros((len(labels), projection.dimensions), np.float32)
    for image, entry in found.items():
        ids = np.array([0] + [labels.index(name) + 1 for name in names[image]], np.uint16)
        maps[image] = ids[entry.index]
        # Unnamed regions of one photograph can share a label: the larger one speaks for it.
        order = np.argsort(-np.bincount(entry.index.ravel(), minlength=len(ids))[1:], kind="stable")
        projected = projection(entry.embeddings)
        features[image] = {int(ids[i + 1]): projected[i] for i in order[::-1]}
        for label, feature in features[image].items():
            sums[label - 1] += feature
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    prototypes = sums / np.maximum(lengths, 1e-12)
    return SceneRegions(tuple(labels), maps, features, prototypes, projection, tuple(_notes(found, words, labels)))


def _found(
    image: TrainingImage,
    provider: RegionProvider,
    embedder: Embedder,
    words: Sequence[str],
    captioner: Captioner | None,
    cache: Path | None,
) -> Found:
    key = (provider.key, embedder.key, captioner.key if captioner and not words else "", *words)
    kept = load_found(cache, image, key)
    if kept is not None:
        return Found(*kept)
    if captioner and not words:
        words = [phrase for caption in captioner.captions(image.pixels) for phrase in phrases(caption)][:PER_IMAGE]
    index, names = flattened(provider.regions(image, words), image)
    embeddings = [embedder.image(*cropped(image.pixels, index == number + 1)) for number in range(len(names))]
    stacked = np.stack(embeddings) if embeddings else np.zeros((0, 1), np.float32)
    if not np.isfinite(stacked).all():
        raise InputError(f"The embedding {embedder.name} made numbers that are not finite: choose another.")
    save_found(cache, image, key, index, names, stacked)
    return Found(index, names, stacked)


def flattened(regions: Sequence[Region], image: TrainingImage) -> tuple[np.ndarray, tuple[str, ...]]:
    """Regions side by side: index (H, W) uint16 and names, as in Found.

    Where masks overlap the first counts; regions of one name become one; invalid pixels belong to none; what is left
    smaller than MIN_PIXELS is dropped. Raises InputError for a mask of another size.
    """
    index = np.zeros(image.valid.shape, np.uint16)
    names: list[str] = []
    for region in regions:
        if region.mask.shape != image.valid.shape:
            rows, columns = region.mask.shape[:2]
            height, width = image.valid.shape
            raise InputError(
                f"The mask of {region.name or 'a region'} is {columns} x {rows} and not {width} x {height}."
            )
        free = region.mask & image.valid & (index == 0)
        if region.name in names and region.name:
            index[free] = names.index(region.name) + 1
        elif free.sum() >= MIN_PIXELS:
            names.append(region.name)
            index[free] = len(names)
    return index, tuple(names)


def _named(found: Mapping[str, Found], projection: Projection) -> dict[str, list[str]]:
    """Names of the regions by photograph, with one for those that have none."""
    places = [(image, i) for image, entry in found.items() for i, name in enumerate(entry.names) if not name]
    names = {image: list(entry.names) for image, entry in found.items()}
    if not places:
        return names
    features = projection(np.stack([found[image].embeddings[i] for image, i in places]))
    groups = np.ones(len(places), int)
    if len(places) > 1:
        groups = fcluster(linkage(features.astype(np.float64), "ward"), MOST_CLUSTERS, "maxclust")
    taken = {name for entry in names.values() for name in entry}
    for group in np.unique(groups):
        members = [place for place, number in zip(places, groups, strict=True) if number == group]
        colours = Counter(colour_name(found[image].embeddings[i]) for image, i in members)
        title = wanted = colours.most_common(1)[0][0]
        number = 1
        while title in taken:
            number += 1
            title = f"{wanted} {number}"
        taken.add(title)
        for image, i in members:
            names[image][i] = title
    return names


def _notes(found: Mapping[str, Found], words: Sequence[str], labels: Sequence[str]) -> list[str]:
    notes = []
    empty = sum(not entry.names for entry in found.values())
    if empty:
        notes.append(f"{empty} of {len(found)} photographs have no region.")
    if missing := [word for word in words if word not in labels]:
        notes.append(f"Nothing was found for {', '.join(missing)}.")
    covered = [name for entry in found.values() if len(entry.names) == 1 for name in entry.names if entry.index.all()]
    if len(covered) == len(found):
        notes.append("One region covers every photograph whole: labels tell nothing apart.")
    return notes


def resized_labels(labels: np.ndarray, width: int, height: int) -> np.ndarray:
    """A map of labels (H, W) at another size, each pixel the label under its centre."""
    return cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
