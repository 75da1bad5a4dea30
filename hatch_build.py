"""Build hook: compiles the kernels for this machine before the wheel is put together."""

import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelBuildHook(BuildHookInterface):
    """The wheel depends on the platform, not on the Python version: the kernels are loaded by ctypes."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        script = Path(self.root) / "swag_engine" / "rasterize" / "kernels" / "build.py"
        subprocess.run([sys.executable, str(script)], check=True)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
        build_data["artifacts"].append("swag_engine/rasterize/kernels/lib/*")
