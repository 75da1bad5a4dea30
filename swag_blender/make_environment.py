"""Make the engine's Python environment: `python make_environment.py FOLDER REQUIREMENTS CONSTRAINTS`.

A child process of Install Engine, with the worker's manners: events as JSON lines on stdout, the log on stderr, and an
end when stdin closes or `{"request": "cancel"}` comes. Standard library only; it runs under Blender's own Python.
`FOLDER/installed.json` is written last: without it the environment is not whole. What a broken run downloaded, pip
keeps in its cache, so that a second try goes on from there.
"""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

CHECK = (
    "import cv2, numpy, platformdirs, pycolmap, rich, safetensors, scipy, sys, torch, tyro;"
    " print(sys.version.split()[0], torch.__version__)"
)


class Cancelled(Exception):
    pass


class Installer:
    def __init__(self, folder: Path, requirements: Path, constraints: Path) -> None:
        self.folder, self.requirements, self.constraints = folder, requirements, constraints
        self.python = folder.joinpath(*(("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")))
        self.child: subprocess.Popen[str] | None = None
        self.cancelled = False

    def listen(self) -> None:
        for line in sys.stdin:
            if "cancel" in line:
                break
        self.cancelled = True
        if self.child:
            self.child.terminate()

    def run(self, step: int, text: str, command: list[str]) -> str:
        """Run one command, its lines shown as progress; returns the last one. Raises RuntimeError when it fails."""
        if self.cancelled:
            raise Cancelled
        progress(step, text)
        self.child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
        )
        last = error = ""
        assert self.child.stdout
        for line in self.child.stdout:
            line = line.strip()
            print(line, file=sys.stderr, flush=True)
            if line:
                last = line
                progress(step, line)
            if line.startswith("ERROR:"):
                error = error or line.removeprefix("ERROR:").strip()
        if self.child.wait():
            if self.cancelled:
                raise Cancelled
            raise RuntimeError(f"{text} failed: {error or last}")
        return last

    def install(self) -> str:
        """All steps; returns the versions of Python and torch."""
        whole = self.folder / "installed.json"
        whole.unlink(missing_ok=True)
        self.run(0, "Making a Python environment", [sys.executable, "-m", "venv", str(self.folder)])
        pip = [str(self.python), "-m", "pip", "install", "--disable-pip-version-check", "--progress-bar", "off"]
        self.run(1, "Installing packages", [*pip, "-r", str(self.requirements), "-c", str(self.constraints)])
        versions = self.run(2, "Checking", [str(self.python), "-c", CHECK])
        part = whole.with_suffix(".part")
        part.write_text(json.dumps({"versions": versions}), encoding="utf-8")
        os.replace(part, whole)
        return versions


def progress(step: int, text: str) -> None:
    send({"event": "progress", "stage": "install", "iteration": step, "iterations": 3, "text": text})


def fail(sentence: str) -> None:
    send({"event": "error", "kind": "input", "message": sentence})


def send(event: dict[str, object]) -> None:
    print(json.dumps(event), flush=True)


def main() -> None:
    installer = Installer(*(Path(argument) for argument in sys.argv[1:4]))
    threading.Thread(target=installer.listen, daemon=True).start()
    try:
        versions = installer.install()
    except Cancelled:
        fail("The installation was stopped; Install Engine goes on with it.")
    except (RuntimeError, OSError) as error:
        fail(f"The engine could not be installed. {error}")
    else:
        send({"event": "result", "request": "install", "versions": versions})


if __name__ == "__main__":
    main()
