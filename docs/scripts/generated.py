"""Replace generated text between markers in the pages of the documentation."""

import re
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"(<!-- table: ([\w ]+) -->\n).*?(<!-- end -->)", re.DOTALL)
"""A block of a page: its first line, the name in it, and its last line."""


def pages() -> list[Path]:
    """Return README.md and the pages of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def filled(text: str, texts: Mapping[str, str]) -> str:
    """Replace the content of the blocks of a page whose names are in `texts`.

    Args:
        text: The page.
        texts: Content by name.

    Returns:
        The page with new content.
    """

    def block(match: re.Match[str]) -> str:
        content = texts.get(match[2])
        return match[0] if content is None else f"{match[1]}\n{content}\n\n{match[3]}"

    return BLOCK.sub(block, text)


def names_in(text: str) -> list[str]:
    """Return the names of the blocks of a page."""
    return [match[2] for match in BLOCK.finditer(text)]


def update(files: Mapping[Path, str], check: bool, command: str) -> int:
    """Write files, or compare them with what they should hold.

    Args:
        files: Content by path.
        check: Compare only.
        command: What makes stale files current, for the message.

    Returns:
        The exit code: 1 where a file is stale in a check.
    """
    stale = {path: text for path, text in files.items() if not path.exists() or path.read_text("utf-8") != text}
    for path, text in stale.items():
        if check:
            print(f"{path.relative_to(ROOT)} is stale: run `{command}` and commit what changed.")
        else:
            path.write_text(text, "utf-8")
            print(f"Wrote {path.relative_to(ROOT)}.")
    return 1 if check and stale else 0
