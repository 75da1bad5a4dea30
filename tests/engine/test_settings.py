"""Settings: one field gives validation, command line and Blender property."""

from dataclasses import dataclass, fields

import pytest

from swag_engine.app import cli
from swag_engine.base.errors import InputError
from swag_engine.experiments.grid import Grid
from swag_engine.formats.export import ExportOptions
from swag_engine.kernels.backends import KERNELS
from swag_engine.settings.field import check_settings, setting, settings_of
from swag_engine.settings.settings import BACKENDS, TrainSettings


@dataclass(frozen=True)
class Example:
    count: int = setting(0, "Count", "How many", least=2, most=9, unit="px", zero="automatic")
    scale: float = setting(1.0, "Scale", "How large", least=0.5, most=2.0)
    kind: str = setting("a", "Kind", "Which", choices={"a": "First", "b": "Second"})
    text: str = setting("", "Text", "What")
    flag: bool = setting(False, "Flag", "Whether")
    counts: tuple[int, ...] = setting((), "Counts", "How many of each", least=1, most=5)
    kinds: tuple[str, ...] = setting(("a",), "Kinds", "Which", choices={"a": "First", "b": "Second"})
    corner: tuple[float, float] | None = setting(None, "Corner", "Where")

    def __post_init__(self) -> None:
        check_settings(self)


@pytest.mark.parametrize(
    "values",
    [
        {}, {"count": 0}, {"count": 9}, {"scale": 2}, {"kind": "b"}, {"text": "x"}, {"flag": True}, {"counts": (1, 5)},
        {"kinds": ()}, {"kinds": ("b", "a")}, {"corner": None}, {"corner": (1, -2.5)},
    ],
)  # fmt: skip
def test_values_within_the_range_are_accepted(values):
    example = Example(**values)
    assert all(getattr(example, name) == value for name, value in values.items())


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"count": 1}, "a whole number from 2 to 9 px, or 0 (automatic), not 1"),
        ({"count": 10}, "from 2 to 9 px"),
        ({"count": 3.0}, "a whole number"),
        ({"count": True}, "a whole number"),
        ({"scale": float("nan")}, "a number from 0.5 to 2.0, not nan"),
        ({"scale": 0.0}, "from 0.5 to 2.0, not 0.0"),
        ({"scale": "1"}, "a number"),
        ({"kind": "c"}, "one of a, b, not 'c'"),
        ({"kind": 1}, "a text, not 1"),
        ({"kind": ["a"]}, "a text"),
        ({"text": 5}, "a text, not 5"),
        ({"flag": 1}, "true or false, not 1"),
        ({"counts": (1, 6)}, "a whole number from 1 to 5, not 6"),
        ({"counts": (1, 2.0)}, "a whole number from 1 to 5, not 2.0"),
        ({"counts": 3}, "a tuple of values, not 3"),
        ({"counts": None}, "a tuple of values, not None"),
        ({"kinds": ("a", "c")}, "one of a, b, not 'c'"),
        ({"corner": (1.0,)}, "2 values, not 1"),
        ({"corner": (1.0, float("nan"))}, "a number, not nan"),
        ({"corner": "12"}, "a tuple of values, not '12'"),
    ],
)
def test_a_wrong_value_is_refused_with_the_allowed_ones(values, words):
    with pytest.raises(InputError) as refused:
        Example(**values)
    assert words in str(refused.value) and next(iter(values)) in str(refused.value)


@pytest.mark.parametrize("options", [TrainSettings, ExportOptions, Grid])
def test_every_setting_is_described(options):
    names = []
    for name, default, described in settings_of(options):
        names.append(name)
        assert described.label and described.help and not described.help.endswith("."), name
        is_number = isinstance(default, int | float) and not isinstance(default, bool)
        assert not is_number or described.range or options is Grid, name
        assert getattr(options(), name) == default
    assert names == [field.name for field in fields(options)]


@pytest.mark.parametrize(("command", "options"), [("train", TrainSettings), ("export", ExportOptions)])
def test_the_command_line_shows_every_setting_with_its_help(command, options, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert not ended.value.code
    printed = capsys.readouterr().out
    letters = "".join(printed.replace("│", " ").split())  # long words are broken between lines
    for name, _, described in settings_of(options):
        shown = [f"--{name.replace('_', '-')}", described.description]
        shown += [f"{choice}: {text}." for choice, text in described.choices.items()]
        assert all("".join(text.split()) in letters for text in shown), name


def test_the_setting_backend_offers_every_backend():
    assert set(BACKENDS) == {"auto", *KERNELS}
