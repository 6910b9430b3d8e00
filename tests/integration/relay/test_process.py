"""The relay as a process: what the supervisor may expect of it."""

import signal
import socket
from collections.abc import Iterator

import pytest

from appliance.channel.messages import NodePlaced, NodeWithdrawn, StateEnded
from appliance.relay.bounds import Limits
from appliance.relay.process import fitted
from tests.support.relay_driver import LOOPBACK, RelayProcess


@pytest.fixture
def relay() -> Iterator[RelayProcess]:
    """A relay process without a control."""
    relay = RelayProcess()
    yield relay
    if relay.process.poll() is None:
        relay.kill()
    relay.lifeline.close()


def refuses(port: int) -> bool:
    """Whether nobody listens there."""
    with socket.socket() as sock:
        return sock.connect_ex((LOOPBACK, port)) != 0


def test_it_says_that_it_is_ready_and_how_it_sends(relay: RelayProcess) -> None:
    """Which congestion control its sockets get, and how many connections it may have."""
    assert relay.ready.detail["index"] == 0
    assert relay.ready.detail["congestion"] in {"cubic", "reno"}
    assert (
        relay.ready.detail["connections"] == fitted(Limits(), relay.ready.detail["descriptors"]).connections
    )


def test_it_answers_pings_from_its_main_loop(relay: RelayProcess) -> None:
    """Also when it was stopped for a while."""
    relay.ping(1)
    relay.process.send_signal(signal.SIGSTOP)
    relay.process.send_signal(signal.SIGCONT)
    relay.ping(2)


def test_stop_ends_it_cleanly(relay: RelayProcess) -> None:
    """With status 0."""
    assert relay.stop() == 0


def test_the_end_of_the_lifeline_ends_it(relay: RelayProcess) -> None:
    """A relay does not outlive its supervisor."""
    relay.lifeline.close()
    assert relay.process.wait(10) == 0


def test_a_control_that_speaks_another_language_is_left_and_the_next_is_served(relay: RelayProcess) -> None:
    """A message that is not of the link ends the link, not the relay."""
    first = relay.open_link()
    relay.ping(1)
    first.send_bytes(b"\0\0\0\5wrong")
    assert first.ended.wait(10)
    second = relay.open_link()
    second.send(StateEnded(1))
    relay.ping(2)
    assert not second.ended.is_set()
    first.close()
    second.close()


def test_a_port_lives_while_its_node_is_placed(relay: RelayProcess) -> None:
    """The relay listens on the socket it is given, over a change of control, until the node is withdrawn."""
    listening = socket.create_server((LOOPBACK, 0))
    port = listening.getsockname()[1]
    link = relay.open_link()
    link.send(NodePlaced("k", "/talker", LOOPBACK), (listening.fileno(),))
    relay.ping(1)
    listening.close()
    assert not refuses(port)
    link.close()
    link = relay.open_link()
    relay.ping(2)
    assert not refuses(port)
    link.send(NodeWithdrawn("k"))
    relay.ping(3)
    assert refuses(port)
    link.close()
