"""Define the faults from which `benchmarks.pair_faults` draws."""

import contextlib
import os
import random
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.process import STEADY_SECONDS
from tests.support.features.standby.standby_site import ADDRESSES, ROBOT, StandbySite
from tests.support.processes import Process
from tests.support.small_disk import filled
from tests.support.waiting import eventually

_NEVER = threading.Event()
_ROLES = ("control", "relay", "rosmaster", "signer", "lease", "api", "recorder", "rosout", "supervisor")
_STANDBY_ROLES = ("control", "lease", "signer", "relay", "supervisor")
_PROMOTE_SECONDS = 30.0
Said = list[str]


@dataclass(frozen=True)
class Fault:
    """A fault, which `make(site, active, passive, said)` causes during its block for `least` to `most` seconds.

    With `cut_off`, no appliance can serve during the fault, so times count from its end. With `goes_on`, the active
    appliance continues without the standby, and a call waits once for up to 0.8 s. With `interrupts`, the network
    loses packets, which TCP repeats at growing intervals.
    """

    name: str
    make: Callable[[StandbySite, str, str, Said], contextlib.AbstractContextManager[object]]
    least: float = 0.3
    most: float = 3.0
    cut_off: bool = False
    goes_on: bool = False
    interrupts: bool = False


def _cut(site: StandbySite, active: str, passive: str, _said: Said, *, edges: str) -> Any:
    own, other = ADDRESSES[active], ADDRESSES[passive]
    ends = {"active": (own, ROBOT), "standby": (other, ROBOT), "link": (own, other)}
    return site.without_link(*(ends[edge] for edge in edges.split()))


@contextlib.contextmanager
def _power(site: StandbySite, active: str, passive: str, _said: Said, *, of: str) -> Iterator[None]:
    names = {"active": [active], "standby": [passive], "both": [active, passive]}[of]
    for name in names:
        site.cut(name)
    yield
    for name in names:
        site.restore(name)


def _chosen(site: StandbySite, name: str, role: str) -> list[int]:
    process = site.appliances[name].process
    assert process is not None
    return {"all": site.pids(name), "supervisor": [process.pid]}.get(role) or site.pids(name, role)


@contextlib.contextmanager
def _killed(
    site: StandbySite, active: str, passive: str, _said: Said, *, role: str, of: str
) -> Iterator[None]:
    name = {"active": active, "standby": passive}[of]
    for pid in _chosen(site, name, role):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    yield
    if role == "supervisor":
        site.restore(name)


@contextlib.contextmanager
def _stalled(
    site: StandbySite, active: str, passive: str, _said: Said, *, role: str, of: str
) -> Iterator[None]:
    name = {"active": active, "standby": passive}[of]
    stopped = _chosen(site, name, role)
    for pid in stopped:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def _witness_killed(site: StandbySite, _active: str, _passive: str, _said: Said) -> Iterator[None]:
    site.stop_witness()
    try:
        yield
    finally:
        site.start_witness()


@contextlib.contextmanager
def _witness_stalled(site: StandbySite, _active: str, _passive: str, _said: Said) -> Iterator[None]:
    assert site.witness is not None
    site.witness.popen.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        site.witness.popen.send_signal(signal.SIGCONT)


@contextlib.contextmanager
def _shut(site: StandbySite, active: str, passive: str, said: Said) -> Iterator[None]:
    with _witness_killed(site, active, passive, said):
        with Process(site.robot, site.command("shut"), env=dict(os.environ), label="shut") as shut:
            shut.wait()
        yield


def _full(site: StandbySite, active: str, passive: str, _said: Said, *, of: str) -> Any:
    places = {"active": site.appliances[active].state, "standby": site.appliances[passive].state}
    if of == "active":
        _NEVER.wait(1.1 * STEADY_SECONDS)  # an appliance that has just got the lease back keeps it
    return filled(places.get(of, site.home / "robot"))


@contextlib.contextmanager
def _full_robot_and_power(site: StandbySite, active: str, passive: str, said: Said) -> Iterator[None]:
    with filled(site.home / "robot"), _power(site, active, passive, said, of="active"):
        eventually(lambda: site.holder() == passive, site.story)
        yield


@contextlib.contextmanager
def _promoted(
    site: StandbySite,
    active: str,
    passive: str,
    said: Said,
    *,
    on: str,
    during: Callable[..., contextlib.AbstractContextManager[object]] | None = None,
) -> Iterator[None]:
    """Order a takeover half a second after `during` has begun; `on` is `active`, `standby` or `both`."""
    names = {"active": [active], "standby": [passive], "both": [active, passive]}[on]
    with during(site, active, passive, said) if during is not None else contextlib.nullcontext():
        _NEVER.wait(0.5 if during is not None else 0)
        orders = [threading.Thread(target=_promote, args=(site, name, said)) for name in names]
        for order in orders:
            order.start()
        yield
    for order in orders:
        order.join()


def _promote(site: StandbySite, name: str, said: Said) -> None:
    try:
        answer = AdminSocket(site.appliances[name].state, _PROMOTE_SECONDS).ask(
            standby_requests.StandbyPromote()
        )
        text = "done" if answer.ok else answer.error
    except NotRunningError as error:
        text = str(error).partition(": ")[2]
    said.append(f"promote on {name}: {text}")


def _kinds() -> Iterator[Fault]:
    for edges in ("active", "standby", "link", "active link", "standby link"):
        cut = partial(_cut, edges=edges)
        yield Fault(f"cut {edges}", cut, 0.3, 8, goes_on="active" not in edges, interrupts="active" in edges)
    yield Fault(
        "cut active standby", partial(_cut, edges="active standby"), 0.3, 8, cut_off=True, interrupts=True
    )
    yield Fault("power of active", partial(_power, of="active"), 3, 6)
    yield Fault("power of standby", partial(_power, of="standby"), 1, 4, goes_on=True)
    yield Fault("power of both", partial(_power, of="both"), 1, 2, cut_off=True)
    for of, roles in (("active", _ROLES), ("standby", _STANDBY_ROLES)):
        for role in roles:
            killed = partial(_killed, role=role, of=of)
            yield Fault(f"kill {role} of {of}", killed, 3, 5, goes_on=of == "standby")
        for role in (*roles, "all"):
            stalled = partial(_stalled, role=role, of=of)
            yield Fault(f"stall {role} of {of}", stalled, goes_on=of == "standby")
    yield Fault("kill witness", _witness_killed, goes_on=True)
    yield Fault("stall witness", _witness_stalled, goes_on=True)
    yield Fault("robot shuts out both", _shut, 0.3, 3, cut_off=True)
    for of in ("active", "standby", "robot"):
        yield Fault(f"full disk of {of}", partial(_full, of=of), 4, 8, goes_on=of != "active")
    yield Fault("full disk of robot, power of active", _full_robot_and_power, 1, 2)
    for on in ("active", "standby", "both"):
        yield Fault(f"promote on {on}", partial(_promoted, on=on))
    states: dict[str, Callable[..., contextlib.AbstractContextManager[object]]] = {
        "cut standby": partial(_cut, edges="standby"),
        "cut link": partial(_cut, edges="link"),
        "cut active": partial(_cut, edges="active"),
        "kill witness": _witness_killed,
        "full disk of standby": partial(_full, of="standby"),
    }
    for on in ("active", "standby"):
        for state, during in states.items():
            yield Fault(
                f"promote on {on}, {state}",
                partial(_promoted, on=on, during=during),
                2,
                4,
                interrupts="cut" in state,
            )
    yield Fault(
        "promote on active, power of standby",
        partial(_promoted, on="active", during=partial(_power, of="standby")),
        1,
        2,
    )


KINDS = tuple(_kinds())


def drawn(number: int, seed: int) -> list[tuple[Fault, float]]:
    """Return faults with their seconds: every kind once in random order, then every kind again."""
    chance, found = random.Random(seed), list[tuple[Fault, float]]()
    while len(found) < number:
        found += [(one, chance.uniform(one.least, one.most)) for one in chance.sample(KINDS, len(KINDS))]
    return found[:number]
