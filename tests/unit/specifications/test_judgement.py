from collections.abc import Sequence

import pytest

from appliance.specifications.checking import check
from appliance.specifications.in_force import Consent, InForce, switch
from appliance.specifications.judgement import Judge, beside_broken, broken_files, in_shadow
from appliance.specifications.live_topics import LiveType
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.switches import SHADOW, Switches

pytestmark = pytest.mark.anyio

GOOD = "Good() { event e() /t std_msgs/String '{}' { } }"
SOURCES = Sources({"good.rv": GOOD, "bad.rv": "bad"})
NOW = InForce(
    1, SOURCES, CheckedSpecifications(monitors={"Good": "good.rv"}, left_out={"bad.rv": "an error"})
)


async def refuse_bad(
    sources: Sources, _keys: Sequence[str], left_out: Sequence[str] = ()
) -> CheckedSpecifications:
    """Refuse the file with an error unless it may be left out."""
    if "bad.rv" in sources.files and "bad.rv" not in left_out:
        raise SpecificationsRefusedError(["bad.rv:1:1: error: it is bad"])
    return CheckedSpecifications(monitors={"Good": "good.rv"}, left_out=dict.fromkeys(left_out, "an error"))


def judge_of(**live: LiveType) -> Judge:
    published = {f"/{topic}": {"/node": kind} for topic, kind in live.items()}
    return Judge(lambda: published, held=set[str], moved=lambda _coming: set[str]())


async def test_a_file_that_does_nothing_stays_idle_until_it_is_loaded() -> None:
    checked = await beside_broken(NOW, refuse_bad, (), SOURCES)
    assert checked.left_out == broken_files(NOW) == {"bad.rv": "an error"}
    assert [warning for warning in checked.warnings if "bad.rv:1:1: warning: it does nothing" in warning]
    with pytest.raises(SpecificationsRefusedError) as refused:
        await beside_broken(NOW, refuse_bad, (), SOURCES, loaded={"bad.rv"})
    assert refused.value.findings == ["bad.rv:1:1: error: it is bad"]


async def test_a_changed_or_removed_file_is_no_longer_idle() -> None:
    with pytest.raises(SpecificationsRefusedError):
        await beside_broken(NOW, refuse_bad, (), SOURCES.with_files(Sources({"bad.rv": "worse"})))
    checked = await beside_broken(NOW, refuse_bad, (), SOURCES.without({"bad.rv"}))
    assert (checked.left_out, checked.warnings) == ({}, ())


async def test_a_cut_topic_needs_consent() -> None:
    sources = Sources({"good.rv": GOOD})
    coming, judge = InForce(2, sources, check(sources, ())), judge_of(t=LiveType("std_msgs/Int32"))
    with pytest.raises(SpecificationsRefusedError, match="/node publishes /t as std_msgs/Int32"):
        judge.judge(InForce(), coming, (), Consent())
    (warning,) = judge.judge(InForce(), coming, (), Consent(force=True))
    assert "std_msgs/Int32" in warning
    assert judge.judge(InForce(), coming, in_shadow(switch(coming, ["Good"], SHADOW)), Consent()) != []
    assert judge_of(t=LiveType("std_msgs/String")).judge(InForce(), coming, (), Consent()) == []


async def test_monitors_in_shadow_are_those_of_the_value_and_of_the_named_files() -> None:
    both = InForce(
        1, SOURCES, CheckedSpecifications(monitors={"Good": "good.rv", "Other": "other.rv"}), Switches("all")
    )
    assert in_shadow(both) == set()
    assert in_shadow(both, ["other.rv"]) == {"Other"}
    assert in_shadow(switch(both, ["Good"], SHADOW), ["other.rv"]) == {"Good", "Other"}
