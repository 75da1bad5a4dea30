"""A file of cameras, read as text, JSON or XML when a reader asks for it."""

import json
import xml.etree.ElementTree as ElementTree
from functools import cached_property
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import read_bytes
from ..base.text import text_encoding


class Source:
    """A file that may hold cameras.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def data(self) -> bytes:
        """The bytes of the file.

        Raises:
            InputError: When it cannot be read.
        """
        try:
            return read_bytes(self.path)
        except OSError as error:
            raise InputError(f"Cannot read {self.path}: {error.strerror or error}.") from error

    @cached_property
    def text(self) -> str:
        """The text of the file."""
        try:
            return self.data.decode(text_encoding(self.data))
        except UnicodeDecodeError:
            return self.data.decode("latin-1")

    @cached_property
    def json(self) -> Any:
        """The JSON document, None where the file is none."""
        if self.text.lstrip()[:1] not in ("{", "["):
            return None
        try:
            return json.loads(self.text)
        except (ValueError, RecursionError):
            return None

    @cached_property
    def xml(self) -> ElementTree.Element | None:
        """The root of the XML document, None where the file is none."""
        if self.text.lstrip()[:1] != "<":
            return None
        try:
            return ElementTree.fromstring(self.data.strip())
        except ElementTree.ParseError:
            return None
