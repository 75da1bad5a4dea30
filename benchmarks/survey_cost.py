"""Time of large surveys on one workstation, eight machines, and spot machines that fail: simulated, not measured.

Run: `python benchmarks/survey_cost.py`, after `python benchmarks/survey.py FOLDER --parts scale cost`
Results: benchmarks/results/survey_cost.json

The processor times and the memory of the jobs are those that benchmarks/survey.py has measured or extended ("cost" in
benchmarks/results/survey.json). The rest follows the rules of the program: the coarse model first and alone; blocks in
any order, as many at once on a machine as its memory and cores allow; what ran on a machine that fails goes on from its
last checkpoint, elsewhere, once its claim counts as dead. It is assumed that cores of all machines are as fast as the
measured ones, and that twice the cores take half the time.
"""

import heapq
import math
import random
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, write_results
from swag_engine.base.claim import WATCHED_SECONDS
from swag_engine.formats.run_folder import read_json
from swag_engine.survey.executors.protocol import Machine, cores_for_each
from swag_engine.training.pacing.memory import USABLE_FRACTION
from swag_engine.training.schedule import STANDARD

CORES, MEMORY = 16, 64e9
"""Cores and memory (bytes) of each machine."""
CLUSTERS = (("one workstation", 1, 0.0), ("eight nodes", 8, 0.0), ("32 spot machines", 32, 0.1))
"""Name, number of machines, and how many of them fail within an hour (fraction)."""
START_SECONDS = 30.0
"""Time from the start of a job to its first new iteration: Python, packages, photos."""
REPLACED_SECONDS = 300.0
"""Time until a machine that failed is replaced."""
SIMULATIONS = 200


@dataclass
class Outcome:
    """What one simulation ended with.

    Attributes:
        seconds: Time until all jobs were done.
        machine_seconds: Time for which machines were there, summed.
        most_losses: How often the job that lost its machine most often did so.
    """

    seconds: float
    machine_seconds: float
    most_losses: int


def simulate(
    jobs: int, seconds: float, machines: int, slots: int, failures: float, chance: random.Random, keeps: bool = True
) -> Outcome:
    """Simulate jobs on machines that fail.

    Args:
        jobs: Number of jobs.
        seconds: Time of each without its start.
        machines: Number of machines.
        slots: Jobs that a machine runs at once.
        failures: Probability that a machine fails within an hour.
        chance: Random numbers.
        keeps: Whether a job goes on from its last checkpoint; else it begins again.
    """
    rate = -math.log(1 - failures) / 3600
    left, losses = [seconds] * jobs, [0] * jobs
    waiting, done, up_time, now = deque(range(jobs)), 0, 0.0, 0.0
    running: list[dict[int, float]] = [{} for _ in range(machines)]
    up_since: list[float | None] = [None] * machines
    events: list[tuple[float, str, int, float]] = [(0.0, "up", machine, 0.0) for machine in range(machines)]
    while done < jobs:
        now, kind, number, since = heapq.heappop(events)
        if kind == "up":
            up_since[number] = now
            if rate:
                heapq.heappush(events, (now + chance.expovariate(rate), "fail", number, now))
        elif kind == "free":
            waiting.appendleft(number)
        elif kind == "fail":
            for job, started in running[number].items():
                worked = max(0.0, now - started - START_SECONDS)
                left[job] -= (worked - worked % STANDARD.checkpoint_seconds) if keeps else 0.0
                losses[job] += 1
                heapq.heappush(events, (now + WATCHED_SECONDS, "free", job, now))
            running[number], up_since[number] = {}, None
            up_time += now - since
            heapq.heappush(events, (now + REPLACED_SECONDS, "up", number, now))
        else:  # the end of a job, which counts where its machine has not failed since it started
            machine = next((m for m in range(machines) if running[m].get(number) == since), None)
            if machine is None:
                continue
            del running[machine][number]
            done += 1
        for machine in range(machines):
            while waiting and up_since[machine] is not None and len(running[machine]) < slots:
                job = waiting.popleft()
                running[machine][job] = now
                heapq.heappush(events, (now + START_SECONDS + left[job], "end", job, now))
    up_time += sum(now - since for since in up_since if since is not None)
    return Outcome(now, up_time, max(losses))


def on_cluster(
    cost: dict[str, Any], machines: int, failures: float, keeps: bool, seed: int, slots: int, cores: int
) -> Outcome:
    """Simulate a whole survey: the coarse model on one machine, then the blocks on all of them."""
    chance = random.Random(seed)
    coarse = simulate(1, 3600 * cost["coarse_hours"] / CORES, 1, 1, failures, chance, keeps)
    seconds = 60 * cost["block_minutes"] / cores
    blocks = simulate(cost["blocks"], seconds, machines, slots, failures, chance, keeps)
    return Outcome(
        coarse.seconds + blocks.seconds,
        coarse.machine_seconds + blocks.machine_seconds,
        max(coarse.most_losses, blocks.most_losses),
    )


def row(cost: dict[str, Any], name: str, machines: int, failures: float) -> dict[str, Any]:
    """Return the figures of one survey on one cluster."""
    machine = Machine(CORES, int(USABLE_FRACTION * MEMORY))
    cores = cores_for_each([machine] * machines, cost["peak_memory"], cost["blocks"])
    slots = machine.fitting(cores, cost["peak_memory"])

    def outcomes(keeps: bool) -> list[Outcome]:
        times = SIMULATIONS if failures else 1
        return [on_cluster(cost, machines, failures, keeps, seed, slots, cores) for seed in range(times)]

    kept = outcomes(True)
    hours = sorted(outcome.seconds / 3600 for outcome in kept)
    return {
        "cluster": name,
        "machines": machines,
        "failures_an_hour": failures,
        "images": cost["images"],
        "blocks": cost["blocks"],
        "at_once_on_a_machine": slots,
        "cores_each": cores,
        "hours": median(hours),
        "hours_95": hours[math.ceil(0.95 * len(hours)) - 1],
        "machine_hours": median(outcome.machine_seconds for outcome in kept) / 3600,
        "most_losses": max(outcome.most_losses for outcome in kept),
        "hours_without_checkpoints": median(outcome.seconds for outcome in outcomes(False)) / 3600,
    }


def main() -> None:
    """Simulate all surveys on all clusters and write the results."""
    costs = read_json(RESULTS / "survey.json", "There are no results: run benchmarks/survey.py first.").get("cost", [])
    if not costs:
        raise SystemExit("survey.json has no costs: run `python benchmarks/survey.py FOLDER --parts scale cost` first.")
    rows = [row(cost, *cluster) for cost in costs for cluster in CLUSTERS]
    write_results(
        "survey_cost",
        {
            "cores": CORES,
            "memory_gb": MEMORY / 1e9,
            "start_seconds": START_SECONDS,
            "checkpoint_seconds": STANDARD.checkpoint_seconds,
            "claim_seconds": WATCHED_SECONDS,
            "replaced_seconds": REPLACED_SECONDS,
            "simulations": SIMULATIONS,
            "rows": rows,
        },
    )


if __name__ == "__main__":
    main()
