from collections.abc import Callable, Iterator
from typing import Any

import pytest

from appliance.channel.messages import (
    ClientGranted,
    MonitorCallAnswered,
    MonitorCallWanted,
    NodePlaced,
    ServicePlaced,
)
from appliance.relay.connections.monitor_calls import MAX, MAX_OF_MONITOR, ServiceCalls
from rosmop.run.outcomes import Published
from roswire.tcpros import encode_frame, encode_header, encode_service_error, encode_service_reply
from tests.unit.relay.contexts import context_of
from tests.unit.relay.monitors.monitored import SET_BOOL_MD5, Monitored, string
from tests.unit.relay.monitors.quiet import QuietMonitors, Reports, Timers
from tests.unit.relay.world import LIMITS, LOOPBACK, Peer

REACT = """react() { std_srvs::SetBoolRequest r;
    event said(std::string t) /chatter std_msgs/String '{data:t}' { r.data = true; CALL(/arm, std_srvs/SetBool, r); }
    event ok(bool s) service /arm std_srvs/SetBool response '{success:s}' { ROS_WARN("answer %d", s); } }"""


def wanted(monitor: str = "react") -> Published:
    return Published(monitor, "/arm", "std_srvs/SetBool", b"\x01", 0, True)


class Calls:
    def __init__(self, *, connected: bool = True) -> None:
        self.quiet, self.loop = QuietMonitors(), Timers()
        self.quiet.load(REACT)
        self.reports = Reports()
        context = context_of(self.loop, LIMITS, reporter=self.reports, interceptor=self.quiet.interceptor)
        self.failed: list[str] = []
        observer: Any = self.quiet.interceptor.observer
        observer.call_failed = lambda *report: self.failed.append(report[-1])
        self.calls = ServiceCalls(context)
        self.calls.attach(connected)

    @property
    def faults(self) -> int:
        monitors = self.quiet.interceptor.monitors
        return monitors.monitor("react").faults if monitors is not None else 0


def denied(calls: Calls) -> None:
    calls.calls.answered(MonitorCallAnswered(1, "", 0, "", "denied: 127.0.0.1 may not"))


@pytest.mark.parametrize(
    ("connected", "happens", "reason"),
    [
        (True, denied, "denied: 127.0.0.1 may not"),
        (True, lambda calls: calls.loop.run_due(), f"no response within {LIMITS.service_seconds:g} s"),
        (True, lambda calls: calls.calls.attach(False), "the appliance's control has ended"),
        (False, lambda calls: calls.loop.run_due(), "the appliance's control is not running"),
    ],
)
def test_each_call_that_does_not_succeed_is_one_fault(
    connected: bool, happens: Callable[[Calls], None], reason: str
) -> None:
    calls = Calls(connected=connected)
    calls.calls.call(wanted())
    happens(calls)
    denied(calls)
    calls.loop.run_due()
    assert calls.failed == [f"the call of /arm failed: {reason}"]
    assert calls.faults == 1
    assert len(calls.reports.sent) == connected


def test_the_number_of_calls_under_way_is_bounded() -> None:
    calls = Calls()
    for _ in range(MAX_OF_MONITOR + 3):
        calls.calls.call(wanted())
    assert (len(calls.reports.sent), calls.faults) == (MAX_OF_MONITOR, 3)
    for number in range(MAX):
        calls.calls.call(wanted(f"other{number}"))
    assert len(calls.reports.sent) == MAX
    calls.loop.run_due()
    assert calls.faults == 3 + MAX_OF_MONITOR
    calls.calls.call(wanted())
    assert len(calls.reports.sent) == MAX + 1


@pytest.fixture(name="world")
def served() -> Iterator[Monitored]:
    world = Monitored()
    listening = world.listen()
    ports = world.listen()
    world.state(NodePlaced("srv", "/server", LOOPBACK), ports)
    world.state(ServicePlaced("srv", "/arm", LOOPBACK, listening.getsockname()[1]))
    world.load(REACT)
    world.service, world.port_of_server = listening, ports.getsockname()[1]  # type: ignore[attr-defined]  # for `grant`
    yield world
    world.close()


def asked(world: Monitored) -> Peer:
    peer = world.accept(world.service)
    header = world.gets_header(peer)
    assert (header["callerid"], header["md5sum"]) == ("/rosrv", SET_BOOL_MD5)
    peer.send(encode_header({"callerid": "/server", "type": "std_srvs/SetBool", "md5sum": SET_BOOL_MD5}))
    world.gets(peer, encode_frame(b"\x01"))
    return peer


def grant(world: Monitored) -> None:
    wanted = world.hears(MonitorCallWanted, service="/arm")
    world.state(ClientGranted("srv", "/arm", LOOPBACK, "/rosrv"))
    port: int = world.port_of_server  # type: ignore[attr-defined]  # of the fixture
    world.state(MonitorCallAnswered(wanted.number, LOOPBACK, port, "/rosrv", ""))


@pytest.mark.nightly
def test_the_response_of_a_call_is_an_event(world: Monitored) -> None:
    publisher, _subscriber = world.typed()
    world.push(publisher, string("x"))
    grant(world)
    asked(world).send(encode_service_reply(b"\x01\0\0\0\0"))
    assert world.event("log").text == "answer 1"
    world.push(publisher, string("x"))
    grant(world)
    asked(world).send(encode_service_error("not now"))
    assert world.event("fault").text == "the call of /arm failed: not now"


@pytest.mark.nightly
def test_a_service_that_goes_away_is_a_fault(world: Monitored) -> None:
    publisher, _subscriber = world.typed()
    world.push(publisher, string("x"))
    grant(world)
    asked(world).reset()
    assert "the call of /arm failed: " in world.event("fault").text
