"""Check the types of the whole extension with mypy, under the package name that contracts.py explains."""

import subprocess
import sys

from contracts import ROOT, package_folder


def main() -> int:
    with package_folder() as folder:
        command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml")]
        command += ["--cache-dir", str(ROOT / ".mypy_cache" / "extension"), "--package", "swag_splatting"]
        return subprocess.run(command, cwd=folder, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
