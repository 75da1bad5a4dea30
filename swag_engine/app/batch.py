"""One command for a folder of scenes or of runs, each in a process of its own: one that fails stops no other."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..formats.registry import FORMATS

ON_RUNS = ("evaluate", "render", "label", "export")
STATES = {0: "done", 2: "not usable", 130: "interrupted"}


def batch(
    command: str,
    folder: Path,
    out: Path | None,
    options: Sequence[str],
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Run `command` for each folder in `folder`, sorted by name; `options` are the command's own.

    out: folder in which each gets a folder (a file for export) of its name. Returns {"command", "interrupted",
    "exit_code", "rows": [{"name", "exit_code", "state", "seconds", "result" or "error"}]}; exit_code is 130 when
    interrupted, 1 when a row ended in a bug, 2 when one could not be used, else 0.
    Raises InputError when there is nothing to work on.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: name the folder with the scenes or runs.")
    entries = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and not entry.name.startswith(".")]
    if command in ON_RUNS:
        entries = [entry for entry in entries if (entry / "config.json").exists()]
    entries = [entry for entry in entries if out is None or entry.resolve() != out.resolve()]
    if not entries:
        raise InputError(f"{folder} holds no {'runs' if command in ON_RUNS else 'folders of scenes'}.")
    rows = []
    for number, entry in enumerate(entries, 1):
        if should_stop():
            break
        print(f"{number} of {len(entries)}: {entry.name}", file=sys.stderr, flush=True)
        rows.append(_row(command, entry, out, options))
        print(f"{number} of {len(entries)}: {entry.name} {rows[-1]['state']}", file=sys.stderr, flush=True)
    codes = {row["exit_code"] for row in rows}
    interrupted = should_stop() or 130 in codes
    worst = 130 if interrupted else 0 if codes == {0} else 2 if codes <= {0, 2} else 1
    return {"command": command, "interrupted": interrupted, "exit_code": worst, "rows": rows}


def _row(command: str, entry: Path, out: Path | None, options: Sequence[str]) -> dict[str, Any]:
    arguments = [command, str(entry)]
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        arguments += ["--out", str(out / (entry.name + _suffix(command, options)))]
    started = time.monotonic()
    # Ctrl-C reaches the child too, which ends in its own time.
    done = subprocess.run(
        [sys.executable, "-m", __package__.partition(".")[0], *arguments, *options, "--json"],
        stdout=subprocess.PIPE,
        encoding="utf-8",
    )
    row = {
        "name": entry.name,
        "exit_code": done.returncode,
        "state": STATES.get(done.returncode, "failed"),
        "seconds": round(time.monotonic() - started, 1),
    }
    try:
        document = json.loads(done.stdout)
    except ValueError:
        return row | {"error": f"It ended with exit code {done.returncode}; what it wrote stands above."}
    return row | ({"error": document["error"]} if "error" in document else {"result": document})


def _suffix(command: str, options: Sequence[str]) -> str:
    """Return the ending of an exported file's name."""
    if command != "export":
        return ""
    pairs = zip(options, [*options[1:], ""], strict=True)
    named = [value for name, value in pairs if name == "--format"]
    named += [option.partition("=")[2] for option in options if option.startswith("--format=")]
    if not named:
        raise InputError(f"An export needs --format {' or --format '.join(FORMATS)}.")
    if named[-1] not in FORMATS:
        raise InputError(f"There is no format {named[-1]}; there are {', '.join(FORMATS)}.")
    return FORMATS[named[-1]].suffix


def describe(document: dict[str, Any]) -> str:
    """The rows as a table, and how many are done."""
    rows = document["rows"]
    width = max((len(row["name"]) for row in rows), default=0)
    lines = [
        f"{row['name']:<{width}}  {row['state']:<11}  {row['seconds']:>8.1f} s  {_said(row)}".rstrip() for row in rows
    ]
    done = sum(row["exit_code"] == 0 for row in rows)
    return "\n".join([*lines, f"{done} of {len(rows)} done."])


def _said(row: dict[str, Any]) -> str:
    """What is worth a place in the table."""
    if "error" in row:
        return str(row["error"])
    result = row["result"]
    if "metrics" in result:
        psnr, gaussians = result["metrics"].get("test_psnr"), result["metrics"]["gaussians"]
        return f"{f'PSNR {psnr:.2f} dB, ' if psnr else ''}{gaussians} Gaussians"
    if "effects" in result:
        return ", ".join(name for name, effect in result["effects"].items() if effect["state"] == "on")
    named = {"registered": "cameras", "gaussians": "Gaussians", "out": "", "files": "files"}
    said = {key: result[key] for key in named if key in result}
    return ", ".join(f"{len(v) if isinstance(v, list) else v} {named[k]}".strip() for k, v in said.items())
