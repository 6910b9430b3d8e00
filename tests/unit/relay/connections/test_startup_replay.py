import pytest

from appliance.relay.connections.startup_replay import APPEARED, SECONDS, SPEECH, StartupReplay
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.memory import HostMemory
from tests.support.relay_memory import share


def replay(memory: HostMemory, now: float = 0.0) -> StartupReplay:
    made = StartupReplay(memory, now)
    made.opened(now, alone=True)
    return made


def kept(replay: StartupReplay, batch: Batch, now: float = 0.0) -> bool:
    replay.add(batch, now)
    return replay.keeps


def frames(messages: int, size: int = 8) -> Batch:
    return Batch(memoryview(bytes(size)), messages, 0)


@pytest.mark.parametrize(
    "added",
    [[(1, 8)] * 201, [(150, 8), (51, 8)], [(1, 600 << 10), (1, 600 << 10)], [(201, 8)], [(1, 2 << 20)]],
)
def test_never_more_than_the_bounds(added: list[tuple[int, int]]) -> None:
    """Beyond a bound, all first messages are dropped, so that no gap is left."""
    memory = share()
    words = replay(memory)
    assert [kept(words, frames(*one)) for one in added] == [True] * (len(added) - 1) + [False]
    assert memory.used == 0


def test_nothing_is_kept_when_the_quota_of_its_host_is_spent() -> None:
    memory = share(16)
    words = replay(memory)
    assert [kept(words, frames(1)) for _ in range(3)] == [True, True, False]
    assert (memory.used, words.give("/a", 0.0)) == (0, [])


def test_the_time_ends_for_speech_for_keeping_and_for_appearing() -> None:
    words, silent = replay(share(), 10.0), replay(share(), 10.0)
    words.expire(10.0 + APPEARED)
    silent.expire(10.1 + APPEARED)
    assert (words.keeps, silent.keeps) == (True, False)
    assert kept(words, frames(1), 12.0)
    assert kept(words, frames(2), 12.0 + SPEECH)
    assert [batch.messages for batch in words.give("/a", 12.0 + SECONDS)] == [1, 2]
    assert words.give("/a", 12.0 + SECONDS) == []
    assert (words.give("/b", 12.1 + SECONDS), words.keeps) == ([], False)
    spoken = replay(share(), 10.0)
    assert kept(spoken, frames(1), 12.0)
    assert not kept(spoken, frames(1), 12.1 + SPEECH)


def test_only_the_first_connection_of_a_new_publisher_is_kept_and_only_for_monitors() -> None:
    used = StartupReplay(share(), 10.0)
    used.opened(10.0, alone=False)
    old = StartupReplay(share(), 9.0)
    old.opened(10.0, alone=True)
    returned = replay(share(), 10.0)
    returned.forget()
    returned.opened(10.0, alone=True)
    assert [one.keeps for one in (used, old, returned)] == [False] * 3
