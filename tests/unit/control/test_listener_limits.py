"""Who is let in to the listeners of control, and until when."""

import asyncio
import dataclasses
import socket
from pathlib import Path

import pytest

from appliance.audit.log import AuditLog
from appliance.configuration.settings import Settings
from appliance.control.listener_limits import Doors, class_of
from appliance.policy.model import address_of
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import Standing
from appliance.rpc.server import HttpRequest
from appliance.telemetry.audit_trail import AuditTrail

pytestmark = pytest.mark.anyio

WAIT = 30.0
CALL = b"POST / HTTP/1.1\r\nHost: here\r\nContent-Length: 1\r\n\r\n?"


@pytest.mark.parametrize("guarded", [True, False])
async def test_an_idle_connection_is_closed_at_every_listener(tmp_path: Path, *, guarded: bool) -> None:
    """Also where the ROS Master calls, which keeps a connection to each node that ever was."""
    given = Settings()
    settings = dataclasses.replace(given, limits=dataclasses.replace(given.limits, idle_seconds=0.1))
    policy = compile_policy("[Nodes]\ndefault = *\n", file="a.ini")
    log = AuditLog(tmp_path / "audit.db")
    trail = AuditTrail(log, strict=False, deny_when_failed=False, recordings=lambda *_: {})
    doors = Doors(settings, trail, lambda: policy, lambda _host: Standing.NAMED)

    async def answer(_request: HttpRequest) -> bytes:
        return b"!"

    with socket.create_server(("127.0.0.1", 0)) as listener:
        await doors.open(listener, answer, guarded=guarded)
        sweep = asyncio.get_running_loop().create_task(doors.sweep())
        reader, writer = await asyncio.open_connection(*listener.getsockname())
        writer.write(CALL)
        async with asyncio.timeout(WAIT):
            assert (await reader.read()).endswith(b"!")
        writer.close()
        sweep.cancel()
        doors.close()
    log.close()


def test_hosts_that_only_everybody_names_share_processor_time_as_one() -> None:
    """Two hundred addresses that a rule for `*` lets in count as one host; an address or network that it names, as one.

    Hosts of `*` that have a registration are one of their own, so that no number of addresses without one delays them.
    """
    policy = compile_policy("[Nodes]\ndefault = 10.0.0.1 10.1.0.0/16\n/guest/** = *\n", file="a.ini")
    registered = address_of("10.9.0.7")
    standing = {registered: Standing.REGISTERED}

    def kind(text: str) -> str:
        return class_of(lambda: policy, lambda host: standing.get(host, Standing.NAMED), address_of(text))

    assert len({kind(f"10.9.1.{number}") for number in range(200)}) == 1
    assert len({kind(text) for text in ("10.0.0.1", "10.1.0.1", "10.9.0.7", "10.9.1.1", "127.0.0.1")}) == 5
    assert kind("10.1.0.1") == kind("10.1.255.9")


def test_hosts_that_only_everybody_names_fill_no_place_of_a_named_host(tmp_path: Path) -> None:
    """Two hundred hosts of `*` connect without end: a named host's connection may wait, before it has a registration.

    A host of `*` with a registration has its place too.
    """
    policy = compile_policy("[Nodes]\ndefault = 10.0.0.1\n/guest/** = *\n", file="a.ini")
    robot, registered = address_of("10.0.0.1"), address_of("10.9.0.7")
    standing = {registered: Standing.REGISTERED}
    log = AuditLog(tmp_path / "audit.db")
    trail = AuditTrail(log, strict=False, deny_when_failed=False, recordings=lambda *_: {})
    doors = Doors(Settings(), trail, lambda: policy, lambda host: standing.get(host, Standing.NAMED))
    arriving = doors.visitors.arriving
    for number in range(200):
        for _ in range(20):
            arriving.take(address_of(f"10.9.1.{number}"))
    assert arriving.total == arriving.bounds.strangers
    assert arriving.take(address_of("10.9.1.1"))
    assert not arriving.take(robot)
    assert not arriving.take(registered)
    log.close()
