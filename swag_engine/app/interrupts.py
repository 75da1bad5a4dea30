"""Signals that end a command: Ctrl-C (SIGINT), and SIGTERM, which clusters, containers and services send."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupts:
    """The signals that this process has received since `install`.

    A signal raises KeyboardInterrupt, so that the work ends where it is. Within `deferred`, once the block has asked
    `should_stop`, the first one only makes `should_stop` true. Ctrl-C after that makes `should_stop_now` true where the
    block has asked that, too; else, and the next time, it raises KeyboardInterrupt all the same.
    SIGTERM after another signal changes nothing: a service sends it to all processes at once, and a parent passes it on
    to its children.
    """

    def __init__(self) -> None:
        self._first = 0
        self._deferred = self._asked = self._asked_now = self._now = False
        self._notice = ""

    def install(self) -> None:
        """Forget what was received and handle both signals from now on. Call it in the main thread."""
        self._first, self._deferred, self._now = 0, False, False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    @contextmanager
    def deferred(self, notice: str = "") -> Iterator[None]:
        """Leave it to the block to ask `should_stop` and to end with what exists kept.

        Until it asks for the first time, while it reads and plans, nothing would be lost: a signal ends it at once.

        Args:
            notice: Sentence for stderr when a signal comes.
        """
        self._deferred, self._asked, self._asked_now, self._notice = True, False, False, notice
        try:
            yield
        finally:
            self._deferred = False

    def should_stop(self) -> bool:
        """Return whether a signal was received."""
        self._asked = True
        return bool(self._first)

    def should_stop_now(self) -> bool:
        """Return whether Ctrl-C was pressed once more after a signal."""
        self._asked_now = True
        return self._now

    @property
    def exit_code(self) -> int:
        """128 and the number of the first signal, as shells count: 130 for Ctrl-C, 143 for SIGTERM; 0 without one."""
        return self._first and 128 + self._first

    def _handle(self, number: int, frame: FrameType | None) -> None:
        again, self._first = bool(self._first), self._first or number
        if again and number == signal.SIGTERM:
            return
        if again and self._deferred and self._asked_now and not self._now:
            self._now = True
            return
        if again or not (self._deferred and self._asked):
            raise KeyboardInterrupt
        if self._notice:
            os.write(2, f"{self._notice}\n".encode())  # the handler may run within a print to stderr


interrupts = Interrupts()
"""Those of this process; the command line and the worker install them."""
