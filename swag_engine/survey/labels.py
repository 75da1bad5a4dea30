"""Labels of a survey: each block is labelled by its own images, and labels of one name become one when it is merged."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.claim import claimed
from ..base.errors import InputError
from ..base.text import first_names
from ..experiments.label_run import label_run
from ..formats.run_folder import read_json, write_json
from ..formats.select import LABEL
from ..formats.survey_folder import SurveyFolder
from ..scene.scene_part import read_part
from ..semantics.labels import TABLE, read_labels
from ..semantics.providers import Progress
from ..splats.splats import Splats
from .job import hash_of


def label_survey(
    folder: Path,
    words: Sequence[str] = (),
    masks: Path | None = None,
    weights_dir: Path | None = None,
    download: bool = False,
    progress: Progress = lambda stage, fraction: None,
) -> dict[str, Any]:
    """Label the Gaussians of all blocks that are done.

    Args:
        folder: Folder of the survey.
        words: What to look for.
        masks: Folder of mask images.
        weights_dir: Folder where networks are looked for first.
        download: Whether networks may be downloaded.
        progress: Gets the stage and its fraction (0..1).

    Returns:
        `labels`: name and number of Gaussians of each, margins of blocks included; `missing`: names of blocks that are
        not done; `survey`, the folder.

    Raises:
        InputError: If no block is done, and as `label_run`; blocks that were labelled before stay so.
    """
    files = SurveyFolder(folder)
    survey = files.read()
    done = [name for name in survey.parts if files.done(name).exists()]
    if not done:
        raise InputError(f"No block of {folder} is done yet: train them first (survey run {folder}).")
    for number, name in enumerate(done):

        def of_block(stage: str, fraction: float, name: str = name, number: int = number) -> None:
            progress(f"{name}: {stage}", (number + fraction) / len(done))

        with claimed(files.job(name)):
            part = read_part(files.scene_part(name), survey.scene)
            label_run(files.run(name).path, words, masks, None, weights_dir, download, False, of_block, part)
            document = read_json(files.done(name), "")
            write_json(files.done(name), document | {"result_sha256": hash_of(files.run(name).ply)})
    labels = SurveyLabels.of(files, done)
    missing = [name for name in survey.parts if name not in done]
    return {"survey": str(folder), "labels": labels.table(labels.counts), "missing": missing}


def describe(document: dict[str, Any]) -> str:
    """Format what `label_survey` returned as the lines that `survey label` prints."""
    lines = [f"{entry['name']}: {entry['count']:,} Gaussians" for entry in document["labels"]]
    if document["missing"]:
        lines.append(f"{len(document['missing'])} blocks and seams are not done and have no labels: "
                     f"{first_names(document['missing'])}.")  # fmt: skip
    return "\n".join([*lines, f"Next: survey merge {document['survey']}"])


@dataclass(frozen=True)
class SurveyLabels:
    """Labels of all blocks under common numbers.

    Attributes:
        names: Names of the labels; label number i is names[i - 1].
        blocks: For each labelled block the common number of each of its own, that of 0 first.
        counts: Number of Gaussians of each label in the blocks, margins included.
        fractions: Mean fraction of the pixels of each label over the blocks.
        gains: Mean gain of each label over the Gaussians of the blocks.
    """

    names: tuple[str, ...]
    blocks: dict[str, np.ndarray]
    counts: tuple[int, ...]
    fractions: tuple[float, ...]
    gains: tuple[float, ...]

    @classmethod
    def of(cls, folder: SurveyFolder, blocks: Sequence[str]) -> "SurveyLabels":
        """Read the labels of blocks; a block without labels has none. Labels are ordered by their number of Gaussians.

        Raises:
            InputError: If a file of labels is damaged.
        """
        tables = {}
        for name in blocks:
            path = folder.run(name).path
            if (path / TABLE).exists():
                tables[name] = read_labels(path)
        counts: dict[str, int] = {}
        fractions: dict[str, float] = {}
        gains: dict[str, float] = {}
        for entry in (entry for table in tables.values() for entry in table):
            counts[entry["name"]] = counts.get(entry["name"], 0) + int(entry["count"])
            fractions[entry["name"]] = fractions.get(entry["name"], 0.0) + float(entry["fraction"]) / len(tables)
            gains[entry["name"]] = gains.get(entry["name"], 0.0) + int(entry["count"]) * entry["gain"]
        names = sorted(counts, key=lambda name: (-counts[name], name))
        numbers = {
            block: np.array([0, *(names.index(entry["name"]) + 1 for entry in sorted(table, key=lambda e: e["id"]))])
            for block, table in tables.items()
        }
        return cls(
            tuple(names),
            numbers,
            tuple(counts[name] for name in names),
            tuple(fractions[name] for name in names),
            tuple(gains[name] / counts[name] if counts[name] else 1.0 for name in names),
        )

    def renumbered(self, block: str, splats: Splats) -> Splats:
        """Return splats of a block with the common numbers of their labels."""
        own = splats.extras.get(LABEL)
        if own is None or block not in self.blocks:
            return splats
        numbers = self.blocks[block]
        known = np.where((own >= 0) & (own < len(numbers)), own, 0)
        return replace(splats, extras=splats.extras | {LABEL: numbers[known].astype(own.dtype)})

    def table(self, counts: Sequence[int]) -> list[dict[str, Any]]:
        """Return the entries of labels.json, with these numbers of Gaussians."""
        rows = zip(self.names, counts, self.fractions, self.gains, strict=True)
        return [
            {"id": number, "name": name, "count": count, "fraction": round(fraction, 6), "gain": round(gain, 4)}
            for number, (name, count, fraction, gain) in enumerate(rows, start=1)
        ]

    def write(self, folder: Path, counts: Sequence[int]) -> None:
        """Write labels.json of the merged model; without labels an earlier one is removed.

        Args:
            folder: Folder of the merged model.
            counts: Number of its Gaussians of each label.

        Raises:
            InputError: If it cannot be written.
        """
        if self.names:
            write_json(folder / TABLE, {"labels": self.table(counts)})
        else:
            with suppress(OSError):
                (folder / TABLE).unlink()
