"""The command `survey`: places with more photos than one machine can train."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..formats.registry import FORMATS
from ..settings.settings import TrainSettings
from .answers import show
from .interrupts import interrupts

STOPPING = "Stopping; what exists is kept. Press Ctrl-C again to stop at once."

Folder = Annotated[Path, tyro.conf.arg(metavar="SURVEY")]
"""Folder of a survey."""
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Plan:
    """Cut a scene into blocks that are trained apart, and write the folder of the survey. Nothing is trained."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    out: Path
    """Folder of the survey; it must not exist or be empty."""
    block_images: int = 300
    """Largest number of photos of a block."""
    settings: tyro.conf.OmitArgPrefixes[TrainSettings] = field(default_factory=TrainSettings)
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.plan import describe, plan_survey
        from .progress import stage_progress

        with stage_progress() as progress:
            document = plan_survey(self.scene, self.out, self.settings, self.block_images, progress=progress)
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Run:
    """Train the coarse model and all blocks of a survey that are not done yet. Started again, it continues."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    executor: Literal["local", "ray"] = "local"
    """What runs the blocks. local: processes on this machine, as many as its memory holds. ray: a Ray cluster, which
    needs the extra ray."""
    address: str | None = None
    """Address of the head of the Ray cluster, HOST or HOST:PORT, or auto for the cluster that this machine belongs to;
    without it Ray runs on this machine alone."""
    at_once: int | None = None
    """Largest number of blocks that are trained at a time on this machine; as many as memory and cores allow without
    it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..formats.survey_folder import SurveyFolder
        from ..survey.executors.local import LocalExecutor
        from ..survey.executors.protocol import Executor
        from ..survey.run import describe, run_survey
        from .progress import survey_progress

        backend = SurveyFolder(self.folder).read().settings.backend
        executor: Executor
        if self.executor == "ray":
            from ..survey.executors.ray import RayExecutor

            executor = RayExecutor(backend, self.address)
        else:
            executor = LocalExecutor(backend, self.at_once)
        with interrupts.deferred(STOPPING), survey_progress() as progress:
            document = run_survey(self.folder, executor, progress, interrupts.should_stop)
        show(document, self.json, describe(document))
        return interrupts.exit_code if document["interrupted"] else document["exit_code"]


@dataclass(frozen=True)
class Block:
    """Train one block or seam of a survey, or continue it. What is done, or what another process has, is left alone."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    block: str
    """Name of a block, such as B-001, or of a seam between two, such as S-001-002, which comes after them; or coarse
    for the coarse model, which comes before all blocks."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.job import describe, run_job
        from .progress import training_progress

        with interrupts.deferred(STOPPING), training_progress() as on_event:
            document = run_job(self.folder, self.block, on_event, interrupts.should_stop)
        show(document, self.json, describe(document))
        return interrupts.exit_code if document["state"] == "begun" else 0


@dataclass(frozen=True)
class Label:
    """Label the splats of all blocks that are done, as the command label does. Merge the survey afterwards."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    words: tuple[str, ...] = ()
    """What to look for, as in --words coral wreck "open water"; needs networks (see --weights-dir)."""
    masks: Path | None = None
    """Folder of mask images, one folder a label: MASKS/coral/NAME.png."""
    weights_dir: Path | None = None
    """Folder of pretrained networks; the user's cache folder without it."""
    download: tyro.conf.FlagCreatePairsOff[bool] = False
    """Download networks that are not on this machine."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.labels import describe, label_survey
        from .progress import stage_progress

        with stage_progress() as progress:
            document = label_survey(
                self.folder, self.words, self.masks, self.weights_dir, self.download, progress=progress
            )
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Merge:
    """Make one model of all blocks: tiles in levels of detail, in the folder merged of the survey."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    partial: tyro.conf.FlagCreatePairsOff[bool] = False
    """Merge the blocks that are done, although others are not."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.merge import describe, merge_survey
        from .progress import stage_progress

        with stage_progress() as progress:
            document = merge_survey(self.folder, progress, self.partial)
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Report:
    """Score the merged survey on its test photos, at the seams and elsewhere, and write merged/report.html."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.report import describe, report_survey
        from .progress import stage_progress

        with stage_progress() as progress:
            document = report_survey(self.folder, progress)
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Render:
    """Render views of a merged survey to image files."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    out: Path
    """Folder of the image files."""
    camera: str | None = None
    """Name of one photo; all test views without it."""
    water: float = 1.0
    """Amount of water, from 0 (removed) to 1 (as photographed)."""
    develop: Annotated[str, tyro.conf.arg(metavar="none|auto|VALUES")] = "auto"
    """Development of restored colors, as the command render has it. auto: that of the coarse model."""
    exr: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write linear light without development to half-float OpenEXR files in place of PNG files."""
    level: int = 0
    """Level of detail, 0 is the finest."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.render import render_survey

        options = self.camera, self.water, self.develop, self.exr, self.level
        files = [str(path) for path in render_survey(self.folder, self.out, *options)]
        show({"files": files}, self.json, "\n".join(files))
        return 0


@dataclass(frozen=True)
class Export:
    """Write a level of a merged survey, or a box of it, to a file that other programs read."""

    folder: tyro.conf.Positional[Folder]
    """Folder of the survey."""
    format: Literal[(*FORMATS, "sog")]  # type: ignore[valid-type]
    """Format of the file. sog: a folder with streamed levels of detail for the web, which needs Node with the package
    splat-transform."""
    out: Path
    """File to write."""
    level: int = 0
    """Level of detail, 0 is the finest."""
    box: Box | None = None
    """Left, bottom, right and top edge on the ground of the survey, scene units."""
    develop: Annotated[str, tyro.conf.arg(metavar="none|auto|VALUES")] = "auto"
    """Development of restored colors, as the command export has it. auto: that of the coarse model."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..survey.export import describe, export_survey
        from .progress import stage_progress

        with stage_progress() as progress:
            document = export_survey(self.folder, self.format, self.out, self.level, self.box, progress, self.develop)
        show(document, self.json, describe(document))
        return 0


Step = Plan | Run | Block | Label | Merge | Report | Render | Export


@dataclass(frozen=True)
class Survey:
    """Reconstruct a place with more photos than one machine can train, in blocks that any machines can train."""

    step: tyro.conf.OmitSubcommandPrefixes[Step]

    def run(self) -> int:
        """Run the step and return its exit code."""
        return self.step.run()
