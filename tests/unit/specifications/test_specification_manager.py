import asyncio
import hashlib
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.base.withdrawal import WithdrawnError, withdrawable
from appliance.channel import admin, messages
from appliance.channel.alarms import open_alarms
from appliance.channel.answers.status import Status
from appliance.control.assembly.monitor_states import monitors_status, states_of
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    MonitorsChangedError,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_manager import (
    DryRunUnderWayError,
    SpecificationManager,
)
from appliance.specifications.specification_revisions import text_of
from tests.support.answers import example
from tests.support.site_key import LINE, NAME, OTHER_KEY, OTHER_LINE, signed
from tests.support.waiting import until
from tests.unit.specifications.monitor_desk import A, B, C, Desk, Dialogue, SlowCompiler
from tests.unit.transcripts import played, transcripts

pytestmark = pytest.mark.anyio


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path)
    yield desk
    desk.close()


ORDERS = transcripts(Path(__file__).with_name("orders.txt"))


@pytest.mark.nightly
@pytest.mark.parametrize("title", ORDERS, ids=ORDERS)
async def test_orders(desk: Desk, title: str) -> None:
    assert await played(ORDERS[title], Dialogue(desk).say) == ORDERS[title]


async def test_a_monitor_that_is_disabled_for_a_time_comes_back(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.shadow(admin.MonitorShadow(["a"], True), "eve")
    for state, seconds in (("shadow", 0.05), (True, 0.05)):
        await monitors.shadow(admin.MonitorShadow(["a"], state is not True), "eve")
        tag = monitors.tag
        await monitors.switch(admin.MonitorSwitch(["a"], False, for_seconds=seconds), "eve")
        assert monitors.until("a") is not None
        await until(lambda: monitors.switches.states["a"] is not False)
        assert (monitors.switches.states["a"], monitors.until("a")) == (state, None)
        assert monitors.tag != tag
    rows = [row for row in desk.trail.heard if row[0] in {"monitor disabled", "monitor enabled"}]
    assert [row[0] for row in rows] == [
        "monitor disabled", "monitor enabled", "monitor disabled", "monitor enabled"
    ]  # fmt: skip


@pytest.mark.parametrize(("setting", "state"), [("none", True), ("all", True), ("shadow", "shadow")])
async def test_a_load_that_enables_ends_no_shadow_mode(desk: Desk, setting: str, state: object) -> None:
    monitors = await desk.monitors(setting)
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve", enable=True)
    assert monitors.switches.states["b"] == state
    assert monitors.switches.is_enabled("a") is (setting == "all")
    again = await desk.monitors(setting, restarted=True)
    assert again.switches.states["b"] == state


@pytest.mark.nightly
async def test_a_time_off_survives_restarts_and_ends_with_a_switch(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    switched = await monitors.switch(admin.MonitorSwitch(["a", "b"], False, for_seconds=3600), "eve")
    assert switched.until == pytest.approx(monitors.until("b"), abs=1)
    assert switched.until == pytest.approx(time.time() + 3600, abs=60)
    again = await desk.monitors()
    assert again.until("a") == pytest.approx(monitors.until("a"), abs=5)
    await again.switch(admin.MonitorSwitch(["a"], False, for_seconds=0.05), "eve")  # shorter than before
    await again.remove(admin.MonitorRemove(["b"]), "eve")
    assert again.until("b") is None
    desk.kill()
    later = await desk.monitors(restarted=True)
    await until(lambda: later.switches.is_enabled("a"))
    await later.switch(admin.MonitorSwitch(["a"], False, for_seconds=3600), "eve")
    endless = await later.switch(admin.MonitorSwitch(["a"], False), "eve")
    assert (endless.names, endless.until) == (["a"], None)
    assert (later.switches.states["a"], later.until("a")) == (False, None)


async def test_a_monitor_that_was_disabled_for_a_time_is_enabled_after_a_rollback(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    await monitors.switch(admin.MonitorSwitch(["b"], False, for_seconds=3600), "eve")
    whole = monitors.revision
    await monitors.remove(admin.MonitorRemove(["b"]), "eve")
    await monitors.roll_back(admin.MonitorRollback(whole), "eve")
    assert (monitors.switches.states["b"], monitors.until("b")) == (True, None)


async def test_a_load_whose_client_gave_up_never_takes_effect(desk: Desk) -> None:
    gone = False
    monitors = await desk.monitors()
    desk.check = slow = SlowCompiler()

    async def order(*changes: Callable[[], Any]) -> None:
        with withdrawable(lambda: gone):
            for change in changes:
                await change()

    load = partial(monitors.load, admin.MonitorLoad({"b.rv": B}, shadow=True, confirm_within=60.0), "eve")
    first = asyncio.ensure_future(order(load))
    await slow.begun.wait()
    switch = partial(monitors.switch, admin.MonitorSwitch(["a"], False), "eve")
    second = asyncio.ensure_future(order(switch))
    await asyncio.sleep(0)
    desk.sent.clear()
    tag, gone = monitors.tag, True
    slow.goes_on.set()
    for withdrawn in (first, second):
        with pytest.raises(WithdrawnError):
            await withdrawn
    assert (monitors.tag, monitors.names(), monitors.switches.states) == (tag, ["a"], {"a": True})
    assert (monitors.confirm_by, monitors.switches.said, desk.sent) == (None, {}, [])
    gone = False
    await order(load)
    assert monitors.names() == ["a", "b"]


async def test_a_client_has_one_dry_run_at_a_time(desk: Desk) -> None:
    desk.try_out = slow = SlowCompiler()
    monitors = await desk.monitors()
    shadowed = admin.MonitorTry(admin.MonitorLoad({"b.rv": B}))
    first = asyncio.ensure_future(monitors.attempt(shadowed, "eve"))
    await slow.begun.wait()
    with pytest.raises(DryRunUnderWayError, match="your previous dry run is still running"):
        await monitors.attempt(shadowed, "eve")
    other = asyncio.ensure_future(monitors.attempt(shadowed, "adam"))
    slow.goes_on.set()
    assert [(await one).added for one in (first, other)] == [["b.rv"]] * 2
    again = await monitors.attempt(admin.MonitorTry(admin.MonitorReplace("a", B)), "eve")
    assert (again.loaded, again.changed, again.monitors, monitors.names()) == (False, ["a.rv"], ["b"], ["a"])


async def test_records_of_loads_have_the_hash_of_the_files_and_of_what_was_compiled(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    await monitors.reload(admin.MonitorReload(prune=True), "operator")
    (desk.folder / "b.rv").write_text(B)
    lines = [
        f"{hashlib.sha256((desk.folder / name).read_bytes()).hexdigest()}  {name}\n"
        for name in ("a.rv", "b.rv")
    ]
    of_all = [hashlib.sha256("".join(some).encode()).hexdigest() for some in (lines[:1], lines, lines[:1])]
    loaded = [fields for event, fields in desk.trail.heard if event == "specifications loaded"]
    assert [fields["sha256"] for fields in loaded] == of_all
    compiled = [fields["compiled_sha256"] for fields in loaded]
    assert compiled[0] == compiled[2] != compiled[1]


async def test_a_switch_is_answered_when_the_relay_has_carried_it_out(desk: Desk) -> None:
    monitors = await desk.monitors()
    monitors.received(messages.SpecificationsTaken(1, [], ["a"], monitors.statement(0).statement))
    for order in (
        monitors.switch(admin.MonitorSwitch(["a"], False), "eve"),
        monitors.resume(admin.MonitorResume(["a"]), "eve"),
    ):
        desk.carried_out.clear()
        told = len(desk.sent)
        task = asyncio.ensure_future(order)
        while len(desk.sent) == told:
            await asyncio.sleep(0)
        await desk.store.until_settled()
        for _ in range(5):
            await asyncio.sleep(0)
        assert not task.done()
        desk.carried_out.set()
        assert (await task).names == ["a"]


async def test_one_of_two_concurrent_changes_is_made(desk: Desk) -> None:
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors()
    monitors.received(messages.SpecificationsTaken(1, [], ["b"]))
    tag = monitors.tag
    done = await asyncio.gather(
        monitors.load(admin.MonitorLoad({"c.rv": A.replace("a()", "c()")}, expected=tag), "adam"),
        monitors.switch(admin.MonitorSwitch(["a"], False, expected=tag), "eve"),
        monitors.resume(admin.MonitorResume(["b"], expected=tag), "eve"),
        monitors.take_bundle(Sources(), "fleet", "of the bundle", tag),
        return_exceptions=True,
    )
    assert [isinstance(one, MonitorsChangedError) for one in done] == [False, True, True, True]
    assert monitors.switches.is_enabled("a")
    assert messages.MonitorResumed("b") not in desk.sent


async def test_actions_of_monitors_are_recorded_with_their_count(desk: Desk) -> None:
    monitors = await desk.monitors()
    told = [
        messages.MonitorEvent("change", "a", "k", "/chatter", 1, "a changed", {}, b"\x01", b"\x02", 1),
        messages.MonitorEvent("change", "a", "k", "/chatter", 2, "", {}, count=41),
        messages.MonitorEvent("fault", "a", "k", "/chatter", 3, "a.rv:1:2: division by zero", {"line": 1}),
    ]
    together = {"changed_by": ["a.e", "b.e", "b.f"]}
    told += [
        messages.MonitorEvent(
            "change", "b", "k", "/cmd", 4, "a and b changed a message", together, b"\x01", b"\x02", 1
        ),
        messages.MonitorEvent("change", "b", "k", "/cmd", 5, "a.e, b.e, b.f", together, count=9),
    ]
    monitors.received(messages.MonitorsReported(told, 5))
    changed = [fields for event, fields in desk.trail.heard if event == "message changed"]
    assert (changed[0]["before"], changed[0]["after"], changed[1]["count"]) == ("01", "02", 41)
    assert changed[3]["more"] == together
    assert (monitors.records.counts["change", "a"], monitors.records.counts["change", "b"]) == (52, 10)
    assert (monitors.records.at["change", "/chatter"], monitors.records.at["change", "/cmd"]) == (42, 10)
    assert [fields["lost"] for event, fields in desk.trail.heard if event == "records lost"] == [5]


def sources(**texts: str) -> Sources:
    files = {f"{name}.rv": text for name, text in texts.items()}
    return Sources(files, {}, {name: signed(text) for name, text in files.items()})


def load_of(new: Sources) -> admin.MonitorLoad:
    return admin.MonitorLoad(new.files, new.definitions, signatures=new.signatures)


async def test_with_site_keys_only_signed_specifications_come_into_force(desk: Desk) -> None:
    unsigned = "a.rv:1:1: error: it has no signature of the site"
    assert unsigned in (await desk.monitors(site_keys=[LINE])).checked.left_out["a.rv"]
    await desk.monitors()  # revision 1 is unsigned
    await desk.store.until_settled()
    beside = desk.folder / "a.rv.sig"
    beside.write_text(signed(A))
    monitors = await desk.monitors(site_keys=[LINE])
    assert (monitors.revision, monitors.differs_from_folder) == (2, False)
    for new in (
        Sources({"b.rv": B}),
        Sources({"b.rv": B}, {}, {"b.rv": signed(A)}),
        Sources({"a.rv": A + "//"}),
    ):
        with pytest.raises(SpecificationsRefusedError):
            await monitors.load(load_of(new), "eve")
    with pytest.raises(SpecificationsRefusedError, match=r"msg/own/T.msg:1:1: error: it has no signature"):
        await monitors.load(
            admin.MonitorLoad({"a.rv": A}, {"own/T.msg": "int32 x"}, signatures={"a.rv": signed(A)}), "eve"
        )
    with pytest.raises(SpecificationsRefusedError, match=unsigned):
        await monitors.roll_back(admin.MonitorRollback(1), "eve")
    assert monitors.revision == 2
    await monitors.load(load_of(sources(b=B)), "adam")
    await monitors.remove(admin.MonitorRemove(["a"]), "adam")
    assert monitors.sources == sources(b=B)
    await monitors.roll_back(admin.MonitorRollback(3), "adam")
    assert monitors.sources == sources(a=A, b=B)
    (desk.folder / "a.rv").write_text(A + " ")
    with pytest.raises(SpecificationsRefusedError, match="it is not the text that"):
        await monitors.reload(admin.MonitorReload(), "adam")
    beside.write_text(signed(A + " "))
    assert (await monitors.reload(admin.MonitorReload(), "adam")).changed == ["a.rv"]
    assert (await desk.monitors(restarted=True, site_keys=[LINE])).sources == sources(a=A + " ", b=B)
    with pytest.raises(SpecificationsRefusedError, match="rosrv monitor reset"):
        await desk.monitors(restarted=True, site_keys=[OTHER_LINE])
    loaded = [fields["signed_by"] for event, fields in desk.trail.heard if event == "specifications loaded"]
    assert loaded == [[], *([[NAME]] * 5)]


async def test_a_signature_that_changes_is_a_change(desk: Desk) -> None:
    (desk.folder / "msg" / "own").mkdir(parents=True)
    texts = {desk.folder / "a.rv": A, desk.folder / "msg" / "own" / "T.msg": "int32 x"}
    for path, text in texts.items():
        path.write_text(text)
        Path(f"{path}.sig").write_text(signed(text))
    monitors = await desk.monitors(site_keys=[LINE, OTHER_LINE])
    differs = [monitors.differs_from_folder]
    for path, text in texts.items():
        Path(f"{path}.sig").write_text(signed(text, OTHER_KEY))
    differs.append(monitors.differs_from_folder)
    await monitors.reload(admin.MonitorReload(), "adam")
    assert [*differs, monitors.differs_from_folder] == [False, True, False]
    assert (await desk.monitors(restarted=True, site_keys=[OTHER_LINE])).names() == ["a"]


async def test_interventions_in_shadow_mode_do_not_count_as_drops(desk: Desk) -> None:
    monitors = await desk.monitors()
    told = [
        messages.MonitorEvent("shadow drop", "a", "k", "/chatter", 1, "a.said dropped it", {}, b"\x01", size=1),
        messages.MonitorEvent("shadow fault", "a", "k", "/chatter", 2, "a.rv:1:2: division by zero", {"line": 1}),
    ]  # fmt: skip
    monitors.received(messages.MonitorsReported(told, 0))
    observed = [fields for event, fields in desk.trail.heard if event == "shadow observed"]
    assert [(fields["shadow"], fields["would"]) for fields in observed] == [(True, "drop"), (True, "fault")]
    assert {str(fields["severity"]) for fields in observed} == {str(observed[0]["severity"])}
    assert not {"message dropped", "monitor fault"} & {event for event, _ in desk.trail.heard}
    assert monitors.records.counts["shadow drop", "a"] == 1
    assert not monitors.records.counts["drop", "a"]
    assert not monitors.records.at


@pytest.mark.parametrize("broken", ["a() { event e() /x std_msgs/String '{}' { missing = 1; } }", "nonsense"])
@pytest.mark.parametrize("reloads", [False, True])
async def test_a_folder_that_a_reload_refuses_is_refused_at_a_start(
    desk: Desk, broken: str, reloads: bool
) -> None:
    monitors = await desk.monitors()
    (desk.folder / "a.rv").write_text(broken)
    with pytest.raises(SpecificationsRefusedError):
        await monitors.reload(admin.MonitorReload(), "adam")
    for restarted in (False, True, False):
        monitors = await desk.monitors(restarted=restarted)
        assert (monitors.revision, monitors.sources.files, monitors.checked.unbuilt) == (1, {"a.rv": A}, {})
        status = example(Status, monitors=monitors_status(monitors))
        [text] = [alarm.text for alarm in open_alarms(status) if alarm.kind == "monitors-folder-refused"]
        assert "a.rv:1:" in text, "even after a crash of control"
    refused = [fields for event, fields in desk.trail.heard if event == "specifications refused"]
    assert [fields["who"] for fields in refused] == ["adam", "disk", "disk"]
    (desk.folder / "a.rv").write_text(A)
    assert monitors_status(monitors).folder_refused == ""
    (desk.folder / "a.rv").write_text(A + " ")
    monitors = monitors if reloads else await desk.monitors()
    if reloads:
        await monitors.reload(admin.MonitorReload(), "adam")
    assert (monitors.revision, monitors_status(monitors).folder_refused) == (2, "")
    for restarted in (True, False):
        assert not monitors_status(await desk.monitors(restarted=restarted)).folder_refused


async def test_a_start_without_monitors_makes_no_revision(desk: Desk) -> None:
    monitors = await desk.monitors(folder=False)
    assert (monitors.revision, desk.store.monitor_revisions()) == (0, [])


async def test_a_changed_folder_leaves_the_time_to_confirm_a_reload(desk: Desk) -> None:
    monitors = await desk.monitors()
    (desk.folder / "b.rv").write_text(B)
    end = (await monitors.reload(admin.MonitorReload(confirm_within=600.0), "eve")).confirm_by
    (desk.folder / "c.rv").write_text(C)
    for restarted in (False, True):
        again = await desk.monitors(restarted=restarted)
        assert (again.names(), again.now.back_to) == (["a", "b", "c"], 1)
        assert again.confirm_by == pytest.approx(end, abs=1)


async def test_a_first_start_leaves_out_a_file_that_it_cannot_parse(desk: Desk) -> None:
    (desk.folder / "a.rv").write_text("nonsense")
    for _ in range(2):
        monitors = await desk.monitors()
        assert list(monitors.checked.left_out) == ["a.rv"]
    [first, again] = [fields for event, fields in desk.trail.heard if event == "monitor not built"]
    assert first == again
    assert first["resource"] == "a.rv"
    (desk.folder / "a.rv").write_text(A)
    await monitors.reload(admin.MonitorReload(), "adam")
    assert (monitors.checked.left_out, monitors.names()) == ({}, ["a"])


async def test_each_file_that_does_nothing_is_an_alarm_until_it_is_corrected(desk: Desk) -> None:
    event = "event e() /x std_msgs/String '{}' { missing = 1; }"
    broken = {"begins": f"begin b() {{ {event} }}", "holds": f"h() {{ {event} }}", "text": "nonsense"}
    for name, text in broken.items():
        (desk.folder / f"{name}.rv").write_text(text)
    (desk.folder / "bytes.rv").write_bytes(b"\xff")
    for restarted in (False, True):
        monitors = await desk.monitors(restarted=restarted)
        monitors.received(
            messages.SpecificationsTaken(monitors.revision, [], ["h"], 0, {"h": "its file has an error"})
        )
        found = {
            alarm.kind: alarm.text
            for alarm in open_alarms(example(Status, monitors=monitors_status(monitors)))
        }
        fixes = {
            kind: text.rpartition(": ")[2] for kind, text in found.items() if kind.startswith("monitor-")
        }
        assert fixes == {"monitor-held:h": "rosrv monitor load holds.rv"} | {
            f"monitor-left-out:{file}.rv": f"rosrv monitor load {file}.rv" for file in (*broken, "bytes")
        }
        for row in states_of(monitors):
            assert bool(row.error) == (row.name in ("b", "h"))
    held = [fields["reason"] for event, fields in desk.trail.heard if event == "topics held"]
    assert held and not any("resume" in str(text) for text in held)
    fixed = {f"{name}.rv": C.replace("c()", f"{name}()") for name in (*broken, "bytes")}
    await monitors.load(admin.MonitorLoad(fixed), "eve")
    assert not monitors_status(monitors).left_out


async def test_a_load_or_removal_of_others_leaves_a_broken_file_as_the_start_left_it(desk: Desk) -> None:
    broken = {"code": "code() { event e() /x std_msgs/String '{}' { missing = 1; } }", "text": "nonsense"}
    for name, text in broken.items():
        (desk.folder / f"{name}.rv").write_text(text)
    (desk.folder / "bytes.rv").write_bytes(b"\xff")
    monitors = await desk.monitors()

    def idle() -> tuple[list[str], list[str]]:
        return [*monitors.checked.unbuilt], sorted(monitors.checked.left_out)

    assert idle() == (["code"], ["bytes.rv", "text.rv"])
    order = admin.MonitorLoad({"b.rv": B})
    tried, loaded = await monitors.attempt(admin.MonitorTry(order), "eve"), await monitors.load(order, "eve")
    for answer in (tried, loaded, await monitors.remove(admin.MonitorRemove(["b"]), "eve")):
        named = [warning.file for warning in answer.warnings if "does nothing" in warning.text]
        assert sorted(named) == ["bytes.rv", "code.rv", "text.rv"]
        assert idle() == (["code"], ["bytes.rv", "text.rv"])
    assert monitors.names() == ["a", "code"]
    await monitors.load(admin.MonitorLoad({"text.rv": C, "code.rv": B}), "eve")
    assert idle() == ([], ["bytes.rv"])


WARNED = "w() { event e(double v) /cmd geometry_msgs/Twist '{linear.x:v}' { if (v > 1) { v = 1; } } }"


async def test_a_start_looks_for_warnings_only_in_what_was_not_loaded_before(desk: Desk) -> None:
    looked: list[bool] = []
    check = desk.check_at_start

    async def noted(
        sources: Sources, keys: Sequence[str], known: Sequence[str] | None
    ) -> CheckedSpecifications:
        looked.append(known is None)
        return await check(sources, keys, known)

    desk.check_at_start = noted
    (desk.folder / "a.rv").write_text(WARNED)
    warnings = (await desk.monitors()).checked.warnings
    assert len(warnings) == 1
    for restarted, taken_over in ((False, False), (True, False), (False, True)):
        monitors = await desk.monitors(restarted=restarted, taken_over=taken_over)
        assert monitors.checked.warnings == warnings
    assert looked == [True, False, False, False]
    row = monitors.in_force._replace(sources=text_of(monitors.sources))  # as an earlier version stored it
    desk.store.save_monitor_revision(row)
    for known in (False, True):
        assert (await desk.monitors()).checked.warnings == warnings
        assert looked.pop() is not known
    (desk.folder / "a.rv").write_text(" " * 9 + WARNED)  # another text, which is not known
    monitors = await desk.monitors()
    assert (looked.pop(), monitors.revision, monitors.checked.warnings == warnings) == (True, 2, False)
    await monitors.load(admin.MonitorLoad({"b.rv": WARNED.replace("w()", "x()")}), "eve")
    both = monitors.checked.warnings
    assert len(both) > 1
    assert (await desk.monitors()).checked.warnings == both
    assert looked.pop() is False


async def test_a_start_looks_for_warnings_beside_a_file_that_did_nothing(desk: Desk) -> None:
    (desk.folder / "a.rv").write_text(WARNED)
    (desk.folder / "b.rv").write_text("nonsense")
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"c.rv": C}), "eve")
    assert any("does nothing" in warning for warning in monitors.checked.warnings)
    assert ["NaN passes" in warning for warning in (await desk.monitors()).checked.warnings] == [True]


async def test_an_unconfirmed_change_goes_back_to_the_warnings_of_the_load(desk: Desk) -> None:
    (desk.folder / "a.rv").write_text(WARNED)
    monitors = await desk.monitors()
    warnings = monitors.checked.warnings
    await monitors.load(admin.MonitorLoad({"a.rv": A}, confirm_within=0), "eve")
    async with asyncio.timeout(30):
        await desk.rolled_back.wait()
    assert (monitors.revision, monitors.checked.warnings) == (3, warnings)


CAP = "cap() given { double speed = 1.0 m/s in 0..2; } { event said() /cmd std_msgs/String '{}' { } }"
CHANGES: dict[str, Callable[[SpecificationManager, float], Awaitable[Any]]] = {
    "in shadow mode": lambda now, within: now.load(
        admin.MonitorLoad({"cap.rv": CAP + " "}, shadow=True, confirm_within=within), "eve"
    ),
    "another constant": lambda now, within: now.load(
        admin.MonitorLoad({"cap.rv": CAP}, given={"cap": {"speed": 2.0}}, confirm_within=within), "eve"
    ),
    "the constant is out of range": lambda now, within: now.load(
        admin.MonitorLoad({"cap.rv": CAP.replace("0..2", "1..2")}, confirm_within=within), "eve"
    ),
    "removed": lambda now, within: now.remove(
        admin.MonitorRemove(["cap", "b"], confirm_within=within), "eve"
    ),
    "enabled": lambda now, within: now.load(
        admin.MonitorLoad({"b.rv": B + " "}, confirm_within=within), "eve", enable=True
    ),
}


def words_of(now: SpecificationManager) -> tuple[object, ...]:
    return (
        now.sources,
        now.now.states,
        now.givens.said,
        [row.value for row in now.givens.states(now.checked, "cap")],
    )


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("others", [[], [*CHANGES]])
@pytest.mark.parametrize("change", CHANGES)
async def test_an_unconfirmed_change_goes_back_with_all_its_switches_and_constants(
    desk: Desk, change: str, others: list[str], restarted: bool
) -> None:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"cap.rv": CAP, "b.rv": B}), "eve")
    await monitors.give(admin.MonitorGive("cap", {"speed": 0.3}), "eve")
    await monitors.switch(admin.MonitorSwitch(["b"], False), "eve")
    before = words_of(monitors)
    for name in dict.fromkeys([change, *others]):
        await CHANGES[name](monitors, 600.0)
    assert words_of(monitors) != before
    if restarted:
        desk.kill()
        monitors = await desk.monitors(restarted=True)
    monitors.ends.set(monitors.unconfirmed, str(monitors.now.back_to), 0.0)
    async with asyncio.timeout(30):
        await desk.rolled_back.wait()
    assert words_of(monitors) == before


async def test_an_order_during_an_unconfirmed_change_outlasts_it(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"cap.rv": CAP, "b.rv": B}), "eve")
    load = admin.MonitorLoad({"cap.rv": CAP, "b.rv": B}, shadow=True, confirm_within=600.0)
    await monitors.load(load, "eve")
    await monitors.give(admin.MonitorGive("cap", {"speed": 0.3}), "ann")
    await monitors.switch(admin.MonitorSwitch(["a"], False), "ann")
    desk.kill()
    monitors = await desk.monitors(restarted=True)
    monitors.ends.set(monitors.unconfirmed, str(monitors.now.back_to), 0.0)
    async with asyncio.timeout(30):
        await desk.rolled_back.wait()
    assert monitors.now.states == {"a": False, "b": True, "cap": True}
    assert monitors.givens.said == {"cap": {"speed": 0.3}}
    switched = [fields["reason"] for event, fields in desk.trail.heard if event == "monitor enabled"]
    assert switched[-2:] == ["b is enabled, as before the change", "cap is enabled, as before the change"]


async def test_no_load_brings_a_further_error_beside_a_broken_file(desk: Desk) -> None:
    broken = "code() { int kept; event e() /x std_msgs/String '{}' { missing = 1; } }"
    (desk.folder / "code.rv").write_text(broken)
    monitors = await desk.monitors()
    user = "u() { event e() /y std_msgs/String '{}' { kept = 1; } }"
    for load in ({"b.rv": "nonsense"}, {"u.rv": user}, {"code.rv": broken + " "}, {"code.rv": broken}):
        with pytest.raises(SpecificationsRefusedError) as refused:
            await monitors.load(admin.MonitorLoad(load), "eve")
        assert refused.value.findings[0].startswith(next(iter(load)))
        assert ("code.rv" in load) != ("rosrv monitor load code.rv" in refused.value.findings[-1])
    with pytest.raises(SpecificationsRefusedError, match=r"code\.rv:1:.*missing"):
        await monitors.reload(admin.MonitorReload(), "eve")
    assert (monitors.revision, [*monitors.checked.unbuilt]) == (1, ["code"])
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    with pytest.raises(SpecificationsRefusedError, match=r"code\.rv:1:.*missing"):
        await monitors.load(admin.MonitorLoad({"code.rv": broken}), "eve")


async def test_an_unconfirmed_correction_of_a_broken_file_is_rolled_back(desk: Desk) -> None:
    (desk.folder / "a.rv").write_text("nonsense")
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"a.rv": A}, confirm_within=0.05), "eve")
    assert monitors.names() == ["a"]
    async with asyncio.timeout(30):
        await desk.rolled_back.wait()
    assert (monitors.sources.files, [*monitors.checked.left_out]) == ({"a.rv": "nonsense"}, ["a.rv"])


@pytest.mark.parametrize("others", [{}, {"a.rv": A}])
@pytest.mark.parametrize("fault", ["text", "unsigned", "long", "folder", "link"])
async def test_a_first_start_leaves_out_a_file_that_it_cannot_use(
    desk: Desk, others: dict[str, str], fault: str
) -> None:
    (desk.folder / "a.rv").unlink()
    for name, text in others.items():
        (desk.folder / name).write_text(text)
        (desk.folder / f"{name}.sig").write_text(signed(text))
    bad = desk.folder / "b.rv"
    if fault == "folder":
        bad.mkdir()
    elif fault == "link":
        bad.symlink_to("nowhere")
    else:
        bad.write_bytes(
            {"text": b"\xff\xfe", "unsigned": B.encode(), "long": b" " * (1 << 20) + B.encode()}[fault]
        )
    if fault == "long":
        (desk.folder / "b.rv.sig").write_text(signed(bad.read_text()))
    for restarted in (False, True, False):
        monitors = await desk.monitors(restarted=restarted, site_keys=[LINE])
        assert (monitors.sources.files, list(monitors.checked.left_out)) == (others, ["b.rv"])
        assert monitors.differs_from_folder
        await desk.store.until_settled()
    if fault != "folder":
        bad.unlink()
        bad.write_text(B)
        (desk.folder / "b.rv.sig").write_text(signed(B))
        monitors = await desk.monitors(site_keys=[LINE])
        assert (monitors.names(), monitors.checked.left_out) == ([*"ab"][-1 - len(others) :], {})


async def test_an_unconfirmed_promotion_returns_to_shadow_mode(desk: Desk) -> None:
    monitors = await desk.monitors()
    promote = partial(admin.MonitorShadow, ["a"], False)

    async def shadowed(now: Any) -> None:
        await until(lambda: now.switches.in_shadow("a"))
        assert now.until("a", of=True) is None

    with pytest.raises(SpecificationsRefusedError, match="in force already"):
        await monitors.shadow(promote(confirm_within=60), "eve")
    await monitors.shadow(admin.MonitorShadow(["a"], True), "eve")
    done = await monitors.shadow(promote(confirm_within=0.05), "eve")
    assert done.confirm_by == monitors.until("a", of=True) and monitors.until("a") is None
    await shadowed(monitors)
    assert desk.trail.heard[-1][0] == "monitor in shadow mode"
    await monitors.shadow(promote(confirm_within=3600), "eve")
    desk.kill()
    again = await desk.monitors(restarted=True)
    assert again.switches.is_enabled("a") and again.until("a", of=True) is not None
    await again.shadow(promote(confirm_within=0.05), "eve")  # a shorter limit, and still back to shadow mode
    await shadowed(again)
    await again.shadow(promote(confirm_within=3600), "eve")
    await again.switch(admin.MonitorSwitch(["a"], False, for_seconds=0.05), "eve")
    await shadowed(again)
    await again.shadow(promote(confirm_within=3600), "eve")
    assert (await again.confirm(admin.MonitorConfirm(), "eve")).confirmed
    assert again.switches.is_enabled("a") and again.until("a", of=True) is None
    assert not (await again.confirm(admin.MonitorConfirm(), "eve")).confirmed


async def test_a_file_that_only_the_folder_may_name_is_replaced_by_its_monitor(desk: Desk) -> None:
    (desk.folder / "größe.rv").write_text(CAP)
    monitors = await desk.monitors()
    order = admin.MonitorReplace("cap", CAP.replace("said", "heard"), given={"cap.speed": 0.5})
    with pytest.raises(SpecificationsRefusedError):
        await monitors.replace(order, "eve")
    done = await monitors.replace(msgspec.structs.replace(order, given={"speed": 0.5}), "eve")
    assert (done.changed, monitors.givens.said) == (["größe.rv"], {"cap": {"speed": 0.5}})
