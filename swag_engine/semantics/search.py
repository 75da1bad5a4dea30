"""Search of Gaussians by words."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .embed import Embedder
from .labels import Semantics

NEUTRAL = ("object", "thing", "stuff", "texture", "scene", "background")
"""Words without a particular meaning: the mean of their embeddings is subtracted from that of a query, as with the
canonical phrases of LERF (arXiv 2303.09553)."""


def similarity(
    semantics: Semantics, table: Sequence[dict[str, Any]], words: str, embedder: Embedder
) -> tuple[np.ndarray, list[str]]:
    """Compare each Gaussian with words.

    Labels that match the words are compared by their prototypes; without such labels the embedding of the words is.

    Args:
        semantics: Features of the run.
        table: Its labels, as `read_labels` returns them.
        words: What to look for.
        embedder: Embeds the words.

    Returns:
        Cosine similarity (N,) float32, -1..1, the largest one of several labels, -1 for Gaussians without a feature;
        and the labels that match the words.

    Raises:
        InputError: If no label matches and the embedder cannot embed words.
    """
    matching = [entry for entry in table if _matches(entry["name"], words)]
    if matching:
        queries = semantics.prototypes[[entry["id"] - 1 for entry in matching]]
    else:
        meaning = embedder.words([words])
        queries = semantics.projection(meaning, embedder.words(NEUTRAL).mean(0))
    cosines = (semantics.features @ queries.T).max(1)
    known = np.abs(semantics.features).sum(1) > 0
    return np.where(known, cosines, -1).astype(np.float32), [entry["name"] for entry in matching]


def _matches(label: str, words: str) -> bool:
    """Return whether a label contains the words, or all its words are among them; plural and case do not matter."""
    label, words = label.casefold(), words.casefold()
    singular = {word.removesuffix("s") for word in words.split()}
    return words in label or singular >= {word.removesuffix("s") for word in label.split()}
