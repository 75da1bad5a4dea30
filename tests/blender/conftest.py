"""Blender in a process of its own, with the extension installed from its zip."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import textwrap
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXTENSION = "bl_ext.user_default.swag_splatting"
INSTALL = """
import bpy, addon_utils, sys
addon_utils.enable("bl_pkg")
bpy.ops.extensions.package_install_files(filepath=sys.argv[-1], repo="user_default", enable_on_install=True)
bpy.ops.wm.save_userpref()
"""
ENABLE = f"""
import bpy, addon_utils
EXTENSION = "{EXTENSION}"
assert addon_utils.enable(EXTENSION, default_set=True)
"""


def packages(version):
    """Where environment.sh puts a bpy package that is not this Python's own; 5.2 has its Python there, too."""
    return ROOT / ".venv" / f"blender-{version}"


class Blender:
    """One version of the bpy package; `user` is its own folder of user files."""

    def __init__(self, version, user):
        self.version, self.user = version, user
        self.path = "" if version == "5.0" else str(packages(version))
        self.executable = str(packages(version) / "python") if version == "5.2" else sys.executable

    def python(self, script, *arguments, **environment):
        own = {"BLENDER_USER_RESOURCES": str(self.user), "PYTHONPATH": self.path, "PYTHONIOENCODING": "utf-8"}
        done = subprocess.run(
            [self.executable, "-c", script, *map(str, arguments)],
            env=os.environ | own | {key: str(value) for key, value in environment.items()},
            capture_output=True, encoding="utf-8", timeout=600, cwd=self.user,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    def run(self, script, *arguments, **environment):
        """Run a script with the extension enabled; returns what it printed. Fails when the script does."""
        return self.python(ENABLE + textwrap.dedent(script), *arguments, **environment)

    @staticmethod
    def json_after(word, printed):
        """The JSON value behind the word that starts a line of the output."""
        line = next(line for line in printed.splitlines() if line.startswith(word + " "))
        return json.loads(line.removeprefix(word))


@pytest.fixture(scope="session")
def root():
    return ROOT


@pytest.fixture(scope="session")
def extension_zip(tmp_path_factory):
    spec = importlib.util.spec_from_file_location("build_extension", ROOT / ".ci" / "build_extension.py")
    builder = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builder)
    return builder.build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="session", params=["5.0", "4.5", "5.2"])
def installed(request, extension_zip, tmp_path_factory):
    """A Blender version and a folder of user files with the extension installed."""
    if request.param == "5.2" and not (packages("5.2") / "python").exists():
        pytest.skip("Blender 5.2's package needs Python 3.13, which environment.sh did not find.")
    blender = Blender(request.param, tmp_path_factory.mktemp(f"blender-{request.param}"))
    blender.python(INSTALL, extension_zip)
    return request.param, blender.user


@pytest.fixture
def blender(installed, tmp_path):
    version, user = installed
    shutil.copytree(user, tmp_path / "user")
    return Blender(version, tmp_path / "user")


@pytest.fixture(scope="session")
def fake_engine(tmp_path_factory):
    """An executable for SWAG_ENGINE_PYTHON that runs fake_worker.py."""
    python = tmp_path_factory.mktemp("engine") / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} {Path(__file__).with_name("fake_worker.py")} "$@"\n')
    python.chmod(0o755)
    return python


@pytest.fixture(scope="session")
def wheels(tmp_path_factory):
    """A folder of wheels of requirements.txt, all empty; the one called torch lends the packages of this Python."""
    folder = tmp_path_factory.mktemp("wheels")
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in constraints if "==" in line)
    for name in (ROOT / "requirements.txt").read_text().split():
        version, plain = pinned[name].split(";")[0].strip(), name.replace("-", "_")
        info = f"{plain}-{version}.dist-info"
        with zipfile.ZipFile(folder / f"{plain}-{version}-py3-none-any.whl", "w") as wheel:
            if name == "torch":
                wheel.writestr("lent.pth", sysconfig.get_path("purelib") + "\n")
            wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
            wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            wheel.writestr(f"{info}/RECORD", "")
    return folder
