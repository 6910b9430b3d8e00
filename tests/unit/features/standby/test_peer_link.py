import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.features.standby import process
from appliance.features.standby.lease import ClaimPromise, PeerMessage, PromiseRequest, TakeOver
from appliance.features.standby.process import PeerChannel
from appliance.features.standby.witness.protocol import HIGHEST, seal

KEY = b"\xcc" * 32
ALL: tuple[PeerMessage, ...] = (
    PromiseRequest(3, "theirs", 7),
    ClaimPromise(3, "ours", 7),
    TakeOver(3, "theirs", 7),
)


def ends() -> tuple[PeerChannel, PeerChannel]:
    return PeerChannel("a", "b", KEY), PeerChannel("b", "a", KEY)


@pytest.mark.parametrize("message", ALL)
def test_each_message_arrives(message: PeerMessage) -> None:
    here, there = ends()
    assert there.read(here.write(message)) == message


@pytest.mark.parametrize("message", ALL)
def test_a_forged_message_is_not_read(message: PeerMessage) -> None:
    here, there = ends()
    assert there.read(PeerChannel("a", "b", b"\xdd" * 32).write(message)) is None
    assert there.read(PeerChannel("c", "b", KEY).write(message)) is None
    assert here.read(here.write(message)) is None


@given(st.integers(0, 200), st.integers(1, 255))
def test_no_changed_byte_is_read(position: int, change: int) -> None:
    here, there = ends()
    datagram = bytearray(here.write(ALL[0]))
    datagram[position % len(datagram)] ^= change
    assert there.read(bytes(datagram)) is None


@given(st.binary(max_size=1100))
def test_garbage_is_not_read(datagram: bytes) -> None:
    _, there = ends()
    assert there.read(datagram) is None
    assert there.read(b"\x01a" + datagram) is None


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"epoch": "3", "session": "s", "number": 1},
        {"epoch": 3, "session": 5, "number": 1},
        {"epoch": -1, "session": "s", "number": 1},
        {"epoch": 3, "session": "s", "number": HIGHEST + 1},
        {"epoch": 3.5, "session": "s", "number": 1},
    ],
)
def test_an_authentic_but_malformed_message_is_not_read(body: dict[str, object]) -> None:
    _, there = ends()
    for purpose in process.PURPOSES.values():
        assert there.read(seal(purpose, "a", KEY, body)) is None


def test_a_request_is_read_once() -> None:
    here, there = ends()
    recorded = [here.write(PromiseRequest(3, "s", number)) for number in (1, 2, 3)]
    assert [there.read(one) is not None for one in recorded] == [True, True, True]
    assert [there.read(one) for one in recorded] == [None, None, None]


def test_a_request_that_was_overtaken_is_not_read() -> None:
    here, there = ends()
    first, second, old = (
        here.write(PromiseRequest(3, "s", 1)),
        here.write(PromiseRequest(3, "s", 2)),
        here.write(PromiseRequest(2, "other", 99)),
    )
    assert there.read(second) is not None
    assert there.read(first) is None and there.read(old) is None


def test_a_new_epoch_begins_new_numbers() -> None:
    here, there = ends()
    assert there.read(here.write(PromiseRequest(3, "s", 50))) is not None
    assert there.read(here.write(PromiseRequest(3, "restarted", 1))) is None
    assert there.read(here.write(PromiseRequest(4, "restarted", 1))) is not None
    assert there.read(here.write(PromiseRequest(3, "s", 51))) is None
