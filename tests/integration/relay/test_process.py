import signal
import socket
from collections.abc import Iterator

import pytest

from appliance.channel.messages import FactWithdrawn, NodePlaced, StateEnded
from appliance.relay.process import fit_limits
from appliance.relay.relay_limits import RelayLimits
from tests.support.processes import LIMIT
from tests.support.relay_driver import LOOPBACK, RelayProcess


@pytest.fixture
def relay() -> Iterator[RelayProcess]:
    relay = RelayProcess()
    yield relay
    if relay.process.poll() is None:
        relay.kill()
    relay.lifeline.close()


def refuses(port: int) -> bool:
    with socket.socket() as sock:
        return sock.connect_ex((LOOPBACK, port)) != 0


def test_it_reports_that_it_is_ready_and_its_congestion_control(relay: RelayProcess) -> None:
    assert relay.ready.detail["index"] == 0
    assert relay.ready.detail["congestion"] in {"cubic", "reno"}
    assert (
        relay.ready.detail["connections"]
        == fit_limits(RelayLimits(), relay.ready.detail["descriptors"]).connections
    )


def test_it_answers_pings_from_its_main_loop(relay: RelayProcess) -> None:
    relay.ping(1)
    relay.process.send_signal(signal.SIGSTOP)
    relay.process.send_signal(signal.SIGCONT)
    relay.ping(2)


def test_stop_ends_it_cleanly(relay: RelayProcess) -> None:
    assert relay.stop() == 0


def test_the_end_of_the_lifeline_ends_it(relay: RelayProcess) -> None:
    relay.lifeline.close()
    assert relay.process.wait(LIMIT) == 0


def test_a_control_with_an_invalid_message_is_dropped_and_the_next_is_served(relay: RelayProcess) -> None:
    first = relay.open_link()
    relay.ping(1)
    first.send_bytes(b"\0\0\0\5wrong")
    assert first.ended.wait(LIMIT)
    second = relay.open_link()
    second.send(StateEnded(1))
    relay.ping(2)
    assert not second.ended.is_set()
    first.close()
    second.close()


def test_a_port_is_open_until_its_node_is_withdrawn(relay: RelayProcess) -> None:
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
    link.send(FactWithdrawn(("node", "k")))
    relay.ping(3)
    assert refuses(port)
    link.close()
