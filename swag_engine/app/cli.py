"""The command line: `python -m swag_engine COMMAND ...`."""

import functools
import operator
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ..base import threads  # noqa: F401
from ..base.errors import InputError
from ..experiments.grid import Grid
from ..formats.export import ExportOptions, export_run
from ..formats.export import describe as describe_export
from ..formats.registry import FormatName
from ..settings.field import settings_of
from ..settings.settings import TrainSettings
from .answers import refuse, refuse_missing, show
from .interrupts import interrupts

DESCRIPTION = """Underwater photographs to 3D Gaussian splats. COMMAND --help says what a command takes.

Exit codes: 0 done, 1 a bug, 2 bad input or usage; with what exists kept, 130 interrupted by Ctrl-C and 143 by SIGTERM.
Progress and errors go to stderr; with --json stdout carries one JSON document and nothing else."""
STOPPING = "Stopping after this iteration; press Ctrl-C again to stop at once."
STARTED = time.monotonic()
"""What a time budget counts from: starting Python and its packages is the user's time too."""


def describe_options(options: type) -> None:
    """Show the help and the choices of a dataclass of settings (settings/field.py) on the command line."""
    for name, default, described in settings_of(options):
        kind: Any = Literal[tuple(described.choices)] if described.choices else type(default)
        sentences = "".join(f" {choice}: {text}." for choice, text in described.choices.items())
        help_text = tyro.conf.arg(help=f"{described.description}.{sentences}")
        options.__annotations__[name] = Annotated[kind, help_text]


describe_options(TrainSettings)


@dataclass(frozen=True)
class Inspect:
    """Say what a COLMAP scene holds: photographs, registered share, points, ranges, warnings."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photographs and a COLMAP model."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..scene.colmap import load_scene
        from ..scene.inspect import describe, inspect_scene

        summary = inspect_scene(load_scene(self.scene))
        show(summary, self.json, describe(summary))
        return 0


@dataclass(frozen=True)
class Sfm:
    """Find the cameras of photographs or of a video with COLMAP, and make a scene of them."""

    photos: tyro.conf.Positional[Path]
    """Folder of photographs, or a video."""
    out: Path
    """Folder of the scene to make; must not exist or be empty."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..scene.sfm import reconstruct
        from .progress import stage_progress

        with stage_progress() as progress:
            summary = reconstruct(self.photos, self.out, progress)
        text = (
            f"{summary['registered']} of {summary['images']} photographs registered, {summary['points']} points, "
            f"reprojection error {summary['reprojection_error']:.2f} px.\nScene: {self.out}"
        )
        show(summary, self.json, text)
        return 0


@dataclass(frozen=True)
class Plan:
    """Say which effects a scene calls for, why, and what each costs; writes plan.json, which training goes by."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photographs and a COLMAP model."""
    out: Path | None = None
    """Folder for plan.json; the scene's own without it."""
    effects: str = ""
    """Effects that you decide yourself, as in attenuation=off,lamp=on."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..planning.plan import describe, plan_and_keep

        plan, written = plan_and_keep(self.scene, self.out, self.effects)
        show(plan.to_json(), self.json, f"{describe(plan)}\n\n{written}")
        return 0


@dataclass(frozen=True)
class Forecast:
    """Say how long each preset will take here and how good it will be, from a first look of some seconds."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photographs and a COLMAP model."""
    settings: tyro.conf.OmitArgPrefixes[TrainSettings] = field(default_factory=TrainSettings)
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.forecast import describe, forecast_scene
        from .progress import stage_progress

        with stage_progress() as progress:
            forecast = forecast_scene(self.scene, self.settings, progress)
        show(forecast, self.json, describe(forecast))
        return 0


@dataclass(frozen=True)
class Train:
    """Train a scene; the run folder holds result.ply, result.glb, metrics and checkpoints."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photographs and a COLMAP model."""
    out: Path
    """Folder of the run."""
    settings: tyro.conf.OmitArgPrefixes[TrainSettings] = field(default_factory=TrainSettings)
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Go on with the run in --out where it stopped."""
    weights_dir: Path | None = None
    """Folder of pretrained networks, for depth priors and interpolated frames; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.train_and_report import train_and_report
        from .progress import training_progress

        with interrupts.deferred(STOPPING), training_progress() as on_event:
            result = train_and_report(
                self.scene, self.out, self.settings, self.resume, on_event, interrupts.should_stop,
                weights_dir=self.weights_dir, started=STARTED,
            )  # fmt: skip
        metrics = result["metrics"]
        quality = (
            f"Held-out views: PSNR {metrics['test_psnr']:.2f} dB, SSIM {metrics['test_ssim']:.3f} "
            f"(median training image: {metrics['control_psnr']:.2f} dB)."
        )
        text = (
            f"{'Interrupted' if result['interrupted'] else 'Done'} after {metrics['iteration']} iterations, "
            f"{metrics['seconds'] / 60:.1f} minutes, {metrics['gaussians']} Gaussians.\n"
            f"{quality if metrics['views'] else 'Too few photographs to hold any out for a figure.'}\n"
            f"{metrics['water'] or 'The water is left in the colours.'}\n"
            f"{''.join(trial['sentence'] + chr(10) for trial in metrics['trials'])}"
            f"{''.join(note + chr(10) for note in metrics['notes'])}"
            f"Result: {result['ply']}"
            f"{chr(10) + 'Report: ' + result['report'] if result['report'] else ''}"
        )
        show(result, self.json, text)
        return interrupts.exit_code if result["interrupted"] else 0


@dataclass(frozen=True)
class Evaluate:
    """Score the result of a run on its held-out views; writes evaluation.json and evaluation.html to the run."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    weights_dir: Path | None = None
    """Folder of lpips-alex.safetensors and lpips-vgg.safetensors; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.evaluate_run import describe, evaluate_run

        evaluation = evaluate_run(self.run_folder, self.weights_dir)
        show(evaluation, self.json, describe(evaluation))
        return 0


@dataclass(frozen=True)
class Report:
    """Write report.html to a run: quality against time, where the time went, held-out views, how to repeat it."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.report import write_report

        path = str(write_report(self.run_folder))
        show({"report": path}, self.json, path)
        return 0


@dataclass(frozen=True)
class Ablate:
    """Train every method, and ours with each part switched, over several seeds, and print what each is worth.

    Started again, it goes on where it stopped.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photographs and a COLMAP model."""
    out: Path
    """Folder of the runs and of the table, ablation.md and ablation.json."""
    seeds: int = 3
    """Runs of each row."""
    iterations: int = 1500
    """Number of optimisation steps of each run."""
    width: int = 320
    """Width in pixels that the photographs are trained at."""
    max_gaussians: int = 30_000
    """Most Gaussians that the scene may grow to."""
    weights_dir: Path | None = None
    """Folder of pretrained networks; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.ablate import ablate, table

        settings = TrainSettings(iterations=self.iterations, width=self.width, max_gaussians=self.max_gaussians)

        def print_run(name: str, seed: int, figures: dict[str, Any]) -> None:
            quality = "not a number" if figures["test_psnr"] is None else f"{figures['test_psnr']:.2f} dB"
            print(f"{name}, seed {seed}: test PSNR {quality}, {figures['seconds']:.0f} s", file=sys.stderr, flush=True)

        with interrupts.deferred(STOPPING):
            document = ablate(
                self.scene, self.out, self.seeds, settings, self.weights_dir, print_run, interrupts.should_stop
            )
        show(document, self.json, table(document))
        return interrupts.exit_code if document["interrupted"] else 0


@dataclass(frozen=True)
class Tradeoff:
    """Train presets x sizes x effects, score all at one width, and draw which of them no other beats.

    Writes tradeoff.png, .csv, .html and .json. Started again, it goes on where it stopped.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photographs and a COLMAP model."""
    out: Path
    """Folder of the runs and of the charts."""
    grid: tyro.conf.OmitArgPrefixes[Grid] = field(default_factory=Grid)
    score_width: int = 0
    """Width in pixels that all runs are scored at; 0: the widest that is trained at."""
    weights_dir: Path | None = None
    """Folder of lpips-alex.safetensors and other pretrained networks; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.tradeoff import describe, tradeoff

        def print_run(name: str, row: dict[str, Any]) -> None:
            print(f"{name}: {row['seconds']:.0f} s, PSNR {row['psnr']:.2f} dB", file=sys.stderr, flush=True)

        with interrupts.deferred(STOPPING):
            document = tradeoff(
                self.scene, self.out, self.grid, self.score_width, self.weights_dir, print_run, interrupts.should_stop
            )
        text = (
            f"{describe(document)}\nPage: {self.out / 'tradeoff.html'}"
            if document["rows"]
            else "Nothing has ended yet."
        )
        show(document, self.json, text)
        return interrupts.exit_code if document["interrupted"] else 0


@dataclass(frozen=True)
class Render:
    """Render the views of a run to PNG files."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    out: Path
    """Folder for the pictures."""
    camera: str | None = None
    """Name of one photograph; all held-out views without it."""
    water: float = 1.0
    """How much water to show, from 0 (taken away) to 1 (as photographed)."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.evaluate_run import render_run

        files = [str(path) for path in render_run(self.run_folder, self.out, self.camera, self.water)]
        show({"files": files}, self.json, "\n".join(files))
        return 0


@dataclass(frozen=True)
class Export:
    """Write the result of a run to a file that other programs read."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    format: FormatName
    """Format of the file."""
    out: Path
    """File to write."""
    options: tyro.conf.OmitArgPrefixes[ExportOptions] = field(default_factory=ExportOptions)
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        result = export_run(self.run_folder, self.format, self.out, self.options)
        show(result, self.json, describe_export(result))
        return 0


@dataclass(frozen=True)
class Label:
    """Give every Gaussian of a run a label: by words, by mask images, or by what stands out."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    words: tuple[str, ...] = ()
    """What to look for, as in --words coral wreck "open water"; needs networks (see --weights-dir)."""
    masks: Path | None = None
    """Folder of mask images, one folder a label: MASKS/coral/NAME.png."""
    provider: Literal["auto", "masks", "grounded-sam", "saliency"] = "auto"
    """Whose regions: masks where a folder is given, grounded-sam where there are words, else masks again where the
    scene has some in its folder labels, else saliency."""
    features: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the 32 numbers of each Gaussian's feature into the splat files too."""
    weights_dir: Path | None = None
    """Folder of pretrained networks; the user's cache folder without it."""
    download: tyro.conf.FlagCreatePairsOff[bool] = False
    """Fetch networks that are not on this machine from their authors."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.label_run import describe, label_run
        from .progress import stage_progress

        provider = None if self.provider == "auto" else self.provider
        with stage_progress() as progress:
            document = label_run(
                self.run_folder,
                self.words,
                self.masks,
                provider,
                self.weights_dir,
                self.download,
                self.features,
                progress,
            )
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Search:
    """Say how near the Gaussians of a labelled run are to words; --out writes the number of each."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    words: tyro.conf.Positional[str]
    """What to look for."""
    out: Path | None = None
    """File (.npy) for the similarity of each Gaussian, -1 to 1, in the order of result.ply."""
    weights_dir: Path | None = None
    """Folder of pretrained networks; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.label_run import search_run, write_similarity

        similarity, names = search_run(self.run_folder, self.words, self.weights_dir)
        if self.out:
            write_similarity(self.out, similarity)
        alike = int((similarity > 0.5).sum())
        text = f"{alike} of {len(similarity)} Gaussians are more than half alike."
        text += f"\nLabels of that name: {', '.join(names)}." if names else ""
        text += f"\n{self.out}" if self.out else ""
        show(
            {"gaussians": len(similarity), "alike": alike, "labels": names, "out": self.out and str(self.out)},
            self.json,
            text,
        )
        return 0


@dataclass(frozen=True)
class Extract:
    """Write the Gaussians of one label of a run to a file of their own."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    label: str
    """Name or number of the label."""
    out: Path
    """File to write; its ending says the format, as .ply does."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..experiments.label_run import extract_run

        count = extract_run(self.run_folder, self.label, self.out)
        show({"out": str(self.out), "gaussians": count}, self.json, f"{count} Gaussians: {self.out}")
        return 0


@dataclass(frozen=True)
class Batch:
    """Run one command for every scene, or every run, in a folder; one that fails stops no other. Ends with a table.

    All further options are the command's own: batch train SCENES --out RUNS --preset draft
    """

    command: tyro.conf.Positional[Literal["inspect", "plan", "train", "evaluate", "render", "label", "export"]]
    """What to run."""
    folder: tyro.conf.Positional[Path]
    """Folder whose folders are scenes (inspect, plan, train) or runs (the others)."""
    out: Path | None = None
    """Folder in which each gets a folder, or a file where that is exported, of its own name."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self, options: Sequence[str] = ()) -> int:
        from .batch import batch, describe

        with interrupts.deferred(STOPPING):
            document = batch(self.command, self.folder, self.out, options, interrupts)
        show(document, self.json, describe(document))
        return document["exit_code"]


@dataclass(frozen=True)
class Doctor:
    """Say what this machine has, which backend a run would take, and why not another."""

    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        from ..kernels.machine import examine
        from .doctor import describe

        found = examine()
        show(found, self.json, describe(found))
        return 0


COMMANDS = (
    Inspect, Sfm, Plan, Forecast, Train, Evaluate, Report, Ablate, Tradeoff, Render, Label, Search, Extract, Export,
    Batch, Doctor,
)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Words of the command line; those of the process without it.

    Returns:
        The exit code.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    named = [Annotated[command, tyro.conf.subcommand(name=command.__name__.lower())] for command in COMMANDS]
    union: Any = functools.reduce(operator.or_, named)
    interrupts.install()
    try:
        # Blender's own command line has the same words behind other ones.
        prog = os.environ.get("SWAG_PROG", "python -m swag_engine")
        parse = functools.partial(tyro.cli, union, prog=prog, description=DESCRIPTION, args=arguments)
        if arguments[:1] == ["batch"]:
            command, options = parse(return_unknown_args=True)
            return command.run(options)
        return parse().run()
    except InputError as error:
        return refuse(str(error), arguments)
    except (MemoryError, RuntimeError) as error:
        from ..training.pacing.memory import TOO_LITTLE, is_shortage

        if not is_shortage(error):
            raise
        return refuse(TOO_LITTLE, arguments)
    except ModuleNotFoundError as error:
        return refuse_missing(error, arguments)
    except SystemExit as usage:  # tyro has said what is wrong
        if usage.code and "--json" in arguments:
            return refuse("The command line is not valid; the lines before this one say why.", arguments)
        raise
    except KeyboardInterrupt:
        return refuse("Interrupted.", arguments, interrupts.exit_code, interrupted=True)


if __name__ == "__main__":
    sys.exit(main())
