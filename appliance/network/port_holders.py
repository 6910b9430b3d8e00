"""Name the programs of this machine that listen on a port, as a person would call them."""

import os
import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from appliance.network.listening_sockets import listening_inodes
from appliance.network.namespaces import NetworkError
from appliance.network.socket_owners import owners_of

_INTERPRETER = re.compile(r"(?:python|perl|ruby|node|sh|bash)[0-9.]{0,8}")
_UNITS = (".service", ".scope")
_LONGEST = 120  # characters of a name, which its process chooses


class PortsInUseError(NetworkError):
    """Another program listens on the appliance's ports."""


class PortHolder(NamedTuple):
    """A process that listens on a port, with its command line and its unit of systemd ("" if it has none)."""

    pid: int
    command: tuple[str, ...]
    unit: str

    @property
    def program(self) -> str:
        """The program: for an interpreter its script."""
        first, *others = self.command or ("?",)
        script = next((word for word in others[:1] if not word.startswith("-")), None)
        return _shown(script if script and _INTERPRETER.fullmatch(os.path.basename(first)) else first)  # noqa: PTH119  text

    @property
    def title(self) -> str:
        """The command line and the unit."""
        return ", ".join(filter(None, (_shown(" ".join(self.command)), _shown(self.unit))))

    def __str__(self) -> str:
        return f"{self.program} ({_shown(self.unit) or f'process {self.pid}'})"


def port_holder(port: int) -> PortHolder | None:
    """Return a process that listens on the port in the thread's network namespace; None if none is visible."""
    owners = owners_of(listening_inodes(port))
    return next((_describe(Path("/proc", str(owner.pid))) for owner in owners.values()), None)


def describe_holder(ports: list[int]) -> str:
    """Return who holds the ports, such as `/usr/bin/rosmaster (roscore.service) holds TCP 11311`."""
    held = ", ".join(map(str, ports[:8])) + (f" and {len(ports) - 8} more" if len(ports) > 8 else "")
    return f"{port_holder(ports[0]) or 'a program'} holds TCP {held}"


def _describe(process: Path) -> PortHolder:
    command, unit = b"", ""
    with suppress(OSError):
        command = (process / "cmdline").read_bytes()
    with suppress(OSError):
        groups = (
            (process / "cgroup").read_text(encoding="utf-8", errors="replace").replace("\n", "/").split("/")
        )
        unit = next((name for name in reversed(groups) if name.endswith(_UNITS)), "")
    words = command.rstrip(b"\0").decode("utf-8", "replace").split("\0")
    return PortHolder(int(process.name), tuple(words if command else ()), unit)


def _shown(text: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text)[:_LONGEST]
