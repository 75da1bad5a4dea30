"""The child process of Install Engine: a folder of wheels, broken downloads, cancelling."""

import errno
import hashlib
import http.server
import json
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from swag_blender.make_environment import Installer, unpacked_size


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

    def __init__(
        self, root, folder, index="", wheels="", look_only=False, without_cuda=False, python_path="", **variables
    ):
        task = {
            "folder": str(folder), "root": str(root), "index": index, "wheels": str(wheels), "look_only": look_only,
            "without_cuda": without_cuda,
        }  # fmt: skip
        environment = {"PATH": "/usr/bin:/bin", "PIP_CONFIG_FILE": "/dev/null", "PIP_INDEX_URL": index, **variables}
        environment |= {"PIP_RETRIES": "1", "PYTHONPATH": str(python_path)}
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


def test_a_repeated_installation_that_finds_no_packages_leaves_the_earlier_one(root, folder, wheels, tmp_path):
    (folder / "installed.json").write_text("{}")
    (tmp_path / "empty").mkdir()
    assert Installation(root, folder, wheels=tmp_path / "empty").end()[0]["event"] == "error"
    assert (folder / "installed.json").exists()


@pytest.fixture
def without_ensurepip(tmp_path):
    """A folder that makes Python lack ensurepip, as that of Debian without python3-venv does."""
    (tmp_path / "stub").mkdir()
    (tmp_path / "stub" / "ensurepip.py").write_text("raise ModuleNotFoundError(name='ensurepip')")
    return tmp_path / "stub"


def test_a_python_without_ensurepip_is_named_with_its_remedy_and_mended_later(
    root, tmp_path, wheels, without_ensurepip
):
    """After the package was installed, Install Engine succeeds, though the folder was half made."""
    folder = tmp_path / "new"
    (folder / "downloads").mkdir(parents=True)
    (folder / "downloads" / "torch.part").write_text("kept")
    failed, _ = Installation(root, folder, wheels=wheels, python_path=without_ensurepip).end()
    assert failed["event"] == "error" and "\n" not in failed["message"]
    assert "its module ensurepip is missing" in failed["message"]
    assert "python3-venv" in failed["message"] and "press Install Engine again" in failed["message"]
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)  # as Debian leaves it
    found, _ = Installation(root, folder, wheels=wheels, look_only=True).end()
    assert found["event"] == "result", found
    assert (folder / "downloads" / "torch.part").read_text() == "kept"


def no_pip(folder):
    shutil.rmtree(next(folder.glob("lib/*/site-packages/pip")))


def part_of_pip(folder):
    next(folder.glob("lib/*/site-packages/pip/_internal/cli/main.py")).unlink()


def no_configuration(folder):
    (folder / "pyvenv.cfg").unlink()


def dead_link(folder):
    (folder / "bin" / "python").unlink()
    (folder / "bin" / "python").symlink_to("/no/such/blender/python")


def no_python(folder):
    (folder / "bin" / "python").unlink()


def other_version(folder):
    """As after an update of the system: the link leads to another Python, which does not find the packages."""
    library = next(folder.glob("lib/python3.*"))
    library.rename(library.with_name("python3.9"))


@pytest.mark.parametrize("damage", [no_pip, part_of_pip, no_configuration, dead_link, no_python, other_version])
def test_a_damaged_environment_is_made_anew(root, folder, wheels, damage):
    damage(folder)
    found, texts = Installation(root, folder, wheels=wheels, look_only=True).end()
    assert found["event"] == "result", found
    assert "Making a Python environment" in texts


def test_half_installed_packages_are_replaced(root, folder, wheels):
    """pip takes a package for installed by its METADATA, and cannot remove one without RECORD."""
    version = next(wheels.glob("torch-*")).name.split("-")[1]
    site = next(folder.glob("lib/*/site-packages"))
    (site / f"torch-{version}.dist-info").mkdir()
    (site / f"torch-{version}.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: torch\nVersion: {version}\n"
    )
    done, _ = Installation(root, folder, wheels=wheels).end()
    assert done["event"] == "result", done


def test_without_network_and_with_a_wrong_proxy_the_cause_is_named(root, folder):
    """Nothing listens on port 9 of this computer."""
    nowhere = "http://127.0.0.1:9/simple"
    failed, _ = Installation(root, folder, nowhere, look_only=True).end()
    assert "cannot be reached: check the internet connection" in failed["message"]
    proxy = {"HTTPS_PROXY": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    failed, _ = Installation(root, folder, "https://packages.invalid/simple", look_only=True, **proxy).end()
    assert "The proxy" in failed["message"] and "\n" not in failed["message"]


@pytest.fixture
def installer(folder, root):
    return Installer(str(folder), str(root), "", "", False)


def test_too_little_disk_is_told_before_the_download(installer, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2_000_000_000))
    with pytest.raises(RuntimeError, match=r"needs 8\.4 GB, and 2\.0 GB are free\. Free 6\.4 GB"):
        installer.check_disk(2_950_000_000 + unpacked_size(2_950_000_000))
    installer.check_disk(1_900_000_000)


def test_a_full_disk_ends_a_download_at_once_and_keeps_it(installer, monkeypatch):
    tries = []

    def fill(url, part, before, total):
        part.write_bytes(b"x" * 10)
        tries.append(url)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(installer, "download_rest", fill)
    installer.downloads.mkdir()
    with pytest.raises(RuntimeError, match="The disk is full: free space on the disk of"):
        installer.download("http://server/torch-1.whl", "", 0, 10)
    assert len(tries) == 1
    assert (installer.downloads / "torch-1.whl.part").stat().st_size == 10


def wheel_with(source, target, **replaced):
    """Copy a wheel with other contents of its files, by the end of their names."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, replaced.get(name.rpartition("/")[2], old.read(name)))


def test_torch_with_cuda_is_not_downloaded_where_one_without_was_stated(root, folder, wheels, tmp_path):
    """As pip resolves it when PyTorch's index cannot be reached."""
    own = shutil.copytree(wheels, tmp_path / "wheels")
    torch = next(own.glob("torch-*"))
    version = torch.name.split("-")[1]
    metadata = f"Metadata-Version: 2.1\nName: torch\nVersion: {version}\nRequires-Dist: nvidia-cublas\n"
    wheel_with(next(wheels.glob("torch-*")), torch, METADATA=metadata)
    info = {f"nvidia_cublas-1.dist-info/{name}": text for name, text in (
        ("METADATA", "Metadata-Version: 2.1\nName: nvidia-cublas\nVersion: 1\n"),
        ("WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"), ("RECORD", ""),
    )}  # fmt: skip
    with zipfile.ZipFile(own / "nvidia_cublas-1-py3-none-any.whl", "w") as wheel:
        for name, text in info.items():
            wheel.writestr(name, text)
    found, _ = Installation(root, folder, wheels=own, without_cuda=True).end()
    assert found["event"] == "result" and found["cuda"] and "doctor" not in found, found
    assert found["bytes"] == sum(wheel.stat().st_size for wheel in own.iterdir())
    assert not (folder / "installed.json").exists() and not (folder / "downloads").exists()
    found, _ = Installation(root, folder, wheels=wheels, look_only=True, without_cuda=True).end()
    assert found["cuda"] is False


def test_a_wheel_that_cannot_be_unpacked_leaves_no_whole_environment_and_the_downloads(
    root, folder, wheels, index, tmp_path
):
    """Its directory is right, and so is the checksum of the index; the contents of one file are not."""
    index.directory = shutil.copytree(wheels, tmp_path / "wheels")
    torch = next(index.directory.glob("torch-*"))
    good = torch.read_bytes()
    line = good.index(b"site-packages")
    torch.write_bytes(good[:line] + b"SITE-PACKAGES" + good[line + 13 :])
    (folder / "installed.json").write_text("{}")
    failed, texts = Installation(root, folder, index.address).end()
    assert failed["event"] == "error" and "\n" not in failed["message"], failed
    assert "could not be installed" in failed["message"] and "Traceback" not in failed["message"]
    assert any(text.startswith("Unpacking") for text in texts)
    assert not (folder / "installed.json").exists()
    assert (folder / "downloads" / torch.name).exists()
