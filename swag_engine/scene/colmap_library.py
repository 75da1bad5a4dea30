"""pycolmap, imported so that it leaves the rest of the process as it was."""

import signal
import threading

import cv2  # noqa: F401  (before pycolmap: in the other order cv2.imwrite has crashed)

_handler = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

# Its log library answers SIGTERM with a stack trace. Python sets handlers in the main thread only, and only its own.
if threading.current_thread() is threading.main_thread() and _handler is not None:
    signal.signal(signal.SIGTERM, _handler)

# It would also write each message to new files in the user's folder of temporary files.
for _level in (pycolmap.logging.INFO, pycolmap.logging.WARNING, pycolmap.logging.ERROR, pycolmap.logging.FATAL):
    pycolmap.logging.set_log_destination(_level, "")

__all__ = ["pycolmap"]
