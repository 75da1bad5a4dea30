"""Requests to the worker: one JSON object a line."""

from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from ..base.errors import InputError
from ..base.strict_json import from_json
from ..formats.registry import FormatName
from ..settings.settings import TrainSettings
from ..splats.development import AS_RESTORED, ColorView

Color = tuple[float, float, float]
"""Display values, 0..1."""
Line = tuple[float, float, float, float, float, float]
"""Coordinates of two points."""
NUMBERS = (Color, Line)
"""Types of fields that are lists of numbers."""


@dataclass(frozen=True)
class InspectRequest:
    """Read a scene.

    Attributes:
        scene: Folder of the scene.
        arrays: Folder for the arrays of the answer.
        settings: Settings of the next run, whose sizes are part of the answer.
    """

    scene: Path
    arrays: Path
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class SfmRequest:
    """Find the cameras of images or of a video, as the command `sfm` does, and read the scene that it makes.

    Attributes:
        photos: Folder of images, or a video.
        out: Folder of the new scene; it must not exist or be empty.
        arrays: Folder for the arrays of the answer.
        settings: Settings of the next run, whose sizes are part of the answer.
    """

    photos: Path
    out: Path
    arrays: Path
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class ScaleRequest:
    """Measure the scale of a scene from coded targets, as the command `scale` does.

    Attributes:
        scene: Folder of the scene.
        targets: Family of the targets.
        size: Edge length of the targets with their black border, metres.
    """

    scene: Path
    targets: str
    size: float


@dataclass(frozen=True)
class ImportCamerasRequest:
    """Make a scene of cameras of another program, as the command `import-cameras` does, and read it.

    Attributes:
        file: File of the cameras.
        out: Folder of the new scene; it must not exist or be empty.
        arrays: Folder for the arrays of the answer.
        photos: Folder of the photos, None for that of the file.
        points: PLY file of sparse points, None without one.
        settings: Settings of the next run, whose sizes are part of the answer.
    """

    file: Path
    out: Path
    arrays: Path
    photos: Path | None = None
    points: Path | None = None
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class TrainRequest:
    """Train a scene.

    Attributes:
        scene: Folder of the scene.
        out: Folder of the run.
        settings: Settings of the run.
        resume: Continue the run in `out`.
    """

    scene: Path
    out: Path
    settings: TrainSettings = field(default_factory=TrainSettings)
    resume: bool = False


@dataclass(frozen=True)
class ForecastRequest:
    """Predict time and quality of each preset.

    Attributes:
        scene: Folder of the scene.
        settings: Settings of the run.
    """

    scene: Path
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class PlanRequest:
    """Decide which effects a scene has.

    Attributes:
        scene: Folder of the scene.
        out: Folder for plan.json, None for that of the scene.
        settings: Settings of the run that the plan is for.
    """

    scene: Path
    out: Path | None = None
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class ExportRequest:
    """Export the result of a run.

    Attributes:
        run: Folder of the run.
        format: Format of the file.
        out: The file.
    """

    run: Path
    format: FormatName
    out: Path


@dataclass(frozen=True)
class FilmRequest:
    """Render splats along a camera path.

    Attributes:
        cameras: File of the camera path (formats/camera_path.py).
        splats: File of the splats (PLY), in the same coordinates.
        out: Folder of an image sequence, or video (.mp4).
        run: Folder of the run that water, lamp and background are read from, None without.
        water: File in the format of water.json per scene unit, for splats without a run.
        background: Display values (3,) behind splats without a run.
        alpha: As in `FilmOptions`, like the following.
        depth: Whether to write depth.
        overwrite: Whether to replace files.
        fps: Frames of a video per second.
        unit: Length of a scene unit in units of the depth.
        colors: How colors are developed.
    """

    cameras: Path
    splats: Path
    out: Path
    run: Path | None = None
    water: Path | None = None
    background: Color = (0.0, 0.0, 0.0)
    alpha: bool = False
    depth: bool = False
    overwrite: bool = False
    fps: float = 24.0
    unit: float = 1.0
    colors: ColorView = AS_RESTORED


@dataclass(frozen=True)
class LabelRequest:
    """Label the Gaussians of a run. Without words, masks or saliency this does what `label` does.

    Attributes:
        run: Folder of the run.
        words: What to look for, separated by commas.
        masks: Folder of mask images.
        saliency: Label by saliency.
        download: Whether networks may be downloaded.
    """

    run: Path
    words: str = ""
    masks: Path | None = None
    saliency: bool = False
    download: bool = False


@dataclass(frozen=True)
class SearchRequest:
    """Compare the Gaussians of a labelled run with words.

    Attributes:
        run: Folder of the run.
        words: The words.
        path: File (.npy) for the similarity of each Gaussian.
    """

    run: Path
    words: str
    path: Path


@dataclass(frozen=True)
class ScoreEditRequest:
    """Compare a run with its test images, before and after Gaussians are removed.

    Attributes:
        run: Folder of the run.
        masks: File (.npy) of (2, N) bool: the Gaussians before and after.
    """

    run: Path
    masks: Path


@dataclass(frozen=True)
class ChartRequest:
    """Find a color chart in the photos of a run, as the command `chart` does.

    Attributes:
        run: Folder of the run.
        marked: As in `measure_chart`.
    """

    run: Path
    marked: str = ""


@dataclass(frozen=True)
class RestoreRequest:
    """Write the photos of a run without water, as the command `restore` does.

    Attributes:
        run: Folder of the run.
        out: Folder of the PNG files.
        colors: How colors are developed.
        haze: Fraction of the haze in open water that is shown, 0..1.
    """

    run: Path
    out: Path
    colors: ColorView = AS_RESTORED
    haze: float = 0.0


@dataclass(frozen=True)
class MapRequest:
    """What the requests for maps of a run have in common; the commands of their names have the same options.

    Attributes:
        run: Folder of the run.
        out: File or folder of the map.
        pixel: Edge of a pixel, 0 for the size of the splats.
        plane: Where the map is seen from.
    """

    run: Path
    out: Path
    pixel: float = 0.0
    plane: str = "up"


@dataclass(frozen=True)
class OrthoRequest(MapRequest):
    """Write an orthomosaic.

    Attributes:
        water: Amount of water, 0 to 1.
        develop: Development of the colors.
        taglab: Whether TagLab must open the file.
    """

    water: float = 0.0
    develop: str = "auto"
    taglab: bool = False


@dataclass(frozen=True)
class DemRequest(MapRequest):
    """Write heights.

    Attributes:
        derived: Names of further maps, separated by commas.
    """

    derived: str = ""


@dataclass(frozen=True)
class AreasRequest(MapRequest):
    """Write areas by label.

    Attributes:
        corrected: Corrected copy of the label map, None without one.
    """

    corrected: Path | None = None


@dataclass(frozen=True, kw_only=True)
class ProfileRequest(MapRequest):
    """Write heights along a line.

    Attributes:
        line: x, y and z of its two ends in the coordinates of the scene.
    """

    line: Line


@dataclass(frozen=True, kw_only=True)
class ChangeRequest(MapRequest):
    """Compare a run with a later one.

    Attributes:
        later: Folder of the later run.
        free_scale: Whether the alignment finds the scale of the later run.
    """

    later: Path
    free_scale: bool = False


@dataclass(frozen=True)
class PlanSurveyRequest:
    """Cut a scene into the blocks of a survey, as the command `survey plan` does.

    Attributes:
        scene: Folder of the scene.
        out: Folder of the survey; it must not hold one.
        settings: Settings of the blocks.
        block_images: Largest number of images in the core of a block.
    """

    scene: Path
    out: Path
    settings: TrainSettings = field(default_factory=TrainSettings)
    block_images: int = 300


@dataclass(frozen=True)
class MergeSurveyRequest:
    """Merge the blocks of a survey into tiles, as the command `survey merge` does.

    Attributes:
        survey: Folder of the survey.
        partial: Whether blocks that are not done are left out.
    """

    survey: Path
    partial: bool = False


@dataclass(frozen=True)
class ReportRequest:
    """Write the report of a run that was killed before it had one.

    Attributes:
        run: Folder of the run.
    """

    run: Path


@dataclass(frozen=True)
class CancelRequest:
    """Stop the request at hand; what exists is kept.

    Attributes:
        now: Also stop the evaluation that a training ends with.
    """

    now: bool = False


@dataclass(frozen=True)
class PauseRequest:
    """Pause the training before the next iteration until `go_on`, `cancel` or the end of the stream."""


@dataclass(frozen=True)
class GoOnRequest:
    """Continue after `pause`."""


Request = (
    InspectRequest
    | SfmRequest
    | ScaleRequest
    | ImportCamerasRequest
    | PlanRequest
    | TrainRequest
    | ForecastRequest
    | ExportRequest
    | FilmRequest
    | LabelRequest
    | SearchRequest
    | ScoreEditRequest
    | ChartRequest
    | RestoreRequest
    | OrthoRequest
    | DemRequest
    | AreasRequest
    | ProfileRequest
    | ChangeRequest
    | PlanSurveyRequest
    | MergeSurveyRequest
    | ReportRequest
    | CancelRequest
    | PauseRequest
    | GoOnRequest
)
REQUESTS: dict[str, type[Request]] = {
    "inspect": InspectRequest,
    "sfm": SfmRequest,
    "scale": ScaleRequest,
    "import_cameras": ImportCamerasRequest,
    "plan": PlanRequest,
    "train": TrainRequest,
    "forecast": ForecastRequest,
    "export": ExportRequest,
    "film": FilmRequest,
    "label": LabelRequest,
    "search": SearchRequest,
    "score_edit": ScoreEditRequest,
    "chart": ChartRequest,
    "restore": RestoreRequest,
    "ortho": OrthoRequest,
    "dem": DemRequest,
    "areas": AreasRequest,
    "profile": ProfileRequest,
    "change": ChangeRequest,
    "plan_survey": PlanSurveyRequest,
    "merge_survey": MergeSurveyRequest,
    "report": ReportRequest,
    "cancel": CancelRequest,
    "pause": PauseRequest,
    "go_on": GoOnRequest,
}


def parse_request(line: str) -> Request:
    """Parse one line.

    Args:
        line: A JSON object with the name of the request and its fields.

    Returns:
        The request.

    Raises:
        InputError: When it is not a request; the message says what is wrong.
    """
    try:
        message = from_json(line)
    except ValueError as error:
        raise InputError(f"A request must be one JSON object a line: {error}.") from error
    if not isinstance(message, dict):
        raise InputError("A request must be a JSON object.")
    name = message.pop("request", None)
    kind = REQUESTS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InputError(f"Unknown request {name!r}; there are {', '.join(REQUESTS)}.")
    known = {entry.name: entry for entry in fields(kind)}
    unknown = sorted(set(message) - set(known))
    if unknown:
        raise InputError(f"The request {name} has no field {', '.join(unknown)}; it has {', '.join(known)}.")
    values = {key: parse_value(name, key, known[key].type, value) for key, value in message.items()}
    try:
        return kind(**values)
    except TypeError:
        required = [key for key, entry in known.items() if entry.default is entry.default_factory is MISSING]
        raise InputError(f"The request {name} needs {', '.join(required)}.") from None


def parse_value(request: str, key: str, kind: Any, value: Any) -> Any:
    """Convert one field of a request to its type.

    Args:
        request: Name of the request.
        key: Name of the field.
        kind: Type of the field.
        value: Value from JSON.

    Returns:
        The value of that type.

    Raises:
        InputError: When the value does not fit.
    """
    if kind in (Path, Path | None) and isinstance(value, str) and value:
        return Path(value)
    if kind is str and isinstance(value, str) and value:
        return value
    if kind is bool and isinstance(value, bool):
        return value
    if kind is TrainSettings and isinstance(value, dict):
        return TrainSettings.from_json(value)
    if kind is ColorView and isinstance(value, dict):
        return ColorView.from_json(value)
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind is float and is_number(value):
        return float(value)
    if kind in NUMBERS and isinstance(value, list) and len(value) == len(get_args(kind)) and all(map(is_number, value)):
        return tuple(map(float, value))
    if kind is FormatName and value in get_args(FormatName):
        return value
    raise InputError(f"The request {request} has {key} = {value!r}, which is not {describe(kind)}.")


def is_number(value: Any) -> bool:
    """Return whether a value from JSON is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")


def describe(kind: Any) -> str:
    """Return a name for the type of a field."""
    words: dict[Any, str] = {
        Path: "a path",
        str: "a text",
        bool: "true or false",
        TrainSettings: "an object of settings",
        ColorView: "an object of developments",
        int: "a whole number",
        float: "a number",
        **{kind: f"{len(get_args(kind))} numbers" for kind in NUMBERS},
    }
    words[Path | None] = words[Path]
    return words.get(kind) or f"one of {', '.join(get_args(kind))}"
