import pytest

from appliance.relay.connections.startup_replay import APPEARED, SECONDS, SPEECH, StartupReplay
from appliance.relay.transport.frames import Batch
from tests.support.relay_memory import share


def frames(messages: int, size: int = 8) -> Batch:
    return Batch(memoryview(bytes(size)), messages, 0)


@pytest.mark.parametrize(
    "added",
    [[(1, 8)] * 201, [(150, 8), (51, 8)], [(1, 600 << 10), (1, 600 << 10)], [(201, 8)], [(1, 2 << 20)]],
)
def test_never_more_than_the_bounds(added: list[tuple[int, int]]) -> None:
    """Beyond the limits all first messages are dropped, so that no gap is left."""
    memory = share()
    words = StartupReplay(memory, 0.0)
    assert [words.add(frames(*one), 0.0) for one in added] == [True] * (len(added) - 1) + [False]
    words.forget()
    assert memory.used == 0


def test_nothing_is_kept_when_the_quota_of_its_host_is_spent() -> None:
    memory = share(16)
    words = StartupReplay(memory, 0.0)
    assert [words.add(frames(1), 0.0) for _ in range(3)] == [True, True, False]
    assert memory.used == 16


def test_the_time_ends_for_speech_for_keeping_and_for_appearing() -> None:
    words = StartupReplay(share(), 10.0)
    assert (words.over(10.0 + APPEARED), words.over(10.1 + APPEARED)) == (False, True)
    assert words.add(frames(1), 12.0)
    assert words.add(frames(2), 12.0 + SPEECH)
    assert (words.over(12.0 + SECONDS), words.over(12.1 + SECONDS)) == (False, True)
    assert [batch.messages for batch in words.give("/a")] == [1, 2]
    assert words.give("/a") == []
    assert not words.add(frames(1), 12.1 + SPEECH)
