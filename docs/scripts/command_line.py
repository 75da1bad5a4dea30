"""Write docs/cli.md from the commands and their options.

Run: `python docs/scripts/command_line.py [--check]`

With --check nothing is written, and the exit code is 1 where the page is stale.
"""

import ast
import dataclasses
import inspect
import sys
import textwrap
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parent))

from generated import ROOT, update

from swag_engine.app.cli import COMMANDS, DESCRIPTION, command_name
from swag_engine.app.survey import Step, Survey
from swag_engine.settings.field import settings_of
from swag_engine.settings.settings import TrainSettings

START = f"""# Command line

This page is generated from the commands themselves. `swag COMMAND` works wherever the package is installed;
`python -m swag_engine COMMAND` is the same, and so is `blender --background --command swag COMMAND`, which has one more
command, `import`.

```
swag train SCENE --out RUN --preset draft
swag render RUN --out pictures --water 0
swag export RUN --format glb --out scene.glb
```

`swag` alone shows how to start. Its completion for bash (for zsh and tcsh write their name):

```
swag --tyro-print-completion bash > ~/.local/share/bash-completion/completions/swag
```

{DESCRIPTION}
"""


POSITIONAL = {"run-folder": "RUN", "folder": "FOLDER"}
"""What a user writes for arguments by place, where it is not the name of the field."""


def sentences_of(options: type) -> dict[str, str]:
    """Return the text behind each field of a dataclass by the field's name."""
    described = {name: f"{setting.description}." for name, _, setting in settings_of(options)}
    body = ast.parse(textwrap.dedent(inspect.getsource(options))).body[0].body  # type: ignore[attr-defined]
    for field, text in zip(body, body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            described[field.target.id] = " ".join(ast.literal_eval(text.value).split())  # type: ignore[union-attr]
    return described


def value_of(kind: Any) -> str:
    """Return what a user writes for a value of a type, such as "NUMBER"; empty for a switch."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return value_of(arguments[0])
    if origin is Literal:
        return "`" + "`, `".join(arguments) + "`"
    if origin is tuple:
        return f"{value_of(arguments[0])} ..."
    if type(None) in arguments:
        return value_of(next(argument for argument in arguments if argument is not type(None)))
    return {bool: "", int: "NUMBER", float: "NUMBER", str: "TEXT", Path: "PATH"}[kind]


def shown(default: Any) -> str:
    """Return a default as the table shows it."""
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    nothing = default in (None, "", False, dataclasses.MISSING)
    return "" if nothing and default != 0 or default is False else f"{default}"


def rows(command: type) -> Iterator[tuple[str, str]]:
    """Yield the argument and its meaning for each field of a command; options of training have a section."""
    kinds, sentences = typing.get_type_hints(command, include_extras=True), sentences_of(command)
    for field in dataclasses.fields(command):
        kind, factory = kinds[field.name], field.default_factory
        if isinstance(factory, type) and dataclasses.is_dataclass(factory):
            if factory is TrainSettings:
                yield "[Training settings](#training-settings)", "How to train."
            else:
                yield from rows(factory)
            continue
        text, name = sentences[field.name], field.name.replace("_", "-")
        settings = {known: setting for known, _, setting in settings_of(command)}
        if field.name in settings:
            described = settings[field.name]
            text += "".join(f" `{choice}`: {meaning}." for choice, meaning in described.choices.items())
            text += f" Allowed: {described.range}." if described.range and not described.choices else ""
        required = field.default is dataclasses.MISSING
        if "Positional" in str(kind):
            yield f"`{POSITIONAL.get(name, name.upper())}`", text
        else:
            value = value_of(kind)
            default = shown(field.default)
            text += " Required." if required else f" Default: {default}." if default else ""
            yield f"`--{name}`{' ' + value if value and not value.startswith('`') else ''}", text


def section(title: str, description: str, options: type) -> str:
    """Return a section with the table of a dataclass of options."""
    lines = [f"| {option} | {text.replace('|', chr(92) + '|')} |" for option, text in rows(options)]
    table = "\n".join(["| Argument | Meaning |", "| --- | --- |", *lines])
    return f"## {title}\n\n{description}\n\n{table}\n"


def page() -> str:
    """Return the whole page."""
    named = {}
    for command in COMMANDS:
        if command is Survey:
            named |= {f"survey {command_name(step)}": step for step in typing.get_args(Step)}
        else:
            named[command_name(command)] = command
    commands = [section(name, inspect.cleandoc(each.__doc__ or ""), each) for name, each in named.items()]
    settings = section("Training settings", "Options of `train`, `forecast` and `survey plan`.", TrainSettings)
    return "\n".join([START, *commands, settings])


if __name__ == "__main__":
    sys.exit(update({ROOT / "docs" / "cli.md": page()}, "--check" in sys.argv, "python docs/scripts/command_line.py"))
