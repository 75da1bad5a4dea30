"""The merged model of a survey, of which only what a view shows is read."""

from dataclasses import dataclass
from pathlib import Path

from ..effects.scene_effects import SceneEffects
from ..formats.survey_folder import Survey, SurveyFolder
from ..formats.survey_tiles import Tiles
from ..gaussians.cloud import GaussianCloud
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.scene_part import read_part
from .view import splats_in_view
from .whole_model import load_whole


@dataclass
class MergedModel:
    """The merged Gaussians of a survey, with the effects of its coarse model.

    Attributes:
        folder: The survey.
        survey: What it consists of.
        tiles: Its tiles.
        effects: Water, lamp, exposure and other effects.
        views: Cameras of all its images, and their split.
    """

    folder: SurveyFolder
    survey: Survey
    tiles: Tiles
    effects: SceneEffects
    views: Scene

    @classmethod
    def load(cls, path: Path) -> "MergedModel":
        """Load what is known of a merged survey beside its Gaussians.

        Raises:
            InputError: If the folder is no survey or is not merged, or a file is damaged.
        """
        folder = SurveyFolder(path)
        survey = folder.read()
        tiles = Tiles.read(folder.merged)
        return cls(folder, survey, tiles, load_whole(folder).effects, read_part(folder.all_views, survey.scene))

    def in_view(self, camera: Camera, level: int = 0) -> GaussianCloud:
        """Return the Gaussians that a camera may see.

        Args:
            camera: The camera.
            level: Level of detail.

        Raises:
            InputError: If there is no such level, or a tile cannot be read.
        """
        return GaussianCloud.from_splats(splats_in_view(self.tiles, camera, level), self.tiles.background)
