import base64
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from vici.protocol import FiniteStream, Message, Packet

from appliance.channel.messages import TunnelHost, TunnelsStated
from appliance.features.tunnels.charon import CharonError, ViciClient
from appliance.ipsec.strongswan import connection_name

pytestmark = pytest.mark.nightly


class Standing(NamedTuple):
    """A tunnel: the name of its connection, and the numbers of its IKE SA and its child SA (0 for none)."""

    tunnel: str
    ike: int
    child: int
    state: str = "ESTABLISHED"

    def listed(self) -> bytes:
        name, child = b"list-sa", {"state": "INSTALLED", "uniqueid": str(self.child)}
        children = {f"ros-{self.child}": child} if self.child else {}
        row = {"state": self.state, "uniqueid": str(self.ike), "child-sas": children}
        said: bytes = Message.serialize({self.tunnel: row})
        return bytes([Packet.EVENT, len(name)]) + name + said


class StandIn:
    """A charon that accepts every command. `standing` are its tunnels, `asked` its commands, `events` its notices."""

    def __init__(self, path: Path) -> None:
        self.events = bytes([Packet.EVENT_CONFIRM])
        self.standing: list[Standing] = []
        self.later: list[list[Standing]] = []  # of the next lists
        self.asked: list[tuple[str, dict[str, bytes]]] = []
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        with connection, connection.makefile("rb") as stream:
            while header := stream.read(4):
                packet = stream.read(struct.unpack("!I", header)[0])
                success = bytes([Packet.CMD_RESPONSE]) + Message.serialize({"success": "yes"})
                answers = [success if packet[0] == Packet.CMD_REQUEST else self.events]
                if packet[0] == Packet.CMD_REQUEST:
                    name, body = packet[2 : 2 + packet[1]].decode(), packet[2 + packet[1] :]
                    self.asked.append((name, dict(Message.deserialize(FiniteStream(body)))))
                    if name == "list-sas":
                        answers[:0] = map(Standing.listed, self.standing)
                        self.standing = self.later.pop(0) if self.later else self.standing
                for answer in answers:
                    connection.sendall(struct.pack("!I", len(answer)) + answer)

    def ended(self, by: str) -> list[str]:
        asked, self.asked = self.asked, []
        return [body[by].decode() for name, body in asked if name == "terminate" and by in body]

    def close(self) -> None:
        self._thread.join()
        self._listener.close()


def pem_of(count: int) -> bytes:
    text = base64.encodebytes(b"x" * count)
    return b"-----BEGIN X509 CRL-----\n" + text + b"-----END X509 CRL-----\n"


def stated(count: int) -> TunnelsStated:
    return TunnelsStated(1, "kernel", "10.113.11.1", b"authority", b"certificate", pem_of(count), [])


@pytest.fixture
def charon(tmp_path: Path) -> Iterator[tuple[StandIn, ViciClient]]:
    stand_in = StandIn(tmp_path / "vici.sock")
    vici = ViciClient(tmp_path / "vici.sock")
    yield stand_in, vici
    vici.close()
    stand_in.close()


def test_an_unexpected_answer_names_the_request(charon: tuple[StandIn, ViciClient]) -> None:
    stand_in, vici = charon
    stand_in.events = bytes([Packet.CMD_RESPONSE])
    with pytest.raises(CharonError, match="the list of tunnels"):
        vici.list_tunnels()


def test_a_list_that_is_too_long_is_an_error(charon: tuple[StandIn, ViciClient]) -> None:
    _stand_in, vici = charon
    vici.provision(stated(65_535))
    with pytest.raises(CharonError, match="the list of revoked certificates"):
        vici.provision(stated(65_536))


def test_unwanted_tunnels_are_closed_at_each_check(charon: tuple[StandIn, ViciClient]) -> None:
    stand_in, vici = charon
    vici.provision(stated(1))
    stand_in.standing = [Standing(connection_name("gone"), 1, 1), Standing("(unnamed)", 2, 2)]
    for _ in range(2):
        assert [tunnel.name for tunnel in vici.list_tunnels()] == ["gone"]
        assert stand_in.ended("ike") == [connection_name("gone")]


def test_tunnels_of_a_replaced_certificate_are_closed_at_each_check(
    charon: tuple[StandIn, ViciClient],
) -> None:
    stand_in, vici = charon
    tunnel, certificates = connection_name("laptop"), ("1a", "1b")
    before, other = Standing(tunnel, 3, 7), Standing(connection_name("other"), 4, 8)
    for serial in certificates:
        stand_in.standing = [before, other]
        hosts = [TunnelHost("laptop", "10.113.11.2", serial), TunnelHost("other", "10.113.11.3", "2a")]
        vici.provision(msgspec.structs.replace(stated(1), hosts=hosts))
    assert stand_in.ended("ike") == [tunnel]
    after = Standing(tunnel, 6, 10)
    for anew in (before, before, Standing(tunnel, 5, 7), Standing(tunnel, 5, 9)):
        stand_in.standing = [after, anew, other]
        vici.list_tunnels()
        assert stand_in.ended("ike-id") == [str(anew.ike)]
    stand_in.standing = [after, other]
    vici.list_tunnels()
    assert stand_in.ended("ike-id") == []


def test_a_tunnel_is_seen_while_its_keys_are_replaced(charon: tuple[StandIn, ViciClient]) -> None:
    stand_in, vici = charon
    tunnel = connection_name("laptop")
    vici.provision(msgspec.structs.replace(stated(1), hosts=[TunnelHost("laptop", "10.113.11.2", "1a")]))
    stand_in.standing = [Standing(tunnel, 3, 7, "REKEYING")]
    assert [one.name for one in vici.list_tunnels()] == ["laptop"]
    stand_in.standing = [Standing(tunnel, 3, 0, "REKEYED")]
    stand_in.later = [[Standing(tunnel, 4, 7), Standing(tunnel, 3, 0, "REKEYED")]]
    assert [one.name for one in vici.list_tunnels()] == ["laptop"]
    stand_in.standing = [Standing(tunnel, 4, 0, "REKEYED")]
    assert vici.list_tunnels() == []
