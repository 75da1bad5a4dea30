"""Split of the views into training, validation and test."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Split:
    """Names of the images of each part, sorted; no name is in two parts.

    Attributes:
        train: Images that the loss is computed on.
        validation: Images that decisions of a run are made on.
        test: Images for the reported metrics only.
    """

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


def split_views(names: Iterable[str]) -> Split:
    """Split image names as is usual in the field, which makes metrics comparable with published ones.

    Test: every eighth of the sorted names from the first. Validation: every eighth of the rest, at least one, midway
    between test views. Where this would leave fewer than two training views, first the validation and then the test
    views are trained on instead; a single name gives one training view.

    Args:
        names: Names of the images.

    Returns:
        The split.
    """
    ordered = sorted(set(names))
    test = ordered[::8]
    rest = [name for name in ordered if name not in set(test)]
    validation = rest[min(3, len(rest) // 2) :: 8]
    if len(rest) - len(validation) < 2:
        validation = []
    if len(rest) < 2:
        test, rest = [], ordered
    held_out = set(validation)
    return Split(tuple(name for name in rest if name not in held_out), tuple(validation), tuple(test))
