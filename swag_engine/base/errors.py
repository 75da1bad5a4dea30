"""The exception whose message is shown to the user."""


class InputError(Exception):
    """Input that cannot be used.

    The message is one sentence: what is wrong, in which file or setting, what to do. Command line, worker and Blender
    show it without a traceback; the exit code is 2, and no file is left incomplete.
    """
