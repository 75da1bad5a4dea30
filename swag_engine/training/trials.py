"""Effects that the plan is not sure of, tried in short forks of the run and kept only where validation views gain.

At a stated share of the run its state is kept. It goes on for LENGTH of the run without the effect, and once more from
the same state, with the same photographs in the same order, with it. The better one goes on. No test view is looked at.
"""

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..evaluation.metrics import ViewScore
from ..planning.plan import Effect, Plan

if TYPE_CHECKING:
    from .trainer import Trainer

TRIED_AT = {"lamp": 0.1, "exposure": 0.1, "caustics": 0.1}
"""Share of the run after which each is tried. Water is not: it is modelled to be taken away, and photographs can be
shown as well without (japanese_gardens: .4 dB better in the fork)."""
NEED_RANGES = ("lamp",)
"""Where the plan cannot tell these, photographs from such ranges cannot: that is left to the user."""
PRECONDITIONS = ("range_ratio", "radius_correlation")
"""Figures that say whether an effect can be told, not how strong it is."""
LENGTH = 0.05
LEAST_GAIN = 0.3
"""dB of validation PSNR; also two standard errors over the views."""
NEAR = 1.5
"""An effect is near its threshold where the figure that decides is within this factor of it."""


def doubtful(plan: Plan | None) -> list[str]:
    """The effects that are to be tried: neither the plan nor the user is sure of them."""
    if plan is None:
        return []
    return [name for name in TRIED_AT if not plan.effects[name].overruled and _doubtful(name, plan.effects[name])]


def _doubtful(name: str, effect: Effect) -> bool:
    if effect.state == "unknown":
        return name not in NEED_RANGES
    return 1 / NEAR < margin(effect.evidence) < NEAR


def margin(evidence: dict[str, Any]) -> float:
    """The least of all figures over their thresholds (NAME_least, NAME_most): above 1 where all are passed."""
    ratios = [np.inf]
    for key, threshold in evidence.items():
        name, _, kind = key.rpartition("_")
        if kind not in ("least", "most") or name in PRECONDITIONS or evidence.get(name) is None or not threshold:
            continue
        figure = float(np.max(evidence[name]))
        ratios.append(figure / threshold if kind == "least" else threshold / max(figure, 1e-12))
    return float(min(ratios))


def trials_due(trainer: "Trainer") -> list[str]:
    """The effects that are to be tried now."""
    tried = {trial["effect"] for trial in trainer.trials}
    return [name for name in trainer.doubtful if name not in tried and trainer.clock.fraction >= TRIED_AT[name]]


def try_effects(trainer: "Trainer", should_stop: Callable[[], bool]) -> bool:
    """Try what is due. False where it was stopped: the run is then as it was before."""
    due = trials_due(trainer)
    length = max(1, round(LENGTH * trainer.clock.iterations))
    before = trainer.state()
    scores = _forked(trainer, length, should_stop)
    if scores is None:
        trainer.load(*before)
        return False
    best, decided = (scores, trainer.state()), dict.fromkeys(due, False)
    trials: list[dict[str, Any]] = []
    for name in due:
        started = time.monotonic()
        kept = {effect: True for effect, chosen in decided.items() if chosen}
        trainer.load(*before)
        trainer.switch(kept | {name: True})
        scores = _forked(trainer, length, should_stop)
        if scores is None:
            trainer.load(*before)
            return False
        gain, needed = compared(best[0], scores)
        if gain > needed:
            decided[name] = True
            best = scores, trainer.state()
        trials.append(
            told(
                {
                    "effect": name,
                    "iteration": before[1]["iteration"],
                    "gain": round(gain, 3),
                    "needed": round(needed, 3),
                    "kept": decided[name],
                    "seconds": round(time.monotonic() - started, 2),
                }
            )
        )
    trainer.load(*best[1])
    trainer.trials += trials
    return True


def _forked(trainer: "Trainer", iterations: int, should_stop: Callable[[], bool]) -> Sequence[ViewScore] | None:
    """Scores of the validation views so many iterations later, None where it was stopped."""
    for _ in range(iterations):
        if should_stop():
            return None
        trainer.step()
    return trainer.scored(trainer.validation)


def compared(without: Sequence[ViewScore], having: Sequence[ViewScore]) -> tuple[float, float]:
    """Mean gain in dB over the views, and the gain that is needed."""
    gains = np.array([b.psnr - a.psnr for a, b in zip(without, having, strict=True)])
    gains = gains[np.isfinite(gains)]
    if not len(gains):
        return 0.0, LEAST_GAIN
    error = float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0
    return float(gains.mean()), max(LEAST_GAIN, 2 * error)


def told(trial: dict[str, Any]) -> dict[str, Any]:
    """A trial with itself in words."""
    name = trial["effect"].replace("_", " ")
    words = (
        f"Tried {name} at iteration {trial['iteration']}: {trial['gain']:+.2f} dB on the validation photographs "
        f"({trial['needed']:.2f} needed), {'kept' if trial['kept'] else 'left off'}; {trial['seconds']:.1f} s."
    )
    return trial | {"sentence": words}
