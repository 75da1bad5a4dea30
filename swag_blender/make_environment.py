"""Make the engine's Python environment: `python make_environment.py TASK`, with the task as JSON.

A child process of Install Engine with the worker's protocol: events as JSON lines on stdout, the log on stderr (and in
FOLDER/install.log); it stops when stdin closes or `{"request": "cancel"}` arrives. It runs in Blender's own Python and
imports only the standard library.

pip reports which wheels are needed and their addresses. This script downloads them, so that their size is known first
and an interrupted download continues where it stopped; pip then installs from files, into an environment without other
packages. `FOLDER/installed.json` is written last: without it the environment is incomplete.
"""

import contextlib
import errno
import hashlib
import http.client
import json
import os
import platform
import re
import shutil
import ssl
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

TIMEOUT = 15
"""Seconds without an answer after which a download is tried again."""
CHUNK = 1 << 18
"""Bytes that are read at a time."""
ATTEMPTS = 3
"""How often a download is tried."""
OPTIONAL = ("wgpu",)
"""Packages that are installed where there are wheels of them: graphics cards of any make, three megabytes."""
KEPT = ("downloads", "install.log")
"""What of an environment stays when it is made anew."""
PROBE = """
import importlib.metadata, os, sys
assert all(file.locate().exists() for file in importlib.metadata.files("pip") or [None])
print(*sys.version_info[:2], os.path.realpath(sys.prefix))
"""
"""Program that prints the version and the folder of a Python; it fails where pip or a file of it is missing."""
REMEDIES = (
    (
        r"No space left|not enough space|Errno 28|WinError 112|Disk quota exceeded",
        "The disk is full: free space on the disk of {folder}.",
    ),
    (
        r"ProxyError|[Cc]annot connect to proxy|Tunnel connection failed|Proxy Authentication",
        "The proxy refuses the connection: check the proxy in the system's settings (or the variable HTTPS_PROXY).",
    ),
    (
        r"CERTIFICATE_VERIFY_FAILED|SSLError",
        "The server's certificate is not accepted: check the date of this computer, and whether a proxy or virus "
        "scanner reads its connections.",
    ),
    (
        r"NewConnectionError|NameResolutionError|ConnectTimeout|ReadTimeout|ConnectionResetError|Connection refused|"
        r"Name or service not known|Temporary failure in name resolution|getaddrinfo failed|nodename nor servname|"
        r"[Nn]etwork is unreachable|No route to host|timed out|WinError 100(13|51|60|61|65)",
        "The server of the packages cannot be reached: check the internet connection.",
    ),
    (r"Permission denied|Errno 13|WinError 5\b", "A file may not be written: check who may write to {folder}."),
)
"""Patterns in what pip or the system says, each with a sentence of cause and remedy."""
LOOKED_UP, DOWNLOADED, UNPACKED, ALL = 50, 800, 950, 1000
"""Progress after looking up, downloading, unpacking and checking, in thousandths."""


class Cancelled(Exception):
    """The user cancelled the installation."""


class Installer:
    """One installation.

    Args:
        folder: folder of the environment.
        root: folder of the extension.
        index: address of an additional package index; "" for none.
        wheels: folder of wheels to install from without network; "" for none.
        look_only: look up what would be downloaded, and stop.
        without_cuda: stop after the look-up where only a torch with CUDA can be had. pip takes it without an error
            when an additional package index cannot be reached.
    """

    def __init__(
        self, folder: str, root: str, index: str, wheels: str, look_only: bool, without_cuda: bool = False
    ) -> None:
        self.folder, self.root = Path(folder), Path(root)
        self.index, self.wheels = index, wheels
        self.look_only, self.without_cuda = look_only, without_cuda
        self.python = self.folder.joinpath(*(("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")))
        self.downloads = self.folder / "downloads"
        self.child: subprocess.Popen[str] | None = None
        self.cancelled = False

    def listen(self) -> None:
        """Wait for a cancel request or the end of stdin, then stop."""
        for line in sys.stdin:
            if "cancel" in line:
                break
        self.cancelled = True
        if self.child:
            self.child.terminate()

    def run(self, done: int, text: str, *command: str, errors_in_log: bool = True) -> str:
        """Run a command; returns its output.

        Raises RuntimeError with the cause, or its first error or last line, if it fails.
        """
        self.progress(done, text)
        self.child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT if errors_in_log else None,
            encoding="utf-8",
            errors="replace",
            # Packages that Blender's own Python finds must not count as installed.
            env={**os.environ, "PYTHONPATH": str(self.root), "PYTHONNOUSERSITE": "1", "PYTHONSAFEPATH": "1"},
        )
        assert self.child.stdout
        output = []
        for line in self.child.stdout:
            output.append(line.rstrip())
            self.log(line.rstrip())
        if self.child.wait():
            if self.cancelled:
                raise Cancelled
            errors = [line.removeprefix("ERROR:").strip() for line in output if line.startswith("ERROR:")]
            lines = errors or [line for line in reversed(output) if line] or ["no output"]
            raise RuntimeError(self.cause("\n".join(output)) or f"{text} failed: {lines[0].rstrip('.')}.")
        return "\n".join(output)

    def cause(self, said: str) -> str:
        """Sentence of cause and remedy for what a program or the system said; "" for an unknown cause."""
        found = (sentence for pattern, sentence in REMEDIES if re.search(pattern, said))
        return next(found, "").format(folder=self.folder)

    def pip(self, done: int, text: str, *arguments: str) -> str:
        """Run `pip install` with the environment's Python; as `run`."""
        quiet = ("--disable-pip-version-check", "--no-input", "--progress-bar", "off")
        return self.run(done, text, str(self.python), "-m", "pip", "install", *quiet, *arguments)

    def work(self) -> dict[str, Any]:
        """Do all steps; returns the contents of the `result` event."""
        made = not self.python_works()
        if made:
            self.make_python()
        wheels, sizes = self.look_up()
        total, here = sum(sizes), sum(self.present(wheel, size) for wheel, size in zip(wheels, sizes, strict=True))
        torch = next((w["metadata"]["version"] for w in wheels if w["metadata"]["name"].lower() == "torch"), "?")
        cuda = "+cu" in torch or any(w["metadata"]["name"].lower().startswith("nvidia-") for w in wheels)
        found: dict[str, Any] = {
            "torch": torch, "cuda": cuda, "packages": len(wheels), "bytes": total, "present": here
        }  # fmt: skip
        if self.look_only or (self.without_cuda and cuda):
            return found
        self.check_disk(max(0, total - here) + unpacked_size(total))
        files = self.download_all(wheels, sizes, total)
        if not made:  # it may hold packages of an installation that was interrupted, or of another version
            self.make_python()
        self.pip(DOWNLOADED, f"Unpacking {len(files)} packages", "--no-index", "--no-deps", *map(str, files))
        doctor = self.run(
            UNPACKED, "Checking the engine", str(self.python), "-m", "swag_engine.app.doctor", errors_in_log=False
        )
        found["doctor"] = json.loads(doctor)
        missing = [name for name, version in found["doctor"]["packages"].items() if version is None]
        if missing or "backends" not in found["doctor"]:
            raise RuntimeError(f"Checking the engine failed: {', '.join(missing) or 'it does not start'}.")
        self.write(self.folder / "installed.json", found)
        shutil.rmtree(self.downloads, ignore_errors=True)
        return found

    # -- an environment without packages ------------------------------------------------------------------------------

    def python_works(self) -> bool:
        """Whether the environment has a Python of this version that runs and has pip."""
        try:
            found = subprocess.run(
                [str(self.python), "-I", "-c", PROBE],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                encoding="utf-8",
            )
        except OSError:  # it is missing, or a link to a Blender that was removed
            return False
        return found.stdout.strip() == " ".join((*map(str, sys.version_info[:2]), os.path.realpath(self.folder)))

    def make_python(self) -> None:
        """Make the environment anew, without packages; downloads are kept. Raises RuntimeError when it cannot be."""
        try:
            import ensurepip  # noqa: F401  # some distributions have it in a package of its own
            import venv  # noqa: F401
        except ImportError as error:
            raise RuntimeError(
                f"Blender's Python cannot make environments: its module {error.name or 'ensurepip'} is missing. "
                f"{venv_remedy()}, then press Install Engine again. Blender from blender.org has the module."
            ) from error
        # First, so that an environment that is only half removed does not look complete.
        (self.folder / "installed.json").unlink(missing_ok=True)
        for path in self.folder.iterdir():
            if path.is_dir() and not path.is_symlink() and path.name not in KEPT:
                shutil.rmtree(path)
            elif path.name not in KEPT:
                path.unlink()
        self.run(0, "Making a Python environment", sys.executable, "-m", "venv", str(self.folder))
        if not self.python_works():
            raise RuntimeError(f"The Python environment in {self.folder} does not work: use Blender from blender.org.")

    def check_disk(self, needed: int) -> None:
        """Raise RuntimeError when fewer than `needed` bytes are free on the disk of the environment."""
        free = shutil.disk_usage(self.folder).free
        if free < needed:
            raise RuntimeError(
                f"The disk is too full: {self.folder} needs {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free. "
                f"Free {(needed - free) / 1e9:.1f} GB."
            )

    # -- what is needed -----------------------------------------------------------------------------------------------

    def look_up(self) -> tuple[list[dict[str, Any]], list[int]]:
        """Look up the wheels that pip would install, as in its report, and their sizes in bytes."""
        report = self.folder / "report.json"
        where = ["--no-index", "--find-links", self.wheels] if self.wheels else []
        if self.index and not self.wheels:
            where = ["--extra-index-url", self.index]
        files = ("-r", str(self.root / "requirements.txt"), "-c", str(self.root / "constraints.txt"))
        options = ("--dry-run", "--ignore-installed", "--only-binary", ":all:", "--report", str(report))
        for optional in (OPTIONAL, ()):
            try:
                self.pip(10, "Looking up the packages", *options, *where, *files, *optional)
                break
            except RuntimeError as error:
                # For a pinned version that does not exist pip reports a conflict.
                missing = re.search(r"(?:Cannot install|No matching distribution found for) ([\w.-]+)", str(error))
                if not missing:
                    raise
                if not optional:
                    raise RuntimeError(
                        f"There is no wheel of {missing[1]} for Python {sys.version_info[0]}."
                        f"{sys.version_info[1]} on this system in {self.wheels or 'the package index'}, in the version "
                        "of constraints.txt."
                    ) from error
        wheels = json.loads(report.read_text(encoding="utf-8"))["install"]
        report.unlink()
        sizes = []
        for number, wheel in enumerate(wheels):
            self.progress(25 + 25 * number // len(wheels), f"Looking up the size of {wheel['metadata']['name']}")
            sizes.append(self.size(wheel["download_info"]["url"]))
        return wheels, sizes

    def size(self, url: str) -> int:
        """Size of a wheel in bytes; 0 where its server does not tell it."""
        if url.startswith("file:"):
            return local_path(url).stat().st_size
        request = urllib.request.Request(url, method="HEAD")
        try:
            with self.open(request) as answer:
                return int(answer.headers.get("Content-Length", 0))
        except (OSError, ValueError):
            return 0

    def present(self, wheel: dict[str, Any], size: int) -> int:
        """Number of bytes of a wheel that are on this machine."""
        url = wheel["download_info"]["url"]
        if url.startswith("file:"):
            return size
        path = self.download_path(url)
        return next((p.stat().st_size for p in (path, part_of(path)) if p.exists()), 0)

    # -- downloading it -----------------------------------------------------------------------------------------------

    def download_path(self, url: str) -> Path:
        """File that a wheel is downloaded to."""
        return self.downloads / unquote(urlparse(url).path.rsplit("/", 1)[-1])

    def download_all(self, wheels: list[dict[str, Any]], sizes: list[int], total: int) -> list[Path]:
        """Download all wheels; returns their files. Files of an interrupted installation are not downloaded again."""
        self.downloads.mkdir(exist_ok=True)
        files, before = [], 0
        for wheel, size in zip(wheels, sizes, strict=True):
            info = wheel["download_info"]
            if info["url"].startswith("file:"):
                files.append(local_path(info["url"]))
            else:
                digest = info.get("archive_info", {}).get("hashes", {}).get("sha256", "")
                files.append(self.download(info["url"], digest, before, total))
            before += size
        return files

    def download(self, url: str, digest: str, before: int, total: int) -> Path:
        """Download a wheel, or the rest of it; returns its file. Raises RuntimeError when it cannot be downloaded."""
        path = self.download_path(url)
        if path.exists():
            return path
        part, problem = part_of(path), ""
        for attempt in range(ATTEMPTS):
            if attempt:
                self.log(f"{path.name}: {problem}; trying again")
                time.sleep(attempt)
            try:
                self.download_rest(url, part, before, total)
            except (OSError, http.client.HTTPException) as error:
                problem = str(error) or type(error).__name__
                if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                    break
                continue
            if not digest or hashlib.sha256(part.read_bytes()).hexdigest() == digest:
                os.replace(part, path)
                return path
            part.unlink()
            problem = "its contents do not match the checksum of the index"
        raise RuntimeError(f"The download of {path.name} failed: {problem}. {self.cause(problem)}".strip())

    def download_rest(self, url: str, part: Path, before: int, total: int) -> None:
        """Append the bytes that a partial file lacks.

        Args:
            url: address of the wheel.
            part: the partial file.
            before: bytes of the wheels before it, for the progress.
            total: bytes of all wheels.

        Raises:
            OSError: the connection failed.
        """
        have = part.stat().st_size if part.exists() else 0
        request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
        try:
            answer = self.open(request)
        except urllib.error.HTTPError as error:
            if error.code != 416:  # range not satisfiable: the file is complete
                raise
            return
        with answer, open(part, "ab") as file:
            if have and answer.status != 206:  # the server does not support ranges and sends the whole file
                file.truncate(0)
                have = 0
            left = int(answer.headers.get("Content-Length", 0))
            while chunk := answer.read1(CHUNK):
                if self.cancelled:
                    raise Cancelled
                file.write(chunk)
                have, left = have + len(chunk), left - len(chunk)
                fraction = (before + have) / max(1, total, before + have)
                self.progress(
                    LOOKED_UP + int((DOWNLOADED - LOOKED_UP) * fraction),
                    f"Downloading {part.name.split('-')[0]}, {(before + have) / 1e6:.0f} of {total / 1e6:.0f} MB",
                )
        if left > 0:
            raise OSError("the connection ended early")

    def open(self, request: urllib.request.Request) -> Any:
        """Open an address with the certificates of the environment's pip."""
        context = ssl.create_default_context()
        # On some systems Blender's Python has no certificates; pip has its own.
        for bundle in self.folder.rglob("pip/_vendor/certifi/cacert.pem"):
            context.load_verify_locations(bundle)
        return urllib.request.urlopen(request, timeout=TIMEOUT, context=context)

    # -- reporting ----------------------------------------------------------------------------------------------------

    def progress(self, done: int, text: str) -> None:
        """Send a `progress` event. Raises Cancelled after a cancel request."""
        if self.cancelled:
            raise Cancelled
        send({"event": "progress", "stage": "install", "iteration": done, "iterations": ALL, "text": text})
        self.log(text)

    def log(self, line: str) -> None:
        """Write a line to the log."""
        print(line, file=sys.stderr, flush=True)
        with contextlib.suppress(OSError), open(self.folder / "install.log", "a", encoding="utf-8") as log:
            log.write(line + "\n")

    def write(self, path: Path, document: dict[str, Any]) -> None:
        """Write a JSON file, complete or not at all."""
        part = part_of(path)
        part.write_text(json.dumps(document, indent=2), encoding="utf-8")
        os.replace(part, path)


def unpacked_size(download: int) -> int:
    """Bytes on disk of all packages whose wheels have `download` bytes, with what Python compiles, estimated.

    Measured: 2.95 GB with CUDA became 5.4 GB, and 0.41 GB without it 1.6 GB.
    """
    return int(1e9 + 1.5 * download)


def venv_remedy() -> str:
    """What to install where Python's modules for environments are missing, as exact as this system is known."""
    try:
        system = platform.freedesktop_os_release()
    except OSError:
        system = {}
    if "debian" in f"{system.get('ID', '')} {system.get('ID_LIKE', '')}".split():
        return f"Install the package python{sys.version_info[0]}.{sys.version_info[1]}-venv (python3-venv)"
    return "Install your system's package with Python's module ensurepip (Debian, Ubuntu: python3-venv)"


def part_of(path: Path) -> Path:
    """File that holds the part of `path` written so far."""
    return path.with_name(path.name + ".part")


def local_path(url: str) -> Path:
    """Path of a file: address."""
    return Path(urllib.request.url2pathname(urlparse(url).path))


def fail(sentence: str) -> None:
    """Send an `error` event."""
    send({"event": "error", "kind": "input", "message": sentence})


def send(event: dict[str, Any]) -> None:
    """Print an event for Blender."""
    print(json.dumps(event), flush=True)


def main() -> None:
    """Install as the command line asks, and report the outcome."""
    installer = Installer(**json.loads(sys.argv[1]))
    threading.Thread(target=installer.listen, daemon=True).start()
    try:
        found = installer.work()
    except Cancelled:
        fail("The installation was cancelled; Install Engine continues it.")
    except (RuntimeError, OSError, ValueError) as error:
        sentence = installer.cause(str(error)) if isinstance(error, OSError) else ""
        fail(f"The engine could not be installed. {sentence or error} Install Engine continues where it stopped.")
    else:
        send({"event": "result", "request": "install", **found})


if __name__ == "__main__":
    main()
