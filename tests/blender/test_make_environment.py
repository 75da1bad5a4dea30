"""The child process of Install Engine: a folder of wheels, broken downloads, cancelling."""

import hashlib
import http.server
import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def empty_environment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("engine") / "engine"
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    return folder


@pytest.fixture
def folder(empty_environment, tmp_path):
    return shutil.copytree(empty_environment, tmp_path / "engine", symlinks=True)


class Installation:
    """The child process; `index` replaces the address of the package index."""

    def __init__(self, root, folder, index="", wheels="", look_only=False):
        task = {
            "folder": str(folder), "root": str(root), "index": index, "wheels": str(wheels), "look_only": look_only
        }  # fmt: skip
        environment = {"PATH": "/usr/bin:/bin", "PIP_CONFIG_FILE": "/dev/null", "PIP_INDEX_URL": index}
        self.process = subprocess.Popen(
            [sys.executable, str(root / "swag_blender" / "make_environment.py"), json.dumps(task)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        )  # fmt: skip
        self.events = map(json.loads, self.process.stdout)

    def end(self):
        """The last event, and the texts of progress before it."""
        texts: list[str] = []
        for event in self.events:
            if event["event"] != "progress":
                self.process.stdin.close()
                assert self.process.wait(30) == 0
                return event, texts
            texts.append(event["text"])
        raise AssertionError("the process ended without a last event")


class Index(http.server.BaseHTTPRequestHandler):
    """A package index of the folder of wheels; `broken` maps a wheel to the bytes after which its download ends."""

    broken: dict[str, int] = {}
    asked: list[tuple[str, str]] = []
    stall = threading.Event()
    directory: Path
    address: str

    def do_GET(self):
        name = self.path.rstrip("/").rpartition("/")[2]
        folder = self.directory
        if self.path.startswith("/simple/"):
            found = [w for w in sorted(folder.glob("*.whl")) if w.name.startswith(name.replace("-", "_") + "-")]
            digests = {w.name: hashlib.sha256(w.read_bytes()).hexdigest() for w in found}
            links = (f'<a href="/{name}#sha256={digest}">{name}</a>' for name, digest in digests.items())
            return self.answer(200, "<br>".join(links).encode(), "text/html")
        body, status = (folder / name).read_bytes(), 200
        if "pip" in self.headers["User-Agent"]:
            return self.answer(200, body)
        begin = self.headers.get("Range", "")
        self.asked.append((name, begin))
        if begin:
            body, status = body[int(begin.removeprefix("bytes=").rstrip("-")) :], 206
        sent = body[: self.broken.get(name, len(body))]
        self.answer(status, sent, length=len(body))
        if len(sent) < len(body):
            self.stall.wait(60)
            self.close_connection = True

    def answer(self, status, body, kind="application/zip", length=None):
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        self.end_headers()
        self.wfile.write(body)

    def do_HEAD(self):
        self.send_response(200)
        self.send_header("Content-Length", str((self.directory / self.path.lstrip("/")).stat().st_size))
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def index(wheels):
    handler: type[Index] = type("OneIndex", (Index,), {"broken": {}, "asked": [], "stall": threading.Event()})
    handler.directory = wheels
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    handler.address = f"http://127.0.0.1:{server.server_port}/simple"
    handler.stall.set()
    yield handler
    handler.stall.set()
    server.shutdown()


def test_the_engine_is_installed_from_a_folder_of_wheels(root, folder, wheels):
    found, _ = Installation(root, folder, wheels=wheels, look_only=True).end()
    assert found["event"] == "result" and not (folder / "installed.json").exists()
    assert found["bytes"] == sum(wheel.stat().st_size for wheel in wheels.iterdir()) == found["present"]
    done, texts = Installation(root, folder, wheels=wheels).end()
    assert done["event"] == "result", done
    assert done["torch"] == done["doctor"]["packages"]["torch"] and done["doctor"]["backends"]["torch"]["runs"]
    assert json.loads((folder / "installed.json").read_text())["torch"] == done["torch"]
    assert f"Unpacking {len(list(wheels.iterdir()))} packages" in texts
    assert not (folder / "downloads").exists() and "Unpacking" in (folder / "install.log").read_text()


def test_without_a_wheel_for_graphics_cards_the_others_are_installed(root, folder, wheels, tmp_path):
    shutil.copytree(wheels, tmp_path / "wheels", ignore=shutil.ignore_patterns("wgpu-*"))
    found, _ = Installation(root, folder, wheels=tmp_path / "wheels", look_only=True).end()
    assert found["event"] == "result" and found["packages"] == len(list(wheels.iterdir())) - 1


def test_a_broken_download_is_continued_where_it_stopped(root, folder, wheels, index):
    torch = next(wheel.name for wheel in wheels.glob("torch-*"))
    index.broken[torch] = 100
    failed, _ = Installation(root, folder, index.address).end()
    assert failed["event"] == "error" and f"The download of {torch} failed" in failed["message"]
    assert "Traceback" not in failed["message"] and not (folder / "installed.json").exists()
    # Three tries, each continues the one before.
    assert [begin for name, begin in index.asked if name == torch] == ["", "bytes=100-", "bytes=200-"]
    fetched = {name for name, _ in index.asked} - {torch}
    index.broken.clear()
    index.asked.clear()
    done, texts = Installation(root, folder, index.address).end()
    assert done["event"] == "result", done
    assert index.asked[0] == (torch, "bytes=300-")
    assert not {name for name, _ in index.asked} & fetched, "fetched twice"
    assert (folder / "installed.json").exists()
    assert any(text.startswith("Downloading torch, ") and text.endswith(" MB") for text in texts)


def test_a_download_with_the_wrong_checksum_is_repeated(root, folder, wheels, index):
    torch = next(wheel for wheel in wheels.glob("torch-*"))
    (folder / "downloads").mkdir()
    (folder / "downloads" / f"{torch.name}.part").write_bytes(b"x" * torch.stat().st_size)
    done, _ = Installation(root, folder, index.address).end()
    assert done["event"] == "result", done


def test_cancel_keeps_downloads_and_marks_nothing_as_installed(root, folder, wheels, index):
    torch = next(wheel.name for wheel in wheels.glob("torch-*"))
    index.broken[torch] = 100
    index.stall.clear()
    running = Installation(root, folder, index.address)
    part = folder / "downloads" / f"{torch}.part"
    while not (part.exists() and part.stat().st_size):
        time.sleep(0.05)
    running.process.stdin.write('{"request": "cancel"}\n')
    running.process.stdin.flush()
    index.stall.set()
    ended, _ = running.end()
    assert ended["event"] == "error" and "was cancelled" in ended["message"]
    assert not (folder / "installed.json").exists()
    assert part.stat().st_size == 100


def test_a_package_that_cannot_be_found_is_reported_in_one_sentence(root, folder, tmp_path):
    (tmp_path / "empty").mkdir()
    failed, _ = Installation(root, folder, wheels=tmp_path / "empty").end()
    assert failed["event"] == "error" and "\n" not in failed["message"]
    assert f"for Python 3.11 on this system in {tmp_path / 'empty'}" in failed["message"]


def test_a_repeated_installation_is_not_complete_before_its_end(root, folder, wheels, tmp_path):
    """installed.json of an earlier installation is removed first."""
    (folder / "installed.json").write_text("{}")
    (tmp_path / "empty").mkdir()
    assert Installation(root, folder, wheels=tmp_path / "empty").end()[0]["event"] == "error"
    assert not (folder / "installed.json").exists()
