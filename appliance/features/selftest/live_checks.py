"""Check the running appliance: its status, a call through RVMaster, a message through the relay."""

import contextlib
import http.client
import secrets
import socket
import threading
import time
import xmlrpc.client
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit, urlunsplit
from xml.parsers import expat
from xmlrpc.server import SimpleXMLRPCServer

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.search.query import Filter, FilterError
from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.admin import StatusWanted
from appliance.channel.alarms import SWITCHED_OFF, open_alarms
from appliance.channel.answers.status import ProcessInfo, Status
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.connection.audit_source import AuditSource, audit_of
from appliance.cli.connection.target import Appliance
from appliance.cli.status_verb import troubles_of
from appliance.features.selftest.selftest_findings import SelftestFinding, fail, ok, run_check, skip, warn
from roswire.tcpros import FrameParser, HeaderParser, encode_frame, encode_header

# Test a running appliance with two minimal ROS nodes: a publisher and a subscriber of one message.
#
# They always unregister at the end.

TOPIC = "/rosrv_selftest"
_PUBLISHER, _SUBSCRIBER = "/rosrv_selftest_publisher", "/rosrv_selftest_subscriber"
_TYPE = "std_msgs/String"
_MD5SUM = "992ce8a1687cec8c8bd883ec73ca41d1"
_SECONDS = 10.0


class ProbeError(Exception):
    """RVMaster or a proxy endpoint denied a call; the text is the reason."""


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: object) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(str(host), timeout=_SECONDS)


def call(uri: str, method: str, *arguments: Any) -> Any:
    try:
        with xmlrpc.client.ServerProxy(uri, _Transport()) as server:
            answer = getattr(server, method)(*arguments)  # how the library calls a method by its name
    except xmlrpc.client.Fault as fault:
        raise ProbeError(fault.faultString) from fault
    except (xmlrpc.client.Error, http.client.HTTPException, expat.ExpatError, ValueError) as error:
        raise OSError(f"{uri}: {error}") from error
    if not isinstance(answer, list) or len(answer) != 3:
        raise OSError(f"{uri}: {method} returned {str(answer)[:100]}, which is not a ROS answer")
    if answer[0] != 1:
        raise ProbeError(str(answer[1]))
    return answer[2]


def own_address(master: str) -> str:
    place = urlsplit(master)
    with socket.create_connection((str(place.hostname), place.port or 80), _SECONDS) as sock:
        return str(sock.getsockname()[0])


def message_through_the_relay(master: str) -> bytes:
    host = own_address(master)
    with _node(host) as publisher, _node(host) as subscriber:
        try:
            call(master, "registerPublisher", _PUBLISHER, TOPIC, _TYPE, publisher.uri)
            places = call(master, "registerSubscriber", _SUBSCRIBER, TOPIC, _TYPE, subscriber.uri)
            if not places:
                raise OSError(f"RVMaster lists no publisher of {TOPIC} to the subscriber")
            return _receive(places[0])
        finally:
            with contextlib.suppress(OSError, ProbeError):
                call(master, "unregisterSubscriber", _SUBSCRIBER, TOPIC, subscriber.uri)
            with contextlib.suppress(OSError, ProbeError):
                call(master, "unregisterPublisher", _PUBLISHER, TOPIC, publisher.uri)


def _receive(uri: str) -> bytes:
    try:
        _name, host, port = call(uri, "requestTopic", _SUBSCRIBER, TOPIC, [["TCPROS"]])
    except ProbeError as error:  # the policy decided at the registrations
        raise OSError(str(error)) from error
    with socket.create_connection((host, port), _SECONDS) as sock:
        sock.sendall(encode_header(_fields(_SUBSCRIBER)))
        header, frames = HeaderParser(), FrameParser()
        fields = None
        while True:
            data = sock.recv(65_536)
            if not data:
                raise OSError("the connection was closed before a message came")
            if fields is None:
                fields = header.feed(data)
                if fields is None:
                    continue
                if "error" in fields:
                    raise OSError(fields["error"])
                data = bytes(header.rest)
            found = frames.feed(data)
            if found:
                return bytes(found[0])


def _fields(node: str) -> dict[str, str]:
    return {
        "callerid": node,
        "topic": TOPIC,
        "type": _TYPE,
        "md5sum": _MD5SUM,
        "message_definition": "string data\n",
    }


class _Node:
    def __init__(self, host: str) -> None:
        self._messages = socket.create_server((host, 0), family=_family(host))
        port = self._messages.getsockname()[1]

        class Server(SimpleXMLRPCServer):
            address_family = _family(host)

            def _dispatch(self, method: str, _parameters: object) -> list[object]:
                return [1, "", ["TCPROS", host, port] if method == "requestTopic" else 0]

        self._api = Server((host, 0), logRequests=False)
        shown = f"[{host}]" if ":" in host else host
        self.uri = f"http://{shown}:{self._api.server_address[1]}/"
        for work in (self._api.serve_forever, self._give):
            threading.Thread(target=work, daemon=True).start()

    def _give(self) -> None:
        while True:
            try:
                connection, _peer = self._messages.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                connection.settimeout(_SECONDS)
                connection.recv(65_536)
                connection.sendall(
                    encode_header(_fields(_PUBLISHER)) + encode_frame(encode_frame(b"selftest"))
                )
                connection.recv(1)  # wait until the appliance has the message and disconnects

    def close(self) -> None:
        self._api.shutdown()
        self._api.server_close()
        self._messages.close()


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


@contextlib.contextmanager
def _node(host: str) -> Iterator[_Node]:
    node = _Node(host)
    try:
        yield node
    finally:
        node.close()


_CALLER = "/rosrv_selftest"  # a random number follows, because repeated reads of one caller are only counted
_GUARD_OFF = "guard-off:"
_MANY_RESTARTS = 3
_MANY_RECORDS = 200_000
_RECORD_SECONDS = 5.0
_FIRST_PAUSE, _LONGEST_PAUSE = 0.05, 1.0


def running(appliance: Appliance) -> Iterator[SelftestFinding]:
    try:
        answer = appliance.ask(StatusWanted())
    except AccessDeniedError as error:
        yield fail("appliance", str(error), "sudo rosrv selftest" if appliance.place is None else "")
        return
    except NotRunningError as error:
        yield fail(
            "appliance",
            str(error),
            "start it (rosrv up), or omit --state and --api to check only the machine",
        )
        return
    if not answer.ok:
        yield fail("appliance", answer.error, "see the log of rosrv up")
        return
    status = answer.unwrap()
    yield ok(
        "appliance",
        f"{status.version}, {counted(len(status.processes), 'process', 'processes')}, nodes find it at {status.master}",
    )
    yield from run_check("status", lambda: _status(status))
    yield from run_check("processes", lambda: _processes(status.processes))
    yield from run_check("audit log", lambda: _audit(appliance))
    master = _reachable(appliance, status.master)
    yield from run_check("RVMaster", lambda: check_call(audit_of(appliance.way), master))
    yield from run_check("relay", lambda: _message(master))


def _status(status: Status) -> Iterator[SelftestFinding]:
    off = [alarm for alarm in open_alarms(status)
           if alarm.severity == "warning" and alarm.kind.startswith((SWITCHED_OFF, _GUARD_OFF))]  # fmt: skip
    for alarm in off:
        yield warn("monitors", alarm.text, "rosrv monitor list")
    troubles = [alarm for alarm in troubles_of(status) if alarm not in off]
    for alarm in troubles:
        yield fail("status", alarm.text, "rosrv status")
    if not troubles:
        probe = status.probe or "not run yet"
        hidden = "no firewall" if status.isolation == "none" else f"probe of the ROS master {probe}"
        yield ok("status", f"isolation {status.isolation}, {hidden}")


def _processes(rows: list[ProcessInfo]) -> Iterator[SelftestFinding]:
    restarted = [
        f"{row.role} {counted(row.restarts, 'time')}" for row in rows if row.restarts >= _MANY_RESTARTS
    ]
    if restarted:
        yield warn("processes", f"restarted: {', '.join(restarted)}", "see the log of rosrv up")
    else:
        yield ok("processes", f"{len(rows)} running")


def _audit(appliance: Appliance) -> Iterator[SelftestFinding]:
    source = audit_of(appliance.way)
    try:
        last = source.last()
        if last > _MANY_RECORDS:
            yield skip(
                "audit log",
                f"{counted(last, 'record takes', 'records take')} too long to verify here",
                "rosrv audit verify",
            )
            return
        result = source.verify(None, None, lambda _sequence: None)
    except (LogUnreadableError, NotRunningError, FilterError) as error:
        yield skip("audit log", str(error))
        return
    if result.ok:
        compared = "" if result.remembered else ", but not compared with the signer's memory"
        yield ok("audit log", f"{counted(result.records, 'record is', 'records are')} unchanged{compared}")
    else:
        yield fail("audit log", result.findings[0].message, "rosrv audit verify")


def _reachable(appliance: Appliance, master: str) -> str:
    """Put REST's host in place of a loopback address."""
    place = appliance.place
    parts = urlsplit(master)
    if place is None or parts.hostname not in ("127.0.0.1", "::1", "localhost"):
        return master
    host = str(urlsplit(place).hostname)
    shown = f"[{host}]" if ":" in host else host
    return urlunsplit((parts.scheme, f"{shown}:{parts.port}", "", "", ""))


def check_call(audit: AuditSource, master: str) -> Iterator[SelftestFinding]:
    before = _last(audit)
    caller = f"{_CALLER}_{secrets.token_hex(4)}"
    began, refusal = clock.now(), ""
    try:
        call(master, "getPid", caller)
        text = "a call was allowed"
    except ProbeError as error:
        refusal = str(error)
        text = f"a call was denied by the policy ({refusal[:120]})"
    except OSError as error:
        yield fail(
            "RVMaster", f"{master} does not answer: {error}", "check this machine's network and firewall"
        )
        return
    text += f" in {(clock.now() - began) * 1000:.1f} ms"
    if before is None:
        yield skip("RVMaster", f"{text}; this user may not read the audit log")
        return
    try:
        recorded = _recorded(audit, before, caller, refusal)
    except (LogUnreadableError, NotRunningError) as error:
        yield skip("RVMaster", f"{text}; cannot read the audit log: {error}")
        return
    if recorded:
        yield ok("RVMaster", f"{text}, and recorded")
    else:
        yield fail("RVMaster", f"{text}, but is not in the audit log", "rosrv status; rosrv audit verify")


def _last(audit: AuditSource) -> int | None:
    try:
        return audit.last()
    except (LogUnreadableError, NotRunningError):
        return None


def _recorded(audit: AuditSource, before: int, caller: str, refusal: str) -> bool:
    """Return whether the log has the call: a record after the sequence `before`, or with the id in `refusal`.

    Raise `LogUnreadableError` or `NotRunningError` if the last query failed.
    """
    deadline, pause = clock.now() + _RECORD_SECONDS, _FIRST_PAUSE
    while True:
        is_last = clock.now() > deadline
        try:
            page = audit.search(Filter(), None, 1000, newest_first=True)
        except (LogUnreadableError, NotRunningError):
            if is_last:
                raise
        else:
            new = [entry.record for entry in page.entries if entry.sequence > before]
            if any(record.caller_id == caller or (refusal and record.id in refusal) for record in new):
                return True
            if is_last:
                return False
        time.sleep(pause)  # noqa: TID251  polling: the log has no notification
        pause = min(2 * pause, _LONGEST_PAUSE)


def _message(master: str) -> Iterator[SelftestFinding]:
    began = clock.now()
    try:
        message = message_through_the_relay(master)
    except ProbeError as error:
        yield skip(
            "relay",
            f"not tried, the policy does not let this machine: {str(error)[:120]}",
            f"grant {TOPIC} and /rosrv_selftest_* to this machine to try it",
        )
    except OSError as error:
        yield fail(
            "relay", f"no message came through: {error}", "can the appliance reach this machine? rosrv status"
        )
    else:
        if message.endswith(b"selftest"):
            yield ok(
                "relay",
                f"a message came through in {(clock.now() - began) * 1000:.0f} ms, registration included",
            )
        else:
            yield fail(
                "relay", "a message came through changed", "a monitor on its topic? rosrv monitor list"
            )
