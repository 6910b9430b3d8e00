from collections.abc import Iterator

import pytest

from appliance.channel.messages import (
    ClientGranted,
    ConnectionClosed,
    ConnectionOpened,
    NodePlaced,
    OwnServiceAnswered,
    OwnServiceCalled,
    ServicePlaced,
)
from appliance.relay.connections.own_service import HEADER
from appliance.relay.relay_limits import RelayLimits
from roswire.standard import standard_definitions
from roswire.tcpros import encode_frame, encode_header, encode_service_reply
from tests.unit.relay.world import IMPATIENT, LIMITS, LOOPBACK, Peer, World

pytestmark = pytest.mark.usefixtures("sockets")

OTHER = "127.0.0.9"
CALL = {"callerid": "/client", "service": "/rosrv/record_now", "md5sum": "*"}


class Scene(World):
    def __init__(self, limits: RelayLimits = LIMITS) -> None:
        super().__init__(limits)
        self.port = self.listen()
        self.state(NodePlaced("own", "/rosrv", LOOPBACK, monitors=True), self.port)
        self.state(ServicePlaced("own", CALL["service"], LOOPBACK, 1))
        for host in (LOOPBACK, OTHER):
            self.state(ClientGranted("own", CALL["service"], host, "/client"))

    def client(self, host: str = LOOPBACK, **fields: str) -> Peer:
        peer = self.connect(encode_header(CALL | fields), host=host)
        assert self.gets_header(peer) == HEADER | {"callerid": "/rosrv"}
        return peer

    def called(self) -> list[OwnServiceCalled]:
        return [message for message in self.told if isinstance(message, OwnServiceCalled)]


@pytest.fixture
def scene(request: pytest.FixtureRequest) -> Iterator[Scene]:
    scene = Scene(getattr(request, "param", LIMITS))
    yield scene
    scene.close()


def reply(success: bool, text: str) -> bytes:
    return encode_service_reply(bytes([success]) + encode_frame(text.encode()))


def test_the_header_is_that_of_the_type() -> None:
    definitions = standard_definitions()
    assert HEADER["md5sum"] == definitions.service_md5sum("std_srvs/Trigger")


def test_control_answers_a_call(scene: Scene) -> None:
    client = scene.client(persistent="1")
    assert scene.hears(ConnectionOpened, resource=CALL["service"]).host == LOOPBACK
    client.send(encode_frame(b""))
    asked = scene.hears(OwnServiceCalled)
    assert (asked.service, asked.host, asked.caller_id) == (CALL["service"], LOOPBACK, "/client")
    scene.state(OwnServiceAnswered(asked.number, True, "an id"))
    scene.gets(client, reply(True, "an id"))
    now = scene.loop.clock()
    scene.loop.clock = lambda: now + 1.1
    client.send(encode_frame(b""))
    asked = scene.hears(OwnServiceCalled)
    scene.state(OwnServiceAnswered(asked.number, False, "why not"))
    scene.gets(client, reply(False, "why not"))


def test_a_flood_of_one_host_is_one_call_to_control(scene: Scene) -> None:
    flood = [scene.client(persistent="1") for _one in range(5)]
    for client in flood:
        client.send(encode_frame(b""))
    asked = scene.hears(OwnServiceCalled, host=LOOPBACK)
    other = scene.client(OTHER)
    other.send(encode_frame(b""))
    scene.hears(OwnServiceCalled, host=OTHER)
    gone = flood.pop()
    gone.sock.close()
    scene.hears(ConnectionClosed)
    now = scene.loop.clock()
    scene.loop.clock = lambda: now
    scene.state(OwnServiceAnswered(asked.number, True, "one"))
    for client in flood:
        scene.gets(client, reply(True, "one"))
        client.send(encode_frame(b"") * 20)
    for client in flood:
        scene.gets(client, reply(True, "one") * 20)
    assert scene.called() == []


def test_an_answer_that_does_not_repeat_is_asked_for_again(scene: Scene) -> None:
    first, second, gone = (scene.client(persistent="1") for _one in range(3))
    first.send(encode_frame(b""))
    asked = scene.hears(OwnServiceCalled)
    now = scene.loop.clock()
    scene.loop.clock = lambda: now
    scene.state(OwnServiceAnswered(asked.number, True, "holds base", repeats=False))
    scene.gets(first, reply(True, "holds base"))
    for client in (gone, first, second):
        client.send(encode_frame(b""))
        scene.loop.turn(0.01)
    gone.sock.close()
    scene.hears(ConnectionClosed)
    assert scene.called() == []
    scene.loop.clock = lambda: now + 1.1
    asked = scene.hears(OwnServiceCalled)
    scene.state(OwnServiceAnswered(asked.number, False, "another host holds base", repeats=False))
    for client in (first, second):
        scene.gets(client, reply(False, "another host holds base"))


def test_a_call_is_answered_when_control_ends(scene: Scene) -> None:
    client = scene.client()
    client.send(encode_frame(b""))
    scene.hears(OwnServiceCalled)
    scene.control.close()
    scene.link.close()
    scene.connect_control()
    assert b"control is not running" in scene.ends(client)
    other = scene.client(OTHER)
    other.send(encode_frame(b""))
    asked = scene.hears(OwnServiceCalled)
    scene.state(OwnServiceAnswered(asked.number, True, "two"))
    assert scene.ends(other) == reply(True, "two")


def test_a_client_with_another_type_gets_an_error(scene: Scene) -> None:
    client = scene.connect(encode_header(CALL | {"md5sum": "0" * 32}))
    assert f"not {'0' * 32}" in scene.gets_header(client)["error"]
    assert scene.called() == []


@pytest.mark.parametrize("scene", [IMPATIENT], indirect=True)
def test_without_a_grant_no_client_calls(scene: Scene) -> None:
    client = scene.connect(encode_header(CALL | {"callerid": "/unknown"}))
    assert "no grant for [/unknown]" in scene.gets_header(client)["error"]
    assert scene.called() == []
