"""Tests of what control measures: bounded, whatever names others choose."""

from appliance.master.measures import MOST_RESOURCES, OTHERS, by_resource, from_zero


def test_sums_by_name() -> None:
    """What several incarnations carried of one topic is one sum."""
    rows = [("/a", (1, 10)), ("/b", (2, 20)), ("/a", (3, 30))]
    assert by_resource(rows) == {"/a": [4, 40], "/b": [2, 20]}


def test_counters_begin_at_zero() -> None:
    """What did not happen yet is 0, so that its first time is an increase."""
    counts = from_zero({("fault", "safe"): 2}, [("fault", "safe"), ("drop", "safe")])
    assert counts == {("fault", "safe"): 2, ("drop", "safe"): 0}


def test_names_without_end() -> None:
    """Past the bound names are not told one by one, and nothing is lost from the sum."""
    sums = by_resource((f"/topic{number}", (1,)) for number in range(MOST_RESOURCES + 500))
    assert len(sums) == MOST_RESOURCES + 1
    assert sums[OTHERS] == [500]
    assert sum(row[0] for row in sums.values()) == MOST_RESOURCES + 500


def test_few_topics_have_a_histogram_of_their_own() -> None:
    """Histograms have many series each, so fewer names are told one by one."""
    sums = by_resource(((f"/topic{number}", (1, 0.5)) for number in range(5)), 3)
    assert sums == {"/topic0": [1, 0.5], "/topic1": [1, 0.5], "/topic2": [1, 0.5], OTHERS: [2, 1.0]}
