"""Rendered views of a merged survey."""

from pathlib import Path

from ..base.errors import InputError
from ..base.files import output_names
from ..experiments.evaluate_run import write_view
from .merged_model import MergedModel


def render_survey(
    folder: Path,
    out: Path,
    camera: str | None = None,
    water: float = 1.0,
    develop: str = "auto",
    exr: bool = False,
    level: int = 0,
) -> list[Path]:
    """Render views of a merged survey at the training size to image files; each reads the tiles that it shows.

    Args:
        folder: Folder of the survey.
        out: Folder of the files.
        camera: Name of one image; all test images without it.
        water: Amount of water, from 0 (removed) to 1 (as photographed).
        develop: Development of PNG files, as `RunFolder.color_view`; `auto` is that of the coarse model.
        exr: Write linear light without development to OpenEXR files in place of PNG files.
        level: Level of detail, 0 is the finest.

    Returns:
        The files.

    Raises:
        InputError: For another amount, name, level or development, and where the survey is not merged.
    """
    if not 0 <= water <= 1:
        raise InputError(f"The amount of water must be from 0 to 1, not {water}.")
    model = MergedModel.load(folder)
    wanted = set(model.views.split.test) if camera is None else {camera}
    views = [view for view in model.views.views if view.name in wanted]
    if not views:
        raise InputError(f"{model.survey.scene} has no photo named {camera}; the first is {model.views.views[0].name}.")
    development = model.folder.coarse.color_view(develop).at(water)
    paths = output_names((view.name for view in model.views.views), ".exr" if exr else ".png")
    files = []
    for view in views:
        sized = view.camera.resized(min(model.survey.settings.width, view.camera.width))
        cloud, degree = model.in_view(sized, level), model.survey.settings.sh_degree
        files.append(write_view(out / paths[view.name], cloud, sized, degree, model.effects, water, development))
    return files
