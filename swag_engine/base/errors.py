"""The exception whose message is shown to the user, and sentences that several programs say."""


class InputError(Exception):
    """Input that cannot be used.

    The message is one sentence: what is wrong, in which file or setting, what to do. Command line, worker and Blender
    show it without a traceback; the exit code is 2, and no file is left incomplete.
    """


def missing_package_sentence(python: str, package: str) -> str:
    """Say that a Python lacks a package of the engine, and what to do."""
    return (
        f"{python} lacks the package {package}: install the packages of requirements.txt there, or press Install "
        "Engine in Blender's preferences of SWAG Splatting."
    )
