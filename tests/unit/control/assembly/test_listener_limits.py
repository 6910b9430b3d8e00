import asyncio
import dataclasses
import ipaddress
import socket

import pytest

from appliance.configuration.settings import Settings
from appliance.control.assembly.listener_limits import Answering, ListenerLimits, class_of
from appliance.policy.model import Address, address_of
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import QuotaClass
from appliance.rpc.connection_table import ConnectionTable, Stage
from appliance.rpc.server import HttpRequest, Peer, exceeds_limit
from roswire.xmlrpc import build_call
from tests.support.core import FakeTrail
from tests.support.virtual_clock import let_time_pass

pytestmark = pytest.mark.anyio

WAIT = 30.0
CALL = b"POST / HTTP/1.1\r\nHost: here\r\nContent-Length: 1\r\n\r\n?"


@pytest.mark.nightly
@pytest.mark.parametrize("guarded", [True, False])
async def test_an_idle_connection_is_closed_at_every_listener(*, guarded: bool) -> None:
    given = Settings()
    settings = dataclasses.replace(given, limits=dataclasses.replace(given.limits, idle_seconds=0.1))
    policy = compile_policy("[Nodes]\ndefault = *\n", file="a.ini")
    listener_limits = ListenerLimits(settings, FakeTrail(), lambda: policy, lambda _host: QuotaClass.NAMED)

    async def answer(_request: HttpRequest) -> bytes:
        return b"!"

    with socket.create_server(("127.0.0.1", 0)) as listener:
        await listener_limits.open(listener_limits.server(listener.dup(), answer, guarded=guarded))
        table = listener_limits.connection_table if guarded else listener_limits.own_connection_table
        sweep = asyncio.get_running_loop().create_task(table.sweep())
        reader, writer = await asyncio.open_connection(*listener.getsockname())
        writer.write(CALL)
        async with asyncio.timeout(WAIT):
            assert (await reader.read()).endswith(b"!")
        writer.close()
        sweep.cancel()
        listener_limits.close()


async def test_calls_are_overdue_while_one_waits_and_none_is_answered() -> None:
    peer, answering, due = Peer(address_of("10.0.0.7"), "10.0.0.7", "10.0.0.1"), Answering(), asyncio.Event()

    async def answer(request: HttpRequest) -> bytes:
        if request.body == b"slow":
            await due.wait()
        return b"!"

    call = answering.watch(answer)
    let_time_pass(60.0)
    assert answering.overdue() == 0.0
    slow = asyncio.ensure_future(call(HttpRequest(peer, "/", b"slow", 0)))
    await asyncio.sleep(0)
    let_time_pass(20.0)
    assert answering.overdue() == 20.0
    await call(HttpRequest(peer, "/", b"quick", 0))
    let_time_pass(5.0)
    assert answering.overdue() == 5.0
    due.set()
    await slow
    assert answering.overdue() == 0.0


def test_hosts_of_a_wildcard_share_processor_time() -> None:
    policy = compile_policy("[Nodes]\ndefault = 10.0.0.1 10.1.0.0/16\n/guest/** = *\n", file="a.ini")
    registered = address_of("10.9.0.7")
    quota_class = {registered: QuotaClass.REGISTERED}

    def kind(text: str) -> str:
        return class_of(
            lambda: policy, lambda host: quota_class.get(host, QuotaClass.NAMED), address_of(text)
        )

    assert len({kind(f"10.9.1.{number}") for number in range(200)}) == 1
    assert len({kind(text) for text in ("10.0.0.1", "10.1.0.1", "10.9.0.7", "10.9.1.1", "127.0.0.1")}) == 5
    assert kind("10.1.0.1") == kind("10.1.255.9")


EVERYBODYS = compile_policy("[Nodes]\ndefault = 10.0.0.1\n/guest/** = *\n", file="a.ini")


@pytest.fixture
def everybodys() -> ListenerLimits:
    registered = {REGISTERED: QuotaClass.REGISTERED}
    return ListenerLimits(
        Settings(), FakeTrail(), lambda: EVERYBODYS, lambda host: registered.get(host, QuotaClass.NAMED)
    )


def test_hosts_of_a_wildcard_leave_a_named_host_its_slot(everybodys: ListenerLimits) -> None:
    arriving = everybodys.connection_table.arriving
    for number in range(200):
        for _ in range(20):
            arriving.take(address_of(f"10.9.1.{number}"))
    assert arriving.total == arriving.bounds.unknown
    assert arriving.take(address_of("10.9.1.1"))
    assert not arriving.take(ROBOT)
    assert not arriving.take(REGISTERED)


def test_registered_hosts_of_a_wildcard_leave_the_robot_its_slots() -> None:
    limits = ListenerLimits(Settings(), FakeTrail(), lambda: EVERYBODYS, lambda _host: QuotaClass.REGISTERED)
    table = limits.connection_table
    for pool in (table.arriving, table.connected):
        for number in range(200):
            while not pool.take(address_of(f"10.9.1.{number}")):
                pass
        assert pool.total == pool.bounds.whole - pool.bounds.kept
        assert [pool.take(ROBOT) for _ in range(pool.bounds.host)] == [""] * pool.bounds.host


class Opened:
    deadline = progress = 0.0
    holding = 0
    cut = False

    def __init__(
        self, connection_table: ConnectionTable[Address], host: Address, stage: Stage = Stage.UNFINISHED
    ) -> None:
        self._visitors = connection_table
        self.refused = connection_table.enter(self, host)
        connection_table.file(self, stage)

    def expire(self) -> None: ...

    def abort(self) -> None:
        self.cut = True
        self._visitors.leave(self)


def test_connections_of_a_wildcard_displace_no_named_host(everybodys: ListenerLimits) -> None:
    connection_table = everybodys.connection_table
    robots = [Opened(connection_table, ROBOT, Stage.IDLE) for _ in range(100)]
    crowd = [
        Opened(connection_table, address_of(f"10.9.1.{number}")) for number in range(200) for _ in range(20)
    ]
    assert sum(not one.refused for one in crowd) == connection_table.connected.bounds.unknown
    robots += [Opened(connection_table, host) for host in (ROBOT, REGISTERED)]
    assert not any(robot.refused or robot.cut for robot in robots)


ROBOT, REGISTERED = address_of("10.0.0.1"), address_of("10.9.0.7")


@pytest.mark.parametrize(
    ("tell", "told"), [("rule", "10.0.0.1 is blocked by an operator ["), ("id", "denied [")]
)
def test_a_blocked_host_is_refused_before_its_request_is_read(tell: str, told: str) -> None:
    policy = compile_policy(
        f"[Options]\ntell = {tell}\naudit-only = all\n[Nodes]\ndefault = *\n", file="a.ini"
    )
    blocked = dataclasses.replace(policy, blocks={ROBOT: "blocked by ann: odd"})
    trail = FakeTrail()
    limits = ListenerLimits(Settings(), trail, lambda: blocked, lambda _host: QuotaClass.NAMED)
    refusal = limits.refuse(Peer(ROBOT, "10.0.0.1", "10.0.0.9"))
    assert refusal is not None
    assert told in str(refusal(build_call("getPid", ("/node",))))
    assert limits.refuse(Peer(address_of("10.0.0.2"), "10.0.0.2", "10.0.0.9")) is None
    assert limits.refuse(Peer(ROBOT, "10.0.0.1", "10.0.0.1")) is None
    [record] = [record for record in trail.records if record.decision == "deny"]
    assert (record.reason, record.host, record.resource) == (
        "10.0.0.1 is blocked by ann: odd",
        "10.0.0.1",
        "getPid",
    )


@pytest.mark.parametrize(
    ("status", "event"),
    [
        ("400 Bad Request", "malformed"),
        ("405 Method Not Allowed", "malformed"),
        ("415 Unsupported Media Type", "malformed"),
        ("501 Not Implemented", "malformed"),
        ("413 Content Too Large", "limit exceeded"),
        ("431 Request Header Fields Too Large", "limit exceeded"),
        ("503 Service Unavailable", "limit exceeded"),
    ],
)
def test_a_request_that_is_not_http_exceeds_no_limit(status: str, event: str) -> None:
    trail = FakeTrail()
    policy = compile_policy("", file="a.ini")
    limits = ListenerLimits(Settings(), trail, lambda: policy, lambda _host: QuotaClass.NAMED)
    peer = Peer(ipaddress.ip_address("10.0.0.9"), "10.0.0.9", "10.0.0.1")
    report = limits.troubled if exceeds_limit(status.encode()) else limits.malformed
    report(peer, "10.0.0.9 sent something")
    assert [(record.event, record.reason) for record in trail.records] == [(event, "10.0.0.9 sent something")]
