"""Color charts that are known: the grid of their patches and the colors of these."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np

PITCH, MARGIN, PATCH = 2.75, 0.25, 2.5
"""Distance of two patches, width of the border around all, and side of a patch, in the unit that OpenCV's detector
uses for all charts."""


@dataclass(frozen=True, eq=False)
class ChartKind:
    """A color chart.

    Attributes:
        title: Name for people.
        rows: Rows of patches, as they are counted with the chart upright.
        columns: Columns of patches.
        opencv_detector: Its number in cv2.mcc.
        light: Linear light (N, 3) of the patches under the white of the sRGB space, row by row. Colors outside of sRGB
            are brought to its border, as a photo brings them.
    """

    title: str
    rows: int
    columns: int
    opencv_detector: int
    light: np.ndarray

    @property
    def size(self) -> np.ndarray:
        """Width and height (2,) of the patches with the border around them, in OpenCV's unit."""
        return np.array([self.columns, self.rows]) * PITCH + MARGIN

    @property
    def outline(self) -> np.ndarray:
        """Corners (4, 2) of the patches with the border around them, from the top left corner clockwise."""
        return np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * self.size

    @property
    def patch_outline(self) -> np.ndarray:
        """Outer corners (4, 2) of the four patches in the corners, from the top left one clockwise."""
        return np.abs(self.outline - MARGIN)

    @property
    def centres(self) -> np.ndarray:
        """Centres (N, 2) of the patches, row by row, from the top left corner of the outline."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.stack([column, row], 1) * PITCH + MARGIN + PATCH / 2

    @property
    def neutral(self) -> np.ndarray:
        """Which patches (N,) are grey: their channels differ by less than 8 %."""
        return np.ptp(self.light, axis=1) < 0.08 * self.light.max(1)


@cache
def chart_kinds() -> dict[str, ChartKind]:
    """Return the known charts by name; the colors are the CIE L*a*b* values that cv2.ccm has for D50, adapted."""
    classic = _known_light(cv2.ccm.COLORCHECKER_MACBETH, 24)
    large = _known_light(cv2.ccm.COLORCHECKER_DIGITAL_SG, 140).reshape(14, 10, 3).transpose(1, 0, 2).reshape(-1, 3)
    return {
        "24": ChartKind("24-patch color chart", 4, 6, cv2.mcc.MCC24, classic),
        "140": ChartKind("140-patch color chart", 10, 14, cv2.mcc.SG140, large),
    }


def _known_light(chart: int, count: int) -> np.ndarray:
    """Read the linear light (N, 3) of a chart in cv2.ccm, where only a fit to measured colors gives it."""
    measured = np.linspace(0.2, 0.8, 3 * count).reshape(count, 1, 3)
    ccm: Any = cv2.ccm
    model = ccm.ColorCorrectionModel(measured, chart)
    opencv5 = hasattr(model, "compute")  # OpenCV 5 renamed three names of OpenCV 4
    model.setColorSpace(ccm.COLOR_SPACE_SRGB if opencv5 else ccm.COLOR_SPACE_S_RGB)
    model.setSaturatedThreshold(-100.0, 100.0)  # it leaves out colors beyond these
    (model.compute if opencv5 else model.run)()
    return np.clip((model.getRefLinearRGB if opencv5 else model.get_dst_rgbl)()[:, 0], 0, 1)
