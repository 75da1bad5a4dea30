"""Pages of the engine in the web browser."""

import webbrowser
from pathlib import Path

from ..swag_engine.base.errors import InputError


def open_page(page: Path) -> None:
    """Open an HTML file in the web browser.

    Raises:
        InputError: there is no browser.
    """
    if not webbrowser.open(page.absolute().as_uri()):
        raise InputError(f"No web browser can be started; open {page} yourself.")
