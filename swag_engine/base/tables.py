"""Tables of measurements: CSV files as spreadsheets write them."""

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .errors import InputError
from .files import read_bytes
from .text import text_encoding

MOST_BYTES = 64 << 20
"""Bytes of a table; a million rows take about as many."""


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        path: The file.
        line: Its line, from 1.
        values: Text by the lower-case name of its column.
        decimal_comma: Whether numbers may have a comma for the decimal point.
    """

    path: Path
    line: int
    values: dict[str, str]
    decimal_comma: bool

    def text(self, column: str) -> str:
        """Return the text of a column, "" where the row has none."""
        return self.values.get(column, "")

    def number(self, column: str) -> float:
        """Return the number of a column.

        Raises:
            InputError: If it is not a finite number.
        """
        text = self.text(column)
        try:
            value = float(text.replace(",", ".") if self.decimal_comma else text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{self.path}, line {self.line}: {column} is {text!r}, which is not a number.")
        return value


def read_table(path: Path, columns: Sequence[str]) -> list[Row]:
    """Read a table with a heading of names, as `parse_table` does.

    Raises:
        InputError: If the file cannot be read, or a column or all rows are missing.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} is larger than {MOST_BYTES >> 20} MiB, and no table of measurements.")
        data = read_bytes(path)
        text = data.decode(text_encoding(data))
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text in UTF-8: save it as CSV (UTF-8).") from error
    return parse_table(path, text, columns)


def parse_table(path: Path, text: str, columns: Sequence[str]) -> list[Row]:
    """Read the text of a table with a heading of names.

    Columns are separated by commas, semicolons or tabs; with the latter two, numbers may have a decimal comma. Lines
    that are empty or begin with # are skipped, except for a heading that begins with # and the first of `columns`.

    Args:
        path: The file, for messages.
        text: Its text.
        columns: Lower-case names of columns that it must have; a row that ends early has "" in the rest.

    Returns:
        Its rows, at least one.

    Raises:
        InputError: If a column or all rows are missing, or a row has more cells than the heading.
    """
    heading = re.compile(rf"\s*#\s*{columns[0]}\s*[,;\t]", re.IGNORECASE)
    numbered = [
        (n, line)
        for n, line in enumerate(text.splitlines(), 1)
        if line.strip() and (not line.lstrip().startswith("#") or heading.match(line))
    ]
    if not numbered:
        raise InputError(f"{path} is empty: it needs a first line with the columns {', '.join(columns)}.")
    separator = max(",;\t", key=numbered[0][1].count)
    try:
        cells = list(csv.reader((line for _, line in numbered), delimiter=separator, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path} is not a table: {error}.") from error
    names = [name.strip().lstrip("#").strip().lower() for name in cells[0]]
    missing = [column for column in columns if column not in names]
    if missing:
        raise InputError(
            f"{path} has no column {' and no column '.join(missing)}: its first line must name the columns, as in "
            f"{','.join(columns)}."
        )
    if len(cells) != len(numbered):
        raise InputError(f"{path} has a text that goes over several lines: remove quotation marks that do not close.")
    for (number, _), row in zip(numbered, cells, strict=True):
        if any(cell.strip() for cell in row[len(names) :]):
            raise InputError(
                f"{path}, line {number}: there are {len(row)} cells for {len(names)} columns: separate columns by "
                "semicolons where numbers have decimal commas."
            )
    rows = [
        Row(path, number, {n: cell.strip() for n, cell in zip(names, row, strict=False)}, separator != ",")
        for (number, _), row in zip(numbered[1:], cells[1:], strict=True)
    ]
    if not rows:
        raise InputError(f"{path} has no rows below its first line.")
    return rows
