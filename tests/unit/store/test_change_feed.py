from appliance.store.change_feed import ChangeFeed
from appliance.store.changes import Encoded


def change(number: int, size: int = 10) -> Encoded:
    return Encoded(number, bytes(size))


def numbers(changes: list[Encoded] | None) -> list[int] | None:
    return None if changes is None else [one.number for one in changes]


def test_a_consumer_gets_all_changes_after_a_number_in_order() -> None:
    calls: list[int] = []
    feed = ChangeFeed(7, lambda: calls.append(1), 1000)
    assert numbers(feed.after(7, 100)) == []
    feed.add([change(8), change(9)])
    feed.add([change(10, 50)])
    assert len(calls) == 2
    assert numbers(feed.after(7, 100)) == [8, 9, 10]
    assert numbers(feed.after(7, 20)) == [8, 9]
    assert numbers(feed.after(7, 19)) == [8]
    assert numbers(feed.after(9, 1)) == [10]
    assert numbers(feed.after(10, 100)) == []
    assert feed.after(6, 100) is feed.after(11, 100) is None
    assert feed.size == 70


def test_a_consumer_that_is_away_for_long_learns_that_changes_are_missing() -> None:
    feed = ChangeFeed(0, lambda: None, 100)
    for number in range(1, 1001):
        feed.add([change(number)])
    assert feed.after(989, 1000) is None
    assert numbers(feed.after(990, 1000)) == list(range(991, 1001))
    feed.add([change(1001, 5000)])
    assert feed.after(999, 1000) is None
    assert numbers(feed.after(1000, 1000)) == [1001]
    feed.add([change(1002)])
    assert feed.after(1000, 1000) is None
    assert numbers(feed.after(1001, 1000)) == [1002]
    assert feed.size == 10


def test_changes_that_the_consumer_has_are_dropped() -> None:
    feed = ChangeFeed(0, lambda: None, 1000)
    feed.add([change(1), change(2), change(3)])
    feed.release(2)
    assert feed.after(1, 100) is None
    assert numbers(feed.after(2, 100)) == [3]
    assert feed.size == 10
    feed.release(1)
    assert numbers(feed.after(2, 100)) == [3]


def test_a_consumer_that_is_there_gets_more_room() -> None:
    feed = ChangeFeed(0, lambda: None, 100)
    feed.keep(400)
    feed.add([Encoded(number, b"x" * 100) for number in range(1, 5)])
    assert feed.size == 400
    feed.keep(100)
    assert feed.size == 100
    assert feed.after(2, 1) is None
