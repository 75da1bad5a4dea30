"""Pairs of images whose features are worth matching, chosen by the images' own features.

Matching all pairs takes time that grows with the square of the number of images. Here every image gets a bounded number
of partners, so the time to match grows linearly: those that share its coarse features, whenever they were taken (a
survey's neighbouring lanes, a loop that closes), and its neighbours in order.
"""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

COARSE_FEATURES = 200
"""Features of an image, the largest ones, by which partners are chosen."""
_PARTNERS = 10
"""Partners of an image by shared features."""
_NEIGHBOURS = 2
"""Neighbours in order on either side, always matched: a video's motion is slow, and coarse features may be few."""
_CANDIDATES = 40
"""Images whose coarse features are compared with those of an image; all when there are not many more."""
_COMPARE_ALL_UP_TO = 100
"""Images of which all pairs are compared by coarse features, in a few seconds."""
_NEAREST = 10
"""Images nearest by GPS that are candidates too."""
_WORDS = 64
"""Centres of the visual vocabulary, learned from the scene."""
_VOCABULARY_SAMPLE = 20_000
"""Descriptors that the vocabulary is learned from."""
_RATIO = 0.8
"""Largest distance of the nearest descriptor over that of the second nearest (Lowe 2004)."""


def choose_pairs(
    descriptors: Sequence[np.ndarray],
    orders: Iterable[Sequence[int]],
    positions: np.ndarray | None = None,
) -> list[tuple[int, int]]:
    """Choose pairs of images to match.

    Args:
        descriptors: Of each image the descriptors (M, 128) of its coarse features; any M, also 0.
        orders: Orders of all images in which neighbours probably overlap, as by name or by time.
        positions: Positions (N, 2) in metres from GPS, NaN where unknown.

    Returns:
        Pairs (i, j), i < j, sorted.
    """
    pairs = set[tuple[int, int]]()
    for order in orders:
        for step in range(1, _NEIGHBOURS + 1):
            pairs |= {_sorted(a, b) for a, b in zip(order, order[step:], strict=False)}
    coarse = [_normalised(each) for each in descriptors]
    candidates = _candidates(coarse) | _nearest(positions) | pairs
    partners: list[list[tuple[int, int]]] = [[] for _ in descriptors]
    for a, b in candidates:
        if features := _shared_features(coarse[a], coarse[b]):
            partners[a].append((-features, b))
            partners[b].append((-features, a))
    for image, shared in enumerate(partners):
        pairs |= {_sorted(image, other) for _, other in sorted(shared)[:_PARTNERS]}
    return sorted(pairs)


def _sorted(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)


def _normalised(descriptors: np.ndarray) -> np.ndarray:
    """Return descriptors (M, 128) float32 of length 1."""
    descriptors = np.asarray(descriptors, np.float32).reshape(-1, 128)
    return descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-6)


def _shared_features(first: np.ndarray, second: np.ndarray) -> int:
    """Count the features of two images that are each other's nearest, and clearly nearer than the second nearest."""
    if min(len(first), len(second)) < 2:
        return 0
    cosine = first @ second.T
    nearest = cosine.argmax(1)
    mutual = cosine.argmax(0)[nearest] == np.arange(len(first))
    two = -np.partition(-cosine[mutual], 1, axis=1)[:, :2]  # squared distances are 2 - 2 cosine
    return int((1 - two[:, 0] < _RATIO**2 * (1 - two[:, 1])).sum())


def _candidates(descriptors: list[np.ndarray]) -> set[tuple[int, int]]:
    """Return the pairs of each image and those most similar to it by their VLAD vectors (Jégou et al. 2010)."""
    count = len(descriptors)
    if count <= _COMPARE_ALL_UP_TO:
        return {(a, b) for a in range(count) for b in range(a + 1, count)}
    pooled = np.concatenate(descriptors)
    if len(pooled) < _WORDS:
        return set()
    sample = pooled[np.random.default_rng(0).permutation(len(pooled))[:_VOCABULARY_SAMPLE]]
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 1e-3)
    words = cv2.kmeans(sample, _WORDS, np.empty(0, np.int32), criteria, 1, cv2.KMEANS_PP_CENTERS)[2]
    vectors = np.stack([_vlad(each, words) for each in descriptors])
    found = set()
    for image, vector in enumerate(vectors):
        similar = vectors @ vector
        similar[image] = -np.inf
        found |= {_sorted(image, int(other)) for other in np.argpartition(-similar, _CANDIDATES)[:_CANDIDATES]}
    return found


def _vlad(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the vector (words * 128,) of an image: its descriptors' residuals to their words, normalised."""
    vector = np.zeros(words.shape, np.float32)
    if len(descriptors):
        nearest = (descriptors @ words.T - (words**2).sum(1) / 2).argmax(1)
        np.add.at(vector, nearest, descriptors - words[nearest])
        vector /= np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-6)
    return vector.ravel() / max(float(np.linalg.norm(vector)), 1e-6)


def _nearest(positions: np.ndarray | None) -> set[tuple[int, int]]:
    """Return the pairs of each image with a position and those nearest to it."""
    if positions is None:
        return set()
    known = np.flatnonzero(np.isfinite(positions).all(1))
    found = set()
    for image in known:
        distance = np.linalg.norm(positions[known] - positions[image], axis=1)
        found |= {_sorted(int(image), int(other)) for other in known[np.argsort(distance)[1 : _NEAREST + 1]]}
    return {pair for pair in found if pair[0] != pair[1]}
