"""Probe a hidden port: try to reach it as another local user.

Without a listener, a refusal proves nothing, so the addresses of the listening sockets are also read.
"""

import ipaddress
import json
import os
import sys
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from appliance.network.hang_detection import run_program
from appliance.network.listening_sockets import listening_addresses
from appliance.network.namespaces import Namespace, NetworkError

PROBE_UID = 61099  # neither root nor a user of the appliance
_CONNECT_SECONDS = 1.0

_CHILD = """
import errno, json, socket, sys
for family, address in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")):
    try:
        with socket.socket(family, socket.SOCK_STREAM) as client:
            client.settimeout(float(sys.argv[2]))
            client.connect((address, int(sys.argv[1])))
        outcome = "reached"
    except TimeoutError:
        outcome = "timed out"
    except ConnectionRefusedError:
        outcome = "refused"
    except OSError as error:
        absent = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT, errno.ENETUNREACH)
        outcome = "no such address" if error.errno in absent else "error: " + str(error)
    print(json.dumps([address, outcome]))
"""


class ConnectOutcome(StrEnum):
    REACHED = "reached"
    REFUSED = "refused"
    TIMED_OUT = "timed out"
    NO_SUCH_ADDRESS = "no such address"  # the machine lacks this loopback address
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class ConnectAttempt:
    address: str
    outcome: ConnectOutcome
    detail: str = ""


@dataclass(frozen=True)
class ProbeResult:
    port: int
    uid: int
    attempts: tuple[ConnectAttempt, ...]
    # Addresses with a listener on the port. Without a listener, a refusal proves nothing.
    listening: tuple[str, ...]

    @property
    def closed(self) -> bool:
        return not any(
            attempt.outcome in (ConnectOutcome.REACHED, ConnectOutcome.UNCLEAR) for attempt in self.attempts
        )

    @property
    def listening_outside(self) -> tuple[str, ...]:
        return tuple(text for text in self.listening if not ipaddress.ip_address(text).is_loopback)

    def describe(self) -> str:
        seen = ", ".join(
            f"{attempt.address} {attempt.detail or attempt.outcome}" for attempt in self.attempts
        )
        return f"port {self.port} as uid {self.uid}: {seen}"


def probe_port(namespace: Namespace, port: int, uid: int = PROBE_UID) -> ProbeResult:
    """Probe a port as an unprivileged user. Raises `NetworkError` if the probe cannot run."""
    if uid <= 0:
        raise ValueError("the probe must run as an unprivileged user, not as root")
    listening = namespace.run(lambda: listening_addresses(port))
    output = _run_child(namespace, port, uid)
    attempts = tuple(_attempt(*json.loads(line)) for line in output.splitlines())
    if len(attempts) != 2:
        raise NetworkError(f"the probe of port {port} as uid {uid} ended early")
    return ProbeResult(port=port, uid=uid, attempts=attempts, listening=listening)


def _run_child(namespace: Namespace, port: int, uid: int) -> str:
    # Other users may not reach a virtual environment; with -I and -S the interpreter itself is enough.
    python = os.path.realpath(sys.executable)
    arguments = [python, "-I", "-S", "-c", _CHILD, str(port), str(_CONNECT_SECONDS)]
    child = partial(namespace.popen, arguments, user=uid, group=uid, extra_groups=[], cwd="/", env={})
    try:
        status, output, errors = run_program(child, "", f"the probe of port {port}")
    except TimeoutError as error:
        raise NetworkError(str(error)) from None
    except OSError as error:
        raise NetworkError(
            f"the probe cannot be run as uid {uid}: {error.strerror} ({python} must be executable by "
            "all users, and CAP_SETUID and CAP_SETGID are needed)"
        ) from error
    if status != 0:
        raise NetworkError(f"the probe of port {port} as uid {uid} failed: {errors.strip()[-300:]}")
    return output


def _attempt(address: str, outcome: str) -> ConnectAttempt:
    try:
        return ConnectAttempt(address, ConnectOutcome(outcome))
    except ValueError:
        return ConnectAttempt(address, ConnectOutcome.UNCLEAR, outcome)
