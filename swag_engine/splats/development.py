"""Development of restored colors into a picture: exposure, white point, contrast and a roll-off of highlights.

The water model gives the light of the scene without water, which need not look right on a screen: it may be dark, or
brighter than white. Development changes colors after everything physical, and stores nothing in the splats, so it can
always be chosen anew. Of a display color, in this order:

    light   srgb_to_linear of the color
    gains   2^exposure diag(white) matrix light
    curve   the largest channel m becomes r(GREY (m / GREY)^contrast); the other channels are scaled by the same factor
    display linear_to_srgb

with r(x) = x below the knee k, and k + (1 - k) t / (1 + t), t = (x - k) / (1 - k), above it: the slope is 1 at the
knee, and no finite light becomes more than 1. One factor for all channels keeps hue and saturation in linear light; a
curve of each channel would turn bright orange to yellow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base.errors import DAMAGE, InputError
from ..base.transfer import LUMINANCE, linear_to_srgb, srgb_to_linear

GREY = 0.18
"""Linear light of middle grey, which contrast does not change: the reflectance of photographers' grey cards."""
KNEE = 0.8
"""Linear light where highlights begin to be rolled off, unless a development says otherwise: display value 0.906."""
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
LIMITS = {"exposure": (-20.0, 20.0), "white": (0.01, 100.0), "contrast": (0.1, 10.0), "knee": (0.0, 1.0)}
"""Smallest and largest values that a user may give."""

Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]


@dataclass(frozen=True)
class Development:
    """What is done to restored colors before they are shown. The default changes nothing, to the bit.

    Attributes:
        exposure: Stops.
        white: Gains of red, green and blue in linear light.
        contrast: Exponent about middle grey.
        matrix: (3, 3) of linear light, rows are the developed channels.
        knee: Linear light above which highlights are rolled off; 1 for no roll-off.
    """

    exposure: float = 0.0
    white: Triple = (1.0, 1.0, 1.0)
    contrast: float = 1.0
    matrix: Matrix = IDENTITY
    knee: float = 1.0

    @property
    def gains(self) -> np.ndarray:
        """Matrix (3, 3) of linear light: `matrix`, white and exposure together."""
        return 2.0**self.exposure * np.array(self.white)[:, None] * np.array(self.matrix)

    def apply(self, display: np.ndarray) -> np.ndarray:
        """Develop display values.

        Args:
            display: (..., 3) display values, 0 or more.

        Returns:
            (..., 3) display values, at most 1 with a knee below 1; the argument itself where nothing changes.
        """
        if self == NO_DEVELOPMENT:
            return display
        light = srgb_to_linear(display) @ self.gains.T
        peak = _peak(light)
        return linear_to_srgb(light * (self._curve(peak) / peak))

    def inverse(self, display: np.ndarray) -> np.ndarray:
        """Undo `apply`.

        Args:
            display: (..., 3) developed display values. From 1 on, with a knee below 1, the highlights are lost: these
                become the light of display value 1 - 1e-6.

        Returns:
            (..., 3) display values.
        """
        if self == NO_DEVELOPMENT:
            return display
        light = srgb_to_linear(display)
        peak = _peak(light)
        return linear_to_srgb(light * (self._inverse_curve(peak) / peak) @ np.linalg.inv(self.gains).T)

    def slope(self) -> np.ndarray:
        """Return the derivative (3, 3) of `apply` at middle grey; rows are developed channels."""
        step = 1e-4  # display value: central differences of it are exact to 1e-7
        grey, changes = linear_to_srgb(np.full(3, GREY)), np.eye(3) * step
        return np.stack([(self.apply(grey + by) - self.apply(grey - by)) / (2 * step) for by in changes], axis=1)

    def faded(self, fraction: float) -> "Development":
        """Return the development of which this fraction is left, 0 (none) to 1 (all)."""
        if fraction == 1:
            return self
        if fraction == 0:
            return NO_DEVELOPMENT
        gains = fraction * self.gains + (1 - fraction) * np.eye(3)
        return Development(
            contrast=self.contrast**fraction, matrix=_as_matrix(gains), knee=1 - fraction * (1 - self.knee)
        )

    def followed_by(self, other: "Development") -> "Development":
        """Return one development with the gains and contrasts of both and the lower knee."""
        if other == NO_DEVELOPMENT:
            return self
        if self == NO_DEVELOPMENT:
            return other
        return Development(
            contrast=self.contrast * other.contrast,
            matrix=_as_matrix(other.gains @ self.gains),
            knee=min(self.knee, other.knee),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the values by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "Development":
        """Read what `to_json` returned; other names are ignored.

        Raises:
            InputError: If a value is missing or is not a finite number.
        """
        try:
            made = cls(
                float(document["exposure"]),
                _triple(document["white"]),
                float(document["contrast"]),
                _as_matrix(np.array(document["matrix"], np.float64).reshape(3, 3)),
                float(document["knee"]),
            )
        except DAMAGE as error:
            raise InputError(f"The development is damaged: {error!r}.") from error
        least, most = LIMITS["exposure"]
        if not (
            least <= made.exposure <= most
            and np.isfinite(made.gains).all()
            and made.contrast > 0
            and 0 <= made.knee <= 1
        ):
            raise InputError("The development is damaged: it has a value outside its range.")
        return made

    @classmethod
    def from_text(cls, text: str) -> "Development":
        """Read values such as `exposure=0.5,white=1.1/1/0.9,contrast=1.1`; those left out change nothing.

        Highlights are rolled off above KNEE unless `knee` is given.

        Raises:
            InputError: Says which value is wrong and what is right.
        """
        values: dict[str, Any] = {"knee": KNEE}
        for part in text.split(","):
            name, _, written = part.strip().partition("=")
            if name not in LIMITS:
                raise InputError(
                    f"The development {text} is not valid: give none, auto, chart, or values as in "
                    "exposure=0.5,white=1.1/1/0.9,contrast=1.1,knee=0.8."
                )
            count = 3 if name == "white" else 1
            try:
                numbers = [float(number) for number in written.split("/")]
            except ValueError:
                numbers = []
            least, most = LIMITS[name]
            if len(numbers) != count or not all(least <= number <= most for number in numbers):
                kind = "three numbers as in 1.1/1/0.9, each" if count == 3 else "one number"
                raise InputError(
                    f"The development {text} is not valid: {name} needs {kind} from {least:g} to {most:g}."
                )
            values[name] = tuple(numbers) if count == 3 else numbers[0]
        return cls(**values)

    def to_text(self) -> str:
        """Return a short description: the values that change something."""
        if self == NO_DEVELOPMENT:
            return "none"
        parts = [f"exposure {self.exposure:+.2f} stops"] if self.exposure else []
        parts += ["white {:.2f}/{:.2f}/{:.2f}".format(*self.white)] if self.white != (1.0, 1.0, 1.0) else []
        parts += [f"contrast {self.contrast:.2f}"] if self.contrast != 1 else []
        parts += ["a color matrix"] if self.matrix != IDENTITY else []
        parts += [f"highlights rolled off above {self.knee:.2f}"] if self.knee < 1 else []
        return ", ".join(parts)

    def _curve(self, peak: np.ndarray) -> np.ndarray:
        """Return the light that a largest channel of this light becomes, both above 0."""
        curved = GREY * (peak / GREY) ** self.contrast
        if self.knee == 1:
            return curved
        over = np.maximum(curved - self.knee, 0) / (1 - self.knee)
        return np.minimum(curved, self.knee) + (1 - self.knee) * over / (1 + over)

    def _inverse_curve(self, peak: np.ndarray) -> np.ndarray:
        if self.knee < 1:
            over = np.clip((peak - self.knee) / (1 - self.knee), 0, 1 - 1e-6)
            peak = np.minimum(peak, self.knee) + (1 - self.knee) * over / (1 - over)
        return GREY * (peak / GREY) ** (1 / self.contrast)


NO_DEVELOPMENT = Development()


@dataclass(frozen=True)
class ColorView:
    """How colors are shown: the development of restored colors, and what a user adjusts on top.

    Attributes:
        restored: For colors without water; it fades as water is shown, so that with all of it colors are as
            photographed.
        adjusted: At any amount of water.
    """

    restored: Development = NO_DEVELOPMENT
    adjusted: Development = NO_DEVELOPMENT

    def at(self, water: float) -> Development:
        """Return the development of colors that show this fraction of the water, 0..1."""
        return self.restored.faded(1 - water).followed_by(self.adjusted)

    def to_json(self) -> dict[str, Any]:
        """Return both developments by name."""
        return {"restored": self.restored.to_json(), "adjusted": self.adjusted.to_json()}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "ColorView":
        """Read what `to_json` returned.

        Raises:
            InputError: If a value is missing or is not a finite number.
        """
        try:
            return cls(Development.from_json(document["restored"]), Development.from_json(document["adjusted"]))
        except DAMAGE as error:
            raise InputError(f"The development is damaged: {error!r}.") from error


AS_RESTORED = ColorView()


@dataclass(frozen=True)
class SplatDevelopment:
    """Development that goes with splats, so that whoever has only their file can apply it or undo it.

    Attributes:
        development: The development.
        applied: Whether the colors of the splats are developed, all but the roll-off, which is left to their pictures;
            otherwise they are restored colors.
    """

    development: Development
    applied: bool

    def to_json(self) -> dict[str, Any]:
        """Return the values by name."""
        return {"applied": self.applied} | self.development.to_json()

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "SplatDevelopment":
        """Read what `to_json` returned.

        Raises:
            InputError: If a value is missing or outside its range.
        """
        applied = document.get("applied")
        if not isinstance(applied, bool):
            raise InputError(f"The development is damaged: applied is {applied!r}, not true or false.")
        return cls(Development.from_json(document), applied)


def white_balance(temperature: float, tint: float) -> Triple:
    """Return gains of red, green and blue that keep the luminance of grey.

    Args:
        temperature: Above 0 is warmer: red over blue changes by two stops for each unit.
        tint: Above 0 is more magenta: green against red and blue changes by one stop for each unit.
    """
    gains = 2.0 ** np.array([temperature, -tint, -temperature])
    return _triple(gains / (LUMINANCE @ gains))


def _peak(light: np.ndarray) -> np.ndarray:
    """Return the largest channel (..., 1), above 0."""
    return np.maximum(light.max(axis=-1, keepdims=True), np.finfo(np.float32).tiny)


def _triple(values: Sequence[float] | np.ndarray) -> Triple:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _as_matrix(values: np.ndarray) -> Matrix:
    first, second, third = (_triple(row) for row in values)
    return first, second, third
