"""The specifications in force: revisions, switches, what the relay is told and what it says."""

import asyncio
import hashlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import asdict

from appliance.audit.log import AuditLog
from appliance.base.withdrawal import WithdrawnError, awaited
from appliance.channel import admin, messages
from appliance.specifications.allocation import Allocation, Move, Resource
from appliance.specifications.checking import check
from appliance.specifications.live_topics import Published
from appliance.specifications.specification_files import (
    Checked,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_revisions import Check
from appliance.specifications.specifications import (
    DryRunUnderWayError,
    Monitors,
    MonitorsChangedError,
    UnknownMonitorError,
)
from appliance.store.state_file import StateStore
from tests.support.audit import HeardTrail
from tests.support.site_key import LINE, NAME, OTHER_KEY, OTHER_LINE, signed
from tests.support.stated import parts_here

A = "a() { int shared; event said() /chatter std_msgs/String '{}' { } }"
B = "hold b() { event said() /other std_msgs/String '{}' { } }"

C = "c() { event said() /third std_msgs/String '{}' { } }"


async def here(sources: Sources, site_keys: Sequence[str]) -> Checked:
    """The compiler, in this process."""
    return await asyncio.to_thread(check, sources, site_keys)


class Desk:
    """The monitors of one control over its life times, with a relay that takes everything."""

    def __init__(self, home: Path) -> None:
        self.home, self.folder = home, home / "monitors"
        self.folder.mkdir()
        (self.folder / "a.rv").write_text(A)
        self.log = AuditLog(home / "audit.db")
        self.trail = HeardTrail(self.log)
        self.store = StateStore(home, failed=pytest.fail)
        self.sent: list[messages.Message] = []
        self.findings: list[str] = []
        self.began: list[str] = []
        self.away = False
        self.carried_out = asyncio.Event()
        self.carried_out.set()
        self.try_out: Check = here
        self.check: Check = here
        self.live: Published = {}

    async def monitors(
        self,
        enable: str = "all",
        *,
        restarted: bool = False,
        folder: bool = True,
        site_keys: Sequence[str] = (),
    ) -> Monitors:
        """A control starts."""
        relay = Taking(self)
        relay.monitors = Monitors(
            self.folder if folder else None,
            enable,
            self.store,
            self.trail,
            on_fault="drop",
            slices=1000,
            allocation=Allocation(1),
            relays=relay,
            published=lambda: None,
            told=[],
            site_keys=site_keys,
            check=lambda sources, keys: self.check(sources, keys),  # noqa: PLW0108  of whatever it is then
            try_out=self.try_out,
            parts=parts_here,
            live=lambda: self.live,
        )
        await relay.monitors.start(restarted=restarted)
        return relay.monitors


class Taking:
    """One relay, which takes everything, or refuses it with the findings of the desk; or is away."""

    monitors: Monitors

    def __init__(self, desk: Desk) -> None:
        self.desk = desk

    def send(self, message: messages.Message, relay: int) -> bool:
        """It answers in the next turn of the loop."""
        if self.desk.away:
            return False
        self.desk.sent.append(message)
        if isinstance(message, messages.SpecificationsStated):
            answer: messages.Message = messages.SpecificationsTaken(
                message.revision, self.desk.began, [], message.statement
            )
            if self.desk.findings:
                answer = messages.SpecificationsRefused(
                    message.revision, self.desk.findings, message.statement
                )
            asyncio.get_running_loop().call_soon(self.monitors.received, answer, relay)
        return True

    async def carried_out(self) -> None:
        """When the desk says so."""
        await self.desk.carried_out.wait()

    def carried_now(self) -> set[Resource]:
        """Nothing is carried."""
        return set()

    def withdraw(self, moves: Sequence[Move]) -> None:
        """Nothing is carried."""

    def place(self, moves: Sequence[Move]) -> None:
        """Nothing is carried."""


pytestmark = pytest.mark.anyio


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    """A folder with one specification."""
    desk = Desk(tmp_path)
    yield desk
    desk.store.close()
    desk.log.close()


async def test_a_topic_whose_publisher_has_another_type_is_not_cut_by_mistake(desk: Desk) -> None:
    """Load, dry run and reload name topic, types and node and change nothing; what is forced says it as a warning."""
    desk.live = {"/other": {"/talker": "std_msgs/Int32"}, "/chatter": {"/talker": "std_msgs/String"}}
    monitors = await desk.monitors()
    found = (
        r"b\.rv:1:12: error: /talker publishes /other as std_msgs/Int32, not as std_msgs/String: .*--force"
    )
    (desk.folder / "b.rv").write_text(B)
    for refused in (
        monitors.load(admin.MonitorLoad({"b.rv": B}), "eve"),
        monitors.attempt(admin.MonitorTry({"b.rv": B}), "eve"),
        monitors.reload(admin.MonitorReload(), "eve"),
    ):
        with pytest.raises(SpecificationsRefusedError, match=found):
            await refused
    assert (monitors.revision, monitors.names()) == (1, ["a"])
    tried = await monitors.attempt(admin.MonitorTry({"b.rv": B}, force=True), "eve")
    forced = await monitors.load(admin.MonitorLoad({"b.rv": B}, force=True), "eve")
    assert [tried.warnings, forced.warnings] == [[found_line] for found_line in forced.warnings] * 2
    assert "b.rv:1:12: warning: /talker publishes /other as std_msgs/Int32" in forced.warnings[0]
    assert (await monitors.load(admin.MonitorLoad({"c.rv": C}), "eve")).added == [
        "c.rv"
    ]  # /other is not judged again


async def test_a_topic_that_no_node_publishes_is_named_with_the_nearest(desk: Desk) -> None:
    """A wrong letter in a topic is a warning of the load, with the topic that was probably meant."""
    desk.live = {"/thirds": {"/talker": "std_msgs/String"}}
    monitors = await desk.monitors()
    loaded = await monitors.load(admin.MonitorLoad({"c.rv": C}), "eve")
    assert loaded.warnings == ["c.rv:1:7: warning: no node publishes /third now; did you mean /thirds?"]


async def test_a_monitor_in_shadow_mode_cuts_nothing_until_it_is_promoted(desk: Desk) -> None:
    """A type conflict in shadow mode is a warning; promoting the monitor is refused as a load would be."""
    desk.live = {"/other": {"/talker": "std_msgs/Int32"}}
    monitors = await desk.monitors()
    loaded = await monitors.load(admin.MonitorLoad({"b.rv": B}, shadow=True), "eve")
    assert "monitors in shadow mode are not given its messages" in loaded.warnings[0]
    with pytest.raises(SpecificationsRefusedError, match="error: /talker publishes /other"):
        await monitors.shadow(admin.MonitorShadow(["b"], False), "eve")
    assert monitors.switches.on_trial("b")
    await monitors.shadow(admin.MonitorShadow(["b"], False, force=True), "eve")
    assert monitors.switches.enabled("b")


async def test_an_untried_monitor_never_acts_when_it_is_loaded_in_shadow_mode(desk: Desk) -> None:
    """With `shadow` a load brings its files into force in shadow mode in the same step; the others stay."""
    monitors = await desk.monitors()
    desk.sent.clear()
    await monitors.load(admin.MonitorLoad({"b.rv": B}, shadow=True), "eve")
    stated = [one for one in desk.sent if isinstance(one, messages.SpecificationsStated)]
    assert stated
    assert all(one.trials == ("b",) for one in stated if "b" in one.enabled)
    assert (monitors.switches.enabled("a"), monitors.switches.on_trial("b")) == (True, True)
    (desk.folder / "c.rv").write_text(C)
    await monitors.reload(admin.MonitorReload(shadow=True), "eve")
    assert monitors.switches.states == {"a": True, "b": "on trial", "c": "on trial"}
    await monitors.load(admin.MonitorLoad({"a.rv": A}, shadow=True), "eve")  # the same text
    assert monitors.switches.on_trial("a")
    assert (await desk.monitors(restarted=True)).switches.states == dict.fromkeys("abc", "on trial")


async def test_what_is_in_force_is_not_taken_into_shadow_mode_by_a_load(desk: Desk) -> None:
    """A load in shadow mode is refused where its monitors share variables with some that are in force."""
    monitors = await desk.monitors()
    sharing = "d() { event said() /chatter std_msgs/String '{}' { shared = 1; } }"
    with pytest.raises(SpecificationsRefusedError, match="share variables"):
        await monitors.load(admin.MonitorLoad({"d.rv": sharing}, shadow=True), "eve")
    assert (monitors.names(), monitors.switches.enabled("a")) == (["a"], True)


async def test_new_monitors_may_begin_in_shadow_mode_by_configuration(desk: Desk) -> None:
    """With `enable: shadow` every monitor that no operator has switched is in shadow mode, and promoted ones stay."""
    monitors = await desk.monitors("shadow")
    assert monitors.switches.states == {"a": "on trial"}
    await monitors.shadow(admin.MonitorShadow(["a"], False), "eve")
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    again = await desk.monitors("shadow", restarted=True)
    assert again.switches.states == {"a": True, "b": "on trial"}
    assert again.switches.switched_off() == {}


async def test_a_monitor_that_is_disabled_for_a_time_comes_back(desk: Desk) -> None:
    """It is enabled again by itself, as it was before, and both are recorded."""
    monitors = await desk.monitors()
    await monitors.shadow(admin.MonitorShadow(["a"], True), "eve")
    for state, seconds in (("on trial", 0.05), (True, 0.05)):
        await monitors.shadow(admin.MonitorShadow(["a"], state is not True), "eve")
        tag = monitors.tag
        await monitors.switch(admin.MonitorSwitch(["a"], False, for_seconds=seconds), "eve")
        assert monitors.returns.until("a") is not None
        async with asyncio.timeout(30):
            while monitors.switches.states["a"] is False:
                await asyncio.sleep(0.01)
        assert (monitors.switches.states["a"], monitors.returns.until("a")) == (state, None)
        assert monitors.tag != tag
    rows = [row for row in desk.trail.heard if row[0] in {"monitor disabled", "monitor enabled"}]
    assert [row[0] for row in rows] == [
        "monitor disabled", "monitor enabled", "monitor disabled", "monitor enabled"
    ]  # fmt: skip


async def test_a_time_off_survives_restarts_and_ends_when_somebody_switches(desk: Desk) -> None:
    """After a restart the monitor comes back; an operator's switch, or a removal, ends the time."""
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    await monitors.switch(admin.MonitorSwitch(["a", "b"], False, for_seconds=3600), "eve")
    again = await desk.monitors()
    assert again.returns.until("a") == pytest.approx(monitors.returns.until("a"), abs=5)
    await again.switch(admin.MonitorSwitch(["a"], False, for_seconds=0.05), "eve")  # shorter than before
    await again.remove(admin.MonitorRemove(["b"]), "eve")
    assert again.returns.until("b") is None
    later = await desk.monitors(restarted=True)
    async with asyncio.timeout(30):
        while not later.switches.enabled("a"):
            await asyncio.sleep(0.01)
    await later.switch(admin.MonitorSwitch(["a"], False, for_seconds=3600), "eve")
    assert (await later.switch(admin.MonitorSwitch(["a"], False), "eve")).names == ["a"]  # now without an end
    assert (later.switches.states["a"], later.returns.until("a")) == (False, None)
    for wrong in (
        admin.MonitorSwitch(["a"], True, for_seconds=9),
        admin.MonitorSwitch(["a"], False, for_seconds=1e9),
    ):
        with pytest.raises(SpecificationsRefusedError, match="for up to 30 days"):
            await later.switch(wrong, "eve")


async def test_a_load_whose_client_gave_up_never_takes_effect(desk: Desk) -> None:
    """A slow load that is withdrawn while it is compiled, or while it waits for another change, changes nothing."""
    begun, goes_on, gone = asyncio.Event(), asyncio.Event(), False

    async def slow(sources: Sources, site_keys: Sequence[str]) -> Checked:
        begun.set()
        await goes_on.wait()
        return await here(sources, site_keys)

    monitors = await desk.monitors()
    desk.check = slow

    async def order(*changes: Callable[[], Any]) -> None:
        with awaited(lambda: gone):
            for change in changes:
                await change()

    load = partial(monitors.load, admin.MonitorLoad({"b.rv": B}, shadow=True, confirm_within=60.0), "eve")
    first = asyncio.ensure_future(order(load))
    await begun.wait()
    switch = partial(monitors.switch, admin.MonitorSwitch(["a"], False), "eve")
    second = asyncio.ensure_future(order(switch))
    await asyncio.sleep(0)
    desk.sent.clear()
    tag, gone = monitors.tag, True
    goes_on.set()
    for withdrawn in (first, second):
        with pytest.raises(WithdrawnError):
            await withdrawn
    assert (monitors.tag, monitors.names(), monitors.switches.states) == (tag, ["a"], {"a": True})
    assert (monitors.confirm_by, monitors.switches.said, desk.sent) == (None, {}, [])
    gone = False
    await order(load)
    assert monitors.names() == ["a", "b"]


async def test_a_client_has_one_dry_run_at_a_time(desk: Desk) -> None:
    """A second dry run of the same token is refused, that of another token is not; then it may have another one."""
    begun, goes_on = asyncio.Event(), asyncio.Event()

    async def slow(sources: Sources, site_keys: Sequence[str]) -> Checked:
        begun.set()
        await goes_on.wait()
        return await here(sources, site_keys)

    desk.try_out = slow
    monitors = await desk.monitors()
    tried = admin.MonitorTry({"b.rv": B})
    first = asyncio.ensure_future(monitors.attempt(tried, "eve"))
    await begun.wait()
    with pytest.raises(DryRunUnderWayError, match="you have a dry run under way"):
        await monitors.attempt(tried, "eve")
    other = asyncio.ensure_future(monitors.attempt(tried, "adam"))
    goes_on.set()
    assert [(await one).added for one in (first, other)] == [["b.rv"]] * 2
    assert (await monitors.attempt(tried, "eve")).added == ["b.rv"]


async def test_the_folder_is_read_at_start_and_what_was_loaded_survives(desk: Desk) -> None:
    """The same folder again is no new revision; an operator's revision stays until `reload`."""
    first = await desk.monitors()
    assert (first.revision, first.names(), first.differs_from_folder) == (1, ["a"], False)
    await desk.store.settled()
    again = await desk.monitors()
    assert again.revision == 1
    desk.began = ["b"]
    replaced = await again.load(admin.MonitorLoad({"b.rv": B}), "eve")
    assert (replaced.revision, replaced.added, replaced.changed) == (2, ["b.rv"], [])
    assert replaced.began == ["b"]
    repeated = await again.load(admin.MonitorLoad({"b.rv": B}), "adam")
    assert (repeated.revision, repeated.replaced, repeated.changed, again.in_force.who) == (2, 2, [], "eve")
    restarted = await desk.monitors()
    assert (restarted.names(), restarted.in_force.who, restarted.differs_from_folder) == (
        ["a", "b"],
        "eve",
        True,
    )
    back = await restarted.reload(admin.MonitorReload(prune=True), "operator")
    assert (back.removed, restarted.names(), restarted.differs_from_folder) == (["b.rv"], ["a"], False)
    loaded = [fields for event, fields in desk.trail.heard if event == "specifications loaded"]
    assert [fields["began"] for fields in loaded][:2] == [[], ["b"]]
    assert [fields["who"] for fields in loaded] == ["disk", "eve", "operator"]
    (desk.folder / "b.rv").write_text(B)
    lines = [
        f"{hashlib.sha256((desk.folder / name).read_bytes()).hexdigest()}  {name}\n"
        for name in ("a.rv", "b.rv")
    ]
    of_all = [hashlib.sha256("".join(some).encode()).hexdigest() for some in (lines[:1], lines, lines[:1])]
    assert [fields["sha256"] for fields in loaded] == of_all, "what sha256sum makes of the files"
    compiled = [fields["compiled_sha256"] for fields in loaded]
    assert compiled[0] == compiled[2] != compiled[1], "the same of the same texts, whoever compiled them"


async def test_a_try_says_what_a_load_would_do_and_changes_nothing(desk: Desk) -> None:
    """Files that are added and changed, the monitors there would be; it is refused as the load would be."""
    monitors = await desk.monitors()
    before, sent = monitors.tag, len(desk.sent)
    (text,) = monitors.sources.files.values()
    tried = await monitors.attempt(admin.MonitorTry({"a.rv": text + " ", "b.rv": B}, expected=before), "eve")
    assert (tried.added, tried.changed, tried.removed, tried.monitors) == (["b.rv"], ["a.rv"], [], ["a", "b"])
    assert (await monitors.attempt(admin.MonitorTry({"a.rv": text}), "eve")).changed == []
    with pytest.raises(SpecificationsRefusedError, match=r"c\.rv:1:20: error"):
        await monitors.attempt(
            admin.MonitorTry({"c.rv": "c() { event e() /x nobody/Knows '{}' { } }"}), "eve"
        )
    with pytest.raises(MonitorsChangedError):
        await monitors.attempt(admin.MonitorTry({"b.rv": B}, expected="9.9"), "eve")
    assert (monitors.tag, len(desk.sent)) == (before, sent)


async def test_a_reload_takes_nothing_away_that_the_folder_did_not_bring(desk: Desk) -> None:
    """What the folder does not have stays in force, over restarts, too, until somebody says that it is to go."""
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    (desk.folder / "c.rv").write_text(C)
    kept = await monitors.reload(admin.MonitorReload(), "operator")
    assert (kept.added, kept.removed, kept.kept) == (["c.rv"], [], ["b.rv"])
    assert monitors.names() == ["a", "b", "c"]
    await desk.store.settled()
    restarted = await desk.monitors()
    assert restarted.names() == ["a", "b", "c"]
    (desk.folder / "c.rv").unlink()
    again = await restarted.reload(admin.MonitorReload(), "operator")
    assert (again.removed, again.kept, restarted.names()) == ([], ["b.rv", "c.rv"], ["a", "b", "c"])
    pruned = await restarted.reload(admin.MonitorReload(prune=True), "operator")
    assert (pruned.removed, pruned.kept, restarted.differs_from_folder) == (["b.rv", "c.rv"], [], False)


async def test_a_file_with_another_name_is_not_taken_beside_the_old_one(desk: Desk) -> None:
    """Its monitor is in force already: nothing changes, and the words say which file has to go, and how."""
    monitors = await desk.monitors()
    (desk.folder / "a.rv").rename(desk.folder / "new.rv")
    with pytest.raises(
        SpecificationsRefusedError, match=r"not of the folder, and kept: a\.rv \(prune removes"
    ):
        await monitors.reload(admin.MonitorReload(), "operator")
    assert list(monitors.sources.files) == ["a.rv"]
    pruned = await monitors.reload(admin.MonitorReload(prune=True), "operator")
    assert (pruned.added, pruned.removed, monitors.names()) == (["new.rv"], ["a.rv"], ["a"])


async def test_a_revision_comes_back_with_its_switches(desk: Desk) -> None:
    """Specifications and switches are as they were, over restarts; what was in force all the time keeps its switch."""
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors(enable="none")
    await monitors.switch(admin.MonitorSwitch(["a", "b"], True), "eve")
    await monitors.remove(admin.MonitorRemove(["b"]), "eve")
    await monitors.switch(admin.MonitorSwitch(["a"], False), "eve")
    restarted = await desk.monitors(enable="none", restarted=True)
    back = await restarted.roll_back(admin.MonitorRollback(None), "adam")
    assert (back.added, back.removed, back.revision) == (["b.rv"], [], 3)
    assert {name: restarted.switches.enabled(name) for name in restarted.names()} == {"a": False, "b": True}
    rows = (await restarted.revisions(admin.MonitorRevisions())).revisions
    assert [(row.revision, row.who, row.note) for row in rows] == [
        (3, "adam", "rolled back to revision 1"),
        (2, "eve", "removed b.rv"),
        (1, "disk", "read at start"),
    ]
    with pytest.raises(SpecificationsRefusedError, match="there is no revision 9; kept are: 1, 2, 3"):
        await restarted.roll_back(admin.MonitorRollback(9), "adam")


async def test_a_refused_rollback_leaves_no_switch_behind(desk: Desk) -> None:
    """A monitor of that name that is loaded later is as if nobody had switched it."""
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors(enable="none")
    await monitors.switch(admin.MonitorSwitch(["b"], True), "eve")
    await monitors.remove(admin.MonitorRemove(["b"]), "eve")
    desk.findings = ["the relay says no"]
    with pytest.raises(SpecificationsRefusedError, match="the relay says no"):
        await monitors.roll_back(admin.MonitorRollback(1), "eve")
    desk.findings = []
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    assert not monitors.switches.enabled("b")


async def gone_back(monitors: Monitors, revision: int) -> None:
    """Wait until this revision is in force."""
    async with asyncio.timeout(30):
        while monitors.revision != revision:
            await asyncio.sleep(0.01)


async def test_what_is_not_confirmed_goes_back(desk: Desk) -> None:
    """The monitor that was removed on trial stands guard again, enabled as it was, also after a restart."""
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors(enable="none")
    await monitors.switch(admin.MonitorSwitch(["b"], True), "eve")
    gone = await monitors.remove(admin.MonitorRemove(["b"], confirm_within=0.0), "eve")
    assert gone.confirm_by is not None
    await gone_back(monitors, 3)
    assert (monitors.names(), monitors.switches.enabled("b"), monitors.confirm_by) == (["a", "b"], True, None)
    assert (monitors.in_force.who, monitors.in_force.note) == (
        "not confirmed in time",
        "rolled back to revision 1",
    )
    await monitors.remove(admin.MonitorRemove(["b"], confirm_within=300.0), "eve")
    await monitors.remove(admin.MonitorRemove(["a"], confirm_within=300.0), "eve")
    restarted = await desk.monitors(enable="none", restarted=True)
    assert restarted.names() == []
    assert restarted.confirm_by is not None
    assert (await restarted.confirm(admin.MonitorConfirm(), "eve")).confirmed
    assert not (await restarted.confirm(admin.MonitorConfirm(), "eve")).confirmed
    again = await desk.monitors(enable="none", restarted=True)
    assert (again.names(), again.confirm_by) == ([], None)
    assert [fields["who"] for event, fields in desk.trail.heard if event == "specifications confirmed"] == [
        "eve"
    ]


async def test_the_first_load_goes_back_to_nothing(tmp_path: Path) -> None:
    """Where there was no revision before."""
    desk = Desk(tmp_path)
    monitors = await desk.monitors(folder=False)
    await monitors.load(admin.MonitorLoad({"b.rv": B}, confirm_within=0.0), "eve")
    await gone_back(monitors, 2)
    assert monitors.names() == []
    desk.store.close()
    desk.log.close()


async def test_without_a_folder_a_reload_is_an_error(tmp_path: Path) -> None:
    """Nothing is removed, the words say what to do, and nothing is said to differ from a folder that is not there."""
    desk = Desk(tmp_path)
    monitors = await desk.monitors(folder=False)
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    assert not monitors.differs_from_folder
    for prune in (False, True):
        with pytest.raises(SpecificationsRefusedError, match="no folder of specifications is configured"):
            await monitors.reload(admin.MonitorReload(prune=prune), "operator")
    assert monitors.names() == ["b"]
    desk.store.close()
    desk.log.close()


async def test_a_bad_specification_changes_nothing(desk: Desk) -> None:
    """Whether control or the relay finds the fault; it is a record."""
    monitors = await desk.monitors()
    with pytest.raises(SpecificationsRefusedError):
        await monitors.load(admin.MonitorLoad({"b.rv": "nonsense"}), "eve")
    assert not desk.sent
    desk.findings = ["b.rv:1:1: error: something"]
    with pytest.raises(SpecificationsRefusedError, match="something"):
        await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    assert (monitors.revision, monitors.names()) == (1, ["a"])
    assert [event for event, _ in desk.trail.heard].count("specifications refused") == 3
    desk.findings = []
    (desk.folder / "a.rv").write_text("nonsense")
    with pytest.raises(SpecificationsRefusedError):
        await monitors.reload(admin.MonitorReload(), "eve")
    await desk.store.settled()
    with pytest.raises(SpecificationsRefusedError):
        await desk.monitors()


async def test_a_switch_is_answered_when_the_relay_has_carried_it_out(desk: Desk) -> None:
    """What is sent after the answer is judged by it: told is not done, nor when monitors are resumed."""
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
        await desk.store.settled()
        for _ in range(5):
            await asyncio.sleep(0)
        assert not task.done()
        desk.carried_out.set()
        assert (await task).names == ["a"]


async def test_switches_are_kept_and_recorded(desk: Desk) -> None:
    """Only what changes is told and recorded; `--enable` is for those that nobody has switched."""
    monitors = await desk.monitors("none")
    assert monitors.switches.enabled("a") is False
    assert (await monitors.switch(admin.MonitorSwitch(["a", "a"], True), "eve")).names == ["a"]
    assert (await monitors.switch(admin.MonitorSwitch(["a"], True), "eve")).names == []
    assert desk.sent == [messages.MonitorSwitched("a", True)]
    assert (await desk.monitors("none")).switches.enabled("a") is True
    assert monitors.statement(0).enabled == {"a": True}
    with pytest.raises(UnknownMonitorError, match="there are: a"):
        await monitors.switch(admin.MonitorSwitch(["nobody"], True), "eve")
    with pytest.raises(SpecificationsRefusedError, match="--enable"):
        await desk.monitors("a,nobody")
    assert [fields["who"] for event, fields in desk.trail.heard if event == "monitor enabled"] == ["eve"]


async def test_a_monitor_that_was_removed_while_the_robot_ran_does_not_keep_it_from_starting(
    desk: Desk,
) -> None:
    """Though `--enable` still names it; nor does a crash of control."""
    monitors = await desk.monitors("a")
    await monitors.remove(admin.MonitorRemove(["a"]), "eve")
    assert (await desk.monitors("a")).names() == []
    assert (await desk.monitors("a", restarted=True)).names() == []


async def test_a_relay_that_follows_another_is_an_alarm_and_holds(desk: Desk) -> None:
    """The first relay of an appliance is not; nor is a control that finds its relay as it was."""
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors()
    assert monitors.statement(0).restarted is False
    monitors.received(messages.SpecificationsTaken(1, ["a", "b"], []))
    assert "monitors restarted" not in [event for event, _ in desk.trail.heard]
    assert monitors.statement(0).restarted is True
    monitors.received(messages.SpecificationsTaken(1, ["a", "b"], ["b"]))
    assert [fields["held"] for event, fields in desk.trail.heard if event == "monitors restarted"] == [["b"]]
    assert monitors.rollout.held == {"b"}
    assert (await monitors.resume(admin.MonitorResume(["a", "b"]), "eve")).names == ["b"]
    assert desk.sent[-1] == messages.MonitorResumed("b")
    await desk.store.settled()
    control = await desk.monitors(restarted=True)
    assert control.statement(0).restarted is True
    control.received(messages.SpecificationsTaken(1, [], []))
    assert [event for event, _ in desk.trail.heard].count("monitors restarted") == 1


async def test_what_others_use_is_not_removed_alone(desk: Desk) -> None:
    """And a file goes whole or not at all."""
    monitors = await desk.monitors()
    user = "c() { event said() /chatter std_msgs/String '{}' { shared = 1; } }"
    await monitors.load(
        admin.MonitorLoad({"c.rv": user + "\nd() { event said() /x std_msgs/String '{}' { } }"}), "eve"
    )
    for names in (["a"], ["c"]):
        with pytest.raises(SpecificationsRefusedError):
            await monitors.remove(admin.MonitorRemove(names), "eve")
    with pytest.raises(UnknownMonitorError):
        await monitors.remove(admin.MonitorRemove(["nobody"]), "eve")
    assert (await monitors.remove(admin.MonitorRemove(["c", "d"]), "eve")).removed == ["c.rv"]
    assert (await monitors.remove(admin.MonitorRemove(["a.rv"]), "eve")).removed == ["a.rv"]


async def test_a_change_that_is_meant_for_other_monitors_is_refused(desk: Desk) -> None:
    """Two engineers cannot overwrite each other: not after a load, a switch, or a resumption."""
    monitors = await desk.monitors()
    seen = [monitors.tag]
    await monitors.load(admin.MonitorLoad({"b.rv": B}, expected=monitors.tag), "adam")
    seen.append(monitors.tag)
    await monitors.switch(admin.MonitorSwitch(["a"], False, expected=monitors.tag), "adam")
    seen.append(monitors.tag)
    monitors.received(messages.SpecificationsTaken(2, [], ["b"]))
    await monitors.resume(admin.MonitorResume(["b"], expected=monitors.tag), "adam")
    assert len({*seen, monitors.tag}) == 4
    for stale in seen:
        changes: list[Callable[[], Any]] = [
            partial(monitors.load, admin.MonitorLoad({"b.rv": B}, expected=stale), "eve"),
            partial(monitors.reload, admin.MonitorReload(expected=stale), "eve"),
            partial(monitors.remove, admin.MonitorRemove(["a"], expected=stale), "eve"),
            partial(monitors.switch, admin.MonitorSwitch(["a"], True, expected=stale), "eve"),
            partial(monitors.resume, admin.MonitorResume(["b"], expected=stale), "eve"),
        ]
        for change in changes:
            with pytest.raises(MonitorsChangedError, match="look at them first") as caught:
                await change()
            assert caught.value.tag == monitors.tag
    assert (monitors.revision, monitors.switches.enabled("a")) == (2, False)


async def test_a_switch_goes_with_its_monitor(desk: Desk) -> None:
    """One that is loaded later under its name is as `--enable` says; so it is in the next life of control."""
    monitors = await desk.monitors()
    await monitors.switch(admin.MonitorSwitch(["a"], False), "eve")
    await monitors.load(admin.MonitorLoad({"a.rv": A.replace("{", "{ int n;", 1)}), "eve")
    assert not monitors.switches.enabled("a")
    await monitors.remove(admin.MonitorRemove(["a"]), "eve")
    await monitors.load(admin.MonitorLoad({"a.rv": A}), "eve")
    assert monitors.switches.enabled("a")
    assert (await desk.monitors(restarted=True)).switches.enabled("a")


async def test_a_monitor_is_not_resumed_while_its_relay_is_away(desk: Desk) -> None:
    """The relay that comes will hold its topics: nobody is told that they go on."""
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors()
    monitors.received(messages.SpecificationsTaken(1, [], ["b"]))
    desk.away = True
    with pytest.raises(SpecificationsRefusedError, match="b not resumed: the relay process is away"):
        await monitors.resume(admin.MonitorResume(["b"]), "eve")
    assert "monitor resumed" not in [event for event, _ in desk.trail.heard]
    assert monitors.rollout.held == {"b"}


async def test_of_two_changes_for_the_same_monitors_one_is_made(desk: Desk) -> None:
    """Though they come at once, and the first takes its time."""
    (desk.folder / "b.rv").write_text(B)
    monitors = await desk.monitors()
    monitors.received(messages.SpecificationsTaken(1, [], ["b"]))
    tag = monitors.tag
    done = await asyncio.gather(
        monitors.load(admin.MonitorLoad({"c.rv": A.replace("a()", "c()")}, expected=tag), "adam"),
        monitors.switch(admin.MonitorSwitch(["a"], False, expected=tag), "eve"),
        monitors.resume(admin.MonitorResume(["b"], expected=tag), "eve"),
        return_exceptions=True,
    )
    assert [isinstance(one, MonitorsChangedError) for one in done] == [False, True, True]
    assert monitors.switches.enabled("a")
    assert messages.MonitorResumed("b") not in desk.sent


async def test_the_tag_is_that_of_what_changed_something(desk: Desk) -> None:
    """A switch that was so already, an unknown name and a bad specification leave it; no start brings one back."""
    monitors = await desk.monitors()
    first = monitors.tag
    assert (await monitors.switch(admin.MonitorSwitch(["a"], True), "eve")).names == []
    assert (await monitors.resume(admin.MonitorResume(["a"]), "eve")).names == []
    with pytest.raises(UnknownMonitorError):
        await monitors.switch(admin.MonitorSwitch(["a", "nobody"], False), "eve")
    with pytest.raises(SpecificationsRefusedError):
        await monitors.load(admin.MonitorLoad({"b.rv": "nonsense"}), "eve")
    assert monitors.tag == first
    await monitors.switch(admin.MonitorSwitch(["a"], False), "eve")
    await monitors.switch(admin.MonitorSwitch(["a"], True), "eve")
    assert monitors.tag != first
    assert (await desk.monitors()).tag == (await desk.monitors(restarted=True)).tag == monitors.tag


async def test_what_monitors_did_is_recorded_with_its_count(desk: Desk) -> None:
    """The bytes before and after as hexadecimal digits; what could not be told, too."""
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
    """Files and their signatures."""
    files = {f"{name}.rv": text for name, text in texts.items()}
    return Sources(files, {}, {name: signed(text) for name, text in files.items()})


async def test_where_the_site_signs_nothing_else_comes_into_force(desk: Desk) -> None:
    """Start, load, reload, removal, rollback, and the start after a crash: each asks for the site's signatures."""
    unsigned = "a.rv:1:1: error: it has no signature of the site"
    with pytest.raises(SpecificationsRefusedError, match=unsigned):
        await desk.monitors(site_keys=[LINE])
    await desk.monitors()  # revision 1 is unsigned
    await desk.store.settled()
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
            await monitors.load(admin.MonitorLoad(**asdict(new)), "eve")
    with pytest.raises(SpecificationsRefusedError, match=r"msg/own/T.msg:1:1: error: it has no signature"):
        await monitors.load(
            admin.MonitorLoad({"a.rv": A}, {"own/T.msg": "int32 x"}, signatures={"a.rv": signed(A)}), "eve"
        )
    with pytest.raises(SpecificationsRefusedError, match=unsigned):
        await monitors.roll_back(admin.MonitorRollback(1), "eve")
    assert monitors.revision == 2
    await monitors.load(admin.MonitorLoad(**asdict(sources(b=B))), "adam")
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
    """Keys are changed over by signing what is there anew; definitions of messages have signatures, too."""
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


async def test_a_trial_is_told_kept_and_promoted(desk: Desk) -> None:
    """It is not enabled; it survives a restart; the relays compile anew when it begins and when it ends."""
    monitors = await desk.monitors()
    assert (await monitors.trial(admin.MonitorTrial(["a"], True), "eve")).names == ["a"]
    assert (await monitors.trial(admin.MonitorTrial(["a"], True), "eve")).names == []
    assert (monitors.switches.enabled("a"), monitors.switches.on_trial("a")) == (False, True)
    stated = desk.sent[-1]
    assert isinstance(stated, messages.SpecificationsStated)
    assert (stated.enabled, stated.trials, stated.revision) == ({"a": True}, ("a",), 1)
    for restarted in (False, True):
        again = await desk.monitors(restarted=restarted)
        assert again.switches.on_trial("a")
        assert again.statement(0).trials == ("a",)
    with pytest.raises(SpecificationsRefusedError, match="rosrv monitor promote"):
        await monitors.switch(admin.MonitorSwitch(["a"], True), "eve")
    assert (await monitors.trial(admin.MonitorTrial(["a"], False), "adam")).names == ["a"]
    assert monitors.switches.enabled("a")
    assert monitors.statement(0).trials == ()
    assert (await monitors.trial(admin.MonitorTrial(["a"], False), "adam")).names == []
    await monitors.switch(admin.MonitorSwitch(["a"], False), "eve")
    with pytest.raises(SpecificationsRefusedError, match="a is disabled, not in shadow mode"):
        await monitors.trial(admin.MonitorTrial(["a"], False), "eve")
    said = [(event, fields["who"]) for event, fields in desk.trail.heard if event.startswith("monitor ")]
    assert said == [("monitor on trial", "eve"), ("monitor enabled", "adam"), ("monitor disabled", "eve")]


async def test_a_trial_that_is_disabled_is_over(desk: Desk) -> None:
    """It is as any disabled monitor; and a switch goes with its monitor."""
    monitors = await desk.monitors()
    await monitors.trial(admin.MonitorTrial(["a"], True), "eve")
    assert (await monitors.switch(admin.MonitorSwitch(["a"], False), "eve")).names == ["a"]
    assert (monitors.switches.enabled("a"), monitors.switches.on_trial("a")) == (False, False)
    assert monitors.statement(0).trials == ()
    assert monitors.statement(0).enabled == {"a": False}
    await monitors.trial(admin.MonitorTrial(["a"], True), "eve")
    await monitors.remove(admin.MonitorRemove(["a"]), "eve")
    await monitors.load(admin.MonitorLoad({"a.rv": A}), "eve")
    assert monitors.switches.enabled("a")
    await monitors.roll_back(admin.MonitorRollback(1), "eve")
    assert monitors.switches.enabled("a")


async def test_a_relay_that_does_not_take_a_trial_leaves_everything(desk: Desk) -> None:
    """What is in force stays in force, and no switch is kept."""
    monitors = await desk.monitors()
    desk.findings = ["no"]
    with pytest.raises(SpecificationsRefusedError, match="no"):
        await monitors.trial(admin.MonitorTrial(["a"], True), "eve")
    desk.findings = []
    assert monitors.switches.enabled("a")
    assert monitors.statement(0).trials == ()
    assert (await desk.monitors(restarted=True)).switches.enabled("a")


USER = "u() { event said() /chatter std_msgs/String '{}' { shared = 1; } }"


async def test_what_shares_variables_is_on_trial_together(desk: Desk) -> None:
    """All are named, by who puts them there and by who promotes them; what is loaded joins, what is in force never."""
    (desk.folder / "u.rv").write_text(USER)
    monitors = await desk.monitors()
    with pytest.raises(
        SpecificationsRefusedError, match="u in shadow mode and a in force do not go together"
    ):
        await monitors.trial(admin.MonitorTrial(["u"], True), "eve")
    assert (await monitors.trial(admin.MonitorTrial(["u", "a"], True), "eve")).names == ["u", "a"]
    with pytest.raises(SpecificationsRefusedError, match="share variables"):
        await monitors.trial(admin.MonitorTrial(["a"], False), "eve")
    await monitors.load(admin.MonitorLoad({"v.rv": USER.replace("u()", "v()")}), "eve")
    assert monitors.statement(0).trials == ("a", "u", "v")
    assert (await desk.monitors(restarted=True)).switches.on_trial("v")
    await monitors.load(admin.MonitorLoad({"c.rv": C}), "eve")
    uses_both = C.replace("{ }", "{ shared = 2; }")
    with pytest.raises(SpecificationsRefusedError, match="a, u, v in shadow mode and c in force"):
        await monitors.load(admin.MonitorLoad({"c.rv": uses_both}), "eve")
    assert monitors.switches.enabled("c")
    assert (await monitors.switch(admin.MonitorSwitch(["v"], False), "eve")).names == ["v"]
    assert monitors.statement(0).trials == ("a", "u")
    assert (await monitors.trial(admin.MonitorTrial(["a", "u"], False), "eve")).names == ["a", "u"]


async def test_a_rollback_brings_a_trial_back(desk: Desk) -> None:
    """A monitor that comes back is on trial as it was when it went."""
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"c.rv": C}), "eve")
    await monitors.trial(admin.MonitorTrial(["c"], True), "eve")
    await monitors.remove(admin.MonitorRemove(["c"]), "eve")
    assert not monitors.switches.on_trial("c")
    await monitors.roll_back(admin.MonitorRollback(2), "eve")
    assert monitors.switches.on_trial("c")


async def test_what_a_trial_would_have_done_is_no_drop(desk: Desk) -> None:
    """Neither in the events nor in the counts of drops; `detail` says what it would have been."""
    monitors = await desk.monitors()
    told = [
        messages.MonitorEvent(
            "trial drop", "a", "k", "/chatter", 1, "a.said dropped it", {}, b"\x01", size=1
        ),
        messages.MonitorEvent(
            "trial fault", "a", "k", "/chatter", 2, "a.rv:1:2: division by zero", {"line": 1}
        ),
    ]
    monitors.received(messages.MonitorsReported(told, 0))
    observed = [fields for event, fields in desk.trail.heard if event == "trial observed"]
    assert [(fields["trial"], fields["would"]) for fields in observed] == [(True, "drop"), (True, "fault")]
    assert {str(fields["severity"]) for fields in observed} == {str(observed[0]["severity"])}
    assert not {"message dropped", "monitor fault"} & {event for event, _ in desk.trail.heard}
    assert monitors.records.counts["trial drop", "a"] == 1
    assert not monitors.records.counts["drop", "a"]
    assert not monitors.records.at
