"""Trials of effects that the plan leaves undetermined: short forks of the run, judged on the validation images.

At a stated fraction of the run its state is copied. The run continues for LENGTH of all iterations without the effect,
and once more from the copy, with the same images in the same order, with the effect. The better fork becomes the run.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..effects.registry import REGISTRY
from ..evaluation.metrics import ViewScore
from ..planning.plan import Plan, PlannedEffect
from .state import RunState

PRECONDITIONS = ("range_ratio", "radius_correlation", "inverse_square", "color_of_loss")
"""Figures that say whether an effect can be determined and which one it is, not how strong it is. (Loss by the inverse
square is a fraction: it is never far above its threshold.)"""
MEASURED = ("gain_sd",)
"""Figures that cast no doubt on an effect that is on: validation images have no exposure of their own and hardly show
its gain. A run without it fills open water with haze."""
LENGTH = 0.05
"""Length of a fork, as a fraction of all iterations."""
LEAST_GAIN = 0.3
"""Validation PSNR that an effect must gain, dB; also two standard errors over the images."""
NEAR = 1.5
"""An effect is tried when its deciding figure is within this factor of the threshold."""


def undetermined_effects(plan: Plan | None) -> list[str]:
    """Return the effects to try: those that neither the plan nor the user decides with certainty."""
    if plan is None:
        return []
    return [
        name
        for name, effect in REGISTRY.items()
        if effect.tried_at is not None and not plan.effects[name].overruled and _undetermined(name, plan.effects[name])
    ]


def _undetermined(name: str, effect: PlannedEffect) -> bool:
    if effect.state == "unknown":
        return not REGISTRY[name].determined_by_ranges
    return 1 / NEAR < margin(effect.evidence, MEASURED if effect.state == "on" else ()) < NEAR


def margin(evidence: Mapping[str, Any], certain: Sequence[str] = ()) -> float:
    """Return the least ratio of a figure to its threshold.

    Args:
        evidence: Figures with thresholds named NAME_least or NAME_most.
        certain: Figures that do not count.

    Returns:
        Above 1 where all thresholds are passed; infinite without any.
    """
    ratios, left_out = [np.inf], (*PRECONDITIONS, *certain)
    for key, threshold in evidence.items():
        name, _, kind = key.rpartition("_")
        if kind not in ("least", "most") or name in left_out or evidence.get(name) is None or not threshold:
            continue
        figure = float(np.max(evidence[name]))
        ratios.append(figure / threshold if kind == "least" else threshold / max(figure, 1e-12))
    return float(min(ratios))


def trials_due(state: RunState, to_try: Sequence[str]) -> list[str]:
    """Return the effects of `to_try` that are to be tried now."""
    tried = {trial["effect"] for trial in state.trials}
    fraction = state.clock.fraction
    return [name for name in to_try if name not in tried and fraction >= (REGISTRY[name].tried_at or 0.0)]


def run_trials(
    state: RunState,
    due: Sequence[str],
    copy: Callable[[RunState], RunState],
    switch: Callable[[RunState, Mapping[str, bool]], None],
    score_after: Callable[[RunState, int], Sequence[ViewScore] | None],
) -> RunState | None:
    """Try effects in forks of a run.

    Args:
        state: State of the run; not changed.
        due: Effects to try.
        copy: Copies a state.
        switch: Switches effects of a state on.
        score_after: Trains a state for so many iterations and scores the validation images; None when it was stopped.

    Returns:
        State of the best fork with the trials recorded, None when a fork was stopped.
    """
    length = max(1, round(LENGTH * state.clock.iterations))
    best = copy(state)
    best_scores = score_after(best, length)
    if best_scores is None:
        return None
    decided = dict.fromkeys(due, False)
    trials: list[dict[str, Any]] = []
    for name in due:
        started = time.monotonic()
        fork = copy(state)
        switch(fork, {effect: True for effect, chosen in decided.items() if chosen} | {name: True})
        scores = score_after(fork, length)
        if scores is None:
            return None
        gain, needed = gain_of_effect(best_scores, scores)
        if gain > needed:
            decided[name] = True
            best, best_scores = fork, scores
        trial = {
            "effect": name,
            "iteration": state.iteration,
            "gain": round(gain, 3),
            "needed": round(needed, 3),
            "kept": decided[name],
            "seconds": round(time.monotonic() - started, 2),
        }
        trials.append(trial | {"sentence": sentence(trial)})
    best.trials += trials
    return best


def gain_of_effect(without: Sequence[ViewScore], having: Sequence[ViewScore]) -> tuple[float, float]:
    """Compare the scores of the same images without and with an effect.

    Args:
        without: Scores without the effect.
        having: Scores with it.

    Returns:
        Mean gain in PSNR over the images, and the gain that is needed, both dB.
    """
    gains = np.array([b.psnr - a.psnr for a, b in zip(without, having, strict=True)])
    gains = gains[np.isfinite(gains)]
    if not len(gains):
        return 0.0, LEAST_GAIN
    error = float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0
    return float(gains.mean()), max(LEAST_GAIN, 2 * error)


def sentence(trial: Mapping[str, Any]) -> str:
    """Describe a trial in a sentence for the user."""
    name = trial["effect"].replace("_", " ")
    return (
        f"Tried {name} at iteration {trial['iteration']}: {trial['gain']:+.2f} dB on the validation photos "
        f"({trial['needed']:.2f} dB needed), {'kept' if trial['kept'] else 'left off'}; {trial['seconds']:.1f} s."
    )
