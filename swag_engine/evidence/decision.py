"""The decision about one effect."""

from dataclasses import dataclass, replace
from typing import Any, Literal

State = Literal["on", "off", "unknown"]
"""Whether a scene calls for an effect; "unknown" where the images cannot determine it."""


@dataclass(frozen=True)
class Decision:
    """Whether a scene calls for an effect, and why.

    Attributes:
        state: The decision.
        evidence: Figures, each beside its threshold (NAME_least, NAME_most).
        reason: The decision in one sentence.
    """

    state: State
    evidence: dict[str, Any]
    reason: str

    def undetermined(self, reason: str) -> "Decision":
        """Return the decision "unknown" with the same figures."""
        return replace(self, state="unknown", reason=reason)
