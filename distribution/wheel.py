"""Hatch's hook for `make wheel`: build the compiled module, and tag the wheel with the machines that can use it."""

import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_MODULE = "appliance/relay/transport/pump.abi3.so"


class ExtensionHook(BuildHookInterface[Any]):
    """Runs `distribution/extension.py`. The wheel is for this architecture, and for this glibc or a newer one."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002  hatch passes both
        subprocess.run([sys.executable, str(Path(self.root, "distribution/extension.py"))], check=True)
        libc = platform.libc_ver()[1].replace(".", "_")
        build_data["artifacts"].append(f"/{_MODULE}")
        build_data["pure_python"] = False
        build_data["tag"] = f"cp311-abi3-manylinux_{libc}_{platform.machine()}"
