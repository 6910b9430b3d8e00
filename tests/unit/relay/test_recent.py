"""The latest messages are kept within bounds, and without a gap."""

import pytest

from appliance.relay.frames import Batch, MemoryBudget
from appliance.relay.recent import SECONDS, Recent


def frames(messages: int, size: int = 8) -> Batch:
    """So many frames, in so many bytes."""
    return Batch(memoryview(bytes(size)), messages, 0)


@pytest.mark.parametrize(
    ("added", "kept"),
    [
        ([(1, 8)] * 300, 200),
        ([(150, 8), (100, 8)], 100),
        ([(1, 600 << 10), (1, 600 << 10)], 1),
        ([(1, 8), (201, 8)], 0),
        ([(1, 8), (1, 2 << 20)], 0),
        ([(1, 2 << 20), (1, 8)], 1),
    ],
)
def test_never_more_than_the_bounds(added: list[tuple[int, int]], kept: int) -> None:
    """The oldest go first; after a batch that is too large only what follows it is whole."""
    budget = MemoryBudget(1 << 30)
    recent = Recent(budget)
    for messages, size in added:
        recent.add(frames(messages, size), 0.0)
    batches = recent.give("/a", 0.0)
    assert sum(batch.messages for batch in batches) == kept
    assert budget.used == sum(len(batch.view) for batch in batches)
    recent.clear()
    assert budget.used == 0


def test_nothing_is_kept_when_memory_is_short() -> None:
    """The budget of the process comes first."""
    budget = MemoryBudget(10)
    recent = Recent(budget)
    recent.add(frames(1, 8), 0.0)
    recent.add(frames(1, 8), 0.0)
    assert (len(recent.give("/a", 0.0)), budget.used) == (2, 16)
    recent.add(frames(1, 8), 0.0)
    assert (recent.give("/b", 0.0), budget.used) == ([], 0)


def test_what_is_old_is_not_given_and_the_time_ends() -> None:
    """A second for messages; a second after the first subscriber for everything; to nobody twice."""
    recent = Recent(MemoryBudget(1 << 30))
    recent.add(frames(1), 0.0)
    recent.add(frames(2), 0.5)
    assert not recent.over(1000.0)
    assert [batch.messages for batch in recent.give("/a", SECONDS + 0.1)] == [2]
    recent.add(frames(3), SECONDS + 0.2)
    assert recent.give("/a", SECONDS + 0.3) == []
    assert [batch.messages for batch in recent.give("/b", SECONDS + 0.3)] == [2, 3]
    assert not recent.over(2 * SECONDS + 0.1)
    assert recent.over(2 * SECONDS + 0.2)
    assert recent.give("/c", 2 * SECONDS + 0.2) == []
