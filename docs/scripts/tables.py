"""Write the tables of the documentation from the figures in benchmarks/results.

Run: `python docs/scripts/tables.py [--check]`

A page holds a table between the lines `<!-- table: NAME -->` and `<!-- end -->`, NAME being a function below. With
--check nothing is written: stale pages are named, and the exit code is 1.
"""

import itertools
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, mean, median
from textwrap import fill
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from generated import ROOT, filled, names_in, pages, update

TABLES: dict[str, Callable[[], str]] = {}
"""Name -> function that makes the table."""
SCENES = {
    "demo": "demo (rendered)",
    "japanese_gardens": "japanese_gardens (rendered by a NeRF)",
    "aqualoc_amphorae": "aqualoc_amphorae (photos)",
}
"""Scenes of the benchmarks, and what they are called in tables."""
STATES = {"unknown": "undetermined"}
"""States of a decision that are stored under another name than the text uses."""


def table(make: Callable[[], str]) -> Callable[[], str]:
    """Register a function under its name."""
    TABLES[make.__name__] = make
    return make


NOT_MEASURED = "*Not measured yet.*"
"""Text in place of a table whose benchmark has not been run."""


def results(name: str) -> Any:
    """Return the contents of benchmarks/results/NAME.json."""
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text("utf-8"))


def markdown(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def mean_and_deviation(row: Mapping[str, Any], name: str) -> str:
    """Return a mean over seeds with its standard deviation."""
    return f"{row['mean'][name]:.2f} ± {row['standard_deviation'][name]:.2f}"


def percent(fraction: float | None) -> str:
    """Return a fraction as a percentage, "none" where there is none."""
    return "none" if fraction is None else f"{fraction:.0%}".replace("%", " %")


def of(count: int, total: int) -> str:
    """Return "19 of 28", "-" where there is nothing to count."""
    return f"{count} of {total}" if total else "-"


def triple(values: Sequence[float] | None, digits: int = 3) -> str:
    """Return three numbers, those of red, green and blue."""
    return "-" if values is None else ", ".join(f"{value:.{digits}f}" for value in values)


# Accuracy and time


def scene_rows(iterations: int | None = None) -> list[dict[str, Any]]:
    """Return the runs of benchmarks/train_scenes.py, those of one length or all."""
    return [run for run in results("train_scenes")["runs"] if iterations in (None, run["iterations"])]


@table
def readme() -> str:
    """Time and quality of a run of 1500 iterations."""
    return markdown(
        ["scene", "training time", "test PSNR", "test SSIM", "PSNR of the median image"],
        [
            [
                run["scene"].replace("photographs", "photos"),
                f"{run['seconds'] / 60:.1f} min",
                f"{run['test_psnr']:.1f} dB",
                f"{run['test_ssim']:.3f}",
                f"{run['control_psnr']:.1f} dB",
            ]
            for run in scene_rows(1500)
        ],
    )


@table
def train_scenes() -> str:
    """Quality of runs of three lengths."""
    return markdown(
        ["scene", "iterations", "minutes", "Gaussians", "test PSNR", "test SSIM", "PSNR of the median image"],
        [
            [
                run["scene"].replace("photographs", "photos"),
                run["iterations"],
                f"{run['seconds'] / 60:.1f}",
                run["gaussians"],
                f"{run['test_psnr']:.2f} dB",
                f"{run['test_ssim']:.3f}",
                f"{run['control_psnr']:.2f} dB",
            ]
            for run in scene_rows()
        ],
    )


def tradeoff(scene: str) -> str:
    """Return the runs of benchmarks/tradeoff.py on a scene, sorted by time."""
    rows = sorted(results(f"tradeoff_{scene}")["rows"], key=lambda row: row["seconds"])
    return markdown(
        ["run", "seconds", "Gaussians", "test PSNR", "SSIM", "LPIPS (AlexNet)", "fraction of the best gain"],
        [
            [
                row["name"].replace("water=off", "without water"),
                f"{row['seconds']:.0f}",
                row["gaussians"],
                f"{row['psnr']:.2f} dB",
                f"{row['ssim']:.3f}",
                f"{row['lpips_alex']:.3f}",
                percent(row["gain"]),
            ]
            for row in rows
        ],
    )


@table
def tradeoff_demo() -> str:
    """Presets on the demo scene."""
    return tradeoff("demo")


@table
def tradeoff_japanese_gardens() -> str:
    """Presets on japanese_gardens."""
    return tradeoff("japanese_gardens")


@table
def draft_and_high() -> str:
    """Draft against high at 480 pixels."""
    rows = []
    for scene in ("demo", "japanese_gardens"):
        document = results(f"tradeoff_{scene}")
        draft, high = (
            next(row for row in document["rows"] if row["name"] == f"{preset}, 480 px") for preset in ("draft", "high")
        )
        control = document["control_psnr"]
        rows.append(
            [
                scene,
                *(f"{row['psnr']:.2f} dB in {row['seconds']:.0f} s" for row in (draft, high)),
                percent((draft["psnr"] - control) / (high["psnr"] - control)),
                percent(draft["seconds"] / high["seconds"]),
            ]
        )
    return markdown(["scene", "draft", "high", "fraction of the gain", "fraction of the time"], rows)


@table
def raster() -> str:
    """Time of the CPU kernels and of torch code."""
    document = results("raster")
    rasterise = document["rasterise 50 000 at 640x360, ms"]
    iteration = document["iteration 50 000 at 640x360, ms"]
    reference = "gsplat, torch implementation"
    large = document["500 000 at 1280x720, ms"]
    return markdown(
        ["work", "CPU kernels", "torch reference inside gsplat 1.5.3", "torch backend of this project"],
        [
            [
                "rasterise 50 000 Gaussians at 640x360",
                f"{rasterise['kernels']:.1f} ms",
                f"{rasterise[reference]:.0f} ms",
                f"{rasterise['torch']:.0f} ms",
            ],
            [
                "whole iteration, 50 000 Gaussians at 640x360",
                f"{iteration['kernels']:.1f} ms",
                "-",
                f"{iteration['torch']:.0f} ms",
            ],
            ["rasterise 500 000 Gaussians at 1280x720", f"{large['rasterise']:.0f} ms", "-", "-"],
            ["whole iteration, 500 000 Gaussians at 1280x720", f"{large['iteration']:.0f} ms", "-", "-"],
        ],
    )


@table
def raster_prototypes() -> str:
    """Processor time of the CPU kernels and of the prototypes that they are compared with."""
    times = results("raster")["processor ms on 1 thread, kernels and prototypes, 50 000 at 640x360"]
    return markdown(
        ["code", "1 thread, ms", "speed relative to raster2"],
        [
            [name, f"{times[name]:.1f}", f"{times['raster2'] / times[name]:.2f}"]
            for name in sorted(times, key=times.get)
        ],
    )


@table
def raster_sizes() -> str:
    """Time of the CPU kernels by number of Gaussians, width and threads."""
    document = results("raster")
    groups = (
        ("ms by Gaussians at 640x360", "{} Gaussians at 640x360, 2 threads"),
        ("ms by width, 100 000 Gaussians", "100000 Gaussians at {} pixels, 2 threads"),
        ("ms by threads, 50 000 at 640x360", "50000 Gaussians at 640x360, {} threads"),
    )
    return markdown(
        ["case", "rasterise, ms", "whole iteration, ms"],
        [
            [words.format(size).replace(" 1 threads", " 1 thread"), times["rasterise"], times["iteration"]]
            for name, words in groups
            for size, times in document[name].items()
        ],
    )


@table
def wgpu_cost() -> str:
    """What a step of the backend wgpu moves and computes, and what that lets expect."""
    counted = results("wgpu_cost")["gaussians"]
    cards = next(iter(counted.values()))["expected_ms"]
    header = ["Gaussians", "pairs with tiles", "moved", "operations", *(f"{card}, ms" for card in cards)]
    rows = [
        [
            f"{int(n):,}".replace(",", " "),
            f"{row['pairs']:,}".replace(",", " "),
            f"{sum(row['megabytes'].values()) / 1000:.1f} GB",
            f"{row['gigaflop']:.0f} GFLOP",
            *(f"{row['expected_ms'][card]:.0f}" for card in cards),
        ]
        for n, row in counted.items()
    ]
    return markdown(header, rows)


def card_timings() -> dict[int, dict]:
    """Return the figures of gpu_check by number of Gaussians."""
    prefix = "ms, "
    rows = {name: row for name, row in results("gpu_check").items() if name.startswith(prefix)}
    return {int(name.removeprefix(prefix).split()[0]): row for name, row in rows.items()}


@table
def card_kernels() -> str:
    """An iteration of the CUDA kernels and of gsplat's on a card."""
    return markdown(
        ["Gaussians", "iteration, ms", "by gsplat, ms", "bytes a Gaussian", "by gsplat"],
        [
            [f"{n:,}".replace(",", " "), *(row[name] for name in ("iteration", "iteration by gsplat"))]
            + [row[f"{name}, bytes a Gaussian"] for name in ("iteration", "iteration by gsplat")]
            for n, row in card_timings().items()
        ],
    )


@table
def card_steps() -> str:
    """A training step of a scene in water on a card."""
    names = {"native step in water": "`cuda`, native step, ms", "autograd step in water": "`cuda`, autograd step, ms"}
    names |= {"step, by wgpu": "`wgpu`, ms"}
    return markdown(
        ["Gaussians", *names.values()],
        [[f"{n:,}".replace(",", " "), *(row[name] for name in names)] for n, row in card_timings().items()],
    )


@table
def card_runs() -> str:
    """Runs on a graphics card."""
    return markdown(
        ["scene", "preset", "width", "iterations", "Gaussians", "runs beside it", "time", "test PSNR", "test SSIM"],
        [
            [row["scene"], f"`{row['preset']}`", row["width"], row["iterations"], row["gaussians"], row["others"]]
            + [f"{row['seconds']:.0f} s", f"{row['test_psnr']:.1f} dB", f"{row['test_ssim']:.3f}"]
            for row in results("card_runs")["rows"]
        ],
    )


@table
def step() -> str:
    """Processor time of a training step and of its rasterising."""
    document = results("step")

    def with_ratio(row: dict, name: str) -> str:
        return f"{row[name]:.1f} ({row[name] / row['rasterise']:.2f})"

    return markdown(
        ["recipe and effects", "Gaussians", "threads", "rasterise, ms", "native step, ms", "autograd step, ms"],
        [
            [row["case"], row["gaussians"], row["threads"], row["rasterise"], with_ratio(row, "native")]
            + [with_ratio(row, "autograd")]
            for row in document["rows"]
        ],
    )


IDEAS = {
    "full size from the start": (
        "full-size images from the first iteration instead of reduced ones until 10 and 30 % of the run",
        "reduced images stay",
    ),
    "coarse until 20 and 50 %": ("reduced images until 20 and 50 % of the run", "not decided"),
    "Gaussians at once": (
        "all Gaussians as soon as densification asks for them, instead of evenly over its time",
        "the even increase stays",
    ),
    "all SH from the start": (
        "all spherical harmonics from the first iteration instead of degrees 1 to 3 from 20, 35 and 50 %",
        "no difference, the later start stays",
    ),
    "higher SH every fourth iteration": (
        "spherical harmonics above degree 0 updated in one iteration of four",
        "gain too small",
    ),
    "sparse Adam": ("Adam for the visible Gaussians only", "not used"),
    "SSIM every second iteration": ("SSIM in every second iteration with twice its weight", "not used"),
    "SSIM of half of the picture": ("SSIM of a random half of the image", "not used"),
    "views by error": ("half of the images drawn by their last loss instead of each once an epoch", "not used"),
}
"""Variants of benchmarks/results/speed_ideas.json: what they change, and what was decided."""


@table
def speed_ideas() -> str:
    """What each idea for speed changed, against the default."""
    document = results("speed_ideas")
    scenes = ("demo", "japanese_gardens")
    quality = {(row["scene"], row["variant"]): row["validation_psnr"] for row in document["quality"]}

    def time(scene: str, variant: str) -> str:
        times = document["ms_per_iteration"][scene]
        if variant not in times:
            return "not measured"
        default = (times["default"] + times["default again"]) / 2
        return f"{100 * (times[variant] / default - 1):+.0f} %"

    def psnr(scene: str, variant: str) -> str:
        value = quality.get((scene, variant))
        return "not measured" if value is None else f"{value - quality[scene, 'default']:+.2f} dB"

    return markdown(
        ["change", *(f"time, {scene}" for scene in scenes), *(f"PSNR, {scene}" for scene in scenes), "decision"],
        [
            [
                words,
                *(time(scene, variant) for scene in scenes),
                *(psnr(scene, variant) for scene in scenes),
                decision,
            ]
            for variant, (words, decision) in IDEAS.items()
        ],
    )


@table
def zoom() -> str:
    """Held-out views at three widths, by the least variance of Gaussians."""
    runs = results("zoom")["runs"]

    def psnr(scene: str, variance: float, width: str) -> float:
        known = [run[width] for run in runs if (run["scene"], run["least_variance"]) == (scene, variance)]
        return fmean(known)

    rows = []
    for scene, words in SCENES.items():
        widths = ("half", "x0.5"), ("half, film", "x0.5 film"), ("equal", "x1"), ("double", "x2")
        for label, width in (*widths, ("double, film", "x2 film")):
            none, used, published = (psnr(scene, variance, width) for variance in (0.0, 0.1, 0.2))
            rows.append([words, label, f"{none:.2f} dB", f"{used - none:+.2f} dB", f"{published - none:+.2f} dB"])
    return markdown(["scene", "width", "without", "with .1", "with .2"], rows)


@table
def largest_size() -> str:
    """Novel views, heights and restored colors by the largest size of Gaussians; means over the seeds."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for run in results("largest_size")["runs"]:
        groups.setdefault((run["scene"], run["limit"]), []).append(run)
    rows = []
    for (scene, limit), runs in sorted(groups.items()):
        means = {
            name: mean(run[name] for run in runs)
            for name in ("psnr", "height_p95_error", "delta_e") if name in runs[0]
        }  # fmt: skip
        heights = f"{means['height_p95_error']:.1f} px" if "height_p95_error" in means else "-"
        colors = f"{means['delta_e']:.1f}" if "delta_e" in means else "-"
        rows.append([scene, limit, f"{means['psnr']:.1f} dB", heights, colors, len(runs)])
    return markdown(["scene", "limit", "test PSNR", "heights, 95 %", "delta E without water", "seeds"], rows)


@table
def schedules() -> str:
    """Schedules against the standard with the same processor time, means of three seeds."""
    scenes = {name: rows for name, rows in results("schedules").items() if name != "machine"}

    def psnr(runs: Mapping[str, Any], change: str) -> str:
        if change not in runs:
            return "not measured"
        mean, standard = (fmean(runs[name]["psnr"]) for name in (change, "standard"))
        return f"{mean:.2f} dB" if change == "standard" else f"{mean - standard:+.2f} dB"

    rows = []
    for change in next(iter(scenes.values())):
        times = [runs[change]["seconds"] / runs["standard"]["seconds"] for runs in scenes.values() if change in runs]
        rows.append([change, *(psnr(runs, change) for runs in scenes.values()), f"{100 * (median(times) - 1):+.0f} %"])
    return markdown(["schedule", *scenes, "time of an iteration"], rows)


@table
def strategies() -> str:
    """Our densification and gsplat's strategies on our rasteriser; rows of one comparison have equal Gaussians."""
    header = ["scene", "iterations", "strategy", "limit from", "equal", "Gaussians", "time", "test PSNR", "seeds"]
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for run in results("strategies")["runs"]:
        key = tuple(run[name] for name in ("scene", "length", "limit", "strategy", "equal"))
        groups.setdefault(key, []).append(run)
    rows = []
    for (scene, length, limit, strategy, equal), runs in sorted(groups.items(), key=lambda group: group[0][1::-1]):
        gaussians, seconds, psnr = (fmean(run[name] for run in runs) for name in ("gaussians", "seconds", "psnr"))
        figures = [f"{gaussians:.0f}", f"{seconds:.0f} s", f"{psnr:.2f} dB", len(runs)]
        rows.append([scene, length, strategy, limit, equal, *figures])
    return markdown(header, rows)


@table
def long_runs() -> str:
    """Stability and memory of long runs."""
    rows = []
    for name, run in results("long_runs").items():
        if name == "machine":
            continue
        recipe, rest = name.split(", ", 1)
        scene, length = rest.rsplit(", ", 1)
        drift = run["restored colors, change in stage two (display values)"]
        rows.append(
            [
                recipe,
                scene.split(" (")[0],
                length.split()[0],
                run["skipped"],
                run["put_back"],
                f"{run['MB when the number of Gaussians was settled']:.0f}",
                f"{run['MB at the end']:.0f}",
                f"{drift['mean_change']:.3f}" if drift else "no stage two",
                f"{max(drift['shift_rgb'], key=abs):+.4f}" if drift else "-",
            ]
        )
    return markdown(
        [
            *("recipe", "scene", "iterations", "steps skipped", "rollbacks", "MB after densification", "MB at the end"),
            *("restored color: mean change in stage two", "largest mean shift of a channel"),
        ],
        rows,
    )


@table
def large_run() -> str:
    """A run with many Gaussians on large images."""
    run = results("large_run")
    return markdown(
        ["figure", "value"],
        [
            ["iterations", run["iterations"]],
            ["Gaussians", run["gaussians"]],
            ["steps skipped, rollbacks", f"{run['skipped']}, {run['put_back']}"],
            ["iteration with all Gaussians, median", f"{run['ms of such an iteration, median']:.0f} ms"],
            ["memory of a Gaussian", f"{run['bytes of a Gaussian']:.0f} bytes"],
            ["memory at the end", f"{run['MB at the end'] / 1000:.2f} GB"],
            ["time of the run", f"{run['seconds']:.0f} s"],
            ["sum of the parts of its iterations", f"{run['seconds by parts']:.0f} s"],
            ["test PSNR", f"{run['test_psnr']:.2f} dB"],
        ],
    )


# Cameras

CAMERA_CASES = {
    "orbit": "around a coral head",
    "lawn-mower": "survey straight down, four lanes",
    "forward video": "video forward by 1 m, little parallax",
    "wall": "along a wall and back",
    "two heights": "two loops, at two heights",
    "lamp": "survey with a lamp, moving shadows",
    "turbid": "survey in dim and turbid water",
    "fisheye": "survey with a fisheye lens of 120°",
}
"""Generated scenes of benchmarks/cameras.py that are for accuracy, and what they are called."""
TIMED_CASES = {
    "large photos": "wall, 1500x1000 pixels (generated)",
    "japanese_gardens": SCENES["japanese_gardens"] + ", 1280x845 pixels",
    "aqualoc_amphorae": SCENES["aqualoc_amphorae"] + ", 968x608 pixels",
}
"""Those that are for processor time."""
EARLIER = "dff4305"
"""Commit that the cameras are compared with: one hypothesis, from all pairs."""


def camera_runs(case: str, version: str) -> list[dict[str, Any]]:
    """Return the runs of benchmarks/cameras.py on a case that placed cameras."""
    runs = results("cameras")["runs"]
    return [run for run in runs if (run["case"], run["version"]) == (case, version) and "error" not in run]


def worst(runs: Sequence[Mapping[str, Any]], name: str, form: str) -> str:
    """Return the figure of the run with the largest one, "not measured" where there is none."""
    values = [run[name] for run in runs]
    return format(max(values, key=abs), form).replace("%", " %") if values else "not measured"


def with_pose(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return how many photos have a pose, in the run with the fewest."""
    fewest = min(runs, key=lambda run: run["registered"], default=None)
    return of(fewest["registered"], fewest["images"]) if fewest else "not measured"


def focal_error(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return the largest error of the focal length, and whether the result said that it is doubtful."""
    if not runs:
        return "not measured"
    run = max(runs, key=lambda run: abs(run["focal_error"]))
    said = any("focal length" in warning for warning in run["warnings"])
    return f"{100 * run['focal_error']:+.1f} %" + (", said to be doubtful" if said else "")


@table
def camera_accuracy() -> str:
    """Errors of the cameras of generated photos, in this version and an earlier one."""
    rows = []
    for case, words in CAMERA_CASES.items():
        now, earlier = camera_runs(case, "current"), camera_runs(case, EARLIER)
        rows.append(
            [
                words,
                with_pose(now),
                worst(now, "position_error", ".2%"),
                worst(now, "rotation_error", ".2f"),
                focal_error(now),
                ", ".join((with_pose(earlier), worst(earlier, "position_error", ".2%"), focal_error(earlier)))
                if earlier
                else "not measured",
            ]
        )
    return markdown(
        [
            *("scene", "photos with a pose", "position error", "rotation error, degrees", "error of the focal length"),
            f"the same in {EARLIER}: poses, position, focal length",
        ],
        rows,
    )


@table
def camera_time() -> str:
    """Processor time for cameras, in this version and an earlier one."""
    rows = []
    for case, words in (CAMERA_CASES | TIMED_CASES).items():
        now, earlier = camera_runs(case, "current"), camera_runs(case, EARLIER)
        times = [[run["processor_seconds"] for run in runs] for runs in (now, earlier)]
        rows.append(
            [
                words,
                *(f"{fmean(each):.0f} s" if each else "not measured" for each in times),
                percent(fmean(times[0]) / fmean(times[1])) if now and earlier else "-",
                *(
                    f"{with_pose(runs)}, {worst(runs, 'position_error', '.2%')}" if runs else "-"
                    for runs in (now, earlier)
                ),
            ]
        )
    return markdown(
        [
            *("photos", "processor time", f"in {EARLIER}", "fraction"),
            *("poses, position error", f"in {EARLIER}"),
        ],
        rows,
    )


@table
def camera_pairs() -> str:
    """Pairs of a large survey that are matched."""
    return markdown(
        [
            *("photos", "matched pairs for each photo", "processor time to choose and match, for each photo"),
            *("photos matched with a neighbouring lane", "verified pairs that cannot overlap"),
        ],
        [
            [
                row["images"],
                f"{row['pairs'] / row['images']:.1f}",
                f"{1000 * row['processor_seconds'] / row['images']:.0f} ms",
                percent(row["lane_neighbours"]),
                of(row["wrong"], row["verified"]),
            ]
            for row in results("camera_pairs")["rows"]
        ],
    )


# Surveys


@table
def survey_levels() -> str:
    """PSNR of levels of detail, and what other ways of making fewer splats reach."""
    rows = []
    for scene, found in results("survey_levels")["scenes"].items():
        finest = found["level_0"]
        ways = {name: way["levels"] for name, way in found["ways"].items()}
        size = f"{finest['bytes'] / 1e6:.1f} MB"
        rows.append([scene, "0", finest["splats"], size, f"{finest['psnr']:.1f} dB", "", *("" for _ in ways)])
        for number, level in enumerate(next(iter(ways.values()))):
            psnr = [f"{way[number]['psnr']:.1f} dB" for way in ways.values()]
            against = f"{level['psnr_level_0']:.1f} dB"
            rows.append(
                [scene, number + 1, level["splats"], f"{level['bytes'] / 1e6:.1f} MB", psnr[0], against, *psnr[1:]]
            )
    others = list(next(iter(results("survey_levels")["scenes"].values()))["ways"])[1:]
    return markdown(["scene", "level", "splats", "PLY", "PSNR", "against level 0", *others], rows)


# Recipes


def ablation(scene: str) -> str:
    """Return the rows of `ablate` on a scene."""
    rows = results(f"ablation_{scene}")["rows"]
    colored = "delta_e" in rows[0]["mean"] and rows[0]["mean"]["delta_e"] is not None
    return markdown(
        ["method", "validation PSNR", "test PSNR", "test SSIM", *(["delta E"] if colored else []), "floaters"],
        [
            [
                row["name"],
                mean_and_deviation(row, "psnr"),
                mean_and_deviation(row, "test_psnr"),
                f"{row['mean']['test_ssim']:.3f}",
                *([f"{row['mean']['delta_e']:.1f}"] if colored else []),
                f"{100 * row['mean']['floater_mass']:.1f} %",
            ]
            for row in rows
        ],
    )


@table
def ablation_demo() -> str:
    """Methods on the demo scene."""
    return ablation("demo")


@table
def ablation_japanese_gardens() -> str:
    """Methods on japanese_gardens."""
    return ablation("japanese_gardens")


@table
def ablation_aqualoc_amphorae() -> str:
    """Methods on aqualoc_amphorae."""
    return ablation("aqualoc_amphorae")


# Effects


def confusion() -> dict[str, dict[str, Any]]:
    """Return decisions by effect on the final set of benchmarks/effects_matrix.py."""
    return results("effects_matrix")["sets"]["final"]["summary"]["confusion"]


def detection(names: Iterable[str]) -> tuple[str, str]:
    """Return "19 of 28" visible effects of these names that were switched on, and the same of absent ones."""
    chosen = [confusion()[name] for name in names]
    visible, absent = (
        of(sum(effect[truth]["on"] for effect in chosen), sum(sum(effect[truth].values()) for effect in chosen))
        for truth in ("present", "absent")
    )
    return visible, absent


@table
def readme_effects() -> str:
    """A sentence on the decisions."""
    visible, absent = detection(confusion())
    scenes = results("effects_matrix")["sets"]["final"]["summary"]["scenes"]
    return (
        f"On {scenes} generated scenes the plan switched on {visible} visible effects, and {absent} absent ones\n"
        "([effects](docs/effects.md))."
    )


@table
def effects_rates() -> str:
    """Sentences on detection, false alarms and what counts as right."""
    summary = results("effects_matrix")["sets"]["final"]["summary"]
    counted = sum(effect["counted"] for effect in confusion().values())
    return (
        f"**Of absent effects, {detection(confusion())[1]} were switched on. Of visible effects, "
        f"{detection(confusion())[0]}.**\nVisible attenuation was switched on in {detection(['attenuation'])[0]} "
        f"scenes, a visible lamp in {detection(['lamp'])[0]}.\n\n"
        f"The last column, {percent(summary['right'])} of {counted} decisions in all, counts differently and looks "
        "better than the detection rate:\noff or undetermined is right where an effect is absent, and undetermined is "
        "right for water and lamp in a survey\nstraight down. Slight effects are not counted."
    )


@table
def effects_matrix() -> str:
    """Detection rate and false alarms of each effect, and what the decisions were."""

    def cells(decisions: Mapping[str, int]) -> str:
        return " / ".join(str(decisions[state]) for state in ("on", "off", "unknown"))

    rows = [
        [
            name,
            *detection([name]),
            *(cells(effect[truth]) for truth in ("present", "slight", "absent")),
            f"{percent(effect['right'])} of {effect['counted']}",
        ]
        for name, effect in confusion().items()
    ]
    rows.append(["all", *detection(confusion()), "", "", "", ""])
    return markdown(
        [
            *("effect", "visible and switched on", "absent and switched on (false alarm)"),
            *("visible: on / off / undetermined", "slight: the same", "absent: the same", "right"),
        ],
        rows,
    )


@table
def effects_surveys() -> str:
    """How many of the undetermined visible effects were in surveys at constant height."""
    return markdown(
        ["effect", "visible and undetermined", "of these in surveys straight down"],
        [
            [name, effect["present"]["unknown"], effect["present_in_surveys"]["unknown"]]
            for name, effect in confusion().items()
            if effect["present"]["unknown"]
        ],
    )


@table
def effects_wrong() -> str:
    """The wrong decisions of the final set."""
    return markdown(
        ["scene", "cameras", "effect", "decision"],
        [
            [case["scene"], case["pattern"], case["effect"], STATES.get(case["state"], case["state"])]
            for case in results("effects_matrix")["sets"]["final"]["summary"]["wrong"]
        ],
    )


@table
def effects_air() -> str:
    """False alarms on scenes in air."""
    document = results("effects_matrix")["sets"]
    sets = {"final set": document["final"]["summary"], "second set, in air only": document["land"]["summary"]}
    effects = list(confusion())
    return markdown(
        ["scenes in air", "number", *(f"{effect} on" for effect in effects)],
        [
            [name, summary["in_air"]["scenes"], *(summary["in_air"]["falsely_on"][effect] for effect in effects)]
            for name, summary in sets.items()
        ],
    )


@table
def water_errors() -> str:
    """Errors of the fitted coefficients of water."""
    summary = results("effects_matrix")["sets"]["final"]["summary"]
    return markdown(
        ["coefficient", "scenes", "median relative error", "90th percentile"],
        [
            [name, errors["scenes"], percent(errors["median"]), percent(errors["p90"])]
            for name, errors in summary["relative_error"].items()
        ],
    )


@table
def water_colors() -> str:
    """Color difference of images with water and with the water removed."""
    delta_e = results("effects_matrix")["sets"]["final"]["summary"]["delta_e"]
    return markdown(
        ["image", "delta E against the truth without water"],
        [["as taken", delta_e["seen"]], ["water removed by the fitted values", delta_e["restored"]]],
    )


@table
def lamp_beam() -> str:
    """Decisions about the beam of a lamp by light."""
    rows = [
        [
            light,
            f"{found['lamp_on']} of {found['scenes']}",
            f"{found['water_on']} of {found['in_water']}",
            str(found["false_water"]),
            str(found["beam_on"]),
            "{:,.0f} to {:,.0f}".format(*found["bic_gain"]),
            "{:.0%} to {:.0%}".format(*found["falloff"]),
        ]
        for light, found in results("lamp_beam")["decisions"].items()
    ]
    return markdown(
        ["light", "lamp on", "water on", "on in clear water", "beam on", "BIC gain of the beam", "fall-off"], rows
    )


@table
def lamp_beam_runs() -> str:
    """Runs without and with the beam of a lamp."""
    rows = []
    for scene, by_state in results("lamp_beam")["runs"].items():
        off, on = by_state["off"], by_state["on"]
        colors = ["-"] * 3
        if "delta_e" in on:
            colors = [f"{delta_e:.1f}" for delta_e in (on["best_gain"], off["delta_e"], on["delta_e"])]
        psnr = [f"{state[key]:.1f}" for key in ("psnr", "validation_psnr") for state in (off, on)]
        rows.append([scene, *psnr, *colors])
    titles = ["test PSNR without", "with", "validation PSNR without", "with"]
    return markdown(["scene", *titles, "delta E of best gain", "ours without", "with"], rows)


@table
def effects_volume() -> str:
    """Decisions and coefficients in scattering water."""
    scenes, rows = results("effects_volume")["rows"], []
    effects = list(dict.fromkeys(name for row in scenes for name in row["states"]))
    for row in scenes:
        truth, states, found = row["truth"], row["states"], row.get("fit")
        beam = [a + b for a, b in zip(truth["absorption"], truth["scattering"], strict=True)]
        rows.append(
            [
                row["scene"],
                row["pattern"],
                str(row["seed"]),
                triple(truth["absorption"]),
                triple(beam),
                triple(found and found["beta_D"]),
                *(STATES.get(states.get(effect, "-"), states.get(effect, "-")) for effect in effects),
            ]
        )
    return markdown(["water", "cameras", "seed", "absorption", "beam attenuation", "beta_D found", *effects], rows)


@table
def effects_volume_colors() -> str:
    """Color difference in scattering water: photos, restored colors, and the best that laws of range can reach."""
    titles = {
        "seen": "as taken",
        "best gain": "best gain",
        "restored": "restored by the fit",
        "trained": "splats of a run",
        "photo": "restored photos",
        "exponential": "best exponential",
        "two exponentials": "best two exponentials",
        "any law": "best law of range",
    }
    rows = [
        [
            row["scene"],
            row["pattern"],
            str(row["seed"]),
            *(f"{row['delta_e'][name]:.1f}" if name in row["delta_e"] else "-" for name in titles),
        ]
        for row in results("effects_volume")["rows"]
        if "delta_e" in row
    ]
    return markdown(["water", "cameras", "seed", *titles.values()], rows)


@table
def spectral_water() -> str:
    """Color difference in water whose attenuation depends on the wavelength."""
    digits = {"red near": 3, "red far": 3, "as taken": 1, "one exponential": 2, "two exponentials": 2}
    return markdown(
        ["water", *digits],
        [
            [name, *(f"{row[key]:.{count}f}" for key, count in digits.items())]
            for name, row in results("spectral_water")["scenes"].items()
        ],
    )


def decisions(states: Mapping[str, Mapping[str, str]], effects: Sequence[str]) -> str:
    """Return a table of decisions by scene."""
    return markdown(
        ["scene", *(effect.replace("_", " ") for effect in effects)],
        [[scene, *(STATES.get(state[name], state[name]) for name in effects)] for scene, state in states.items()],
    )


@table
def effects_real() -> str:
    """Decisions on real scenes."""
    plans = {
        scene: {name: effect["state"] for name, effect in entry["plan"]["effects"].items()}
        for scene, entry in results("effects_real").items()
        if "plan" in entry
    }
    return decisions(plans, ("attenuation", "backscatter", "lamp", "exposure", "caustics", "semantics", "depth_prior"))


@table
def effects_flsea() -> str:
    """Coefficients of single images with metric depth."""
    return markdown(
        ["image", "ranges, metres", "beta_D per metre: red, green, blue", "beta_B per metre"],
        [
            [
                name,
                f"{frame['metres'][0]:.1f} to {frame['metres'][1]:.1f}",
                triple(frame["beta_D"], 2),
                triple(frame["beta_B"], 2),
            ]
            for name, frame in results("effects_real")["flsea_rgbd"]["frames"].items()
        ],
    )


@table
def effects_land() -> str:
    """Decisions on photos taken on land."""
    scenes = results("effects_land")
    return decisions(
        {
            f"{name} ({scene['images']} photos, {scene['points']} points)": scene["states"]
            for name, scene in scenes.items()
        },
        list(next(iter(scenes.values()))["states"]),
    )


@table
def effects_training() -> str:
    """Time of an iteration and test PSNR with each effect."""
    scenes = results("effects_training")["scenes"]
    names = list(next(iter(scenes.values()))["rows"])
    return markdown(
        ["effects", *(f"{scene}: {figure}" for scene in scenes for figure in ("ms", "test PSNR"))],
        [
            [
                "as planned" if name == "planned" else name,
                *(
                    cell
                    for scene in scenes.values()
                    for cell in (f"{scene['rows'][name]['ms']:.1f}", f"{scene['rows'][name]['test_psnr']:.2f} dB")
                ),
            ]
            for name in names
        ],
    )


@table
def effects_forecast() -> str:
    """Cost of each effect as the plan states it."""
    scenes = results("effects_training")["scenes"]
    names = [name for name in next(iter(scenes.values()))["plan_ms"]]
    return markdown(
        ["effect", *scenes],
        [
            [name.replace("_", " "), *(f"{scene['plan_ms'][name]:.1f} ms" for scene in scenes.values())]
            for name in names
            if any(scene["plan_ms"][name] for scene in scenes.values())
        ],
    )


@table
def effects_street() -> str:
    """A street in air as planned and with all effects."""
    return markdown(
        ["effects", "processor ms per iteration", "test PSNR"],
        [
            ["as planned (none)" if name == "planned" else name, f"{run['cpu_ms']:.0f}", f"{run['test_psnr']:.1f} dB"]
            for name, run in results("effects_training")["street in air"].items()
        ],
    )


@table
def moving_objects() -> str:
    """Painted fish with and without masks."""
    runs = results("moving_objects")["rows"]
    rows = []
    for scene in dict.fromkeys(run["scene"] for run in runs):
        with_fish = {run["way"]: run for run in runs if run["scene"] == scene and run["fish"]}
        without = next(run for run in runs if run["scene"] == scene and not run["fish"] and run["way"] == "planned")
        masked, unmasked = with_fish["planned"], with_fish["never"]
        rows.append(
            [
                scene.replace("photographs", "photos"),
                f"{unmasked['test_psnr']:.2f} dB",
                f"{masked['test_psnr']:.2f} dB",
                percent(masked["fish_masked"]),
                percent(masked["mask_is_fish"]),
                percent(without["masked"]),
            ]
        )
    return markdown(
        [
            *("scene", "test PSNR without masks", "test PSNR with masks", "fish pixels masked"),
            *("mask pixels that are fish", "pixels masked where there are no fish"),
        ],
        rows,
    )


def time_to_earlier(row: Mapping[str, Any]) -> str:
    """Interpolate after which fraction of the earlier version's time the present one has its test PSNR."""
    runs = sorted([(run["seconds"], run["psnr"]) for run in (row["now"], *row["other lengths"])])
    seconds, wanted = row["earlier"]["seconds"], row["earlier"]["psnr"]
    if runs[0][1] >= wanted:
        return f"below {percent(runs[0][0] / seconds)}"
    for (shorter, low), (longer, high) in itertools.pairwise(runs):
        if low < wanted <= high:
            return percent((shorter + (longer - shorter) * (wanted - low) / (high - low)) / seconds)
    return "not reached"


@table
def presets() -> str:
    """Presets against those of an earlier version: processor time, quality and Gaussians."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in results("presets")["rows"]:
        groups.setdefault((row["preset"], row["scene"]), []).append(row)

    def mean(rows: Sequence[Mapping[str, Any]], version: str, figure: str) -> float:
        return fmean(row[version][figure] for row in rows)

    return markdown(
        [
            "preset",
            "scene (seeds)",
            "processor time",
            "time to the PSNR before",
            "test PSNR before",
            "now",
            "Gaussians before",
            "now",
        ],  # fmt: skip
        [
            [
                preset,
                f"{scene} ({len(rows)})",
                percent(median(row["now"]["seconds"] / row["earlier"]["seconds"] for row in rows)),
                next((time_to_earlier(row) for row in rows if "other lengths" in row), "-"),
                *(f"{mean(rows, version, 'psnr'):.2f} dB" for version in ("earlier", "now")),
                *(f"{mean(rows, version, 'gaussians'):.0f}" for version in ("earlier", "now")),
            ]
            for (preset, scene), rows in groups.items()
        ],
    )


@table
def restoration_limit() -> str:
    """Restored colors as trained and limited."""
    rows = []
    for scene, figures in results("restoration_limit")["scenes"].items():
        trained, limited = figures["as trained"], figures["limited"]
        change = limited["psnr"] - trained["psnr"]
        delta_e = [f"{of['delta_e']:.1f}" for of in (trained, limited)]
        clipped = [f"{100 * of['clipped']:.2f} %" for of in (trained, limited)]
        rows.append([scene, percent(figures["not_restored"]), f"{change:+.3f} dB", *delta_e, *clipped])
    return markdown(
        ["scene", "pixels not restored", "PSNR of photos with limited colors", "delta E as trained", "limited",
         "clipped as trained", "limited"],
        rows,
    )  # fmt: skip


KNOW_TRUTH = ("best gain", "true water")
"""Methods of restored_colors that know the true colors or the true water."""


RENDERS = ("render, not developed", "render")
"""Methods of restored_colors that do not have the photo of the test view."""
RESTORED = "restored photo"
NOT_COMPRESSED = ", not compressed"
"""End of the names of scenes whose photos are PNG files."""


@table
def restored_colors() -> str:
    """Methods that have the photo of the test view: delta E and hue error, means over seeds."""
    scenes = _color_errors()
    shown = [name for name in next(iter(scenes.values())) if name not in RENDERS]
    rows = {scene: {name: means[name] for name in shown} for scene, means in scenes.items()}
    rows["**mean of the scenes**"] = _mean_errors(list(rows.values()))
    lines = [[scene, *_colors_of_methods(means), _against_best_gain(means)] for scene, means in rows.items()]
    return markdown(["scene (seeds)", *shown, "restored photo, not developed, against best gain"], lines)


@table
def restored_colors_short() -> str:
    """Delta E of the photo, of the restored photo, and of the best other method that does not know the truth."""
    lines = []
    for scene, means in _color_errors().items():
        errors = {method: figures["delta_e"] for method, figures in means.items()}
        others = [name for name in errors if name not in (*KNOW_TRUTH, *RENDERS) and not name.startswith(RESTORED)]
        best = min(others, key=errors.__getitem__)
        cells = [f"{errors['photo']:.1f}", f"{best}: {errors[best]:.1f}", f"{errors[RESTORED]:.1f}"]
        lines.append([scene, *cells, f"{100 * (errors[RESTORED] / errors[best] - 1):+.0f} %"])
    return markdown(["scene (seeds)", "photo", "next best method", RESTORED, "against it"], lines)


@table
def restored_renders() -> str:
    """Delta E of renders of the test views beside photos restored in other ways."""
    names = ("best gain", *RENDERS, f"{RESTORED}, not developed", RESTORED)
    lines = [[scene, *(f"{means[name]['delta_e']:.1f}" for name in names)] for scene, means in _color_errors().items()]
    return markdown(["scene (seeds)", *names], lines)


@table
def restored_without_compression() -> str:
    """Delta E where the photos are not compressed, beside the same scenes as JPEG files."""
    names = ("best gain", "true water", "render, not developed", f"{RESTORED}, not developed")
    compressed, lines = _color_errors(), []
    for scene, means in _color_errors(compressed=False).items():
        pairs = [f"{means[name]['delta_e']:.1f} ({compressed[scene][name]['delta_e']:.1f})" for name in names]
        lines.append([scene, *pairs, _against_best_gain(means)])
    return markdown(["scene (seeds)", *names, "against best gain"], lines)


def _color_errors(compressed: bool = True) -> dict[str, dict[str, dict[str, float]]]:
    """Return delta E and hue error of each method, means over the seeds, by scene with its number of seeds.

    Args:
        compressed: Whether the photos are JPEG files; the names of scenes with others are given without that.
    """
    scenes = results("restored_colors")["scenes"]
    chosen = {
        scene.removesuffix(NOT_COMPRESSED): seeds
        for scene, seeds in scenes.items()
        if scene.endswith(NOT_COMPRESSED) != compressed
    }
    return {f"{scene} ({len(seeds)})": _mean_errors(list(seeds.values())) for scene, seeds in chosen.items()}


def _mean_errors(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the mean delta E and hue error of each method over some rows."""
    methods = [name for name in rows[0] if name != "seen"]
    return {m: {key: fmean(row[m][key] for row in rows) for key in ("delta_e", "hue")} for m in methods}


def _colors_of_methods(means: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the cells of all methods; bold is the least delta E of those that do not know the truth."""
    least = min(figures["delta_e"] for method, figures in means.items() if method not in KNOW_TRUTH)
    cells = []
    for figures in means.values():
        delta_e = f"{figures['delta_e']:.1f}"
        delta_e = f"**{delta_e}**" if figures["delta_e"] == least else delta_e
        cells.append(f"{delta_e}, {figures['hue']:.0f}°")
    return cells


def _against_best_gain(means: Mapping[str, Mapping[str, float]]) -> str:
    """Return how delta E of the restored photo differs from that of the best gain, which has the truth's exposure."""
    restored = means[f"{RESTORED}, not developed"]["delta_e"]
    return f"{100 * (restored / means['best gain']['delta_e'] - 1):+.0f} %"


@table
def readme_colors() -> str:
    """How far restored colors are from the truth, for README."""
    errors = {method: of["delta_e"] for method, of in next(iter(_color_errors().values())).items()}
    sentences = (
        f"Without water, the test views of the demo differ from the truth by delta E {errors['render']:.1f} as "
        f"rendered and {errors[RESTORED]:.1f} as restored photos; as photographed, by {errors['photo']:.1f}. "
        "[Colors](docs/colors.md) has other scenes and other methods; some are nearer to the truth. [Accuracy and "
        "time](docs/accuracy.md) has all figures and the commands that repeat them."
    )
    return fill(sentences, 120, break_long_words=False, break_on_hyphens=False)


@table
def caustics() -> str:
    """Three ways to treat caustics."""
    document = results("caustics")["psnr"]
    ways = list(next(iter(document.values())))
    return markdown(
        ["strength of the caustics", *ways],
        [[strength, *(f"{figures[way]:.2f} dB" for way in ways)] for strength, figures in document.items()],
    )


# Labels

PARTS = ("salient_densification", "salient_pixels", "open_water", "class_pruning", "reallocation")
"""Switches by which regions act on training."""


@table
def region_switches() -> str:
    """What the switches of regions are worth."""
    scenes = {scene: {row["name"]: row for row in results(f"ablation_{scene}")["rows"]} for scene in SCENES}

    def cells(name: str) -> list[str]:
        return [
            cell
            for rows in scenes.values()
            for cell in (
                mean_and_deviation(rows[name], "psnr"),
                mean_and_deviation(rows[name], "test_psnr"),
                f"{100 * rows[name]['mean']['floater_mass']:.1f} %",
            )
        ]

    header = [f"{scene}: {figure}" for scene in scenes for figure in ("validation", "test", "floaters")]
    rows = [["none", *cells("swag")], *([f"`{part}`", *cells(f"swag with {part.replace('_', ' ')}")] for part in PARTS)]
    return markdown(["switch", *header], rows)


@table
def label_accuracy() -> str:
    """IoU of rendered labels by view and label."""
    demo = results("semantics")["demo"]
    names = list(demo["held-out"])
    views = {
        "the test views": demo["held-out"],
        "reef_000 (test)": demo["views"]["reef_000.jpg"],
        "reef_008 (test)": demo["views"]["reef_008.jpg"],
        "reef_016 (test)": demo["views"]["reef_016.jpg"],
        "the validation views": demo["validation"],
        "the truth of the test views, shifted by one pixel": demo["truth one pixel aside"],
    }
    return markdown(
        ["views", *("mean IoU" if name == "miou" else name for name in names)],
        [
            [view, *(f"{figures[name]:.3f}" if name == "miou" else f"{figures[name]:.2f}" for name in names)]
            for view, figures in views.items()
        ],
    )


@table
def label_saliency() -> str:
    """IoU of the provider saliency on SUIM."""
    return markdown(
        ["region", "IoU"], [[name, f"{iou:.2f}"] for name, iou in results("semantics")["suim"]["mean"].items()]
    )


@table
def label_costs() -> str:
    """Time and memory of labels."""
    demo = results("semantics")["demo"]
    return markdown(
        ["work", "cost"],
        [
            ["an iteration without labels, processor time", f"{demo['cpu_ms_iteration']:.0f} ms"],
            ["learning features, in one iteration of four", f"{demo['cpu_ms_semantics']:.0f} ms more"],
            ["regions of 18 images from masks", f"{demo['cpu_seconds']['regions']:.1f} s"],
            ["a label for every Gaussian", f"{demo['cpu_seconds']['assignment']:.1f} s"],
            ["features with gradients and Adam's moments", f"{demo['mb_per_100000']:.0f} MB for 100 000 Gaussians"],
        ],
    )


# Formats and Blender


@table
def format_costs() -> str:
    """Time and memory of reading and writing files."""
    document = results("formats")
    return markdown(
        ["one million splats of SH degree 3", "seconds", "memory held, bytes per byte of the file", "size of the file"],
        [
            [
                name,
                f"{figures['seconds']:.2f}",
                f"{figures['held_per_file_byte']:.2f}",
                f"{figures['file_bytes'] / 1e6:.0f} MB",
            ]
            for name, figures in document.items()
            if isinstance(figures, dict)
        ],
    )


@table
def blender_preview() -> str:
    """PSNR of Blender's renders against the engine's."""
    figures = results("blender_preview")["psnr"]
    ways = {
        "as trained": "Cycles, As Trained",
        "in light": "Cycles, in linear light",
        "ellipsoids as trained": "Cycles, ellipsoids, As Trained",
        "EEVEE as trained": "EEVEE, As Trained",
    }
    return markdown(
        ["render", "without water", "with water"],
        [
            [words, f"{figures[f'{way}, water 0']:.1f} dB", f"{figures[f'{way}, water 1']:.1f} dB"]
            for way, words in ways.items()
        ],
    )


@table
def native_splats() -> str:
    """PSNR, time and memory of the splats that Blender draws, and of the extension's own."""
    figures = results("native_splats")["ways"]
    ways = {
        "own drawing in Solid": "viewport, the extension's drawing",
        "native Solid": "viewport, Blender's Splats, Solid",
        "native Material Preview": "viewport, Blender's Splats, Material Preview",
        "native EEVEE": "EEVEE",
        "native Cycles": "Cycles",
        "shapes in Cycles, light": "Cycles, Exact Shapes",
        "shapes in Cycles, display values": "Cycles, As Trained",
    }
    scenes = ("demo, without water", "demo, with water", "one", "two", "many")
    rows = []
    for way, words in ways.items():
        found = figures[way]
        time = f"{found['demo, without water']['processor_seconds']:.1f} s"
        rows.append([words, *(f"{found[name]['psnr']:.1f} dB" for name in scenes), time, f"{found['peak MB']} MB"])
    return markdown(["drawn by", "without water", "with water", "one", "two", "300", "time", "memory"], rows)


@table
def blender_load() -> str:
    """Time of a million splats in Blender."""
    document = results("blender_preview")["into blender"]
    rows = [["load into Blender", document["seconds"]]]
    rows += [[name, value["seconds"]] for name, value in document.items() if isinstance(value, dict)]
    return markdown(["one million splats", "seconds"], rows)


@table
def viewport() -> str:
    """Frames of Blender's viewport with splats, relative to one without."""
    rows = []
    for found in results("viewport")["counts"]:
        empty = found["without_splats"]
        ratios = [f"{found[name] / empty:.1f}" for name in ("resting", "moving", "all_drawn_anew")]
        megabytes = [f"{found['megabytes_a_moving_frame']:.1f}", f"{found['megabytes_uploaded']:.0f}"]
        rows.append([f"{found['splats']:,}".replace(",", " "), *ratios, *megabytes, found["sort"]])
    return markdown(
        ["splats", "resting", "moving", "all drawn anew", "MB a moving frame", "MB at first", "sort, ms"], rows
    )


# Stability


@table
def backends_agree() -> str:
    """Largest differences between the backends."""
    document = results("backends_agree")
    errors = document["largest error"]
    tolerance = document["tolerance"]

    def largest(backend: str, kinds: Iterable[str], chosen: Callable[[str], bool]) -> str:
        found = [error for kind in kinds for name, error in errors[backend][kind].items() if chosen(name)]
        return f"{max(found):.1e}"

    scores = ("weighted", "importance", "error")
    rows = (
        (
            "images, alpha, range, loss",
            ("blended", "trained"),
            lambda name: not name.startswith("gradient") and name not in scores,
            "of all others",
        ),
        ("contributions, importance, error", ("blended",), lambda name: name in scores, "of all others"),
        ("gradients without water", ("blended",), lambda name: name.startswith("gradient"), "of all others"),
        (
            "gradients through water, range and SSIM",
            ("trained",),
            lambda name: name.startswith("gradient"),
            "of gradients, trained",
        ),
    )
    return markdown(
        ["compared", "tolerance", "CPU kernels", "CUDA kernels", "torch, float32"],
        [
            [words, f"{tolerance[key]:g}", *(largest(backend, kinds, chosen) for backend in ("cpu", "cuda", "torch"))]
            for words, kinds, chosen, key in rows
        ],
    )


@table
def guard() -> str:
    """Time of the guard."""
    document = results("guard")
    return markdown(
        ["50 000 Gaussians at 640x360", "cost"],
        [
            ["an iteration", f"{document['iteration']} ms"],
            ["the check of each iteration", f"{document['guard, every iteration']} ms"],
            ["the full check, once in 100 iterations", f"{document['guard, every 100 iterations']} ms"],
            ["both", f"{document['guard, per cent of an iteration']} % of an iteration"],
        ],
    )


@table
def maps_truth() -> str:
    """Maps of trained surveys of known seabeds."""
    found = results("products")["seeds"]
    names = next(iter(found["0"]["surveys"].values()))["areas"]
    heads = [
        "water", "seed", "test PSNR", "scale", "height, median", "height, 95 %", *names, "patches over 5 %",
        "largest error, corrected", "labels in their interval",
    ]  # fmt: skip
    rows = []
    for seed, figures in found.items():
        for water, survey in figures["surveys"].items():
            areas = survey["areas"].values()
            largest = max((area["corrected_error"] for area in areas), key=abs)
            rows.append(
                [
                    water, seed, f"{survey['test_psnr']:.1f} dB", f"{100 * survey['scale_error']:+.2f} %",
                    f"{survey['height_median_error']:.1f} px", f"{survey['height_p95_error']:.1f} px",
                    *(f"{100 * survey['areas'][name]['error']:+.1f} %" for name in names),
                    of(survey["wrong_patches"], survey["patches"]), f"{100 * largest:+.1f} %",
                    of(sum(area["in_interval"] for area in areas), len(areas)),
                ]
            )  # fmt: skip
    return markdown(heads, rows)


@table
def change_truth() -> str:
    """Changes between trained surveys of known seabeds, sums and ranges over seeds."""
    seeds = [figures["changes"] for figures in results("products")["seeds"].values()]
    rows = []
    for name in seeds[0]:
        pairs = [seed[name] for seed in seeds]
        expected, invented = (sum(pair[key] for pair in pairs) for key in ("expected", "invented"))
        found = sum(pair["found"] for pair in pairs)
        compared, limit = ([pair[key] for pair in pairs] for key in ("compared", "height_limit"))
        rows.append(
            [
                name, len(pairs), of(found, expected) if expected else "-", invented,
                f"{percent(min(compared))} to {percent(max(compared))}", f"{min(limit):.1f} to {max(limit):.1f} px",
            ]
        )  # fmt: skip
    heads = "later survey", "seeds", "changes found", "invented", "compared", "told from"
    return markdown(heads, rows)


@table
def change_pairs() -> str:
    """Changes between every two trained surveys of a seabed, sums over seeds."""
    seeds = [figures["pairs"]["every pair"] for figures in results("products")["seeds"].values() if "pairs" in figures]
    rows = []
    for kind in seeds[0]:
        total = {name: sum(seed[kind][name] for seed in seeds) for name in seeds[0][kind]}
        rows.append([kind, total["pairs"], of(total["found"], total["expected"]), total["invented"]])
    return markdown(["light", "pairs", "changes found", "invented"], rows)


# Surveys


@table
def survey_quality() -> str:
    """Surveys against one run of the same scene."""
    rows = []
    for row in sorted(results("survey")["quality"], key=lambda row: (row["scene"], row["cut"], row["seed"])):
        single, survey = row["single"], row["survey"]
        at_seams = [model["seam_psnr"] - model["interior_psnr"] for model in (single, survey)]
        rows.append(
            [
                row["scene"], row["blocks"], row["seed"], f"{single['test_psnr']:.2f} dB",
                f"{survey['test_psnr']:.2f} dB", *(f"{difference:+.2f} dB" for difference in at_seams),
                f"{at_seams[1] - at_seams[0]:+.2f} dB", f"{100 * (survey['density'] / single['density'] - 1):+.1f} %",
            ]
        )  # fmt: skip
    heads = ["scene", "blocks", "seed", "test PSNR, one run", "test PSNR, survey"]
    heads += ["at seams minus elsewhere: one run", "survey", "survey minus one run"]
    return markdown([*heads, "splats at borders"], rows)


@table
def survey_scale() -> str:
    """Processor time and memory of surveys of several sizes."""
    rows = sorted(results("survey").get("scale", []), key=lambda row: row["images"])
    if not rows:
        return NOT_MEASURED
    return markdown(
        ["photos", "blocks", "processor time, coarse model", "processor time, all", "most memory of a block"],
        [
            [
                row["images"], row["blocks"], f"{row['jobs'][0]['processor_seconds'] / 60:.1f} min",
                f"{row['processor_seconds'] / 60:.1f} min",
                f"{max(job['peak_memory'] for job in row['jobs'][1:]) / 1e9:.2f} GB",
            ]
            for row in rows
        ],
    )  # fmt: skip


@table
def survey_plan() -> str:
    """Planning of a large survey."""
    return markdown(
        ["images", "sparse points", "blocks", "images of a block", "time", "memory"],
        [
            [
                row["images"], f"{row['points'] / 1e6:g} million", row["blocks"],
                f"{row['block_images_least']} to {row['block_images_most']}", f"{row['seconds']:.0f} s",
                f"{row['peak_memory'] / 1e9:.1f} GB",
            ]
            for row in results("survey")["plan"]
        ],
    )  # fmt: skip


def _hours(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.0f} min"


@table
def survey_cost() -> str:
    """Time of large surveys on one machine, on eight and on spot machines."""
    if not (ROOT / "benchmarks" / "results" / "survey_cost.json").exists():
        return NOT_MEASURED
    rows = [
        [
            f"{row['images']:,}".replace(",", " "), row["blocks"], row["cluster"], row["at_once_on_a_machine"],
            _hours(row["hours"]) + (f" ({_hours(row['hours_95'])})" if row["failures_an_hour"] else ""),
            _hours(row["machine_hours"]), row["most_losses"], _hours(row["hours_without_checkpoints"]),
        ]
        for row in results("survey_cost")["rows"]
    ]  # fmt: skip
    heads = [
        "photos", "blocks", "on", "blocks at once on each", "time (95 % of simulations)", "machines, summed",
        "most losses of a block", "time without checkpoints",
    ]  # fmt: skip
    return markdown(heads, rows)


def main(arguments: Sequence[str]) -> int:
    """Write or check the tables of all pages and return the exit code."""
    texts = {path: path.read_text("utf-8") for path in pages()}
    used = {name for text in texts.values() for name in names_in(text)}
    made = {name: TABLES[name]() for name in sorted(used & set(TABLES))}
    if unused := sorted(set(TABLES) - used):
        print(f"No page shows the tables {', '.join(unused)}: show or remove them.")
        return 1
    return update(
        {path: filled(text, made) for path, text in texts.items()},
        "--check" in arguments,
        "python docs/scripts/tables.py",
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
