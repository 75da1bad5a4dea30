"""The one exception that is meant for the user's eyes."""


class InputError(Exception):
    """What the user gave cannot be used.

    The message is one sentence in plain words: what is wrong, in which file, what to do. Every door (command line,
    worker, Blender) shows it as it is and ends with exit code 2; no traceback, nothing half-written.
    """
