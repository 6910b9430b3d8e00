import ast

from distribution import doubles, interfaces
from distribution.counts import over_their_limits
from distribution.interfaces import _lines_with_any, _new_aliases, modules_that_features_import


def test_no_interface_grows() -> None:
    """A change that lowers a count lowers its limit."""
    found = over_their_limits("distribution.interfaces", interfaces.COUNTS)
    assert not found, "\n".join(found)


def test_tests_get_no_further_doubles() -> None:
    """A change that lowers a count lowers its limit."""
    found = over_their_limits("distribution.doubles", doubles.COUNTS)
    assert not found, "\n".join(found)


def test_each_goal_is_below_its_limit() -> None:
    assert all(count.goal <= count.limit for count in (*interfaces.COUNTS, *doubles.COUNTS))


def test_an_import_by_string_counts() -> None:
    assert "appliance.control.operators.queries" not in modules_that_features_import()
    assert "appliance.channel.admin" in modules_that_features_import()


def test_a_name_that_stands_for_any_counts_with_each_use() -> None:
    defining = ast.parse("from typing import Any\nTerm = Any\nOther = Term | None\nRow = list[Any]\n")
    using = ast.parse(
        "from rosmop import made\nfrom rosmop.made import Other as O\nx: O\ny: made.Term\nTerm: int\n"
    )
    aliases: set[str] = set()
    for _ in range(2):  # `Other` stands for `Any` because `Term` does
        aliases |= set(_new_aliases("rosmop.made", defining, aliases))
    assert aliases == {"rosmop.made.Term", "rosmop.made.Other"}
    assert sorted(_lines_with_any("rosmop.made", defining, aliases)) == [2, 3, 4]
    assert sorted(_lines_with_any("rosmop.used", using, aliases)) == [3, 4]
