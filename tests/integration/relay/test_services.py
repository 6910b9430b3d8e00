import socket
from functools import partial

import pytest

from appliance.channel.messages import ConnectionClosed, ConnectionOpened, ConnectionRefused, FactWithdrawn
from roswire.tcpros import HeaderParser, encode_header
from tests.support.nodes import Client, RosSession
from tests.support.relay_driver import LOOPBACK, Face, RelayDriver
from tests.support.waiting import eventually

BOTH: tuple[Client, Client] = ("rospy", "roscpp")


def ask_header(face: Face, fields: dict[str, str]) -> dict[str, str]:
    with socket.create_connection((LOOPBACK, face.port), timeout=20) as sock:
        sock.sendall(encode_header(fields))
        parser = HeaderParser()
        while True:
            data = sock.recv(4096)
            assert data, "closed without a header"
            header = parser.feed(data)
            if header is not None:
                return header


def _refused(message: object, resource: str) -> bool:
    return isinstance(message, ConnectionRefused) and message.resource == resource


@pytest.mark.parametrize("options", [(), ("--persistent",)], ids=["one-by-one", "persistent"])
@pytest.mark.parametrize("caller", BOTH)
@pytest.mark.parametrize("server", BOTH)
def test_calls_are_answered(
    driver: RelayDriver, ros: RosSession, server: Client, caller: Client, options: tuple[str, ...]
) -> None:
    service = ros.service_server(server, "/mode", name="server")
    client = ros.service_client(caller, "/mode", *options, name="client")
    for count, value in enumerate(("true", "false", "true"), start=1):
        client.send(value)
        answers = client.wait_for_count(count, event="answered")
        assert answers[-1]["success"] is (value == "false")
    assert service.wait_for(event="called")["client"] == "/client"

    def opened() -> list[str]:
        messages = [m for m in driver.link.messages if isinstance(m, ConnectionOpened)]
        return [m.kind for m in messages if m.caller_id == "/client"]

    expected = ["service"] * (1 if options else 3)
    eventually(lambda: len(opened()) >= len(expected), "control gets a report of each connection")
    assert opened() == expected


@pytest.mark.parametrize("server", BOTH)
def test_the_stock_tools_find_type_and_call(driver: RelayDriver, ros: RosSession, server: Client) -> None:
    ros.service_server(server, "/mode", name="server")
    assert ros.run("/usr/bin/rosservice", "type", "/mode").stdout.strip() == "std_srvs/SetBool"
    assert "negated" in ros.run("/usr/bin/rosservice", "call", "/mode", "data: true").stdout


@pytest.mark.parametrize("server", BOTH)
def test_a_probe_is_answered_with_the_services_header(
    driver: RelayDriver, ros: RosSession, server: Client
) -> None:
    ros.service_server(server, "/mode", name="server")
    fields = {"callerid": "/probe", "service": "/mode", "md5sum": "*", "probe": "1"}
    header = ask_header(driver.faces["/server"], fields)
    assert header["type"] == "std_srvs/SetBool"


@pytest.mark.parametrize("server", BOTH)
def test_a_service_of_another_type_answers_with_its_own_error(
    driver: RelayDriver, ros: RosSession, server: Client
) -> None:
    ros.service_server(server, "/mode", name="server")
    fields = {"callerid": "/client", "service": "/mode", "md5sum": "0" * 32}
    assert "md5sum" in ask_header(driver.faces["/server"], fields)["error"]


def test_a_failed_call_returns_the_services_error(driver: RelayDriver, ros: RosSession) -> None:
    program = (
        "import rospy\n"
        "from std_srvs.srv import SetBool\n"
        "rospy.init_node('server')\n"
        "def fail(request): raise rospy.ServiceException('no such bolt')\n"
        "rospy.Service('/mode', SetBool, fail)\n"
        'print(\'{"event": "ready"}\', flush=True)\n'
        "rospy.spin()\n"
    )
    ros.start(["/usr/bin/python3", "-c", program], label="server").wait_for(event="ready")
    client = ros.service_client("rospy", "/mode")
    client.send("true")
    assert "no such bolt" in client.wait_for(event="failed")["reason"]


def test_a_client_without_a_grant_is_refused(driver: RelayDriver, ros: RosSession) -> None:
    ros.service_server("rospy", "/mode", name="server")
    face = driver.faces["/server"]
    driver.link.send(FactWithdrawn(("client", face.key, "/mode", LOOPBACK, "/client")))
    for service, reason in (("/mode", "no grant"), ("/other", "not a provider")):
        fields = {"callerid": "/client", "service": service, "md5sum": "*"}
        assert reason in ask_header(face, fields)["error"]
        driver.link.wait_for(partial(_refused, resource=service))


def test_a_revoked_client_loses_its_persistent_connection(driver: RelayDriver, ros: RosSession) -> None:
    ros.service_server("rospy", "/mode", name="server")
    client = ros.service_client("rospy", "/mode", "--persistent", name="client")
    client.send("true")
    client.wait_for(event="answered")
    driver.link.send(FactWithdrawn(("client", driver.faces["/server"].key, "/mode", LOOPBACK, "/client")))
    driver.link.wait_for(
        lambda message: isinstance(message, ConnectionClosed) and "revoked" in message.reason
    )
    client.send("true")
    client.wait_for(event="failed")


def test_a_service_that_never_answers_blocks_only_its_client(driver: RelayDriver, ros: RosSession) -> None:
    program = (
        "import rospy, threading\n"
        "from std_srvs.srv import SetBool, SetBoolResponse\n"
        "rospy.init_node('server')\n"
        "stuck = threading.Event()\n"
        "def answer(request):\n"
        "    if request.data: stuck.wait()\n"
        "    return SetBoolResponse(success=True)\n"
        "rospy.Service('/mode', SetBool, answer)\n"
        'print(\'{"event": "ready"}\', flush=True)\n'
        "rospy.spin()\n"
    )
    ros.start(["/usr/bin/python3", "-c", program], label="server").wait_for(event="ready")
    stuck = ros.service_client("roscpp", "/mode", name="stuck")
    stuck.send("true")
    opened = driver.link.wait_for(lambda m: isinstance(m, ConnectionOpened) and m.caller_id == "/stuck")
    well = ros.service_client("roscpp", "/mode", name="well")
    well.send("false")
    well.wait_for(event="answered")
    stuck.kill()
    driver.link.wait_for(lambda m: isinstance(m, ConnectionClosed) and m.number == opened.number)


def test_a_call_of_a_dead_service_fails_at_once(driver: RelayDriver, ros: RosSession) -> None:
    server = ros.service_server("rospy", "/mode", name="server")
    server.kill()
    client = ros.service_client("rospy", "/mode")
    client.send("true")
    assert "connection to the service" in client.wait_for(event="failed")["reason"]
