"""Quality of a run in a word, from its PSNR on test photos and that of the median-image baseline."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Quality:
    """One word for the quality of a run.

    Attributes:
        word: The word.
        psnr: Smallest PSNR on test photos, dB.
        gain: Smallest gain over the median-image baseline, dB.
        meaning: What a user can expect, in a sentence.
    """

    word: str
    psnr: float
    gain: float
    meaning: str


QUALITIES = (
    # RMS error of 2.5 % of white. Two scenes of docs/accuracy.md reach it: 33 to 39 dB, 11 to 18 dB above the baseline.
    Quality("Excellent", 32.0, 10.0, "Close to the photos, at the size of the training."),
    # The demo in docs/accuracy.md: 26.0 to 26.7 dB, 6.2 to 7.0 dB above the baseline. RMS error of 5 % of white, and
    # little more than half of the baseline's.
    Quality("Good", 26.0, 5.0, "Shapes and colors are those of the photos; fine detail is softer."),
    # RMS error of 8 % of white, and four fifths of the baseline's: the scene is there, but blurred or in places wrong.
    Quality("Fair", 22.0, 2.0, "Large shapes are right; detail is lost. More photos of places that few show help."),
    # Hardly nearer to a photo than the picture that is the same from everywhere.
    Quality("Poor", float("-inf"), float("-inf"), "Check that the photos overlap and that their cameras fit."),
)
"""From best to worst. A run has the first whose limits it reaches."""


def quality_of(metrics: dict[str, Any]) -> tuple[Quality, float] | None:
    """The quality of a run and its PSNR on test photos in dB; None where the run has no figures of test photos."""
    psnr, baseline = metrics.get("test_psnr"), metrics.get("control_psnr")
    if not isinstance(psnr, int | float):
        return None
    gain = psnr - baseline if isinstance(baseline, int | float) else float("inf")
    return next(one for one in QUALITIES if psnr >= one.psnr and gain >= one.gain), psnr
