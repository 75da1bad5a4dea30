"""One field for each setting: default, label, help, range and unit in one place.

The command line, Blender's properties, validation and docs/cli.md are made from these fields.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from ..base.errors import InputError

_KEY = "setting"


@dataclass(frozen=True)
class Setting:
    """What the command line, Blender and the documentation show of a setting, and which values it may have.

    Attributes:
        label: Noun of one to three words for a panel.
        help: One sentence without its full stop.
        least: Smallest value of a number.
        most: Largest value of a number.
        unit: Unit of a number, such as px.
        zero: What 0 stands for where it lies outside the range; empty where 0 has no meaning of its own.
        choices: Sentence by value, for a text that must be one of several.
        is_folder: Whether a text is the path of a folder.
    """

    label: str
    help: str
    least: float = -math.inf
    most: float = math.inf
    unit: str = ""
    zero: str = ""
    choices: Mapping[str, str] = dataclasses.field(default_factory=dict)
    is_folder: bool = False

    @property
    def description(self) -> str:
        """The help with what 0 stands for, for a tooltip and for the command line's help."""
        return f"{self.help}; 0: {self.zero}" if self.zero else self.help

    @property
    def range(self) -> str:
        """The allowed values in words, such as "8 to 20000 px"; empty where all are."""
        if self.choices:
            return ", ".join(self.choices)
        if math.isinf(self.least):
            return ""
        return f"{self.least} to {self.most} {self.unit}".rstrip()

    def check(self, name: str, value: Any, kind: Any) -> None:
        """Check a value.

        Args:
            name: Name of the field, for the message.
            value: The value.
            kind: Type of the field: bool, int, float or str, a tuple of these, or one of these or None.

        Raises:
            InputError: Says which setting is wrong and what it may be.
        """
        title = f"The setting {name.replace('_', ' ')}"
        if isinstance(kind, UnionType):
            if value is None:
                return
            kind = next(other for other in get_args(kind) if other is not NoneType)
        if get_origin(kind) is not tuple:
            self._check_one(title, value, kind)
            return
        kinds = get_args(kind)
        if not isinstance(value, tuple):
            raise InputError(f"{title} must be a tuple of values, not {value!r}.")
        if kinds[-1] is Ellipsis:
            kinds = kinds[:1] * len(value)
        if len(value) != len(kinds):
            raise InputError(f"{title} must have {len(kinds)} values, not {len(value)}.")
        for one, its_kind in zip(value, kinds, strict=True):
            self._check_one(title, one, its_kind)

    def _check_one(self, title: str, value: Any, kind: type) -> None:
        """Check a value that is not a tuple."""
        if kind is bool:
            if not isinstance(value, bool):
                raise InputError(f"{title} must be true or false, not {value!r}.")
        elif kind is str:
            if not isinstance(value, str):
                raise InputError(f"{title} must be a text, not {value!r}.")
            if self.choices and value not in self.choices:
                raise InputError(f"{title} must be one of {', '.join(self.choices)}, not {value!r}.")
        else:
            kinds: Any = int if kind is int else int | float
            is_number = isinstance(value, kinds) and not isinstance(value, bool)
            means_default = bool(self.zero) and is_number and value == 0
            # A comparison with NaN is false, so NaN is refused, too.
            if not is_number or not (means_default or self.least <= value <= self.most):
                number = "a whole number" if kind is int else "a number"
                allowed = f" from {self.range}" if self.range else ""
                also = f", or 0 ({self.zero})" if self.zero and self.range else ""
                raise InputError(f"{title} must be {number}{allowed}{also}, not {value!r}.")


def setting(default: Any, label: str, help: str, **more: Any) -> Any:
    """Declare a field of a dataclass of settings.

    Args:
        default: Default value.
        label: Noun of one to three words for a panel.
        help: One sentence without its full stop.
        **more: Further attributes of `Setting`.

    Returns:
        What `dataclasses.field` returns.
    """
    return dataclasses.field(default=default, metadata={_KEY: Setting(label, help, **more)})


def settings_of(options: Any) -> Iterator[tuple[str, Any, Setting]]:
    """List the settings of a dataclass.

    Args:
        options: The dataclass or an instance of it; fields that `setting` did not declare are passed over.

    Yields:
        Name, default and description of each, in the order of declaration.
    """
    for field in dataclasses.fields(options):
        if _KEY in field.metadata:
            yield field.name, field.default, field.metadata[_KEY]


def check_settings(options: Any) -> None:
    """Check every setting of an instance by its type, range and choices.

    Raises:
        InputError: Names the first wrong setting.
    """
    kinds = {field.name: field.type for field in dataclasses.fields(options)}
    for name, _, described in settings_of(options):
        described.check(name, getattr(options, name), kinds[name])
