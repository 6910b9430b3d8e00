from itertools import pairwise

from appliance.relay.monitors.time_budget import TimeBudget

_SECOND = 10**9


def reductions(budget: TimeBudget, seconds: float) -> list[float]:
    times = [number / 100 for number in range(round(100 * seconds))]
    cut = []
    for time in times:
        now = round((1 + time) * _SECOND)
        if budget.part(now, 100) == 1:
            cut.append(time)
        budget.cut(now, 100)
    return cut


def test_a_sender_of_costly_messages_has_the_whole_budget_ever_more_rarely() -> None:
    cut = reductions(TimeBudget(), 64)
    assert [after - before for before, after in pairwise(cut)] == [4, 8, 16, 16, 16]


def test_one_costly_message_reduces_the_budget_for_four_seconds() -> None:
    budget = TimeBudget()
    for begin in (5 * _SECOND, 13 * _SECOND, 30 * _SECOND):
        budget.cut(begin, 100)
        assert [budget.part(begin + after, 100) for after in (0, 4 * _SECOND - 1, 4 * _SECOND)] == [
            0.1,
            0.1,
            1,
        ]


def test_shorter_messages_keep_the_whole_budget() -> None:
    budget = TimeBudget()
    budget.cut(5 * _SECOND, 100)
    assert [budget.part(5 * _SECOND, size) for size in (49, 50, 1000)] == [1, 0.1, 0.1]
    budget.cut(6 * _SECOND, 40)
    assert [budget.part(6 * _SECOND, size) for size in (19, 20)] == [1, 0.1]
