"""What a run leaves in its folder, and how it is found again."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.strict_json import from_json, to_json
from ..settings.settings import TrainSettings


@dataclass(frozen=True)
class RunFolder:
    """One run = one folder. `path` need not exist yet."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.json"

    @property
    def metrics_log(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.json"

    @property
    def ply(self) -> Path:
        return self.path / "result.ply"

    @property
    def glb(self) -> Path:
        return self.path / "result.glb"

    @property
    def water(self) -> Path:
        return self.path / "water.json"

    @property
    def plan(self) -> Path:
        return self.path / "plan.json"

    @property
    def preview(self) -> Path:
        return self.path / "preview.ply"

    def write_config(self, scene: Path, settings: TrainSettings, up: list[float]) -> None:
        """config.json: the scene's folder, every setting, and which way is up in the scene's coordinates."""
        document = {"scene": str(scene.resolve()), "settings": settings.to_json(), "up": up}
        write_json(self.config, document)

    def read_config(self) -> tuple[Path, TrainSettings, list[float]]:
        """Scene folder, settings and up vector of a run. Raises InputError when this is not a run."""
        document = read_json(self.config, f"{self.path} is not a training run: it has no config.json.")
        try:
            up = [float(value) for value in document["up"]]
            return Path(document["scene"]), TrainSettings.from_json(document["settings"]), up
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{self.config} is not a training run's configuration: {error!r}.") from error

    def resumed_settings(self, scene_folder: Path, asked: TrainSettings) -> tuple[TrainSettings, bool]:
        """The settings that the run was started with, and whether it is to go on for longer than these say.

        With more iterations it does, or for a further time budget. Raises InputError where the request names other
        settings, or nothing is left.
        """
        scene, settings, _ = self.read_config()
        if scene.resolve() != scene_folder.resolve():
            raise InputError(f"The run {self.path} belongs to the scene {scene}, not to {scene_folder}.")
        longer = asked.iterations > max(settings.iterations, self.iterations()) or bool(
            asked.budget and self.finished()
        )
        if longer:
            settings = replace(settings, iterations=asked.iterations, time_budget=asked.time_budget)
        elif self.finished():
            raise InputError(
                f"The run {self.path} is finished already; its result is {self.ply.name}. More --iterations than "
                f"{self.iterations()}, or a --time-budget, make it go on."
            )
        default, kept = TrainSettings().to_json(), settings.to_json()
        for name, value in asked.to_json().items():
            if value not in (default[name], kept[name]):
                title = name.replace("_", " ")
                raise InputError(
                    f"The run {self.path} was started with {title} {kept[name]}; it cannot go on with {value}."
                )
        return settings, longer

    def discard(self) -> None:
        """Take back a run that never began."""
        self.config.unlink(missing_ok=True)
        self.plan.unlink(missing_ok=True)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        write_json(self.metrics, metrics)

    def read_water(self) -> dict[str, Any] | None:
        """The water that the run found; None where it modelled none. Raises InputError when the file is damaged."""
        return read_json(self.water, "") if self.water.exists() else None

    def finished(self) -> bool:
        """Whether the run came to its end and not merely to a stop."""
        return self.metrics.exists() and not self._ended("interrupted", bool)

    def iterations(self) -> int:
        """How many iterations a run that ended has; 0 for others."""
        return self._ended("iteration", int) if self.metrics.exists() else 0

    def _ended(self, name: str, kind: type) -> Any:
        value = read_json(self.metrics, "").get(name)
        if type(value) is not kind:
            raise InputError(f"{self.metrics} is damaged: {name} is {value!r}; remove the file to go on with the run.")
        return value

    def log_until(self, iteration: int) -> None:
        """Drop lines of metrics.jsonl past `iteration`: a resumed run writes them again."""
        if not self.metrics_log.exists():
            return
        kept = []
        for line in self.metrics_log.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                entry = from_json(line)
                keep = entry["iteration"] <= iteration and "test_psnr" not in entry
            except (ValueError, KeyError, TypeError):
                continue  # half a line, of a run that was killed
            if keep:
                kept.append(line + "\n")
        with atomic_path(self.metrics_log) as temporary:
            temporary.write_text("".join(kept), encoding="utf-8")

    def log(self, entry: dict[str, Any]) -> None:
        """Append one line to metrics.jsonl."""
        try:
            with open(self.metrics_log, "a", encoding="utf-8") as log:
                log.write(to_json(entry) + "\n")
        except OSError as error:
            raise InputError(f"Cannot write {self.metrics_log}: {error.strerror or error}.") from error


def write_json(path: Path, document: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(to_json(document, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path, missing: str) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError: with the sentence `missing` when there is no file."""
    try:
        document = from_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(missing) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
    if not isinstance(document, dict):
        raise InputError(f"{path} does not hold a JSON object.")
    return document
