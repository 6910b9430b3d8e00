"""Rights with a time: `until` and `during`, in each section, over changes of the clocks."""

import ipaddress
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest

from appliance.policy.cases import run_cases
from appliance.policy.host_names import HostNames
from appliance.policy.hours import changes_of, closed_times
from appliance.policy.model import Category, Request, address_of
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rate_limits import LimitScope

HOST, BERLIN = address_of("10.0.0.7"), ZoneInfo("Europe/Berlin")
HOURS = """
[Hours]
zone = Europe/Berlin
night = 22:00-06:00
shift = mon-fri 06:00-14:00, sat 08:00-12:00
whole = sat-sun 00:00-24:00
early = 02:30-04:00
late = 00:00-02:30
"""
FULL = """
[Groups]
{groups}
[Nodes]
default = * {during}
[Publishers]
default = {word}
[Subscribers]
default = {word}
[Commands]
default = {word}
[Services]
default = {word}
[Clients]
default = {word}
[Parameters]
read default = {word}
write default = {word}
"""


def at(text: str) -> float:
    return datetime.fromisoformat(text).replace(tzinfo=BERLIN).timestamp()


def policy(word: str, now: str | None, groups: str = "other = 10.0.0.8") -> Policy:
    during = word.partition(" ")[2] if "other" not in word else ""
    text = FULL.format(word=word, groups=groups, during=during) + HOURS
    return compile_policy(text, file="site.ini", now=None if now is None else at(now))


def granted(some: Policy, category: Category = Category.PUBLISH) -> bool:
    name = "getPid" if category is Category.COMMAND else "/x"
    return some.decide(Request(HOST, "/n", category, name)).allowed


TIMES = [  # a time, then moments with and without the right
    ("until 2026-12-05", "2026-12-05T23:59:59", "2026-12-06T00:00:00"),
    ("until 2026-12-05T18:00", "2026-12-05T17:59", "2026-12-05T18:00"),
    ("during night", "2026-12-01T22:00", "2026-12-01T21:59"),
    ("during night", "2026-12-02T05:59", "2026-12-02T06:00"),
    ("during shift", "2026-12-04T06:00", "2026-12-05T06:00"),
    ("during shift", "2026-12-05T08:00", "2026-12-06T08:00"),
    ("during whole", "2026-12-06T00:00", "2026-12-07T00:00"),
    ("during night until 2026-12-01", "2026-12-01T23:59", "2026-12-02T00:00"),
    ("until 2026-12-01 during night", "2026-12-01T00:00", "2026-12-01T12:00"),
]


@pytest.mark.parametrize(("time", "within", "outside"), TIMES)
@pytest.mark.parametrize("place", ["entry", "group"])
def test_a_right_is_granted_within_its_time_alone(time: str, within: str, outside: str, place: str) -> None:
    """In each section, for a host and for the member of a group, whatever the category."""
    word, groups = (
        (f"10.0.0.7 {time}", "") if place == "entry" else ("some", f"some = 10.0.0.8, 10.0.0.7 {time}")
    )
    for category in set(Category) - {Category.NODE} if place == "entry" else Category:
        section = FULL.replace("* {during}", "{word}").format(word=word, groups=groups, during="") + HOURS
        for moment, allowed in ((within, True), (outside, False), (None, False)):
            now = None if moment is None else at(moment)
            some = compile_policy(section, file="site.ini", now=now)
            assert granted(some, category) is allowed, (category, moment)
            assert some.knows(HOST) is allowed
            assert some.times_of(HOST, some.named), "the host has a time"


def test_a_denial_outside_the_time_gives_the_reason() -> None:
    told = {
        now: policy("10.0.0.7 during night until 2026-12-05, other", now)
        for now in (None, "2026-12-01T12:00")
    }
    unset, day = (one.decide(Request(HOST, "/n", Category.PUBLISH, "/x")) for one in told.values())
    limit = "during night (22:00-06:00 Europe/Berlin) until 2026-12-05"
    assert f"now, because its right {limit} waits until the clock is set: only" in unset.reason
    assert day.told == (
        f"10.0.0.7 is not among the hosts that may publish /x now, because its right {limit} is not now,"
        " by [Publishers] default (site.ini:7)"
    )
    ended = policy("10.0.0.7 until 2026-12-05", "2026-12-07")
    assert (
        ended.why_unnamed(HOST)
        == "no rule of the policy names 10.0.0.7 now: its right until 2026-12-05 has ended"
    )
    [warning] = [one for one in ended.warnings if one.line == 7]
    assert warning.text == "10.0.0.7 until 2026-12-05 has ended: it grants nothing, remove it"


@pytest.mark.parametrize(
    ("hours", "date", "begin", "end"),
    [
        (
            "early",
            "2026-03-29",
            "01:30",
            "02:00",
        ),  # 02:30 does not exist: from 03:30, which is 01:30 UTC, to 04:00
        ("late", "2026-03-29", "23:00", "00:30"),  # from 00:00 to 01:30
        ("early", "2026-10-25", "01:30", "03:00"),  # 02:30 is twice: from the second
        ("late", "2026-10-25", "22:00", "00:30"),  # to the first
    ],
)
def test_a_change_of_the_clocks_gives_a_right_no_more_time(
    hours: str, date: str, begin: str, end: str
) -> None:
    midnight = at(f"{date}T00:00")
    moments = [midnight + 60.0 * minute for minute in range(-60, 6 * 60)]
    times = policy(f"10.0.0.7 during {hours}", None).times
    within = [now for now in moments if not closed_times(times, now, {})]
    assert [f"{datetime.fromtimestamp(one, UTC):%H:%M}" for one in (within[0], within[-1] + 60.0)] == [
        begin,
        end,
    ]
    assert changes_of(times, midnight - 60.0) == {within[0]}
    assert changes_of(times, within[0]) >= {within[-1] + 60.0}


def test_another_clock_ends_a_right_before_the_system_clock_and_keeps_one_that_it_counts() -> None:
    end = at("2026-12-06T00:00")
    for now, passed, allowed in (
        ("2026-12-01T00:00", True, False),  # the system clock was set back
        ("2026-12-07T00:00", False, True),  # this appliance took over, and its clock is ahead
    ):
        some = policy("10.0.0.7 until 2026-12-05", None).at(at(now), {end: passed})
        assert granted(some) is allowed
    night = at("2026-12-02T06:00")
    assert not granted(policy("10.0.0.7 during night", None).at(night - 60.0, {night: True}))


def test_the_longest_right_wins_and_a_limit_holds_at_any_hour() -> None:
    both = policy("10.0.0.7 until 2026-12-01, 10.0.0.0/24 during night, other", "2026-12-03T23:00")
    assert granted(both)
    [rule] = both.rules(Category.PUBLISH)
    assert both.open_to(HOST, rule.hosts) == "during night (22:00-06:00 Europe/Berlin)"
    always = policy("10.0.0.7 until 2026-12-01, 10.0.0.0/24", "2026-12-03T23:00")
    assert granted(always)
    assert always.times_of(HOST, always.rules(Category.PUBLISH)[0].hosts) == []
    text = FULL.format(word="*", during="", groups="some = 10.0.0.7 until 2026-12-01")
    limited = compile_policy(
        f"{text}\n[Limits]\n/x = publisher some 5 Hz", file="site.ini", now=at("2026-12-03")
    )
    assert limited.limit(LimitScope.PUBLISHER, "/x", HOST).messages == 5.0


def test_a_host_has_its_part_in_a_command_group_within_its_time_alone() -> None:
    text = (
        FULL.format(word="*", during="", groups="")
        + "[Authority]\nbase = /x\ntake base = 10.0.0.7 until 2026-12-05"
    )
    for now, claims in (("2026-12-06T00:59", True), ("2026-12-06T01:00", False)):
        some = compile_policy(text, file="site.ini", now=at(now))
        assert some.may_command("/x", HOST) is claims
        assert granted(some) is claims


def test_a_group_may_have_the_name_of_a_word_for_times() -> None:
    """A policy of an earlier version means what it did."""
    old = compile_policy(
        FULL.format(word="until during", during="", groups="until = 10.0.0.7\nduring = 10.0.0.9"), file="f"
    )
    assert granted(old)
    assert not old.times


def test_names_of_groups_hold_at_any_time() -> None:
    some = policy("some", "2026-12-03T12:00", "some = 10.0.0.7 during night, 10.0.0.8 until 2020-01-01")
    names = HostNames.of(some.text, {}, ())
    assert names.networks("some") == tuple(map(ipaddress.ip_network, ("10.0.0.7", "10.0.0.8")))


CASES = """
cases:
- host: 10.0.0.7
  node: /n
  allow: [publish /x]
- host: 10.0.0.7
  node: /n
  at: 2026-12-05T12:00
  deny: [publish /x]
- host: 10.0.0.7
  node: /n
  at: 2026-12-04T23:00
  {verdict}: [publish /x]
"""


@pytest.mark.parametrize("verdict", ["allow", "deny"])
def test_a_case_is_decided_at_its_time_and_without_one_at_any(verdict: str) -> None:
    some = policy("10.0.0.7 during night until 2026-12-05", "2030-01-01T00:00")
    results = run_cases(some, CASES.format(verdict=verdict), "site.ini.tests.yaml")
    assert [result.passed for result in results] == [True, True, verdict == "allow"]
