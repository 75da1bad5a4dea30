"""The command line: `swag COMMAND ...`."""

import difflib
import functools
import operator
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro

from ..base import threads  # noqa: F401
from ..base.errors import InputError, program
from ..base.files import require_parent
from ..experiments.grid import Grid
from ..formats.export import ExportOptions, export_run
from ..formats.export import describe as describe_export
from ..formats.registry import FORMATS, FormatName
from ..georeference.families import FAMILIES
from ..georeference.papers import PAPERS
from ..kernels.machine import engine_version
from ..settings.field import settings_of
from ..settings.settings import TrainSettings
from .answers import BROKEN_PIPE, print_answer, refuse, refuse_missing, show
from .interrupts import interrupts
from .survey import Step, Survey

DESCRIPTION = """Underwater photos to 3D Gaussian splats. COMMAND --help says what a command takes.
--version prints the version.

Exit codes: 0 done, 1 a bug, 2 bad input or usage; with what exists kept, 130 interrupted by Ctrl-C and 143 by SIGTERM;
141 the reader of the output has ended.
Progress and errors go to stderr; with --json stdout carries one JSON document and nothing else."""
START = """Underwater photos to 3D Gaussian splats.

  {0} sfm PHOTOS --out SCENE                  find the cameras of photos or of a video
  {0} train SCENE --out RUN --preset draft    train; the folder of the run has the result and a report
  {0} restore RUN --out PICTURES              write the photos without water

{0} --help lists all commands."""
STOPPING = "Stopping after this iteration; press Ctrl-C again to stop at once."
STOPPING_TRAINING = "Stopping after this iteration; press Ctrl-C again to skip the evaluation."
STARTED = time.monotonic()
"""Time that a time budget counts from: loading Python and its packages belongs to the run."""


def describe_options(options: type) -> None:
    """Show the help and the choices of a dataclass of settings (settings/field.py) on the command line."""
    for name, _, described in settings_of(options):
        kind: Any = options.__annotations__[name]
        if described.choices:
            one: Any = Literal[tuple(described.choices)]
            kind = tuple[one, ...] if get_origin(kind) is tuple else one
        sentences = "".join(f" {choice}: {text}." for choice, text in described.choices.items())
        help_text = tyro.conf.arg(help=f"{described.description}.{sentences}")
        options.__annotations__[name] = Annotated[kind, help_text]


for described_options in (TrainSettings, ExportOptions, Grid):
    describe_options(described_options)


@dataclass(frozen=True)
class Inspect:
    """Print what a COLMAP scene contains: photos with a camera, points, ranges, and warnings."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    page: Path | None = None
    """HTML file to write too: the path of the cameras, the points that photos share, and the doubtful places."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..scene.camera_page import write_camera_page
        from ..scene.colmap import load_scene
        from ..scene.inspect import describe, inspect_scene

        scene = load_scene(self.scene)
        summary = inspect_scene(scene)
        if self.page:
            write_camera_page(scene, self.page)
        show(summary, self.json, describe(summary))
        return 0


def _show_new_scene(folder: Path, made: dict[str, Any], first_lines: Sequence[str], as_json: bool) -> None:
    """Print what a command did to make a scene, and what the scene contains; each warning is printed once."""
    from ..scene.colmap import load_scene
    from ..scene.inspect import describe, inspect_scene

    found = inspect_scene(load_scene(folder))
    document = made | found | {"warnings": list(dict.fromkeys(made["warnings"] + found["warnings"]))}
    show(document, as_json, "\n".join([*first_lines, describe(document)]))


@dataclass(frozen=True)
class Sfm:
    """Find the cameras of photos or of a video with COLMAP, and make a scene."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos, or a video."""
    out: Path
    """Folder of the new scene; it must not exist or be empty."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..sfm.reconstruct import reconstruct
        from .progress import stage_progress

        with stage_progress() as progress:
            made = reconstruct(self.photos, self.out, progress)
        _show_new_scene(self.out, made, made["notes"], self.json)
        return 0


@dataclass(frozen=True)
class Scale:
    """Measure metres per unit, axes and coordinates of a scene from targets, points, GPS or depths; write scale.json.

    Nothing is trained again: training, export and Blender apply what was measured.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    targets: Literal[tuple(FAMILIES)] | None = None  # type: ignore[valid-type]
    """Family of coded targets to look for in the photos."""
    size: float | None = None
    """Edge length of the targets with their black border, in metres."""
    distance: tuple[str, ...] = ()
    """Distances between the middles of two targets in metres, as in --distance 3,7=0.5 7,9=1.25."""
    points: Path | None = None
    """CSV table of reference points with the columns name,x,y,z, and photo,u,v where a point is seen (pixels). Without
    these, a name is the number of a target, or a photo whose position is known."""
    gps: tyro.conf.FlagCreatePairsOff[bool] = False
    """Use the GPS positions in the EXIF data of the photos."""
    depths: Path | None = None
    """CSV table with the columns name,depth: metres below the surface for each photo."""
    crs: str | None = None
    """Coordinate reference system of the reference points, such as EPSG:32633; kept in exported files."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..georeference.measure import Measurements, describe, scale_scene
        from .progress import stage_progress

        known = Measurements(self.targets, self.size, self.distance, self.points, self.gps, self.depths, self.crs)
        with stage_progress() as progress:
            document = scale_scene(self.scene, known, progress)
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Targets:
    """Write a PDF of coded targets to print at true size; `scale` finds them in the photos."""

    out: Path
    """The PDF."""
    family: Literal[tuple(FAMILIES)] = "aruco_4x4_50"  # type: ignore[valid-type]
    """Family of the targets."""
    size: float = 0.15
    """Edge length of a target with its black border, in metres."""
    count: int = 6
    """Number of targets."""
    first: int = 0
    """Number of the first target."""
    paper: Literal[tuple(PAPERS)] = "a4"  # type: ignore[valid-type]
    """Size of the paper."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..georeference.sheet import Sheet, describe, write_sheet

        document = write_sheet(self.out, Sheet(self.family, self.size, self.count, self.first, self.paper))
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class ImportCameras:
    """Make a scene of cameras that another program has found: Metashape, RealityScan, nerfstudio and others."""

    file: tyro.conf.Positional[Path]
    """File of the cameras; its format is recognised by its content."""
    out: Path
    """Folder of the new scene; it must not exist or be empty."""
    photos: Path | None = None
    """Folder of the photos. Default: the folder of the camera file."""
    points: Path | None = None
    """PLY file of points in the coordinates of the cameras; without it the points of the file, or of the photos."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..camera_files.import_cameras import import_cameras
        from .progress import stage_progress

        with stage_progress() as progress:
            made = import_cameras(self.file, self.out, self.photos, self.points, progress)
        source = f"{'From:':<13}{made['program']}, {made['registered']} of {made['images']} cameras"
        _show_new_scene(self.out, made, [source], self.json)
        return 0


@dataclass(frozen=True)
class Plan:
    """Decide which effects a scene has, with reasons and costs; write plan.json, which training follows."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    out: Path | None = None
    """Folder for plan.json; the folder of the scene without it."""
    effects: str = ""
    """Effects that you switch yourself, as in attenuation=off,lamp=on."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..planning.plan import describe, plan_and_keep

        plan, written = plan_and_keep(self.scene, self.out, self.effects)
        show(plan.to_json(), self.json, f"{describe(plan)}\n\n{written}")
        return 0


@dataclass(frozen=True)
class Forecast:
    """Predict how long each preset takes on this machine and how good it is, from two short probe runs."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    settings: tyro.conf.OmitArgPrefixes[TrainSettings] = field(default_factory=TrainSettings)
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.forecast import describe, forecast_scene
        from .progress import stage_progress

        with stage_progress() as progress:
            forecast = forecast_scene(self.scene, self.settings, progress)
        show(forecast, self.json, describe(forecast))
        return 0


@dataclass(frozen=True)
class Train:
    """Train a scene; the folder of the run gets result.ply, result.glb, metrics, a report and checkpoints."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    out: Path
    """Folder of the run."""
    settings: tyro.conf.OmitArgPrefixes[TrainSettings] = field(default_factory=TrainSettings)
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in --out where it stopped."""
    weights_dir: Path | None = None
    """Folder of pretrained networks, for depth priors and interpolated frames; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.forecast import time_text
        from ..experiments.train_and_report import train_and_report
        from ..training.trainer import EVALUATION_STOPPED
        from .progress import training_progress

        with interrupts.deferred(STOPPING_TRAINING), training_progress() as on_event:
            result = train_and_report(
                self.scene, self.out, self.settings, self.resume, on_event, interrupts.should_stop,
                weights_dir=self.weights_dir, started=STARTED, should_stop_now=interrupts.should_stop_now,
            )  # fmt: skip
        metrics = result["metrics"]
        quality = "No test views: the scene has too few photos to keep some out of training, or masks cover them."
        if metrics["evaluation_stopped"]:
            quality = EVALUATION_STOPPED
        elif metrics["views"]:
            quality = (
                f"Test views: PSNR {metrics['test_psnr']:.2f} dB, SSIM {metrics['test_ssim']:.3f} "
                f"(median-image baseline: {metrics['control_psnr']:.2f} dB)."
            )
        lines = [
            f"{'Interrupted' if result['interrupted'] else 'Done'} after {metrics['iteration']} iterations, "
            f"{time_text(metrics['seconds'])}, {metrics['gaussians']} Gaussians.",
            quality,
            metrics["water"] or "No water was modelled: the colors are as photographed.",
            *(trial["sentence"] for trial in metrics["trials"]),
            *metrics["notes"],
            f"Result: {result['ply']}",
            *([f"Report: {result['report']}"] if result["report"] else []),
        ]
        show(result, self.json, "\n".join(lines))
        return interrupts.exit_code if result["interrupted"] else 0


@dataclass(frozen=True)
class Evaluate:
    """Score the result of a run on its test views; write evaluation.json and evaluation.html to its folder."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    weights_dir: Path | None = None
    """Folder of lpips-alex.safetensors and lpips-vgg.safetensors; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.evaluate_run import describe, evaluate_run

        evaluation = evaluate_run(self.run_folder, self.weights_dir)
        show(evaluation, self.json, describe(evaluation))
        return 0


@dataclass(frozen=True)
class Report:
    """Write report.html to a run: quality against time, time by part, test views, effects, settings."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.report import write_report

        path = str(write_report(self.run_folder))
        show({"report": path}, self.json, path)
        return 0


@dataclass(frozen=True)
class Chart:
    """Find a color chart in the photos, and fit white balance, exposure and a color matrix to its known colors.

    For a run, the chart without water is corrected, its attenuation is compared with the run's, and chart.json is
    written to the run.
    """

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FOLDER")]]
    """Folder of a run or of a scene."""
    chart: Literal["24", "140"] = "24"
    """Number of the chart's patches."""
    corners: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Outer corners of the corner patches in a photo where the chart is not found, in pixels, going around the chart:
    PHOTO:x,y,x,y,x,y,x,y. May be given several times."""
    out: Path | None = None
    """File (.json) for the result, instead of the run's chart.json."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.color_chart import describe, measure_chart
        from .progress import stage_progress

        with stage_progress() as progress:
            document = measure_chart(self.folder, self.chart, self.corners, self.out, progress)
        show(document, self.json, describe(document))
        return 0


@dataclass(frozen=True)
class Ablate:
    """Train every recipe, and the default one with each effect switched, over several seeds; print their metrics.

    Started again, it continues where it stopped.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    out: Path
    """Folder of the runs and of the table, ablation.md and ablation.json."""
    seeds: int = 3
    """Number of runs of each row."""
    iterations: int = 1500
    """Number of optimisation steps of each run."""
    width: int = 320
    """Width in pixels of the training images."""
    max_gaussians: int = 30_000
    """Largest number of Gaussians."""
    weights_dir: Path | None = None
    """Folder of pretrained networks; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.ablate import ablate, format_table

        settings = TrainSettings(iterations=self.iterations, width=self.width, max_gaussians=self.max_gaussians)

        def print_run(name: str, seed: int, figures: dict[str, Any]) -> None:
            quality = "unknown" if figures["test_psnr"] is None else f"{figures['test_psnr']:.2f} dB"
            print(f"{name}, seed {seed}: test PSNR {quality}, {figures['seconds']:.0f} s", file=sys.stderr, flush=True)

        with interrupts.deferred(STOPPING):
            document = ablate(
                self.scene, self.out, self.seeds, settings, self.weights_dir, print_run, interrupts.should_stop
            )
        show(document, self.json, format_table(document))
        return interrupts.exit_code if document["interrupted"] else 0


@dataclass(frozen=True)
class Tradeoff:
    """Train all combinations of presets, sizes and effects, score them at one width, and draw the Pareto front.

    Writes tradeoff.png, .csv, .html and .json. Started again, it continues where it stopped.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the scene: photos and a COLMAP model."""
    out: Path
    """Folder of the runs and of the charts."""
    grid: tyro.conf.OmitArgPrefixes[Grid] = field(default_factory=Grid)
    score_width: int = 0
    """Width in pixels at which all runs are scored; 0: the largest training width."""
    weights_dir: Path | None = None
    """Folder of lpips-alex.safetensors and other pretrained networks; the user's cache folder without it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
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
            else "No run is finished yet."
        )
        show(document, self.json, text)
        return interrupts.exit_code if document["interrupted"] else 0


Develop = Annotated[str, tyro.conf.arg(metavar="none|auto|chart|VALUES")]
"""Option of the commands that render."""


@dataclass(frozen=True)
class Render:
    """Render views of a run to PNG files."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    out: Path
    """Folder of the PNG files."""
    camera: str | None = None
    """Name of one photo; all test views without it."""
    water: float = 1.0
    """Amount of water, from 0 (removed) to 1 (as photographed)."""
    haze: float = 0.0
    """Fraction of the haze in open water that is shown, from 0 (none) to 1 (as trained); at least that of the water."""
    develop: Develop = "auto"
    """Development of restored colors. auto: exposure and white point that the run found, which fade as water is shown.
    chart: from a color chart in the photos. none: not at all. Or values at any amount of water, as in
    exposure=0.5,white=1.1/1/0.9,contrast=1.1,knee=0.8."""
    exr: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write linear light without development to half-float OpenEXR files in place of PNG files."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.evaluate_run import render_run

        paths = render_run(self.run_folder, self.out, self.camera, self.water, self.develop, self.exr, self.haze)
        files = [str(path) for path in paths]
        show({"files": files}, self.json, "\n".join(files))
        return 0


@dataclass(frozen=True)
class Restore:
    """Write the photos of a run without water: the colors of the splats, with the details of the photos.

    The photos themselves stay as they are.
    """

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    out: Path
    """Folder of the PNG files."""
    photo: str | None = None
    """Name of one photo; all photos without it."""
    width: int | None = None
    """Width in pixels; that of the photos without it."""
    haze: float = 0.0
    """Fraction of the haze in open water that is shown, from 0 (none) to 1 (as trained)."""
    develop: Develop = "auto"
    """Development of restored colors: auto, chart, none or values, as render has it."""
    exr: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write linear light without development to half-float OpenEXR files in place of PNG files."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.restore_photos import restore_photos
        from .progress import stage_progress

        with stage_progress() as progress:
            paths = restore_photos(
                self.run_folder, self.out, self.photo, self.width, self.develop, self.exr, self.haze, progress
            )  # fmt: skip
        files = [str(path) for path in paths]
        show({"files": files}, self.json, "\n".join(files))
        return 0


@dataclass(frozen=True)
class Haze:
    """Find open water among the splats of a run of an earlier version, as training does at its end."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run, whose result files and checkpoint are written again."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.find_haze import describe, find_haze

        found = find_haze(self.run_folder)
        show(found, self.json, describe(found))
        return 0


@dataclass(frozen=True)
class Film:
    """Render a run along a camera path to an image sequence or a video, with alpha and depth."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    cameras: tyro.conf.Positional[Path]
    """Camera path in the scene's coordinates: a transforms.json, such as cameras.json of Blender's Render Film."""
    out: Path
    """Folder of the PNG files, or a video (.mp4)."""
    water: float = 1.0
    """Amount of water, from 0 (removed) to 1 (as photographed), for frames that name none."""
    haze: float = 0.0
    """Fraction of the haze in open water that is shown, from 0 (none) to 1 (as trained), for frames that name none; at
    least that of the water."""
    alpha: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave the background out: PNG files get an alpha channel, a video gets a second one, NAME_alpha.mp4."""
    depth: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the depth of each frame to an EXR file, in scene units."""
    develop: Develop = "auto"
    """Development of restored colors. auto: exposure and white point that the run found, which fade as water is shown.
    chart: from a color chart in the photos. none: not at all. Or values at any amount of water, as in
    exposure=0.5,white=1.1/1/0.9,contrast=1.1,knee=0.8."""
    exr: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write linear light without development to half-float OpenEXR files in place of PNG files."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Render frames whose files exist; without it they are kept."""
    fps: float = 24.0
    """Frames of a video per second."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.film import FilmOptions, describe, film_run
        from ..formats.camera_path import read_camera_path
        from .progress import progress_display

        frames = read_camera_path(self.cameras)
        options = FilmOptions(self.alpha, self.depth, self.overwrite, self.fps, exr=self.exr)
        stopping = "Stopping after this frame; press Ctrl-C again to stop at once."
        with interrupts.deferred(stopping), progress_display() as display:

            def progress(done: int, total: int) -> None:
                display("film", f"Frame {done} of {total}", done / total)

            result = film_run(
                self.run_folder, self.out, frames, options, self.develop,
                water=self.water, haze=self.haze, progress=progress, should_stop=interrupts.should_stop,
            )  # fmt: skip
        show(result, self.json, describe(result))
        return interrupts.exit_code if result["interrupted"] else 0


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
        """Run the command and return its exit code."""
        if self.out.suffix.lower() != (suffix := FORMATS[self.format].suffix):
            raise InputError(
                f"{self.out} does not end in {suffix}, as files of the format {self.format} do: rename it."
            )
        result = export_run(self.run_folder, self.format, require_parent(self.out), self.options)
        show(result, self.json, describe_export(result))
        return 0


@dataclass(frozen=True)
class Label:
    """Label every Gaussian of a run: by words, by mask images, or by saliency."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    words: tuple[str, ...] = ()
    """What to look for, as in --words coral wreck "open water"; needs networks (see --weights-dir)."""
    masks: Path | None = None
    """Folder of mask images, one folder a label: MASKS/coral/NAME.png."""
    provider: Literal["auto", "masks", "grounded-sam", "saliency"] = "auto"
    """Source of the regions. auto: masks where --masks is given, grounded-sam where --words are given, else the masks
    in the folder labels of the scene where it has one, else saliency."""
    features: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the feature of each Gaussian, 32 numbers, into the splat files, too."""
    weights_dir: Path | None = None
    """Folder of pretrained networks; the user's cache folder without it."""
    download: tyro.conf.FlagCreatePairsOff[bool] = False
    """Download networks that are not on this machine."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
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
    """Compare the Gaussians of a labelled run with words; --out writes the similarity of each."""

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
        """Run the command and return its exit code."""
        from ..experiments.label_run import search_run, write_similarity
        from ..formats.run_folder import RunFolder

        similarity, labels = search_run(self.run_folder, self.words, self.weights_dir)
        if self.out:
            RunFolder(self.run_folder).refuse_own(self.out)
            write_similarity(self.out, similarity)
        alike = int((similarity > 0.5).sum())
        text = f"{alike} of {len(similarity)} Gaussians have a similarity above 0.5."
        text += f"\nLabels with that name: {', '.join(labels)}." if labels else ""
        text += f"\n{self.out}" if self.out else ""
        show(
            {"gaussians": len(similarity), "alike": alike, "labels": labels, "out": self.out and str(self.out)},
            self.json,
            text,
        )
        return 0


@dataclass(frozen=True)
class Extract:
    """Write the Gaussians of one label of a run to a file."""

    run_folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    label: str
    """Name or number of the label."""
    out: Path
    """File to write; its suffix, such as .ply, gives the format."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..experiments.label_run import extract_run

        count = extract_run(self.run_folder, self.label, require_parent(self.out))
        show({"out": str(self.out), "gaussians": count}, self.json, f"{count} Gaussians: {self.out}")
        return 0


Source = Annotated[Path, tyro.conf.arg(metavar="RUN|PLY")]
"""What maps are made of."""
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Ortho:
    """Write the orthomosaic of a run or of a splat PLY as a Cloud Optimized GeoTIFF, with a PNG preview.

    Lengths are in metres where the command scale measured the scene, else in its units. Needs the extra science.
    """

    source: tyro.conf.Positional[Source]
    """Folder of the run, or a PLY file."""
    out: Path
    """The GeoTIFF."""
    pixel: float = 0.0
    """Edge of a pixel in metres, or in units where the scale is not known; 0 for the size of the splats."""
    box: Box | None = None
    """Left, bottom, right and top edge of the map; from the splats without it."""
    plane: str = "up"
    """Where the map is seen from. up: straight above. fit: perpendicular to the plane that fits the splats, as for a
    wall. Or a direction in the scene's coordinates, as in 0,0,1."""
    water: float = 0.0
    """Amount of water, from 0 (restored) to 1 (as photographed)."""
    develop: Develop = "auto"
    """Development of restored colors: auto, chart, none or values, as render has it."""
    taglab: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write what TagLab opens: RGB without alpha, at most 32767 pixels a side, and a text file with the pixel size."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..products.ortho import describe, make_ortho
        from .progress import stage_progress

        options = self.plane, self.water, self.develop, self.taglab
        with stage_progress() as progress:
            result = make_ortho(self.source, self.out, self.pixel, self.box, *options, progress=progress)
        show(result, self.json, describe(result))
        return 0


@dataclass(frozen=True)
class Dem:
    """Write the heights of a run or of a splat PLY as a GeoTIFF: first surface (band 1) and median height (band 2).

    Pixels in which nothing was seen have no data. Needs the extra science.
    """

    source: tyro.conf.Positional[Source]
    """Folder of the run, or a PLY file."""
    out: Path
    """The GeoTIFF."""
    pixel: float = 0.0
    """Edge of a pixel in metres, or in units where the scale is not known; 0 for the size of the splats."""
    box: Box | None = None
    """Left, bottom, right and top edge of the map; from the splats without it."""
    plane: str = "up"
    """Where the map is seen from, as ortho has it."""
    derived: tuple[Literal["hillshade", "slope", "rugosity"], ...] = ()
    """Further maps, which are made from the first surface: NAME_hillshade.tif, NAME_slope.tif (degrees) and
    NAME_rugosity.tif (surface over planar area)."""
    window: float = 1.0
    """Edge of the windows over which rugosity is taken, in metres or units."""
    above: float | None = None
    """Height of a horizontal plane, in the heights of the map: the volume of what lies above it is measured."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..products.dem import describe, make_dem
        from .progress import stage_progress

        options = self.plane, self.derived, self.window, self.above
        with stage_progress() as progress:
            result = make_dem(self.source, self.out, self.pixel, self.box, *options, progress=progress)
        show(result, self.json, describe(result))
        return 0


@dataclass(frozen=True)
class Areas:
    """Write the label map of a labelled run, the areas of its labels with errors, and its patches, to a folder.

    Files: labels.tif (palette), heights.tif, areas.csv, patches.geojson, patches_coco.json. Needs the extra science.
    """

    source: tyro.conf.Positional[Source]
    """Folder of the run, or a PLY file with labels."""
    out: Path
    """Folder of the files."""
    pixel: float = 0.0
    """Edge of a pixel in metres, or in units where the scale is not known; 0 for the size of the splats."""
    box: Box | None = None
    """Left, bottom, right and top edge of the map; from the splats without it."""
    plane: str = "up"
    """Where the map is seen from, as ortho has it."""
    masks: Path | None = None
    """Folder of mask images of test photos, as label takes it, from which errors are found; the folder labels of the
    scene without it."""
    least_patch: int = 10
    """Smallest number of pixels of a patch."""
    corrected: Path | None = None
    """Corrected copy of labels.tif in the folder --out: its labels go to the splats of the run, and all files are made
    again with the same pixels."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..products.areas import describe, make_areas
        from .progress import stage_progress

        options = self.plane, self.masks, self.least_patch, self.corrected
        with stage_progress() as progress:
            result = make_areas(self.source, self.out, self.pixel, self.box, *options, progress=progress)
        show(result, self.json, describe(result))
        return 0


@dataclass(frozen=True)
class Profile:
    """Write the heights of a run or of a splat PLY along a straight line to a CSV table, and a picture of them.

    Needs the extra science.
    """

    source: tyro.conf.Positional[Source]
    """Folder of the run, or a PLY file."""
    line: Box
    """x and y of the first and of the last point, in the map without the offset of its coordinate system."""
    out: Path
    """The CSV file; the picture is NAME.png."""
    pixel: float = 0.0
    """Distance between heights in metres or units; 0 for the size of the splats."""
    plane: str = "up"
    """Where heights are seen from, as ortho has it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..products.profile import describe, make_profile
        from .progress import stage_progress

        with stage_progress() as progress:
            result = make_profile(self.source, self.line, self.out, self.pixel, self.plane, progress=progress)
        show(result, self.json, describe(result))
        return 0


@dataclass(frozen=True)
class Change:
    """Compare two runs of one place: align them by what did not change, map the differences, and list changed objects.

    Files: change.tif, changed.tif (palette), changes.csv, label_change.csv, change.html. Needs the extra science.
    """

    earlier: tyro.conf.Positional[Source]
    """Folder of the earlier run, or a PLY file."""
    later: tyro.conf.Positional[Source]
    """Folder of the later run, or a PLY file."""
    out: Path
    """Folder of the files."""
    pixel: float = 0.0
    """Edge of a pixel in metres, or in units where the scale is not known; 0 for the size of the splats."""
    box: Box | None = None
    """Left, bottom, right and top edge in the map of the earlier run; from the splats without it."""
    plane: str = "up"
    """Where the maps are seen from, as ortho has it."""
    scale: Literal["fixed", "free"] = "fixed"
    """fixed: both scales were measured. free: the alignment finds the scale of the later run."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..products.change import describe, make_change
        from .progress import stage_progress

        options = self.plane, self.scale
        with stage_progress() as progress:
            result = make_change(self.earlier, self.later, self.out, self.pixel, self.box, *options, progress=progress)
        show(result, self.json, describe(result))
        return 0


@dataclass(frozen=True)
class Batch:
    """Run one command for every scene, or every run, in a folder, and print a table. A failure does not stop the rest.

    All further options are those of the command: batch train SCENES --out RUNS --preset draft
    """

    command: tyro.conf.Positional[Literal["inspect", "plan", "train", "evaluate", "render", "label", "export"]]
    """The command."""
    folder: tyro.conf.Positional[Path]
    """Folder whose folders are scenes (inspect, plan, train) or runs (the others)."""
    out: Path | None = None
    """Folder in which each scene or run gets a folder of its name, for export a file."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self, options: Sequence[str] = ()) -> int:
        """Run the command with its options for each folder and return the exit code."""
        from .batch import batch, describe

        with interrupts.deferred(STOPPING):
            document = batch(self.command, self.folder, self.out, options, interrupts)
        show(document, self.json, describe(document))
        return document["exit_code"]


@dataclass(frozen=True)
class Doctor:
    """Print what this machine has, which backend training would use, and why others cannot run."""

    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """One JSON document on stdout instead of text."""

    def run(self) -> int:
        """Run the command and return its exit code."""
        from ..kernels.machine import examine
        from .doctor import describe

        found = examine()
        show(found, self.json, describe(found))
        return 0


COMMANDS = (
    Inspect, Sfm, ImportCameras, Scale, Targets, Plan, Forecast, Train, Evaluate, Report, Chart, Ablate, Tradeoff,
    Render, Restore, Haze, Film, Label, Search, Extract, Export, Ortho, Dem, Areas,
    Profile, Change, Survey, Batch, Doctor,
)  # fmt: skip


def command_name(command: type) -> str:
    """Return the word that calls a command: import-cameras for ImportCameras."""
    return re.sub("(?<=[a-z])(?=[A-Z])", "-", command.__name__).lower()


def _suggest(arguments: Sequence[str]) -> None:
    """Raise InputError for a word that is no command, with the command that is spelled most like it."""
    known, words = [command_name(command) for command in COMMANDS], arguments
    if words[0] == "survey":
        known, words = [command_name(step) for step in get_args(Step)], words[1:]
    elif words[0] == "batch":
        known, words = list(get_args(get_args(Batch.__annotations__["command"])[0])), words[1:]
    if words and not words[0].startswith("-") and words[0] not in known:
        close = difflib.get_close_matches(words[0].lower(), known, 1)
        guess = f" Did you mean {close[0]}?" if close else ""
        before = " ".join([program(), *arguments[: len(arguments) - len(words)]])
        how = f"{before} --help lists the commands, and {before} COMMAND --help says what one takes."
        raise InputError(f"{before} has no command {words[0]}.{guess} {how}")


def _parsed(parse: Callable[[], Any]) -> Any:
    """Return what tyro makes of the command line; what it prints before it exits is written as an answer."""
    try:
        return parse()
    except SystemExit as done:
        if not done.code:
            print_answer()
        raise
    except OSError:
        print_answer()
        raise


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Words of the command line. Default: sys.argv.

    Returns:
        The exit code.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    os.environ["SWAG_PROG"] = program()  # for commands that start others
    named = [Annotated[command, tyro.conf.subcommand(name=command_name(command))] for command in COMMANDS]
    union: Any = functools.reduce(operator.or_, named)
    interrupts.install()
    try:
        if arguments in ([], ["--version"]):
            print_answer(f"swag {engine_version()}" if arguments else START.format(program()), end="\n")
            return 0
        for name in (*arguments, os.path.abspath(".")):
            if re.search("[\ud800-\udfff]", name):
                raise InputError(f"{name} is not in UTF-8: rename the folder or the file.")
        _suggest(arguments)
        parse = functools.partial(tyro.cli, union, prog=program(), description=DESCRIPTION, args=arguments)
        if arguments[:1] == ["batch"]:
            command, options = _parsed(functools.partial(parse, return_unknown_args=True))
            return command.run(options)
        return _parsed(parse).run()
    except InputError as error:
        return refuse(str(error), arguments)
    except (MemoryError, RuntimeError) as error:
        from ..training.pacing.memory import TOO_LITTLE, is_shortage

        if not is_shortage(error):
            raise
        return refuse(TOO_LITTLE, arguments)
    except ModuleNotFoundError as error:
        return refuse_missing(error, arguments)
    except BrokenPipeError:
        return BROKEN_PIPE
    except SystemExit as usage:  # tyro has printed what is wrong
        if usage.code and "--json" in arguments:
            return refuse("The command line is not valid; the lines before this one say why.", arguments)
        raise
    except KeyboardInterrupt:
        return refuse("Interrupted.", arguments, interrupts.exit_code, interrupted=True)


if __name__ == "__main__":
    sys.exit(main())
