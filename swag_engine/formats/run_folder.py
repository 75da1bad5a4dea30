"""The folder of a run: which files it has, and how they are written and read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import DAMAGE, InputError, remedy
from ..base.files import atomic_path, no_link, not_writable, read_text
from ..base.strict_json import from_json, to_json
from ..scene.image_files import IMAGE_SUFFIXES
from ..settings.settings import TrainSettings
from ..splats.development import NO_DEVELOPMENT, ColorView, Development
from ..splats.splats import Splats
from .registry import FORMATS


@dataclass(frozen=True)
class RunFolder:
    """The files of one run.

    Attributes:
        path: The folder, which need not exist yet.
    """

    path: Path

    @property
    def config(self) -> Path:
        """Scene, settings and up direction."""
        return self.path / "config.json"

    @property
    def metrics_log(self) -> Path:
        """One JSON object a line for each report during training."""
        return self.path / "metrics.jsonl"

    @property
    def metrics(self) -> Path:
        """Figures of a run that has ended."""
        return self.path / "metrics.json"

    @property
    def results(self) -> dict[str, Path]:
        """The file of the result in every export format that leaves nothing out, by the format's name."""
        return {
            name: self.path / f"result{format.suffix}" for name, format in FORMATS.items() if "extras" in format.options
        }

    @property
    def ply(self) -> Path:
        """The result as 3DGS PLY, from which the other commands read the splats."""
        return self.results["ply"]

    def refuse_own(self, *outputs: Path) -> None:
        """Refuse to write where a file of the run, a photo of its scene or its COLMAP model would be replaced.

        Args:
            *outputs: Files that a command is going to write; what they name through links counts.

        Raises:
            InputError: For the first such file.
        """
        from ..scene.colmap import load_scene

        scene = None
        for path in outputs:
            real = path.resolve()
            if not real.exists():
                continue
            own = real.parent == self.path.resolve() and (
                real in {each.resolve() for each in (self.config, self.metrics, self.plan, *self.results.values())}
                or real.name.startswith("checkpoint-")
            )
            if not own and scene is None:
                try:
                    folder = self.read_config()[0]
                    scene = load_scene(folder, read_scale=False) if real.is_relative_to(folder.resolve()) else None
                except InputError:
                    scene = None  # its photos are not here
            if scene is not None:
                folders = {view.path.resolve().parent for view in scene.views}
                own |= real.parent in folders and real.suffix.lower() in IMAGE_SUFFIXES
                own |= real.is_relative_to(scene.model_folder.resolve())
            if own:
                raise InputError(f"{path} belongs to the run or to its scene and is not replaced: choose another name.")

    def write_result(self, splats: Splats, up: Sequence[float] | np.ndarray) -> None:
        """Write the files of `results`.

        Args:
            splats: Splats of the run.
            up: Up direction (3,) in the scene's coordinates.

        Raises:
            InputError: If a file cannot be written.
        """
        for name, path in self.results.items():
            FORMATS[name].write(path, splats, up, ())

    @property
    def water(self) -> Path:
        """The learned water."""
        return self.path / "water.json"

    @property
    def plan(self) -> Path:
        """The plan that the run follows."""
        return self.path / "plan.json"

    @property
    def chart(self) -> Path:
        """Colors of a color chart, and the correction that they ask for."""
        return self.path / "chart.json"

    @property
    def preview(self) -> Path:
        """Splats during training, for the viewport."""
        return self.path / "preview.ply"

    def write_config(
        self, scene: Path, settings: TrainSettings, up: list[float], hardware: dict[str, Any] | None = None
    ) -> None:
        """Write config.json.

        Args:
            scene: Folder of the scene.
            settings: All settings of the run.
            up: Up direction (3,) in the scene's coordinates.
            hardware: What computes the run: the fields of `Hardware`.

        Raises:
            InputError: If the file cannot be written.
        """
        document = {"scene": str(scene.resolve()), "settings": settings.to_json(), "up": up, "hardware": hardware}
        write_json(self.config, document)

    def read_config(self) -> tuple[Path, TrainSettings, list[float]]:
        """Read config.json.

        Returns:
            Folder of the scene, settings, and up direction (3,) in the scene's coordinates.

        Raises:
            InputError: If the folder is not a run or the file is damaged.
        """
        document = read_json(self.config, f"{self.path} is not a training run: it has no config.json.")
        try:
            up = [float(value) for value in document["up"]]
            return Path(document["scene"]), TrainSettings.from_json(document["settings"]), up
        except DAMAGE as error:
            raise InputError(f"{self.config} is not a training run's configuration: {error!r}.") from error

    def resumed_settings(self, scene_folder: Path, asked: TrainSettings) -> tuple[TrainSettings, bool]:
        """Find the settings with which the run continues.

        A run continues for longer than it was started for where more iterations, or a further time budget, are asked,
        and on another backend where one is: the driver of a graphics card may end every process that uses it.

        Args:
            scene_folder: Folder of the scene that the user named.
            asked: Settings that the user named, the others at their defaults.

        Returns:
            The settings that the run was started with, and whether it continues for longer than these say.

        Raises:
            InputError: If the run is of another scene, was started with other settings, or is finished.
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
                f"The run {self.path} is finished already; its result is {self.ply.name}. "
                + remedy(
                    f"To continue it, give more --iterations than {self.iterations()}, or a --time-budget.",
                    "Press Train to start another one.",
                )
            )
        if asked.backend != TrainSettings().backend:
            settings = replace(settings, backend=asked.backend)
        default, started = TrainSettings().to_json(), settings.to_json()
        for name, value in asked.to_json().items():
            if value not in (default[name], started[name]):
                title = name.replace("_", " ")
                raise InputError(
                    f"The run {self.path} was started with {title} {started[name]}; it cannot continue with {value}."
                )
        return settings, longer

    def discard(self) -> None:
        """Remove the files of a run that failed before its first iteration."""
        self.config.unlink(missing_ok=True)
        self.plan.unlink(missing_ok=True)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write metrics.json.

        Raises:
            InputError: If the file cannot be written.
        """
        write_json(self.metrics, metrics)

    def read_water(self) -> dict[str, Any] | None:
        """Read water.json.

        Returns:
            The learned water, None where the run models none.

        Raises:
            InputError: If the file is damaged.
        """
        return read_json(self.water, "") if self.water.exists() else None

    @property
    def development(self) -> Path:
        """The automatic development of the restored colors."""
        return self.path / "development.json"

    def write_development(self, values: dict[str, Any]) -> None:
        """Write the automatic development.

        Args:
            values: What `Development.to_json` returned, and figures for the report.

        Raises:
            InputError: If the file cannot be written.
        """
        write_json(self.development, values)

    def read_developments(self) -> dict[str, Any]:
        """Read the automatic development, and that from a color chart.

        Returns:
            The developments by the names that `--develop` has for them; empty where the run has none.

        Raises:
            InputError: If a file is damaged.
        """
        files = {"auto": self.development, "chart": self.chart}
        return {name: read_json(path, "") for name, path in files.items() if path.exists()}

    def has_background_color(self) -> bool:
        """Return whether a color was learned for what is behind all splats: not where open water has its own."""
        return self.metrics.exists() and any(read_json(self.metrics, "").get("background", ()))

    def color_view(self, develop: str) -> ColorView:
        """Find how colors of the run are shown.

        Args:
            develop: `none`; `auto` or `chart`, a development of the run, which fades as water is shown; or values as
                `Development.from_text` reads them, which do not.

        Returns:
            The view. Colors of a run without an automatic development are shown as they are.

        Raises:
            InputError: If `develop` is not valid, or the run has no color chart. For `auto` and `chart` also if
                development.json or chart.json is damaged, even the one that is not asked for: the message names the
                file. Without development.json, `auto` shows colors as they are; `develop_run.color_view` makes the
                development anew. For other values of `develop` neither file is read.
        """
        if develop == "none":
            return ColorView()
        if develop not in ("auto", "chart"):
            return ColorView(adjusted=Development.from_text(develop))
        values = self.read_developments().get(develop)
        if values is None and develop == "chart":
            how = remedy("find it with `chart`, or use auto", "press Find Color Chart, or use Automatic")
            raise InputError(f"The run {self.path} has no color chart: {how}.")
        return ColorView(restored=NO_DEVELOPMENT if values is None else Development.from_json(values))

    def finished(self) -> bool:
        """Return whether the run did all its iterations, and was not interrupted."""
        return self.metrics.exists() and not self._ended("interrupted", bool)

    def iterations(self) -> int:
        """Return how many iterations a run that has ended did; 0 for others."""
        return self._ended("iteration", int) if self.metrics.exists() else 0

    def _ended(self, name: str, kind: type) -> Any:
        value = read_json(self.metrics, "").get(name)
        if type(value) is not kind:
            raise InputError(f"{self.metrics} is damaged: {name} is {value!r}; remove the file to continue the run.")
        return value

    def log_until(self, iteration: int) -> None:
        """Remove the lines of metrics.jsonl past an iteration: a resumed run writes them again."""
        if not self.metrics_log.exists():
            return
        lines = []
        for line in read_text(self.metrics_log, errors="replace").splitlines():
            try:
                entry = from_json(line)
                keep = entry["iteration"] <= iteration and "test_psnr" not in entry
            except (ValueError, KeyError, TypeError):
                continue  # an incomplete line of a run that was killed
            if keep:
                lines.append(line + "\n")
        with atomic_path(self.metrics_log) as temporary:
            temporary.write_text("".join(lines), encoding="utf-8")

    def log(self, entry: dict[str, Any]) -> None:
        """Append one line to metrics.jsonl.

        Raises:
            InputError: If the file cannot be written.
        """
        try:
            with open(self.metrics_log, "a", encoding="utf-8", opener=no_link) as log:
                log.write(to_json(entry) + "\n")
        except OSError as error:
            raise not_writable(self.metrics_log, error) from error


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write an object to a JSON file, which is whole or as it was.

    Raises:
        InputError: If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(to_json(document, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path, missing: str) -> dict[str, Any]:
    """Read the object in a JSON file.

    Args:
        path: The file.
        missing: Message of the error for a file that does not exist.

    Returns:
        The object.

    Raises:
        InputError: If the file does not exist, cannot be read, or holds no object.
    """
    try:
        document = from_json(read_text(path))
    except FileNotFoundError as error:
        raise InputError(missing) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
    if not isinstance(document, dict):
        raise InputError(f"{path} does not hold a JSON object.")
    return document
