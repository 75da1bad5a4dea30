"""Restore the photos of a run: remove water, lamp and photo effects from them."""

from collections.abc import Callable
from pathlib import Path

from ..base.errors import InputError
from ..base.files import output_names
from ..base.transfer import linear_to_srgb
from ..evidence.noise import estimate_noise
from ..formats.run_folder import RunFolder
from ..rendering.model import SceneModel
from ..rendering.photo_terms import works_on_light
from ..rendering.restored_photo import restored_photo
from ..rendering.trained_detail import TrainedDetail
from ..scene.colmap import load_scene
from ..scene.images import load_image
from ..splats.development import ColorView
from ..splats.haze import check_haze
from .develop_run import color_view
from .evaluate_run import load_run, write_picture


def restore_photos(
    folder: Path,
    out: Path,
    photo: str | None = None,
    width: int | None = None,
    develop: str | ColorView = "auto",
    exr: bool = False,
    haze: float = 0.0,
    progress: Callable[[str, float], None] = lambda stage, fraction: None,
) -> list[Path]:
    """Restore photos of a run and write them to image files, undistorted.

    Args:
        folder: Folder of the run.
        out: Folder of the files.
        photo: Name of one photo; all without it.
        width: Width of the pictures in pixels; that of each photo without it, and where the photo is narrower.
        develop: Development of PNG files, as `RunFolder.color_view`, or how colors are shown.
        exr: Write linear light without development to OpenEXR files in place of PNG files.
        haze: Fraction of the haze in open water that is shown, 0..1.
        progress: Called with the stage and its fraction, 0..1.

    Returns:
        The files.

    Raises:
        InputError: For an unknown photo, width or development, where a file would replace a photo, where the run has
            no checkpoint, and where its recipe computes water in display values.
    """
    if width is not None and width < 1:
        raise InputError(f"The width must be at least 1 pixel, not {width}.")
    check_haze(haze)
    scene_folder, settings, _ = RunFolder(folder).read_config()
    run = load_run(folder)
    if not works_on_light(run.effects):
        raise InputError(
            f"The recipe {settings.recipe} of {folder} has its water in display values. Photos are restored in linear "
            "light: train with the recipe swag."
        )
    scene = load_scene(scene_folder)
    views = [view for view in scene.views if photo in (None, view.name)]
    if not views:
        raise InputError(f"{scene.folder} has no photo named {photo}; the first is {scene.views[0].name}.")
    if out.resolve().is_relative_to(scene.image_folder.resolve()):
        raise InputError(f"{out} is in the folder of the photos, which must not be replaced: choose another folder.")
    colors = develop if isinstance(develop, ColorView) else color_view(folder, develop, run.cloud, run.effects)
    detail = TrainedDetail.of_training(run.trained.means, scene.training_cameras(settings.width))
    paths = output_names((view.name for view in scene.views), ".exr" if exr else ".png")
    files = []
    for number, view in enumerate(views):
        progress("Restore photos", number / len(views))
        image = load_image(scene, view, width)
        model = SceneModel(detail.widened(run.trained, image.camera), run.effects)
        noise = estimate_noise([image], [view])
        light = restored_photo(model, run.limit, image, noise, settings.sh_degree, run.haze, haze)
        files.append(write_picture(out / paths[view.name], linear_to_srgb(light), colors.at(0)))
    return files
