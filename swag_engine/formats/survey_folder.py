"""The folder of a survey: which files it has, and how they are written and read. Blender imports it.

    survey.json             scene, settings, ground, blocks
    coarse/                 run of the coarse model of the whole survey
    blocks/B-001/           block.json, run/ (the block's run), done.json or failed.json
    seams/S-001-002/        the same for the strip along the border between two blocks
    merged/                 tiles.json, tiles/, report.html

Whether a block is done, running or waiting follows from its files and is stored nowhere else.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..base.errors import DAMAGE, InputError, reading
from ..base.files import refuse_link
from ..settings.settings import TrainSettings
from .run_folder import RunFolder, read_json, write_json

VERSION = 1
"""Version of survey.json, block.json and done.json."""
COARSE = "coarse"
"""Name of the job that trains the coarse model, among the names of blocks."""

NAME = re.compile(r"B-\d{3,}|S-\d{3,}-\d{3,}")
"""Names of blocks and seams, which are names of folders, too."""

FIGURES = ("gaussians_in_core", "iterations", "processor_seconds", "peak_memory", "seconds", "test_psnr")
"""Numbers in the done.json of a block; the last one is null without test images."""

State = Literal["waiting", "begun", "running", "failed", "done"]
"""State of a block. begun: it has a checkpoint, and no process works on it."""
Box = tuple[float, float, float, float]
"""Left, bottom, right and top edge on the ground, half-open: left <= x < right. Edges of the survey are infinite."""


@dataclass(frozen=True)
class Ground:
    """Plane on which a survey is cut.

    Attributes:
        origin: (3,) point of the plane, scene units.
        axes: Rows (3, 3): x, y and up of the plane in the scene's coordinates, a rotation.
    """

    origin: tuple[float, float, float]
    axes: tuple[tuple[float, float, float], ...]

    def on_ground(self, positions: np.ndarray) -> np.ndarray:
        """Return x, y and height (N, 3) float64 of positions (N, 3), scene units.

        A position has the same place to the last bit among any others, so that it is on one side of a border only. A
        matrix product would not ensure that.
        """
        x, y, z = (np.asarray(positions, np.float64) - np.array(self.origin)).T
        return np.stack([x * a + y * b + z * c for a, b, c in self.axes], axis=1)


@dataclass(frozen=True)
class Block:
    """A part of a survey that is trained by itself: a block, or the seam between two blocks.

    Attributes:
        name: Such as B-001, or S-001-002 for the seam between B-001 and B-002.
        core: Box on the ground; each place of the plane is in the core of one block, and in one seam at most.
        extended: Core with the margin in which the block has Gaussians of its own; in that of a seam are the Gaussians
            of its two blocks, which do not change. Coarse ones are beyond.
        training: Names of the images that the loss is computed on.
        validation: Names of the images that decisions of the run are made on.
        test: Names of the images for the reported figures only; all held-out images are held out in every block.
        seed: Seed of the run.
        iterations: Number of optimisation steps.
        max_gaussians: Largest number of Gaussians; of a seam an estimate of the number in its core.
        points: Sparse points in the extended box.
        memory: Estimate of the memory that the run needs, bytes.
        sides: Names of the blocks whose Gaussians a seam trains further; empty for a block.
    """

    name: str
    core: Box
    extended: Box
    training: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]
    seed: int
    iterations: int
    max_gaussians: int
    points: int
    memory: int
    sides: tuple[str, ...] = ()

    @property
    def images(self) -> tuple[str, ...]:
        """Names of all its images, sorted."""
        return tuple(sorted({*self.training, *self.validation, *self.test}))

    def in_core(self, on_ground: np.ndarray) -> np.ndarray:
        """Return which places (N, 2 or 3) on the ground are in the core, (N,) bool."""
        return inside(self.core, on_ground)

    def to_json(self) -> dict[str, Any]:
        """Return a plain dict that `from_json` reads; infinite edges are null."""
        document = asdict(self)
        for name in ("core", "extended"):
            document[name] = [edge if np.isfinite(edge) else None for edge in document[name]]
        return {"version": VERSION} | document

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "Block":
        """Read what `to_json` returned.

        Raises:
            KeyError, TypeError, ValueError: If a value is missing or of the wrong kind.
        """
        values = {entry.name: document[entry.name] for entry in fields(cls)}
        ends = (-np.inf, -np.inf, np.inf, np.inf)
        for name in ("core", "extended"):
            pairs = zip(values[name], ends, strict=True)
            values[name] = tuple(float(end if edge is None else edge) for edge, end in pairs)
        for name in ("training", "validation", "test"):
            values[name] = tuple(str(image) for image in values[name])
        (values["name"],), values["sides"] = _jobs([values["name"]]), _jobs(values["sides"])
        for name in ("seed", "iterations", "max_gaussians", "points", "memory"):
            values[name] = int(values[name])
        return cls(**values)


def inside(box: Box, on_ground: np.ndarray) -> np.ndarray:
    """Return which places (N, 2 or 3) on the ground are in a half-open box, (N,) bool."""
    left, bottom, right, top = box
    x, y = on_ground[:, 0], on_ground[:, 1]
    return (left <= x) & (x < right) & (bottom <= y) & (y < top)


@dataclass(frozen=True)
class Survey:
    """What a survey consists of: survey.json.

    Attributes:
        scene: Folder of the scene; in the file relative to the survey where both are in one folder.
        engine: Version of the engine that planned the survey; blocks are trained by the same one.
        settings: Settings of the blocks; their sizes are filled in, iterations are those of the average block, and
            the number of Gaussians is that of all blocks together.
        coarse_settings: Settings of the coarse model.
        coarse_training: Names of the images that the coarse model is trained on.
        coarse_validation: Names of the images that decisions of the coarse run are made on.
        test: Names of all test images, which no run of the survey sees.
        ground: Plane on which it is cut.
        bounds: Box on the ground that holds the cameras and all but the outermost sparse points, for maps.
        images: Number of images.
        blocks: Names of the blocks.
        seams: Names of the seams.
        median_range: Median distance from a camera to the sparse points that it sees, scene units.
    """

    scene: Path
    engine: str
    settings: TrainSettings
    coarse_settings: TrainSettings
    coarse_training: tuple[str, ...]
    coarse_validation: tuple[str, ...]
    test: tuple[str, ...]
    ground: Ground
    bounds: Box
    images: int
    blocks: tuple[str, ...]
    seams: tuple[str, ...] = ()
    median_range: float = 0.0

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of blocks and seams, which are merged."""
        return (*self.blocks, *self.seams)

    @property
    def jobs(self) -> tuple[str, ...]:
        """Names of all jobs in an order in which each has what it needs: coarse model, blocks, seams."""
        return (COARSE, *self.parts)

    def to_json(self) -> dict[str, Any]:
        """Return a plain dict that `from_json` reads."""
        return {"version": VERSION} | asdict(self) | {"scene": self.scene.as_posix()}  # Windows reads it, too

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "Survey":
        """Read what `to_json` returned.

        Raises:
            InputError: For settings that are not valid.
            KeyError, TypeError, ValueError: If a value is missing or of the wrong kind.
        """
        ground = document["ground"]
        axes = tuple(_triple(row) for row in ground["axes"])
        left, bottom, right, top = (float(edge) for edge in document["bounds"])
        return cls(
            scene=Path(document["scene"]),
            engine=str(document["engine"]),
            settings=TrainSettings.from_json(document["settings"]),
            coarse_settings=TrainSettings.from_json(document["coarse_settings"]),
            coarse_training=_names(document["coarse_training"]),
            coarse_validation=_names(document["coarse_validation"]),
            test=_names(document["test"]),
            ground=Ground(_triple(ground["origin"]), axes),
            bounds=(left, bottom, right, top),
            images=int(document["images"]),
            blocks=_jobs(document["blocks"]),
            seams=_jobs(document["seams"]),
            median_range=float(document["median_range"]),
        )


@dataclass(frozen=True)
class SurveyFolder:
    """The files of one survey.

    Attributes:
        path: The folder, which need not exist yet.
    """

    path: Path

    @property
    def survey(self) -> Path:
        """Scene, settings, ground and blocks."""
        return self.path / "survey.json"

    @property
    def coarse(self) -> RunFolder:
        """Run of the coarse model."""
        return RunFolder(self.path / COARSE)

    @property
    def merged(self) -> Path:
        """Folder of tiles and report."""
        return self.path / "merged"

    @property
    def report(self) -> Path:
        """The report."""
        return self.merged / "report.html"

    def job(self, name: str) -> Path:
        """Return the folder of a block, of a seam, or of the coarse model."""
        if name == COARSE:
            return self.path / COARSE
        return self.path / ("seams" if name.startswith("S-") else "blocks") / name

    def block_file(self, name: str) -> Path:
        """Return the file that describes a block."""
        return self.job(name) / "block.json"

    def run(self, name: str) -> RunFolder:
        """Return the run of a block, or of the coarse model."""
        return self.coarse if name == COARSE else RunFolder(self.job(name) / "run")

    def scene_part(self, name: str) -> Path:
        """Return the file of the part of the scene that a block, or the coarse model, is trained on."""
        return self.job(name) / "scene.npz"

    @property
    def all_views(self) -> Path:
        """Cameras of all images of the survey and their split, without points."""
        return self.path / COARSE / "views.npz"

    @property
    def whole(self) -> Path:
        """What blocks take over from the coarse model beside its checkpoint: exposures and colors of the survey."""
        return self.path / COARSE / "whole.json"

    def done(self, name: str) -> Path:
        """Return the file that a finished block has: figures and the hash of its result."""
        return self.job(name) / "done.json"

    def read_done(self, name: str) -> dict[str, Any]:
        """Read the figures of a finished block.

        Raises:
            InputError: If the block is not done, or its file is damaged.
        """
        document = read_json(self.done(name), f"The block {name} is not done; run it.")
        with reading(self.done(name), "remove it and run the block again"):
            figures = [document[figure] for figure in FIGURES]
            if not all(map(math.isfinite, (0 if value is None else value for value in figures))):
                raise ValueError("a figure that is not finite")
        return document

    def failed(self, name: str) -> Path:
        """Return the file that says why a block failed."""
        return self.job(name) / "failed.json"

    def claim(self, name: str) -> Path:
        """Return the file of the process that works on a block."""
        return self.job(name) / "claim.json"

    def write(self, survey: Survey) -> None:
        """Write survey.json.

        Raises:
            InputError: If it cannot be written.
        """
        write_json(self.survey, survey.to_json())

    def read(self) -> Survey:
        """Read survey.json. A scene that is given relative to the folder is returned as an absolute path.

        Raises:
            InputError: If the folder is not a survey, the file is damaged or of another version, or one of its folders
                is a link.
        """
        document = read_json(self.survey, f"{self.path} is not a survey: it has no survey.json.")
        survey = _parsed(self.survey, document, Survey.from_json)
        jobs = [self.job(name) for name in survey.jobs]
        runs = [self.run(name).path for name in survey.parts]
        tiles = self.merged / "tiles"
        for folder in {self.merged, tiles, *tiles.glob("*"), *jobs, *runs, *(job.parent for job in jobs[1:])}:
            refuse_link(folder)
        return replace(survey, scene=(self.path / survey.scene).resolve())

    def write_block(self, block: Block) -> None:
        """Write the file that describes a block.

        Raises:
            InputError: If it cannot be written.
        """
        write_json(self.block_file(block.name), block.to_json())

    def read_block(self, name: str) -> Block:
        """Read a block.

        Raises:
            InputError: If there is no such block, or its file is damaged or of another version.
        """
        file = self.block_file(name)
        document = read_json(
            file, f"The survey {self.path} has no block {name}: its blocks are in {file.parent.parent}."
        )
        return _parsed(file, document, Block.from_json)


def _parsed(file: Path, document: dict[str, Any], parse: Any) -> Any:
    if document.get("version") != VERSION:
        raise InputError(
            f"{file} has version {document.get('version')!r}, and this program reads version {VERSION}: use the "
            "version of SWAG Splatting that planned the survey, or plan it again."
        )
    try:
        return parse(document)
    except DAMAGE as error:
        raise InputError(f"{file} is damaged: {error!r}; plan the survey again to a new folder.") from error


def _names(values: Any) -> tuple[str, ...]:
    return tuple(str(value) for value in values)


def _jobs(values: Any) -> tuple[str, ...]:
    if wrong := [name for name in _names(values) if not NAME.fullmatch(name)]:
        raise ValueError(f"{wrong[0]!r} is no name of a block")
    return _names(values)


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
