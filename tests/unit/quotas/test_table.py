from appliance.quotas import table
from appliance.quotas.table import (
    LIMITED_TOPIC,
    NODE_CALLS_UNDER_WAY,
    PROBES,
    QUOTA_ROWS,
    RELAY_MESSAGE,
    RVMASTER_CONNECTIONS,
    RVMASTER_FAREWELLS,
    RVMASTER_REQUESTS,
    QuotaRow,
)
from appliance.relay.monitors.time_budget import TimeBudget
from distribution.generated_pages import all_rows, bound_of

WITHOUT_NUMBER = {RVMASTER_FAREWELLS.thing, LIMITED_TOPIC.thing}


def test_every_row_is_on_the_page() -> None:
    assert tuple(row for row in vars(table).values() if isinstance(row, QuotaRow)) == QUOTA_ROWS


def test_each_row_fits_an_honest_use_or_says_what_it_notices() -> None:
    for row in all_rows():
        use, needs, _of, beyond = row.margin
        assert use or row is RVMASTER_FAREWELLS, row.thing  # no honest host is rejected
        assert needs <= bound_of(row) or beyond, f"{use} needs {needs} of {bound_of(row)} {row.thing}"
        assert needs or "wait" in row.at_limit or row.thing in WITHOUT_NUMBER, row.thing


def test_only_turns_are_too_few_for_an_honest_use() -> None:
    """Beyond these bounds work waits for its turn, or costs a connection: nothing of an honest host is rejected."""
    short = [row for row in QUOTA_ROWS if row.margin.needs > bound_of(row)]
    assert short == [RVMASTER_CONNECTIONS, RVMASTER_REQUESTS, PROBES, NODE_CALLS_UNDER_WAY]


def test_the_reduction_of_a_message_over_budget_is_that_of_the_relay() -> None:
    budget = TimeBudget()
    budget.cut(0, 1)
    seconds = next(second for second in range(60) if budget.part(second * 10**9, 1) == 1)
    assert f"for {seconds} s, up to" in RELAY_MESSAGE.at_limit
