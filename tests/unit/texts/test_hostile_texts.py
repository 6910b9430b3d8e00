"""Text that others chose is never a format, a path, a head, a command or markup: one table, fed to every entrance.

Each entrance of `tests/support/entrances.py`, and each place to which such text goes out, has a row here. A row puts a
text wherever a peer can put one. The text is refused in the words of the protocol, or it comes out as itself.
"""

import contextlib
import csv
import html
import io
import json
import logging
import re
import struct
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import msgspec
import pytest
import structlog
from prometheus_client.parser import text_string_to_metric_families
from rosrv_fleet.search_sql import FleetFilter, SearchCursor, search_statement

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.audit.log.repetition import storable
from appliance.audit.search.query import Filter, FilterError
from appliance.base.metric import gauge
from appliance.features.approvals.hook_link import CallWaits
from appliance.features.approvals.hook_process import body_of
from appliance.features.audit_tools.csv_records import csv_lines
from appliance.features.doors.client_frames import content, is_text
from appliance.features.doors.foxglove import Foxglove, FoxgloveLimits
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.rosbridge import Rosbridge, RosbridgeLimits
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue
from appliance.features.metrics import routes as metric_routes
from appliance.features.syslog.syslog import Formatter
from appliance.formats import html_page
from appliance.hosts.hosts_file import DeclaredHostsError, parse_declared
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.rpc.server import HttpRequest, Peer
from appliance.rpc.xmlrpc_client import XmlRpcClient
from appliance.signing.bearer_secrets import SecretForm
from appliance.supervisor.logs import configure_logs
from rosmop.tool.terminal import say
from roswire.definitions import Definitions
from roswire.errors import DefinitionError, InvalidUriError, PeerError
from roswire.message_view import PublisherReader
from roswire.standard import standard_definitions
from roswire.uris import parse_node_uri, parse_service_uri
from roswire.xmlrpc import FaultReceived, build_response, parse_response
from tests.support.control_parts import HOST, ControlParts
from tests.support.entrances import CELLS, WITHOUT_TOKEN
from tests.support.rest_world import RestWorld
from tests.support.rows import require_rows
from tests.support.syslog import parse
from tests.unit.api.routes.test_operation_routes import REQUESTS
from tests.unit.relay.world import ASK, HEADER, LIMITS, World

TEXTS = {
    "percent": "%",
    "formats": "%s %d %n %(x)s %%",
    "braces": "{} {0} {x.y} {{",
    "quotes": "\"'`\\",
    "CR LF": "a\r\nX-Evil: 1\r\n\r\n",
    "NUL": "a\0b",
    "escape": "\x1b[2J\x1b]0;title\x07\x9b2J",
    "64 KB": "a" * (64 << 10),
    "not UTF-8": "\udcff\udcfe",
    "lone surrogate": "\ud800",
    "bidi": "\u202eabc\u2066",
    "line separator": "a\u2028b\u0085c",
    "markup": "<script>alert(1)</script>&amp;",
    "formula": "=cmd|' /C calc'!A0",
    "path": "../../../etc/passwd",
    "shell": "$(reboot) `reboot`; reboot | $x ${x}",
    "SQL": "'; DROP TABLE record; --",
}
texts = pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
Feed = Callable[[str], None]


def raw(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def as_received(text: str) -> str:
    """Return a text of a connection header as the receiver has it."""
    return raw(text).decode("utf-8", "surrogateescape")


# --- entrances ---


async def calls_of_the_master(text: str) -> None:
    """Each parameter of each call, at RVMaster and at a node's endpoint."""
    parts = await ControlParts.begun()
    value = b"<param><value><string>%b</string></value></param>" % raw(html.escape(text))
    body = b"<methodCall><methodName>%b</methodName><params>%b</params></methodCall>"
    names = [name.encode() for name in (*MASTER_CALLS, *NODE_CALLS)] + [raw(html.escape(text))]
    for name, count in [(name, count) for name in names for count in range(1, 6)]:
        request = HttpRequest(Peer(HOST, str(HOST), "10.0.0.1"), "/", body % (name, value * count), 0)
        try:
            answer = parse_response(await parts.serve(request))
        except FaultReceived as fault:
            assert "Traceback" not in fault.text and "defect" not in fault.text
        except PeerError as error:  # the server answers it with the status 400
            assert str(error).isprintable()
        else:
            assert isinstance(answer, list | int | str)
    for record in parts.records.records:
        goes_out_as_a_record(record)


def answers_of_nodes(text: str) -> None:
    for form in ("http://robot:1/{}", "http://{}:1/", "{}", "rosrpc://{}:1", "rosrpc://robot:{}"):
        for read in (parse_node_uri, parse_service_uri):
            try:
                uri = read(form.replace("{}", text))
            except InvalidUriError as error:
                assert str(error).isprintable()
                continue
            first, *fields = XmlRpcClient(uri, timeout=1.0).head.split(b"\r\n")
            assert first.startswith(b"POST ") and first.count(b" ") == 2 and len(fields) == 5
    document = build_response([1, "x", 0]).replace(b"x", raw(html.escape(text)), 1)
    try:
        parse_response(document)
    except (PeerError, FaultReceived) as error:
        assert str(error).isprintable()


def headers_of_connections(text: str) -> None:
    """Each field of a subscriber and of a publisher. Afterwards the relay serves as before."""
    world = World(LIMITS)
    try:
        for name in (*ASK, "message_definition", "tcp_nodelay", text):
            fields = [raw(f"{one}={value}") for one, value in {**ASK, name: text}.items()]
            header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
            world.connect(struct.pack("<I", len(header)) + header)
            for _turn in range(5):
                world.loop.turn(0.01)
        for name in ("type", "md5sum", "message_definition", "callerid", "latching"):
            PublisherReader(HEADER | {name: as_received(text)}).read(b"abc")
        world.subscribed()
    finally:
        world.close()


def replaced(body: Any, text: str) -> Iterator[Any]:
    """Yield the body with each of its texts, and each of its names, replaced."""
    if isinstance(body, str):
        yield text
    for name, value in body.items() if isinstance(body, dict) else ():
        yield from ({**body, name: one} for one in replaced(value, text))
        yield {**body, text: value}
    for place, value in enumerate(body) if isinstance(body, list) else ():
        yield from ([*body[:place], one, *body[place + 1 :]] for one in replaced(value, text))


def percent_encoded(text: str) -> str:
    return "".join(f"%{byte:02X}" for byte in raw(text)[:4096])


def harmless(answer: httpx.Response) -> None:
    assert answer.status_code < 500, (answer.request.url, answer.text[:300])
    assert all("\n" not in value and "\r" not in value for value in answer.headers.values())
    assert "x-evil" not in answer.headers


def frames_of_clients(text: str) -> None:
    """Each text of each operation of both protocols; answers are frames of their protocol."""
    for protocol in (
        Rosbridge("/door", RosbridgeLimits(), ViewerQueue()),
        Foxglove("/door", FoxgloveLimits(), ViewerQueue()),
    ):
        for operation in OPERATIONS:
            for given in replaced(operation, text):
                for frame in (json.dumps(given).encode(), raw(json.dumps(given, ensure_ascii=False))):
                    protocol.receive(frame, is_text=True)
        for call in range(3):
            protocol.answered(call, msgspec.Raw(b"{}"))
        protocol.warned(raw(text).decode("utf-8", "replace"))
        while (answer := protocol.next_frame(0.0)) is not None:
            assert isinstance(answer, bytes | tuple)
            assert not is_text(answer) or json.loads(content(answer))["op"]
    types = KnownTypes(standard_definitions(), ValueLimits())
    for name in ("type", "md5sum", "message_definition"):
        for header in (
            {"type": "a/B", "md5sum": "x", "message_definition": "int8 x"} | {name: as_received(text)},
        ):
            with pytest.raises(DefinitionError) as refused:
                types.learn(header)
            assert types.key(header).fingerprint == "" and str(refused.value)
    with pytest.raises(DefinitionError):
        Definitions.from_files({text: "int8 x"})


OPERATIONS: tuple[dict[str, Any], ...] = (
    {"op": "advertise", "topic": "/t", "type": "std_msgs/String", "id": "1"},
    {"op": "advertise", "channels": [{"id": 1, "topic": "/t", "encoding": "json", "schemaName": "a/B"}]},
    {"op": "publish", "topic": "/t", "msg": {"data": "x"}},
    {"op": "subscribe", "topic": "/t", "type": "std_msgs/String", "id": "1", "compression": "none"},
    {"op": "unsubscribe", "topic": "/t", "id": "1"},
    {"op": "call_service", "service": "/s", "args": {"data": "x"}, "id": "1", "type": "a/B"},
    {"op": "advertise_service", "service": "/s", "type": "a/B"},
    {"op": "service_response", "service": "/s", "id": "1", "values": {"data": "x"}, "result": True},
    {"op": "fragment", "id": "1", "data": "x", "num": 0, "total": 2},
    {"op": "set_level", "level": "info", "id": "1"},
    {"op": "status", "level": "info", "msg": "x", "id": "1"},
    {"op": "getParameters", "parameterNames": ["/p"], "id": "1"},
    {"op": "setParameters", "parameters": [{"name": "/p", "value": "x"}], "id": "1"},
    {"op": "subscribeParameterUpdates", "parameterNames": ["/p"]},
    {"op": "fetchAsset", "uri": "package://a/b", "requestId": 1},
)


def hosts_and_policies(text: str) -> None:
    """Names of hosts become identities of tunnels, and names of the policy rules of the firewall."""
    for written in (
        f"hosts:\n  {json.dumps(text)}: {{}}\n",
        f"hosts: {{arm: {{groups: [{json.dumps(text)}]}}}}\n",
        text,
    ):
        try:
            for host, row in parse_declared(written, "hosts.yaml").items():
                assert all(one.isascii() and one.isprintable() for one in (host, *row.groups))
        except DeclaredHostsError as error:
            assert error.args
    for written in (
        f"[Hosts]\n{text} = 10.0.0.1\n",
        f"[Hosts]\na = {text}\n",
        f"[Publishers]\n{text} = a\n",
        text,
    ):
        try:
            compile_policy(written, file="site.ini")
        except PolicyError as error:
            assert error.findings


def tickets(text: str) -> None:
    form = SecretForm("rosrv_door_")
    for shown in (text, f"rosrv_door_{text}", form.make()[2] + text):
        assert form.parse(shown) is None


def searches(text: str) -> None:
    wanted = FleetFilter(None, Filter(resource=text, caller_id=text))
    try:
        statement = search_statement(wanted, SearchCursor(1, text, text), 10, [text])
    except FilterError:
        return
    assert statement.text.count("%s") == len(statement.values) and "DROP" not in statement.text


FEEDS: dict[str, Feed | str] = {
    "node API": answers_of_nodes,
    "relay": headers_of_connections,
    "REST with a token": "- `test_requests_of_rest`",
    "REST without a token": "- `test_requests_without_a_token`",
    "console": "- its files are the same for all; what it shows is text of REST, and set as `textContent`",
    "follower": "- it is a request of REST, with the same parameters as the search that it follows",
    "sign-on": "- `test_requests_without_a_token`",
    "door's port": frames_of_clients,
    "door's ticket": tickets,
    "tunnel": hosts_and_policies,
    "pair": "- both ends are this program, and know each other by a key",
    "collector": searches,
    "admin socket": "- it is for programs of the robot's administrator; what they print has its row",
    "RVMaster": "- `test_the_master_answers_every_text`",
}


@pytest.mark.complete
def test_each_entrance_is_fed() -> None:
    require_rows(CELLS, FEEDS, "FEEDS in tests/unit/texts/test_hostile_texts.py")


@texts
@pytest.mark.parametrize("entrance", [name for name, feed in FEEDS.items() if callable(feed)])
@pytest.mark.usefixtures("sockets")
def test_an_entrance_takes_no_text_for_more_than_text(entrance: str, text: str) -> None:
    feed = FEEDS[entrance]
    assert callable(feed)
    feed(text)


@texts
@pytest.mark.anyio
async def test_the_master_answers_every_text(text: str) -> None:
    await calls_of_the_master(text)


@pytest.fixture(scope="module")
def rest() -> Iterator[RestWorld]:
    world = RestWorld()
    yield world
    world.close()


@texts
def test_requests_of_rest(text: str, rest: RestWorld) -> None:
    """Each text goes to its part of all requests, so that all are asked."""
    for method, target, body in REQUESTS[[*TEXTS.values()].index(text) :: len(TEXTS)]:
        for given in replaced(body, text):
            with contextlib.suppress(UnicodeEncodeError):  # of the client: no such text fits into its JSON
                harmless(rest.asked(method, target, given))
        path = target.partition("?")[0]
        for shown in (f"{path}/{percent_encoded(text)}", f"{path}?note={percent_encoded(text)}"):
            harmless(rest.asked(method, shown, None))


@texts
def test_requests_without_a_token(text: str, rest: RestWorld) -> None:
    for path in WITHOUT_TOKEN:
        for shown in (f"{path}/{percent_encoded(text)}", f"{path}?code={percent_encoded(text)}"):
            harmless(rest.asked("GET", shown, None, None))
        harmless(rest.asked("POST", path, raw(text), None))


# --- where text goes out ---


def goes_out_as_a_record(record: AuditRecord) -> None:
    entry = LogEntry(7, msgspec.structs.replace(storable(record), time=1_700_000_000_000_000_000))
    message = Formatter(facility=13, longest=8192, host_name="robot").record(entry)
    assert message.isascii() and message.decode().isprintable()
    assert parse(message).elements
    [line] = [line for _sequence, line in csv_lines([entry])]
    [cells] = csv.reader(io.StringIO(line, newline=""), strict=True)
    assert len(cells) == 16 and not any(cell.startswith(("=", "+", "-", "@")) for cell in cells)


def record_of(text: str) -> None:
    for name in ("host", "caller_id", "resource", "reason", "category"):
        fields: dict[str, Any] = {"id": "0" * 20, "time": 1, "event": "decision", name: text}
        goes_out_as_a_record(AuditRecord(**fields, detail={"note": text}))


def label_of(text: str) -> None:
    metric = gauge("rosrv_x", "of a test", "host")
    try:
        page = metric_routes.page({"rosrv_x": [((text,), 1.0)]}, [metric])
    except UnicodeEncodeError:
        assert not text.isascii()  # no record or registration has it: names are ASCII
        return
    [family] = text_string_to_metric_families(page.decode())
    [sample] = family.samples
    assert sample.labels == {"host": text}


def page_of(text: str) -> None:
    shown = html_page.head(text) + "".join(html_page.section("a", ["b"], [[text]]))
    assert "<script" not in shown and "\x1b" not in shown and html.escape("&") in html.escape("&")
    shown.encode()


def hook_of(text: str) -> None:
    body = body_of(CallWaits(1, text, text, "publish", text, text, 5.0), 5.0, text, "")
    assert b"<" not in body and b"\n" not in body and json.loads(body)["number"] == 1


OUTPUTS: dict[str, Feed] = {
    "records in syslog and CSV": record_of,
    "labels of metrics": label_of,
    "HTML of reports": page_of,
    "web hook": hook_of,
}


@texts
@pytest.mark.parametrize("output", OUTPUTS)
def test_text_goes_out_as_text(output: str, text: str) -> None:
    OUTPUTS[output](text)


@texts
def test_a_terminal_gets_no_control_characters(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(f"{text} of a node")
    shown = capsys.readouterr().out
    assert shown.endswith(" of a node\n") and shown[:-1].isprintable()


@texts
@pytest.mark.parametrize("terminal", [True, False])
def test_a_line_of_the_log_is_one_line(text: str, terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: terminal)
    monkeypatch.setattr("sys.stderr", stream)
    before, handlers = structlog.get_config(), logging.root.handlers[:]
    try:
        configure_logs("tester")
        structlog.get_logger().warning(text, node=text, rows=[text])
        logging.getLogger("library").warning("%s of a node", text)
    finally:
        structlog.configure(**before)
        structlog.contextvars.clear_contextvars()
        logging.root.handlers[:] = handlers
    lines = stream.getvalue().removesuffix("\n").split("\n")
    assert len(lines) == 2
    for line in lines:
        shown = re.sub(r"\x1b\[[0-9;]*m", "", line)  # the colours of the line itself
        assert shown.isprintable() if terminal else json.loads(line), line[:200]
