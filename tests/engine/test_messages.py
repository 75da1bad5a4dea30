"""Messages: what the user can do is said for the command line, and by buttons for Blender."""

import ast
import re
from pathlib import Path

import pytest

from swag_engine.base import errors

COMMAND = re.compile(r"(^|[\s(])--[a-z]|`|python -m|on the command line")
WITHOUT_BUTTONS = (
    # Blender does not reach them, or always gives what they ask for.
    "app/", "survey/executors/", "survey/export.py", "kernels/", "evaluation/lpips.py", "georeference/", "colorchart/",
)  # fmt: skip


def messages(tree):
    """Constant parts of the messages of the InputErrors that a file raises, without the arguments of `remedy`."""
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "InputError":
            waiting: list[ast.AST] = list(call.args)
            while waiting:
                node = waiting.pop()
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.lineno, node.value
                elif not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "remedy"):
                    waiting += ast.iter_child_nodes(node)


def test_messages_that_blender_shows_name_no_command():
    root = Path(errors.__file__).parents[1]
    found = []
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if not name.startswith(WITHOUT_BUTTONS):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found += [f"{name}:{line}: {text}" for line, text in messages(tree) if COMMAND.search(text)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("buttons", [False, True])
def test_a_remedy_is_that_of_the_program(buttons, monkeypatch):
    monkeypatch.setattr(errors, "_names_buttons", False)
    if buttons:
        errors.name_buttons()
    assert errors.remedy("give --box", "press Crop") == ("press Crop" if buttons else "give --box")
    assert ("--resume" in errors.continue_run()) != buttons
