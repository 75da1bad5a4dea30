"""Where the time of a training goes: seconds by part, each part without those inside it."""

import time
from collections.abc import Callable, Iterator
from contextlib import ContextDecorator, contextmanager

Synchronise = Callable[[], None]
SAMPLED = 16
"""On a device that works ahead of the program only one iteration in so many waits for it and is counted."""


class Ledger:
    """Seconds by part of the iterations that were counted.

    synchronise: waits for a device that works ahead of the program; None where none does, and every iteration counts.
    clock: the time in seconds.
    """

    def __init__(self, synchronise: Synchronise | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self.synchronise = synchronise
        self.clock = clock
        self.seconds: dict[str, float] = {}
        self.iterations = 0
        self._open: list[str] = []
        self._since = 0.0
        self._seen = 0

    def enter(self, part: str) -> None:
        self._settle()
        self._open.append(part)

    def leave(self) -> None:
        self._settle()
        self._open.pop()

    def _settle(self) -> None:
        """What passed since the last change belongs to the innermost part."""
        if self.synchronise:
            self.synchronise()
        now = self.clock()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now

    @contextmanager
    def iteration(self) -> Iterator[None]:
        """Count what `part` names meanwhile, under "other" what none names."""
        global _active
        self._seen += 1
        if self.synchronise and self._seen % SAMPLED:
            yield
            return
        _active = self
        self.iterations += 1
        self.enter("other")
        try:
            yield
        finally:
            self.leave()
            _active = None

    def milliseconds(self) -> dict[str, float]:
        """Mean ms per iteration by part, the dearest first."""
        count = max(1, self.iterations)
        parts = sorted(self.seconds.items(), key=lambda entry: -entry[1])
        return {name: round(1000 * seconds / count, 4) for name, seconds in parts}


_active: Ledger | None = None


class part(ContextDecorator):
    """`with part("water"):`, or `@part("water")` on a function, counts its body in the ledger of the iteration that
    runs; nothing where none does."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        self.ledger = _active
        if self.ledger:
            self.ledger.enter(self.name)

    def __exit__(self, *_: object) -> None:
        if self.ledger:
            self.ledger.leave()
