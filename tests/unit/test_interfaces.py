from distribution import doubles, interfaces
from distribution.counts import over_their_limits
from distribution.interfaces import modules_that_features_import


def test_no_interface_grows() -> None:
    """`python -m distribution.interfaces NAME` lists the members of a count. Lower a limit with the count."""
    assert over_their_limits(interfaces.COUNTS) == {}


def test_tests_get_no_further_doubles() -> None:
    """`python -m distribution.doubles NAME` lists the members of a count. Lower a limit with the count."""
    assert over_their_limits(doubles.COUNTS) == {}


def test_each_goal_is_below_its_limit() -> None:
    assert all(count.goal <= count.limit for count in (*interfaces.COUNTS, *doubles.COUNTS))


def test_an_import_by_string_counts() -> None:
    assert "appliance.control.operators.queries" not in modules_that_features_import()
    assert "appliance.channel.admin" in modules_that_features_import()
