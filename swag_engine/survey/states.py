"""State and progress of a survey's jobs, read from their files."""

from typing import Any

from ..base.strict_json import from_json
from ..formats.survey_folder import State, SurveyFolder


def state_of(folder: SurveyFolder, name: str) -> State:
    """Return the state of a block, or of the coarse model."""
    if folder.done(name).exists():
        return "done"
    if folder.claim(name).exists():
        return "running"
    if folder.failed(name).exists():
        return "failed"
    return "begun" if any(folder.run(name).path.glob("checkpoint-*.safetensors")) else "waiting"


def progress_of(folder: SurveyFolder, name: str) -> dict[str, Any]:
    """Return the last complete line of a job's metrics.jsonl; empty where there is none."""
    try:
        with open(folder.run(name).metrics_log, "rb") as log:
            log.seek(max(0, log.seek(0, 2) - 4000))
            lines = log.read().split(b"\n")
    except OSError:
        return {}
    for line in reversed(lines[:-1]):
        try:
            return from_json(line.decode())
        except ValueError:
            continue
    return {}
