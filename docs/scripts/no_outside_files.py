"""Stop the build of the documentation where a page loads a script, style, font or picture from another site."""

import re
from typing import Any

from mkdocs.exceptions import PluginError

OUTSIDE = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
"""Elements that a browser loads; links that a reader follows are no such elements."""


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Return the page unchanged.

    Raises:
        PluginError: Where it loads something from outside.
    """
    if found := OUTSIDE.search(output):
        raise PluginError(f"{page.file.src_uri} loads a file from outside: {found[0]}")
    return output
