"""A color chart in a scene or a run: its colors before and after correction, and what it says about the water."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.transfer import srgb_to_linear
from ..colorchart.chart_attenuation import chart_attenuation
from ..colorchart.chart_kinds import chart_kinds
from ..colorchart.chart_pose import chart_ranges
from ..colorchart.color_correction import (
    ColorCorrection,
    differences,
    fit_correction,
    left_out_images,
    left_out_patches,
)
from ..colorchart.find_chart import measure
from ..colorchart.scene_charts import ChartImage, find_charts, parse_corners
from ..effects.exposure import Exposure
from ..effects.scene_effects import SceneEffects
from ..evaluation.metrics import render_image
from ..formats.run_folder import RunFolder, write_json
from ..scene.colmap import load_scene
from ..splats.development import KNEE, Development
from .evaluate_run import load_newest
from .restore_patches import restored_patches

FEW_PATCHES = 6
"""Patches from which a correction is determined."""


def measure_chart(
    folder: Path,
    chart: str = "24",
    corners: Sequence[str] = (),
    out: Path | None = None,
    progress: Callable[[str, float], None] = lambda stage, fraction: None,
    marked: str = "",
) -> dict[str, Any]:
    """Find a color chart, and fit the correction that brings its patches to their known colors.

    In a run, the patches of the photos without the run's water are corrected, and chart.json is written;
    in a scene, those of the photos.

    Args:
        folder: Folder of a run or of a scene.
        chart: Name of the kind of chart.
        corners: Corners of the chart in photos, as in `parse_corners`.
        out: File for the document instead of the run's chart.json; None for a scene writes nothing.
        progress: Called with the stage and its fraction, 0..1.
        marked: Corners in the only photo to read, written as in `parse_corners`, but in fractions of the width and
            height of the undistorted photo; "" for a search.

    Returns:
        The document in chart.json: the correction as a `Development`, which `--develop chart` applies; `delta_e`:
        mean CIE delta E 2000 of the photos (`photos`), of these corrected (`photos_corrected`), and for a run of the
        photos without water (`restored`) and of these corrected (`corrected`), and with each patch or each photo left
        out of the fit that corrects it (`left_out_patches`, `left_out_photos`), and of the run's splats without water
        after the same correction (`rendered`); `beta_D`: attenuation from the chart
        with its standard error, beside that of the run; `photos`: of each photo its corners, the patches left out, and
        delta E. What is not known is NaN or None, and `notes` say why.

    Raises:
        InputError: Where no photo shows the chart, or the folder is neither a run nor a scene.
    """
    kind = chart_kinds()[chart]
    run = RunFolder(folder)
    in_run = run.config.exists()
    scene_folder, settings = (run.read_config()[:2]) if in_run else (folder, None)
    scene = load_scene(scene_folder)
    found = find_charts(
        scene, kind, parse_corners(corners, scene), progress, parse_corners([marked] if marked else [], scene)
    )
    observations = [image.observation for image in found]
    photographed = np.stack([observation.light for observation in observations])
    used = np.stack([observation.used for observation in observations])
    restored = rendered = None
    log_gains = np.zeros((len(found), 3))
    if settings is not None:
        progress("Restore the color chart", 0.99)
        cloud, effects, _ = load_newest(folder)
        restored = np.stack(
            [restored_patches(cloud, effects, shown.image.camera, shown.observation) for shown in found]
        )
        views = [
            render_image(cloud, shown.image.camera, settings.sh_degree, effects=effects, amount=0) for shown in found
        ]
        rendered = np.stack(
            [measure(srgb_to_linear(view.numpy()), shown.observation) for view, shown in zip(views, found, strict=True)]
        )
        log_gains = _log_gains(effects, found)
    corrected = photographed if restored is None else restored
    correction = fit_correction(corrected, used, kind)
    if correction is None or used.any(0).sum() < FEW_PATCHES:
        raise InputError(
            f"The chart in {', '.join(image.name for image in found)} is too dark or too much covered for a "
            "correction: look for photos that show it better."
        )
    after = differences(correction.apply(corrected), kind)
    delta_e = {"photos": _mean(differences(photographed, kind), used)}
    if restored is not None:
        own = fit_correction(photographed, used, kind)
        delta_e["photos_corrected"] = _mean(differences(own.apply(photographed), kind), used) if own else np.nan
        delta_e["restored"] = _mean(differences(restored, kind), used)
    delta_e |= {
        "corrected": _mean(after, used),
        "left_out_patches": _mean(left_out_patches(corrected, used, kind), used),
        "left_out_photos": _mean(left_out_images(corrected, used, kind), used),
    }
    if rendered is not None:
        delta_e["rendered"] = _mean(differences(correction.apply(rendered), kind), used)
    metres = settings.metres_per_unit if settings is not None else 0.0
    attenuation, notes = _attenuation(found, photographed / np.exp(log_gains)[:, None], used, metres)
    water = (run.read_water() or {}) if in_run else {}
    document = {
        "chart": chart,
        **_development(correction).to_json(),
        "delta_e": delta_e,
        "beta_D": attenuation | {"run": water.get("beta_D") if attenuation["chart"] else None},
        "photos": [
            {
                "name": image.name,
                "corners": image.observation.corners.round(2).tolist(),
                "width": image.image.camera.width,
                "upside_down": image.observation.upside_down,
                "patches_left_out": (np.flatnonzero(~image.observation.used) + 1).tolist(),
                "delta_e": _mean(differences(image.observation.light[None], kind), used[row][None]),
                "delta_e_corrected": _mean(after[row], used[row]),
            }
            for row, image in enumerate(found)
        ],
        "notes": notes,
    }
    if in_run or out:
        write_json(out or run.chart, document)
    return document


def describe(document: dict[str, Any]) -> str:
    """Format a document of `measure_chart` as the lines that `chart` prints."""
    delta_e, attenuation = document["delta_e"], document["beta_D"]
    lines = [f"{chart_kinds()[document['chart']].title.capitalize()} in {len(document['photos'])} photos:"]
    for photo in document["photos"]:
        left = len(photo["patches_left_out"])
        lines.append(
            f"  {photo['name']}: delta E {photo['delta_e']:.1f} as photographed, {photo['delta_e_corrected']:.1f} "
            f"corrected{', upside down' if photo['upside_down'] else ''}"
            f"{f', {left} patches left out (covered, in shadow or clipped)' if left else ''}"
        )
    lines.append("Mean delta E 2000:")
    lines += [
        f"  {title}: {delta_e[name]:.1f}" for name, title in DELTA_E.items() if np.isfinite(_number(delta_e, name))
    ]
    white = ", ".join(f"{gain:.3f}" for gain in document["white"])
    lines.append(f"Exposure {document['exposure']:+.2f} stops, white balance {white}.")
    if attenuation["chart"]:
        values = ", ".join(
            f"{value:.3f} ± {error:.3f}"
            for value, error in zip(attenuation["chart"], attenuation["error"], strict=True)
        )
        lines.append(f"Attenuation per {attenuation['per']} from the chart (red, green, blue): {values}.")
    if attenuation["run"]:
        lines.append(f"Attenuation of the run: {', '.join(f'{value:.3f}' for value in attenuation['run'])}.")
    return "\n".join([*lines, *document["notes"]])


DELTA_E = {
    "photos": "photos",
    "photos_corrected": "photos, corrected without removing the water",
    "restored": "photos without water",
    "corrected": "corrected",
    "left_out_patches": "corrected, each patch left out of its fit",
    "left_out_photos": "corrected, each photo left out of its fit",
    "rendered": "the run's splats without water, corrected",
}
"""Titles of the entries of `delta_e`."""


def _number(values: dict[str, Any], name: str) -> float:
    return np.nan if values.get(name) is None else float(values[name])


def _mean(values: np.ndarray, used: np.ndarray) -> float:
    """Return the mean of the patches that are used and known, NaN without any."""
    known = values[used & np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _log_gains(effects: SceneEffects, found: Sequence[ChartImage]) -> np.ndarray:
    """Return the exposure (V, 3) of each photo that the run has fitted, natural logarithm; 0 without."""
    exposure = effects.models.get("exposure")
    if not isinstance(exposure, Exposure):
        return np.zeros((len(found), 3))
    gains = [exposure.log_gain(image.name).detach().cpu().numpy() for image in found]
    return np.stack([np.broadcast_to(gain, 3) for gain in gains])


def _development(correction: ColorCorrection) -> Development:
    """Return the development of pictures that applies a correction."""
    document = {"white": correction.white, "matrix": correction.matrix, "contrast": 1.0, "knee": KNEE}
    return Development.from_json(document | {"exposure": correction.exposure})


def _attenuation(
    found: Sequence[ChartImage], light: np.ndarray, used: np.ndarray, metres_per_unit: float
) -> tuple[dict[str, Any], list[str]]:
    """Return the attenuation from the chart's patches for the document, and why it is not known."""
    result: dict[str, Any] = {"chart": None, "error": None, "per": "metre" if metres_per_unit else "unit"}
    place = chart_ranges([image.image.camera for image in found], [image.observation for image in found])
    if place.ranges is None:
        return result, [place.problem]
    attenuation = chart_attenuation(light, used, place.ranges, found[0].observation.kind)
    if attenuation.beta_D is None or attenuation.error is None:
        return result, [attenuation.problem]
    unit = metres_per_unit or 1.0
    result["chart"] = (attenuation.beta_D / unit).tolist()
    result["error"] = (attenuation.error / unit).tolist()
    return result, []
