"""The probe: another local user tries to reach a port that must be closed to it.

Run at start and every minute. A child process drops to an unprivileged user inside the namespace and
connects to the port over loopback, IPv4 and IPv6. That it is refused proves something only while someone
listens, so the sockets that listen on the port are looked up too, and with them whether any of them can be
reached from outside loopback at all.
"""

import ipaddress
import json
import sys
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from appliance.network.listening_sockets import listening_addresses
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.patience import run

PROBE_UID = 61099  # nobody's: neither root nor one of the appliance's users
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


class Outcome(StrEnum):
    """What an attempt to connect came to."""

    REACHED = "reached"
    REFUSED = "refused"
    TIMED_OUT = "timed out"
    NO_SUCH_ADDRESS = "no such address"  # the machine has no such loopback: nobody can be reached on it
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Attempt:
    """One attempt."""

    address: str
    outcome: Outcome
    detail: str = ""


@dataclass(frozen=True)
class ProbeResult:
    """What another local user sees of a port."""

    port: int
    uid: int
    attempts: tuple[Attempt, ...]
    # Addresses on which someone listens on the port: without any nothing is proven
    listening: tuple[str, ...]

    @property
    def closed(self) -> bool:
        """Nobody got through and every attempt had a clear end."""
        return not any(attempt.outcome in (Outcome.REACHED, Outcome.UNCLEAR) for attempt in self.attempts)

    @property
    def listening_outside(self) -> tuple[str, ...]:
        """The addresses of `listening` that are not loopback."""
        return tuple(text for text in self.listening if not ipaddress.ip_address(text).is_loopback)

    def describe(self) -> str:
        """Say in one line what was seen."""
        seen = ", ".join(
            f"{attempt.address} {attempt.detail or attempt.outcome}" for attempt in self.attempts
        )
        return f"port {self.port} as uid {self.uid}: {seen}"


def probe_port(namespace: Namespace, port: int, uid: int = PROBE_UID) -> ProbeResult:
    """Try to reach `port` over loopback as the user `uid`, which must not be root.

    Raises: NetworkError when the attempt itself could not be made (that is no proof of a closed port).
    """
    if uid <= 0:
        raise ValueError("the probe must run as an unprivileged user, not as root")
    listening = namespace.run(lambda: listening_addresses(port))
    output = _run_child(namespace, port, uid)
    attempts = tuple(_attempt(*json.loads(line)) for line in output.splitlines())
    if len(attempts) != 2:
        raise NetworkError(f"the probe of port {port} as uid {uid} ended early")
    return ProbeResult(port=port, uid=uid, attempts=attempts, listening=listening)


def _run_child(namespace: Namespace, port: int, uid: int) -> str:
    arguments = [sys.executable, "-I", "-S", "-c", _CHILD, str(port), str(_CONNECT_SECONDS)]
    child = partial(namespace.popen, arguments, user=uid, group=uid, extra_groups=[], cwd="/", env={})
    try:
        status, output, errors = run(child, "", f"the probe of port {port}")
    except TimeoutError as error:
        raise NetworkError(str(error)) from None
    except OSError as error:
        raise NetworkError(
            f"the probe cannot be run as uid {uid}: {error.strerror} ({sys.executable} must be executable by "
            "all users, and CAP_SETUID and CAP_SETGID are needed)"
        ) from error
    if status != 0:
        raise NetworkError(f"the probe of port {port} as uid {uid} failed: {errors.strip()[-300:]}")
    return output


def _attempt(address: str, outcome: str) -> Attempt:
    try:
        return Attempt(address, Outcome(outcome))
    except ValueError:
        return Attempt(address, Outcome.UNCLEAR, outcome)
