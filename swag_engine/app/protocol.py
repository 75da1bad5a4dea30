"""The messages between the worker and whoever started it: one JSON object a line."""

from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from ..base.errors import InputError
from ..base.strict_json import from_json
from ..formats.registry import FormatName
from ..settings.settings import TrainSettings


@dataclass(frozen=True)
class InspectRequest:
    """Read a scene; `arrays` is the folder for the arrays of the answer."""

    scene: Path
    arrays: Path


@dataclass(frozen=True)
class TrainRequest:
    """Train `scene` to the run folder `out`."""

    scene: Path
    out: Path
    settings: TrainSettings = field(default_factory=TrainSettings)
    resume: bool = False


@dataclass(frozen=True)
class ForecastRequest:
    """Say what each preset would take and reach on `scene`."""

    scene: Path
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class PlanRequest:
    """Say which effects `scene` calls for; `settings` are those of a run that would follow. The plan goes to plan.json
    in the folder `out`, or in the scene's."""

    scene: Path
    out: Path | None = None
    settings: TrainSettings = field(default_factory=TrainSettings)


@dataclass(frozen=True)
class ExportRequest:
    """Write the result of the run folder `run` to the file `out`."""

    run: Path
    format: FormatName
    out: Path


@dataclass(frozen=True)
class LabelRequest:
    """Label the Gaussians of the run `run` by `words` (between commas), by the folder `masks`, by what stands out
    (`saliency`), or as the command `label` does by itself; `download`: networks may be fetched."""

    run: Path
    words: str = ""
    masks: Path | None = None
    saliency: bool = False
    download: bool = False


@dataclass(frozen=True)
class SearchRequest:
    """Write how near each Gaussian of the labelled run `run` is to `words` to the .npy file `path`."""

    run: Path
    words: str
    path: Path


@dataclass(frozen=True)
class CancelRequest:
    """Stop what is running; what exists is kept."""


@dataclass(frozen=True)
class PauseRequest:
    """Wait before the next iteration until `go_on`, `cancel` or the end of the stream."""


@dataclass(frozen=True)
class GoOnRequest:
    """Go on after `pause`."""


Request = (
    InspectRequest
    | PlanRequest
    | TrainRequest
    | ForecastRequest
    | ExportRequest
    | LabelRequest
    | SearchRequest
    | CancelRequest
    | PauseRequest
    | GoOnRequest
)
REQUESTS: dict[str, type[Request]] = {
    "inspect": InspectRequest,
    "plan": PlanRequest,
    "train": TrainRequest,
    "forecast": ForecastRequest,
    "export": ExportRequest,
    "label": LabelRequest,
    "search": SearchRequest,
    "cancel": CancelRequest,
    "pause": PauseRequest,
    "go_on": GoOnRequest,
}


def parse_request(line: str) -> Request:
    """The request in one line. Raises InputError that names what is wrong with it."""
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
        raise InputError(f"The request {name} knows no {', '.join(unknown)}.")
    values = {key: parse_value(name, key, known[key].type, value) for key, value in message.items()}
    try:
        return kind(**values)
    except TypeError:
        required = [key for key, entry in known.items() if entry.default is entry.default_factory is MISSING]
        raise InputError(f"The request {name} needs {', '.join(required)}.") from None


def parse_value(request: str, key: str, kind: Any, value: Any) -> Any:
    """One field of a request as the type that the dataclass gives it."""
    if kind in (Path, Path | None) and isinstance(value, str) and value:
        return Path(value)
    if kind is str and isinstance(value, str) and value:
        return value
    if kind is bool and isinstance(value, bool):
        return value
    if kind is TrainSettings and isinstance(value, dict):
        return TrainSettings.from_json(value)
    if kind is FormatName and value in get_args(FormatName):
        return value
    raise InputError(f"The request {request} has {key} = {value!r}, which is no {describe(kind)}.")


def describe(kind: Any) -> str:
    words: dict[Any, str] = {Path: "path", str: "text", bool: "true or false", TrainSettings: "object of settings"}
    words[Path | None] = words[Path]
    return words.get(kind) or f"one of {', '.join(get_args(kind))}"
