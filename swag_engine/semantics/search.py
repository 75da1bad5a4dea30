"""Words to Gaussians."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .embed import Embedder
from .labels import Semantics

NEUTRAL = ("object", "thing", "stuff", "texture", "scene", "background")
"""Words that mean nothing in particular: what every text has in common is taken away (as LERF's canonical phrases,
arXiv 2303.09553)."""


def similarity(
    semantics: Semantics, table: Sequence[dict[str, Any]], words: str, embedder: Embedder
) -> tuple[np.ndarray, list[str]]:
    """How near each Gaussian is to `words`: (N,) float32, the cosine in -1..1, and the labels that are called so.

    Labels whose name has the words in it, or is one of them, speak for themselves: the largest cosine with one of
    theirs. Otherwise the words' embedding is compared. Gaussians without a feature get -1. Raises InputError when no
    label is called so and `embedder` knows no words.
    """
    named = [entry for entry in table if _called(entry["name"], words)]
    if named:
        queries = semantics.prototypes[[entry["id"] - 1 for entry in named]]
    else:
        meaning = embedder.words([words])
        queries = semantics.projection(meaning, embedder.words(NEUTRAL).mean(0))
    cosines = (semantics.features @ queries.T).max(1)
    known = np.abs(semantics.features).sum(1) > 0
    return np.where(known, cosines, -1).astype(np.float32), [entry["name"] for entry in named]


def _called(name: str, words: str) -> bool:
    name, words = name.casefold(), words.casefold()
    singular = {word.removesuffix("s") for word in words.split()}
    return words in name or singular >= {word.removesuffix("s") for word in name.split()}
