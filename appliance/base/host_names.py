"""Resolve host names that nodes chose, in a bounded time."""

import ipaddress
import re
import socket
import subprocess
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from appliance.base import clock

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,253}")
_FILE = Path("/etc/hosts")
_LONGEST_FILE = 1 << 20  # bytes
_MAX_ASKED = 500
_AT_ONCE = 16
_NAME_SECONDS, _WHOLE_SECONDS = 2.0, 3.0


class Starter(Protocol):
    """Starts a program, as `subprocess.Popen` does."""

    def __call__(
        self, command: list[str], /, *, stdout: int, stderr: int, text: bool
    ) -> "subprocess.Popen[str]": ...


def addresses_of(names: Iterable[str], start: Starter = subprocess.Popen) -> dict[str, list[str]]:
    """Return the addresses of host names, as this machine resolves them; an unknown name has none.

    The names of /etc/hosts wait for no name server. All others have three seconds together: first this machine's own
    name, then the given order.
    """
    wanted = dict.fromkeys(names)
    listed = _read_names()
    addresses = {name: listed.get(name.lower(), []) for name in wanted}
    until = clock.now() + _WHOLE_SECONDS

    def ask(name: str) -> list[str]:
        seconds = min(_NAME_SECONDS, until - clock.now())
        if not _NAME.fullmatch(name) or seconds <= 0:
            return []
        with suppress(subprocess.TimeoutExpired, OSError):
            command = ["getent", "ahosts", "--", name]
            with start(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as asked:
                try:
                    text, _ = asked.communicate(timeout=seconds)
                finally:
                    asked.kill()
            return list(dict.fromkeys(line.split()[0] for line in text.splitlines() if line.split()))
        return []

    own = socket.gethostname().partition(".")[0].lower()
    others = [name for name in wanted if not addresses[name]]
    others.sort(key=lambda name: name.lower().partition(".")[0] != own)
    with ThreadPoolExecutor(_AT_ONCE, "resolver") as threads:
        addresses.update(zip(others, threads.map(ask, others[:_MAX_ASKED]), strict=False))
    return addresses


def _read_names() -> dict[str, list[str]]:
    """Return the addresses of the names in /etc/hosts; nothing if it cannot be read."""
    found: dict[str, list[str]] = {}
    with suppress(OSError), _FILE.open("rb") as file:
        for line in file.read(_LONGEST_FILE).decode("ascii", "replace").splitlines():
            words = line.partition("#")[0].split()
            with suppress(ValueError):
                for name in words[1:]:
                    found.setdefault(name.lower(), []).append(str(ipaddress.ip_address(words[0])))
    return found
