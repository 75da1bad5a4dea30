"""Time of a training by part: seconds of each part, without those of the parts inside it."""

import time
from collections.abc import Callable, Iterator
from contextlib import ContextDecorator, contextmanager

Synchronise = Callable[[], None]
SAMPLE_EVERY = 16
"""Iterations of which one is timed on a device that works asynchronously, as each timed one has to wait for it."""


class Ledger:
    """Seconds by part of the iterations that were timed.

    Args:
        synchronise: Waits for a device that works asynchronously; None where there is none, and all are timed.
        clock: Returns the time in seconds.

    Attributes:
        seconds: Seconds by name of the part.
        iterations: Number of iterations that were timed.
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
        """Begin a part inside the current one."""
        self._settle()
        self._open.append(part)

    def leave(self) -> None:
        """End the innermost part."""
        self._settle()
        self._open.pop()

    def _settle(self) -> None:
        """Add the time since the last change to the innermost part."""
        if self.synchronise:
            self.synchronise()
        now = self.clock()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now

    @contextmanager
    def iteration(self) -> Iterator[None]:
        """Time one iteration: the parts inside the block, and the rest as "other"."""
        global _active
        self._seen += 1
        if self.synchronise and self._seen % SAMPLE_EVERY:
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
        """Return the mean ms per iteration by part, the slowest first."""
        count = max(1, self.iterations)
        parts = sorted(self.seconds.items(), key=lambda entry: -entry[1])
        return {name: round(1000 * seconds / count, 4) for name, seconds in parts}


_active: Ledger | None = None


class part(ContextDecorator):
    """Times its body as a part of the iteration that runs: `with part("water"):`, or `@part("water")` on a function.

    Outside a timed iteration it does nothing.

    Args:
        name: Name of the part.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        self.ledger = _active
        if self.ledger:
            self.ledger.enter(self.name)

    def __exit__(self, *_: object) -> None:
        if self.ledger:
            self.ledger.leave()
