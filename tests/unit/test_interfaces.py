from distribution.interfaces import COUNTS, modules_that_features_import


def test_no_interface_grows() -> None:
    """`python -m distribution.interfaces NAME` lists the members of a count. Lower a limit with the count."""
    numbers = {count.name: len(count.members()) for count in COUNTS}
    assert [count.name for count in COUNTS if count.goal and not numbers[count.name]] == [], (
        "it counts nothing"
    )
    assert {count.name: numbers[count.name] for count in COUNTS if numbers[count.name] > count.limit} == {}


def test_each_goal_is_below_its_limit() -> None:
    assert all(count.goal <= count.limit for count in COUNTS)


def test_an_import_by_string_counts() -> None:
    assert "appliance.control.operators.queries" not in modules_that_features_import()
    assert "appliance.channel.admin" in modules_that_features_import()
