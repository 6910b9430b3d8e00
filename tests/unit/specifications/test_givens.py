from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import admin, messages
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.specification_manager import SpecificationManager
from tests.support.site_key import LINE, signed
from tests.unit.specifications.monitor_desk import A, Desk

pytestmark = pytest.mark.anyio

TEXT = """cap() given { double vMax = 0.22 m/s in 0..2; int n = 3 in 1..5; bool on = true; topic command = /cmd; } {
    event e() command std_msgs/String '{}' when (on && n > vMax) { } }"""


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path)
    yield desk
    desk.close()


async def loaded(desk: Desk, **given: Any) -> SpecificationManager:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"cap.rv": TEXT}, given={"cap": given} if given else {}), "eve")
    return monitors


def values(monitors: SpecificationManager) -> dict[str, object]:
    return {state.name: state.value for state in monitors.givens.states(monitors.checked, "cap")}


def stated(monitors: SpecificationManager) -> dict[str, Any]:
    return monitors.statement(0).given.get("cap", {})


@pytest.mark.nightly
async def test_a_value_is_set_recorded_and_kept(desk: Desk) -> None:
    monitors = await loaded(desk)
    before, sha = (
        monitors.tag,
        [one["sha256"] for event, one in desk.trail.heard if event == "specifications loaded"],
    )
    answer = await monitors.give(admin.MonitorGive("cap", {"vMax": "0.3 m/s", "on": False, "n": 3}), "eve")
    assert (answer.changed, monitors.revision, monitors.tag != before) == (["vMax", "on"], 2, True)
    assert desk.sent[-1] == messages.MonitorGiven("cap", {"vMax": 0.3, "on": False, "n": 3})
    [record] = [fields for event, fields in desk.trail.heard if event == "monitor set"]
    assert record["reason"] == "cap: vMax = 0.3 m/s (was 0.22 m/s), on = false (was true)"
    assert (record["values"], record["before"]) == ({"vMax": 0.3, "on": False}, {"vMax": 0.22, "on": True})
    assert sha == [one["sha256"] for event, one in desk.trail.heard if event == "specifications loaded"]
    for restarted in (False, True):
        await desk.store.until_settled()
        again = await desk.monitors(restarted=restarted)
        assert stated(again) == {"vMax": 0.3, "on": False, "n": 3}
        assert values(again) == {"vMax": 0.3, "n": 3, "on": False, "command": "/cmd"}
    count = len(desk.sent)
    assert (await again.give(admin.MonitorGive("cap", {"vMax": 0.3}), "eve")).changed == []
    assert len(desk.sent) == count


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("vMax", 3, "vMax=3 is outside of 0..2 m/s: give a number in this range"),
        ("vMax", "nan", "outside of 0..2 m/s"),
        ("vMax", "1 km/h", "outside of 0..2 m/s"),
        ("vMax", True, "outside of 0..2 m/s"),
        ("n", 2.5, "give a whole number"),
        ("n", "1e999", "give a whole number"),
        ("on", 1, "is not true or false"),
        ("w", 1, "cap has no given w; there are: vMax, n, on, command"),
        ("command", "/x", "--set cap.command=/x"),
    ],
)
async def test_a_wrong_value_changes_nothing(desk: Desk, name: str, value: Any, why: str) -> None:
    monitors = await loaded(desk)
    with pytest.raises(SpecificationsRefusedError) as caught:
        await monitors.give(admin.MonitorGive("cap", {"vMax": 1, name: value}), "eve")
    assert why in caught.value.findings[-1]
    assert (values(monitors)["vMax"], stated(monitors)) == (0.22, {})


async def test_a_load_sets_topics_and_constants_or_nothing(desk: Desk) -> None:
    monitors = await loaded(desk, command="/base/cmd", vMax="0.5")
    assert (set(monitors.checked.topics["cap"]), stated(monitors)) == ({"/base/cmd"}, {"vMax": 0.5})
    wrong: list[dict[str, dict[str, messages.GivenValue]]] = [
        {"cap": {"vMax": 9}}, {"cap": {"vMax": "/x"}}, {"gap": {"vMax": 1}}, {"gap": {"command": "/x"}},
    ]  # fmt: skip
    for values_given in wrong:
        order = admin.MonitorLoad({"cap.rv": TEXT}, given=values_given)
        with pytest.raises(SpecificationsRefusedError):
            await monitors.load(order, "eve")
        with pytest.raises(SpecificationsRefusedError):
            await monitors.attempt(admin.MonitorTry(order), "eve")
    await desk.store.until_settled()
    again = await desk.monitors()
    assert set(again.checked.topics["cap"]) == {values(again)["command"]} == {"/base/cmd"}
    await again.roll_back(admin.MonitorRollback(1), "eve")
    assert "cap" not in again.checked.monitors
    await again.roll_back(admin.MonitorRollback(2), "eve")
    assert (set(again.checked.topics["cap"]), stated(again)) == ({"/base/cmd"}, {"vMax": 0.5})


async def test_topics_of_the_folders_files_survive_a_reload_and_a_start(desk: Desk) -> None:
    (desk.folder / "cap.rv").write_text(TEXT)
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"cap.rv": TEXT}, given={"cap": {"command": "/base/cmd"}}), "eve")
    await monitors.reload(admin.MonitorReload(), "eve")
    assert (set(monitors.checked.topics["cap"]), monitors.differs_from_folder) == ({"/base/cmd"}, False)
    await desk.store.until_settled()
    (desk.folder / "cap.rv").write_text(TEXT + "// edited")
    assert set((await desk.monitors()).checked.topics["cap"]) == {"/base/cmd"}


async def test_a_text_that_does_not_allow_a_value_gets_its_default(desk: Desk) -> None:
    monitors = await loaded(desk, vMax=1.5, n=4)
    done = await monitors.load(admin.MonitorLoad({"cap.rv": TEXT.replace("0..2", "0..1")}), "eve")
    assert [(one.file, one.line) for one in done.warnings if "vMax=1.5 no longer applies" in one.text]
    (record,) = (fields for event, fields in desk.trail.heard if "no longer applies" in fields["reason"])
    assert (record["resource"], record["before"], record["values"]) == ("cap", {"vMax": 1.5}, {"vMax": 0.22})
    assert stated(monitors) == {"n": 4}
    assert [one["reason"] for event, one in desk.trail.heard if event == "monitor set"][-1].startswith(
        "cap: vMax=1.5"
    )
    await monitors.remove(admin.MonitorRemove(["cap"]), "eve")
    await monitors.load(admin.MonitorLoad({"cap.rv": TEXT}), "eve")
    assert stated(monitors) == {}


async def test_with_site_keys_a_load_cannot_replace_a_signed_topic(desk: Desk) -> None:
    (desk.folder / "a.rv.sig").write_text(signed(A))
    monitors = await desk.monitors(site_keys=[LINE])
    order = admin.MonitorLoad(
        {"cap.rv": TEXT}, signatures={"cap.rv": signed(TEXT)}, given={"cap": {"command": "/x"}}
    )
    with pytest.raises(SpecificationsRefusedError, match="the site signs the topics"):
        await monitors.load(order, "eve")
    await monitors.load(admin.MonitorLoad({"cap.rv": TEXT}, signatures={"cap.rv": signed(TEXT)}), "eve")
    assert (await monitors.give(admin.MonitorGive("cap", {"vMax": 1}), "eve")).changed == ["vMax"]


async def test_the_record_of_a_load_has_the_text_and_the_values_before_and_after(desk: Desk) -> None:
    monitors = await loaded(desk, vMax=1.5)
    await monitors.switch(admin.MonitorSwitch(["cap"], False), "eve")
    await monitors.load(admin.MonitorLoad({"cap.rv": TEXT.replace("0.22", "0.3")}), "ann")
    records = [fields for event, fields in desk.trail.heard if event == "specifications loaded"]
    assert records[-1]["earlier_sha256"] == records[-2]["sha256"] != records[-1]["sha256"]
    assert [line[:1] for line in records[-1]["diff"][-2:]] == ["-", "+"]
    assert "0.22" in records[-1]["diff"][-2] and "0.3" in records[-1]["diff"][-1]
    assert [record["off"] for record in records[-2:]] == [{}, {"cap": "disabled"}]
    (given,) = (fields for event, fields in desk.trail.heard if event == "monitor set")
    assert (given["before"], given["values"]) == ({"vMax": 0.22}, {"vMax": 1.5})
    (disabled,) = (fields for event, fields in desk.trail.heard if event == "monitor disabled")
    assert disabled["earlier"] == "enabled"
