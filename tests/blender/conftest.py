"""Blender versions as long-lived processes with the extension installed from its zip."""

import contextlib
import importlib.util
import json
import os
import re
import select
import signal
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.blender.real_blender import REAL, TOOLS
from tests.conftest import ROOT

VERSIONS = ("5.3", "4.5", "5.2")
THIS_PYTHON = "4.5"
"""The version that runs in this Python; the others have a Python of their own."""


def packages(version):
    """Where environment.sh puts the bpy package of a version, with its Python unless it runs in this one."""
    return ROOT / ".venv" / f"blender-{version}"


class Blender:
    """One Blender version as a process of server.py, which runs functions of scripts/.

    Args:
        version: one of VERSIONS.
        extension_zip: the extension to install.
        make_folder: gives an empty folder for the user files of a new process.
        nodes: a file of the version, for server.py.
    """

    def __init__(self, version, extension_zip, make_folder, nodes):
        self.version, self._zip, self._make_folder, self._nodes = version, extension_zip, make_folder, nodes
        self._process = None
        self.user = None
        self.printed = ""
        """What the last function, Blender and their child processes printed."""

    def fresh(self):
        """Another process of the same version, which the caller quits."""
        return Blender(self.version, self._zip, self._make_folder, self._nodes)

    def _start(self):
        self.user = self._make_folder()
        self._log = Path(f"{self.user}.log")
        own = {
            "BLENDER_USER_RESOURCES": str(self.user),
            "PYTHONPATH": str(packages(self.version)),
            "PYTHONIOENCODING": "utf-8",
        }
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    sys.executable if self.version == THIS_PYTHON else str(packages(self.version) / "python"),
                    *("-X", "faulthandler", str(Path(__file__).with_name("server.py")), self._zip, self._nodes),
                ],
                env=os.environ | own, cwd=self.user, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
                encoding="utf-8", start_new_session=True,
            )  # fmt: skip

    def run(self, name, *arguments, seconds=300, **environment):
        """Call a function of a script in an empty file with the extension enabled.

        Args:
            name: "script.function".
            arguments: what the function takes, as JSON; paths become strings.
            seconds: after which the process is killed.
            environment: variables of the process for this call.

        Returns:
            What the function returned, through JSON.

        Raises:
            AssertionError: The function raised, Blender crashed, or the time was over. A crash or a timeout ends the
                process; the next call starts another one.
        """
        if self._process is None:
            self._start()
        script, function = name.split(".")
        request = {"script": script, "function": function, "arguments": arguments}
        request["environment"] = {key: str(value) for key, value in environment.items()}
        begin, line, ended = self._log.stat().st_size, "", f"Blender did not answer within {seconds} s"
        try:
            print(json.dumps(request, default=str), file=self._process.stdin, flush=True)
            if select.select([self._process.stdout], [], [], seconds)[0]:
                line = self._process.stdout.readline()
                if not line:
                    ended = f"Blender ended with exit code {self._process.wait(10)}"
        finally:
            if not line:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self.quit()
        self.printed = self._log.read_bytes()[begin:].decode(errors="replace")
        answer = json.loads(line) if line else {"error": ended}
        if "error" in answer:
            raise AssertionError(f"{name} in Blender {self.version}: {answer['error']}\n{self.printed}")
        return answer["result"]

    def quit(self):
        """End the process as a user ends Blender; the next call starts another one."""
        if self._process is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
            self._process.wait(60)
            self._process.stdout.close()
            self._process = None


@pytest.fixture(scope="session")
def root():
    return ROOT


@pytest.fixture(scope="session")
def extension_zip(tmp_path_factory):
    spec = importlib.util.spec_from_file_location("build_extension", ROOT / ".ci" / "build_extension.py")
    builder = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builder)
    return builder.build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="session")
def blenders(extension_zip, tmp_path_factory):
    """One process per version, started when a test first asks for it."""
    # The workers of pytest-xdist have folders beside one another.
    shared = tmp_path_factory.getbasetemp()
    shared = shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared
    made = {
        version: Blender(
            version, extension_zip, lambda version=version: tmp_path_factory.mktemp(f"blender-{version}"),
            shared / f"nodes-{version}.blend",
        )
        for version in VERSIONS
    }  # fmt: skip
    yield made
    for blender in made.values():
        blender.quit()


@pytest.fixture(params=VERSIONS)
def blender(request, blenders, missing):
    """Each Blender version."""
    folder = packages(request.param)
    if not (folder / "bpy").exists() or not (request.param == THIS_PYTHON or (folder / "python").exists()):
        needed = "" if request.param == THIS_PYTHON else "; it needs Python 3.13"
        missing(f"Blender {request.param} is not in {folder}: run `make .venv/ready`{needed}.")
    return blenders[request.param]


@pytest.fixture(scope="session")
def real_blender(missing):
    """The folder of the real Blender, a root folder of its own with a window system."""
    if not (REAL / "usr/bin/blender").exists():
        missing(f"There is no Blender with a window in {REAL}: run `{TOOLS}/setup {REAL}` (3 minutes, 2 GB).")
    return REAL


@pytest.fixture(scope="session")
def fake_engine(tmp_path_factory):
    """An executable for SWAG_ENGINE_PYTHON that runs fake_worker.py."""
    python = tmp_path_factory.mktemp("engine") / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} {Path(__file__).with_name("fake_worker.py")} "$@"\n')
    python.chmod(0o755)
    return python


@pytest.fixture(scope="session")
def wheels(tmp_path_factory):
    """A folder of empty wheels of all that is installed; that of torch makes this Python's packages importable."""
    folder = tmp_path_factory.mktemp("wheels")
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in constraints if "==" in line)
    for name in [*re.findall(r"^[\w-]+", (ROOT / "requirements.txt").read_text(), re.MULTILINE), "wgpu"]:
        version, plain = pinned[name].split(";")[0].strip(), name.replace("-", "_")
        info = f"{plain}-{version}.dist-info"
        with zipfile.ZipFile(folder / f"{plain}-{version}-py3-none-any.whl", "w") as wheel:
            if name == "torch":
                wheel.writestr("lent.pth", sysconfig.get_path("purelib") + "\n")
            wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
            wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            wheel.writestr(f"{info}/RECORD", "")
    return folder
