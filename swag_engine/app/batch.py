"""One command for a folder of scenes or of runs, each in a process of its own: one that fails stops no other."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.isolation import child_environment
from ..base.text import printable
from ..formats.registry import FORMATS
from .interrupts import Interrupts

ON_RUNS = ("evaluate", "render", "label", "export")
"""Commands that work on runs; the others work on scenes."""
STATES = {0: "done", 2: "not usable", 130: "interrupted", 143: "interrupted"}
"""State of a row by its exit code; any other code is a failure."""
POLL_SECONDS = 0.2
"""Seconds between two looks for an interrupt."""


def batch(
    command: str, folder: Path, out: Path | None, options: Sequence[str], interrupts: Interrupts
) -> dict[str, Any]:
    """Run a command for each folder in a folder, sorted by name.

    Args:
        command: The command.
        folder: Folder of scenes or of runs.
        out: Folder in which each scene or run gets a folder of its name, for export a file.
        options: The command's own options.
        interrupts: The signals that stop the batch: the row at hand ends as an interrupted command, no other starts.

    Returns:
        {"command", "interrupted", "exit_code", "rows": [{"name", "exit_code", "state", "seconds", "result" or
        "error"}]}; `exit_code` is that of the interrupt, else 1 when a row ended in a bug, 2 when one could not be
        used, else 0.

    Raises:
        InputError: When there is nothing to work on.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name the folder with the scenes or runs.")
    entries = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and not entry.name.startswith(".")]
    if command in ON_RUNS:
        entries = [entry for entry in entries if (entry / "config.json").exists()]
    entries = [entry for entry in entries if out is None or entry.resolve() != out.resolve()]
    if not entries:
        kind = "runs" if command in ON_RUNS else "scenes"
        raise InputError(f"{folder} holds no folders of {kind}: name the folder that has the {kind} in it.")
    rows = []
    for number, entry in enumerate(entries, 1):
        if interrupts.should_stop():
            break
        line = printable(f"{number} of {len(entries)}: {entry.name}")
        print(line, file=sys.stderr, flush=True)
        rows.append(_row(command, entry, out, options, interrupts))
        print(line, rows[-1]["state"], file=sys.stderr, flush=True)
    codes = {row["exit_code"] for row in rows}
    interrupted = interrupts.exit_code or max(codes & {130, 143}, default=0)
    worst = interrupted or (0 if codes == {0} else 2 if codes <= {0, 2} else 1)
    return {"command": command, "interrupted": bool(interrupted), "exit_code": worst, "rows": rows}


def _row(command: str, entry: Path, out: Path | None, options: Sequence[str], interrupts: Interrupts) -> dict[str, Any]:
    """Run the command for one folder and return its row of the table."""
    arguments = [command, str(entry.absolute())]  # a name that begins with "-" is no option
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        arguments += ["--out", str(out / (entry.name + _suffix(command, options)))]
    started = time.monotonic()
    engine = [sys.executable, "-m", __package__.partition(".")[0]]
    words = [*engine, *arguments, *options, "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, encoding="utf-8", env=child_environment()) as child:
        answer, code = _answer(child, interrupts)
    row = {
        "name": entry.name,
        "exit_code": code,
        "state": STATES.get(code, "failed"),
        "seconds": round(time.monotonic() - started, 1),
    }
    try:
        document = json.loads(answer)
    except ValueError:
        return row | {"error": f"It ended with exit code {code}; the lines above say why."}
    return row | ({"error": document["error"]} if "error" in document else {"result": document})


def _answer(child: subprocess.Popen[str], interrupts: Interrupts) -> tuple[str, int]:
    """Return what a command printed, and its exit code as shells count; an interrupt is passed on to it."""
    passed_on = False
    while True:
        try:
            answer, _ = child.communicate(timeout=POLL_SECONDS)
            return answer, child.returncode if child.returncode >= 0 else 128 - child.returncode
        except subprocess.TimeoutExpired:
            # Ctrl-C reaches the child by itself; SIGTERM need not. On Windows this call would end it at once.
            if interrupts.should_stop() and not passed_on and os.name == "posix":
                child.terminate()
                passed_on = True


def _suffix(command: str, options: Sequence[str]) -> str:
    """Return the suffix of an exported file's name, an empty text for other commands."""
    if command != "export":
        return ""
    pairs = zip(options, [*options[1:], ""], strict=True)
    formats = [value for name, value in pairs if name == "--format"]
    formats += [option.partition("=")[2] for option in options if option.startswith("--format=")]
    if not formats:
        raise InputError(f"An export needs --format {' or --format '.join(FORMATS)}.")
    if formats[-1] not in FORMATS:
        raise InputError(f"There is no format {formats[-1]}; there are {', '.join(FORMATS)}.")
    return FORMATS[formats[-1]].suffix


def describe(document: dict[str, Any]) -> str:
    """Format the result of `batch` as a table.

    Args:
        document: What `batch` returned.

    Returns:
        A line for each row, and how many are done.
    """
    rows = document["rows"]
    width = max((len(row["name"]) for row in rows), default=0)
    lines = [
        f"{row['name']:<{width}}  {row['state']:<11}  {row['seconds']:>8.1f} s  {_summary(row)}".rstrip()
        for row in rows
    ]
    done = sum(row["exit_code"] == 0 for row in rows)
    return "\n".join([*lines, f"{done} of {len(rows)} done."])


def _summary(row: dict[str, Any]) -> str:
    """Return the figures of a row that the table shows."""
    if "error" in row:
        return str(row["error"])
    result = row["result"]
    if "metrics" in result:
        psnr, gaussians = result["metrics"].get("test_psnr"), result["metrics"]["gaussians"]
        return f"{f'PSNR {psnr:.2f} dB, ' if psnr else ''}{gaussians} Gaussians"
    if "effects" in result:
        return ", ".join(name for name, effect in result["effects"].items() if effect["state"] == "on")
    units = {"registered": "cameras", "gaussians": "Gaussians", "out": "", "files": "files"}
    found = {key: result[key] for key in units if key in result}
    return ", ".join(f"{len(v) if isinstance(v, list) else v} {units[k]}".strip() for k, v in found.items())
