import asyncio
import contextlib
import ipaddress
import threading
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from appliance.base.clock import using
from appliance.channel.admin import (
    PolicyConfirm,
    PolicyLoad,
    PolicyReload,
    PolicyRevisions,
    PolicyRollback,
    PolicyWanted,
)
from appliance.control.assembly.policies import Policies, RevisionChangedError, passed_changes
from appliance.control.errors import PolicyRefusedError
from appliance.policy import judgement
from appliance.policy.judgement import PolicyContext
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Address, Category, Request, address_of
from appliance.policy.policy import Approval, CurrentPolicy, Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.store.state_file import StateStore
from tests.support.control_parts import OPEN, Records
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.site_key import LINE, OTHER_KEY, OTHER_LINE, signed
from tests.support.virtual_clock import ShiftedClock, let_time_pass, set_wall
from tests.support.waiting import until

pytestmark = pytest.mark.anyio
OTHER = OPEN.replace("default=*", "default=10.0.0.5", 1)


def fail(reason: str) -> None:
    raise AssertionError(reason)


async def at_once() -> None: ...


class Appliance:
    def __init__(self, directory: Path) -> None:
        self.state = directory / "state"
        self.state.mkdir()
        self.file = directory / "policy.ini"
        self.file.write_text(OPEN)
        self.behind = 0.0  # the seconds by which the system clock is not set

    @contextlib.contextmanager
    def started(
        self,
        *,
        restarted: bool = False,
        hosts: Callable[[], Mapping[str, Address]] = dict,
        blocks: Callable[[], Mapping[Address, str]] = dict,
        holders: Callable[[], Mapping[str, Address]] = dict,
        approved: Callable[[], frozenset[Approval]] = frozenset,
        live: Callable[[], Iterable[LiveRight]] = list,
        changed: Callable[[Policy, Policy], int] = lambda _before, _policy: 0,
        site_keys: Sequence[str] = (),
    ) -> Iterator[Policies]:
        store = StateStore(self.state, failed=fail, kind=InlineDatabase)
        self.records = Records()
        self.ends = ends_of(store, self.state, behind=lambda: self.behind)
        policies = Policies(
            self.file, store, self.ends, self.records, CurrentPolicy(), live=live, changed=changed,
            carried_out=at_once,
            known=lambda: PolicyContext(
                hosts(), blocks=blocks(), holders=holders(), approved=approved(), site_keys=site_keys,
                now=self.ends.system_time(),
                ends=passed_changes(self.ends),
            ),
        )  # fmt: skip
        policies.start(restarted=restarted)
        ending = asyncio.get_running_loop().create_task(self.ends.run())
        try:
            yield policies
        finally:
            ending.cancel()
            store.close()


async def test_an_unconfirmed_change_is_rolled_back_after_a_restart(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        await policies.reload(PolicyReload(confirm_within=60.0), "operator")
        deadline = policies.confirm_by
    let_time_pass(59.5)
    with appliance.started() as policies:
        assert (policies.revision, policies.current.text) == (2, OTHER)
        assert policies.confirm_by == pytest.approx(deadline, abs=1)
        await until(lambda: policies.revision == 3)
        assert policies.current.text == OPEN
        assert policies.confirm_by is None
    with appliance.started(restarted=True) as policies:
        await asyncio.sleep(0)
        assert (policies.revision, policies.confirm_by) == (3, None)


@pytest.mark.nightly
async def test_a_reload_warns_of_hosts_that_lose_everything(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    robot, other = ipaddress.ip_address("192.168.1.10"), ipaddress.ip_address("10.0.0.2")
    live = [LiveRight(robot, f"/n{number}", "registerPublisher", "/scan") for number in range(5)]
    live += [LiveRight(other, "/ocu", "registerPublisher", topic) for topic in ("/scan", "/joy")]
    with appliance.started(live=lambda: live) as policies:
        loaded = await policies.reload(PolicyReload(), "operator")
        assert [text for text in loaded.warnings if "loses" in text] == []
        appliance.file.write_text(OPEN.replace("[Publishers]\n", "[Publishers]\n/scan =\n"))
        loaded = await policies.reload(PolicyReload(), "operator")
        assert [text for text in loaded.warnings if "loses" in text] == [
            "warning: 192.168.1.10 has nodes (/n0, /n1, /n2 and 2 more) and loses all its rights: if that is a "
            "mistake, `rosrv policy rollback` and name the host in the policy"
        ]


@pytest.mark.parametrize("kind", ["approval", "holder", "block", "none"])
async def test_a_reload_of_an_unchanged_policy_deprives_no_host(tmp_path: Path, kind: str) -> None:
    """Whatever beside the text of the policy gave or took the right: an approval, a group, a block."""
    appliance, host = Appliance(tmp_path), ipaddress.ip_address("10.0.0.7")
    text = OPEN.replace("[Publishers]\n", "[Groups]\nagent=10.0.0.7\n[Publishers]\n/cmd_vel = ask agent\n")
    if kind == "holder":
        text = OPEN + "[Authority]\nbase = /cmd_vel\ntake base = 10.0.0.7\n"
    appliance.file.write_text(text)
    approved = frozenset({(host, Category.PUBLISH, "/cmd_vel")}) if kind == "approval" else frozenset()
    live = [LiveRight(host, "/agent", "registerPublisher", "/cmd_vel")]
    given: Any = {
        "approved": lambda: approved,
        "holders": lambda: {"base": host} if kind == "holder" else {},
        "blocks": lambda: {host: "blocked by ann"} if kind == "block" else {},
    }
    with appliance.started(live=lambda: live, **given) as policies:
        loaded = await policies.reload(PolicyReload(), "operator")
        assert [warning for warning in loaded.warnings if "loses" in warning] == []
        appliance.file.write_text(OPEN.replace("[Publishers]\n", "[Publishers]\n/cmd_vel =\n"))
        loaded = await policies.reload(PolicyReload(), "operator")
        had = kind in ("approval", "holder")
        assert any("10.0.0.7 has nodes (/agent) and loses all" in one for one in loaded.warnings) is had


async def test_a_reload_names_its_author(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Appliance(tmp_path).started() as policies:
        recorded: list[object] = []
        monkeypatch.setattr(Records, "happened", lambda *_texts, **detail: recorded.append(detail["who"]))
        for who, note in (
            ("operator", "reloaded from disk by operator"),
            ("alice", "reloaded from disk by alice"),
            ("disk", "reloaded from disk"),
        ):
            policies.file.write_text(f"{OPEN}# {who}\n")
            for _ in range(2):  # the same text makes no second revision
                loaded = await policies.reload(PolicyReload(), who)
                assert (policies.in_force.who, policies.in_force.note) == ("disk", note)
            assert loaded.revision == loaded.replaced == policies.revision
        assert recorded == ["operator", "alice", "disk"]


@pytest.mark.nightly
async def test_a_clock_set_back_does_not_extend_the_timeout(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        await policies.reload(PolicyReload(confirm_within=2.0), "operator")
    with using(ShiftedClock(-3e8)), appliance.started() as policies:
        await until(lambda: policies.revision == 3)
        assert policies.current.text == OPEN


@pytest.mark.parametrize(
    "order",
    [
        "load",
        "load again",
        "reload",
        "reload again",
        "roll back the next",
        "decide again",
        "start",
        "crash",
        "confirm",
        "roll back",
    ],
)
async def test_only_a_confirmation_and_a_rollback_end_the_timeout(tmp_path: Path, order: str) -> None:
    """The file is edited before each order, except before those that read it again."""
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        end = (await policies.reload(PolicyReload(confirm_within=60.0), "ann")).confirm_by
        if order != "reload again":
            appliance.file.write_text(OTHER + "# edited\n")
        match order:
            case "load":
                await policies.load(PolicyLoad(OTHER + "# another\n"), "bob")
            case "load again":
                for _ in range(2):
                    await policies.load(PolicyLoad(OTHER), "bob")
            case "reload" | "reload again":
                await policies.reload(PolicyReload(), "bob")
            case "roll back the next":
                await policies.load(PolicyLoad(OTHER + "# another\n"), "bob")
                await policies.roll_back(PolicyRollback(), "bob")
            case "confirm":
                await policies.confirm(PolicyConfirm(), "bob")
            case "roll back":
                await policies.roll_back(PolicyRollback(), "bob")
            case _:
                policies.decide_again()
    with appliance.started(restarted=order == "crash") as policies:
        if order in ("confirm", "roll back"):
            assert policies.confirm_by is None
            return
        assert policies.confirm_by == pytest.approx(end, abs=1)
        before = policies.revision
        let_time_pass(60.5)
        await until(lambda: policies.revision == before + 1)
        assert policies.current.text == OPEN


@pytest.mark.nightly
async def test_a_change_stays_confirmed_over_a_crash(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        await policies.reload(PolicyReload(confirm_within=300.0), "operator")
    with appliance.started(restarted=True) as policies:
        assert policies.confirm_by is not None
        assert policies.confirm_by > time.time()
        assert (await policies.confirm(PolicyConfirm(), "operator")).confirmed
    with appliance.started(restarted=True) as policies:
        assert (policies.revision, policies.confirm_by) == (2, None)


class Slow:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, appliance: Appliance) -> None:
        self.rounds = 0
        self.begun, self.over = threading.Event(), threading.Event()
        monkeypatch.setattr(judgement, "run_cases", self._run)
        appliance.file.with_name("policy.ini.tests.yaml").write_text("cases: []\n")

    def _run(self, *_given: object) -> list[object]:
        self.rounds += 1
        self.begun.set()
        assert self.over.wait(10), "the loop stood still meanwhile"
        return []

    async def until_begun(self) -> None:
        assert await asyncio.to_thread(self.begun.wait, 10)


@pytest.mark.nightly
async def test_a_reload_does_not_block_nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        slow = Slow(monkeypatch, appliance)
        appliance.file.write_text(OTHER)
        loading = asyncio.ensure_future(policies.reload(PolicyReload(), "operator"))
        await slow.until_begun()
        assert policies.revision == 1
        slow.over.set()
        assert (await loading).revision == 2
        assert policies.current.text == OTHER


@pytest.mark.nightly
async def test_a_reload_overtaken_by_another_change_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        slow = Slow(monkeypatch, appliance)
        await policies.store.until_settled()
        loading = asyncio.ensure_future(policies.reload(PolicyReload(), "operator"))
        await slow.until_begun()
        await policies.rollback(1, who="not confirmed in time")
        slow.over.set()
        with pytest.raises(RevisionChangedError):
            await loading
        assert policies.revision == 2


@pytest.mark.nightly
async def test_hosts_changed_during_the_tests_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    appliance = Appliance(tmp_path)
    hosts = {"ocu": ipaddress.ip_address("10.0.0.7"), "new": ipaddress.ip_address("10.0.0.8")}
    with appliance.started(hosts=lambda: dict(hosts)) as policies:
        slow = Slow(monkeypatch, appliance)
        appliance.file.write_text(OPEN.replace("[Nodes]\ndefault=*", "[Nodes]\ndefault=host:ocu host:new"))
        loading = asyncio.ensure_future(policies.reload(PolicyReload(), "operator"))
        await slow.until_begun()
        hosts["ocu"] = ipaddress.ip_address("10.0.0.9")
        slow.over.set()
        await loading
        allowed = [
            text
            for text in ("10.0.0.7", "10.0.0.8", "10.0.0.9")
            if policies.current.decide(Request(ipaddress.ip_address(text), "/n", Category.NODE, "/n")).allowed
        ]
        assert (allowed, slow.rounds) == (["10.0.0.8", "10.0.0.9"], 2)


CASES = "cases:\n  - {host: 10.0.0.5, node: /n, publish: /t, expect: deny}\n"
REFUSED: dict[str, Callable[[Path], object]] = {
    "its tests fail": lambda file: file.with_name("policy.ini.tests.yaml").write_text(CASES),
    "its tests cannot be read": lambda file: file.with_name("policy.ini.tests.yaml").write_bytes(b"\xff"),
    "it has an error": lambda file: file.write_text("[Nonsense]\n"),
    "it is not text": lambda file: file.write_bytes(b"\xff"),
    "it is not there": lambda file: file.unlink(),
    "it is not signed": lambda file: file.with_name("policy.ini.sig").unlink(),
    "it is signed by another": lambda file: file.with_name("policy.ini.sig").write_text(
        signed(OTHER, OTHER_KEY)
    ),
}


@pytest.mark.parametrize("reason", REFUSED)
async def test_a_file_that_a_reload_refuses_is_refused_at_a_start(tmp_path: Path, reason: str) -> None:
    appliance = Appliance(tmp_path)
    beside = tmp_path / "policy.ini.sig"
    beside.write_text(signed(OPEN))
    with appliance.started(site_keys=[LINE]) as policies:
        assert (policies.revision, policies.file_refused) == (1, "")
        appliance.file.write_text(OTHER)
        beside.write_text(signed(OTHER))
        REFUSED[reason](appliance.file)
        with pytest.raises(PolicyRefusedError) as refused:
            await policies.reload(PolicyReload(), "operator")
        assert policies.file_refused == refused.value.findings[0]
    for restarted in (False, True, False):
        with appliance.started(restarted=restarted, site_keys=[LINE]) as policies:
            assert (policies.revision, policies.current.text) == (1, OPEN)
            assert policies.file_refused == refused.value.findings[0], "even after a crash of control"
            recorded = [event for event, _resource in appliance.records.pairs]
            assert recorded == ([] if restarted else ["policy file refused"])
    appliance.file.write_text(OTHER)
    beside.write_text(signed(OTHER))
    (tmp_path / "policy.ini.tests.yaml").unlink(missing_ok=True)
    with appliance.started(site_keys=[LINE]) as policies:
        assert (policies.revision, policies.current.text, policies.file_refused) == (2, OTHER, "")


@pytest.mark.parametrize("reason", REFUSED)
async def test_a_file_that_has_the_policy_in_force_again_is_not_refused(tmp_path: Path, reason: str) -> None:
    """Test cases that failed still do: their reason stays until a reload. No later text has an earlier reason."""
    appliance = Appliance(tmp_path)
    beside = tmp_path / "policy.ini.sig"
    beside.write_text(signed(OPEN))
    with appliance.started(site_keys=[LINE]) as policies:
        appliance.file.write_text(OTHER)
        beside.write_text(signed(OTHER))
        REFUSED[reason](appliance.file)
        with pytest.raises(PolicyRefusedError) as refused:
            await policies.reload(PolicyReload(), "operator")
        assert policies.look_at_file() == (True, refused.value.findings[0])
        appliance.file.write_text(OPEN)
        beside.write_text(signed(OPEN))
        kept = refused.value.findings[0] if (tmp_path / "policy.ini.tests.yaml").exists() else ""
        assert policies.look_at_file() == (False, kept)
        appliance.file.write_text(OTHER)
        assert policies.look_at_file() == (True, kept)


async def test_a_refused_file_does_not_end_the_timeout(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        await policies.reload(PolicyReload(confirm_within=600.0), "operator")
    appliance.file.write_text("[Nonsense]\n")
    with appliance.started() as policies:
        assert (policies.revision, policies.current.text) == (2, OTHER)
        assert policies.confirm_by is not None


async def test_the_first_start_has_nothing_to_keep(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    REFUSED["its tests fail"](appliance.file)
    with pytest.raises(PolicyRefusedError, match=r"policy.ini.tests.yaml:2:"):
        appliance.started().__enter__()


class DiedError(Exception):
    pass


@pytest.mark.nightly
async def test_a_crash_during_an_unconfirmed_change_rolls_it_back(tmp_path: Path) -> None:
    """The timeout counts from the time at which the new revision comes into force, so a crash cannot avoid it."""
    appliance = Appliance(tmp_path)

    def die(_before: object, _policy: object) -> int:
        raise DiedError

    with appliance.started(changed=die) as policies:
        appliance.file.write_text(OTHER)
        with pytest.raises(DiedError):
            await policies.reload(PolicyReload(confirm_within=1.0), "operator")
    with appliance.started(restarted=True) as policies:
        assert (policies.revision, policies.current.text) == (2, OTHER)
        await until(lambda: policies.revision == 3)
        assert policies.current.text == OPEN


@pytest.mark.nightly
async def test_the_loop_does_not_wait_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Appliance(tmp_path).started() as policies:
        read, loop_thread, asked = policies.store.database.query, threading.get_ident(), []

        def query(*given: Any) -> list[tuple[Any, ...]]:
            asked.append(threading.get_ident())
            return read(*given)

        monkeypatch.setattr(policies.store.database, "query", query)
        assert (await policies.load(PolicyLoad(OTHER), "eve")).revision == 2
        assert (await policies.roll_back(PolicyRollback(None), "eve")).revision == 3
        assert (await policies.reload(PolicyReload(confirm_within=1.0), "operator")).revision == 4
        await until(lambda: policies.revision == 5)
        assert [row.revision for row in (await policies.revisions(PolicyRevisions())).revisions] == [
            5, 4, 3, 2, 1,
        ]  # fmt: skip
        assert (await policies.text(PolicyWanted(2))).text == OTHER
        assert len(asked) >= 4
        assert loop_thread not in asked


async def unsigned(policies: Policies, change: Callable[[], Awaitable[object]]) -> str:
    before = policies.revision, policies.current.text
    with pytest.raises(PolicyRefusedError) as refused:
        await change()
    assert (policies.revision, policies.current.text) == before
    return refused.value.findings[0]


@pytest.mark.nightly
async def test_a_site_that_signs_accepts_only_signed_policies(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    beside = tmp_path / "policy.ini.sig"
    with pytest.raises(PolicyRefusedError, match="it has no signature of the site"):
        appliance.started(site_keys=[LINE]).__enter__()
    with appliance.started() as policies:  # revision 1 is unsigned
        assert policies.in_force.signature == ""
    beside.write_text(signed(OPEN))
    with appliance.started(site_keys=[LINE]) as policies:
        assert (policies.revision, policies.in_force.signature) == (2, signed(OPEN))
        appliance.file.write_text(OTHER)
        assert policies.differs_from_file
        with pytest.raises(PolicyRefusedError, match="it is not the text that"):
            await policies.reload(PolicyReload(), "operator")
        for signature in ("", signed(OPEN), signed(OTHER, OTHER_KEY)):
            with pytest.raises(PolicyRefusedError):
                await policies.load(PolicyLoad(OTHER, signature=signature), "eve")
        assert "no signature" in await unsigned(policies, lambda: policies.rollback(1, who="eve"))
        assert policies.hosts_changed() == 0
        await policies.load(PolicyLoad(OTHER, signature=signed(OTHER)), "adam")
        assert (await policies.rollback(2, who="eve")).revision == 4
    with appliance.started(restarted=True, site_keys=[LINE]) as policies:
        assert (policies.revision, policies.in_force.signature) == (4, signed(OPEN))
    with pytest.raises(PolicyRefusedError, match="this is revision 4, which eve brought into force"):
        appliance.started(site_keys=[OTHER_LINE]).__enter__()


@pytest.mark.nightly
async def test_a_rollback_restores_a_signed_revision(tmp_path: Path) -> None:
    appliance = Appliance(tmp_path)
    (tmp_path / "policy.ini.sig").write_text(signed(OPEN))
    with appliance.started(site_keys=[LINE]) as policies:
        await policies.load(PolicyLoad(OTHER, confirm_within=0.0, signature=signed(OTHER)), "adam")
        await until(lambda: policies.revision == 3)
        assert (policies.current.text, policies.in_force.signature) == (OPEN, signed(OPEN))


async def test_keys_are_replaced_while_both_are_valid(tmp_path: Path) -> None:
    """The same text with a new signature is a new revision, so no later crash requires the old key."""
    appliance = Appliance(tmp_path)
    beside = tmp_path / "policy.ini.sig"
    beside.write_text(signed(OPEN))
    with appliance.started(site_keys=[LINE]) as policies:
        differs = [policies.differs_from_file]
        beside.write_text(signed(OPEN, OTHER_KEY))
        differs.append(policies.differs_from_file)
        assert differs == [False, True]
    with appliance.started(site_keys=[LINE, OTHER_LINE]) as policies:
        assert (policies.revision, policies.in_force.signature) == (2, signed(OPEN, OTHER_KEY))
    with appliance.started(restarted=True, site_keys=[OTHER_LINE]) as policies:
        assert policies.revision == 2


@pytest.mark.nightly
async def test_the_same_text_posted_twice_is_one_revision(tmp_path: Path) -> None:
    with Appliance(tmp_path).started() as policies:
        first = await policies.load(PolicyLoad(OTHER, confirm_within=100.0), "adam")
        again = await policies.load(PolicyLoad(OTHER, "once more"), "eve")
        assert (first.revision, again.revision, again.replaced) == (2, 2, 2)
        assert again.confirm_by == first.confirm_by
        assert policies.in_force.who == "adam"
        assert (await policies.load(PolicyLoad(OPEN), "adam")).revision == 3


async def test_a_change_for_an_earlier_revision_is_refused(tmp_path: Path) -> None:
    with Appliance(tmp_path).started() as policies:
        seen = policies.revision
        await policies.load(PolicyLoad(OTHER, expected=seen), "alice")
        for change in (
            policies.load(PolicyLoad(OPEN, expected=seen), "bob"),
            policies.roll_back(PolicyRollback(expected=seen), "bob"),
            policies.reload(PolicyReload(expected=seen), "bob"),
            policies.confirm(PolicyConfirm(expected=seen), "bob"),
        ):
            with pytest.raises(RevisionChangedError):
                await change
        assert (policies.revision, policies.current.text) == (seen + 1, OTHER)


async def test_revisions_have_their_authors_and_notes(tmp_path: Path) -> None:
    with Appliance(tmp_path).started() as policies:
        await policies.load(PolicyLoad(OTHER, note="trial"), "alice")
        await policies.roll_back(PolicyRollback(1), "bob")
        rows = (await policies.revisions(PolicyRevisions())).revisions
        assert [(row.revision, row.who, row.in_force) for row in rows] == [
            (3, "bob", True), (2, "alice", False), (1, "disk", False),
        ]  # fmt: skip
        assert rows[1].note == "trial"
        assert (await policies.text(PolicyWanted(2))).text == OTHER
        with pytest.raises(PolicyRefusedError):
            await policies.roll_back(PolicyRollback(7777), "bob")


def test_a_policy_keeps_what_was_known_when_it_came_into_force() -> None:
    host, blocks, holders = (
        address_of("10.0.0.9"),
        {address_of("10.0.0.7"): "odd"},
        {"base": address_of("10.0.0.8")},
    )
    known = PolicyContext(blocks=blocks, holders=holders)
    policy = known.complete(compile_policy(OPEN, file="site.ini"))
    blocks[host], holders["arm"] = "odd", host
    assert (len(policy.blocks), list(policy.holders or ())) == (1, ["base"])
    assert not policy.decide(Request(address_of("10.0.0.7"), "/n", Category.PUBLISH, "/x")).allowed
    assert policy.decide(Request(host, "/n", Category.PUBLISH, "/x")).allowed


@pytest.mark.parametrize("way", ["start", "reload", "reload of other text", "load", "same load", "rollback"])
async def test_a_right_that_ended_before_a_load_stays_ended_when_the_clock_is_set_back(
    tmp_path: Path, way: str
) -> None:
    appliance, host = Appliance(tmp_path), ipaddress.ip_address("10.0.0.7")
    text = OPEN.replace(
        "[Publishers]", "[Publishers]\n/y = 10.0.0.7 until 2026-12-01\n/z = 10.0.0.7 until 2026-12-03"
    )
    appliance.file.write_text(text)

    def granted(policies: Policies) -> str:
        asked = (Request(host, "/n", Category.PUBLISH, name) for name in ("/y", "/z"))
        return "".join(one.resource[1] for one in asked if policies.current.decide(one).allowed)

    set_wall(datetime(2026, 12, 2, 12, tzinfo=UTC).timestamp())
    with appliance.started() as policies:
        match way:
            case "reload":
                await policies.reload(PolicyReload(), "operator")
            case "reload of other text":
                appliance.file.write_text(f"{text}# more\n")
                await policies.reload(PolicyReload(), "operator")
            case "load" | "same load" | "rollback":
                for _ in range(1 + (way == "same load")):
                    await policies.load(PolicyLoad(f"{text}# more\n"), "ann")
                if way == "rollback":
                    await policies.rollback(1, who="ann")
        assert granted(policies) == "z"
        set_wall(datetime(2026, 11, 30, tzinfo=UTC).timestamp())
        policies.time_passed()
        assert granted(policies) == "z"
    with appliance.started(restarted=True) as policies:
        assert granted(policies) == "z"
        await policies.reload(PolicyReload(), "operator")
        assert granted(policies) == "yz"


async def test_rights_end_and_begin_with_a_record_each_and_a_reload_begins_an_ended_one(
    tmp_path: Path,
) -> None:
    """The text stays as it is: there is no revision. A clock that was wrong ends a right until the policy is loaded."""
    appliance, host = Appliance(tmp_path), ipaddress.ip_address("10.0.0.7")
    night = "/x = 10.0.0.7 during night, 10.0.0.8 during night\n/y = 10.0.0.7 until 2026-12-01"
    rights = OPEN.replace("[Publishers]", f"[Publishers]\n{night}")
    appliance.file.write_text(f"{rights}\n[Hours]\nnight = 22:00-06:00\n")
    lines = [
        number
        for number, text in enumerate(appliance.file.read_text().split("\n"), 1)
        if text[:2] in ("/x", "/y")
    ]
    set_wall(datetime(2026, 12, 1, 21, 59, 50, tzinfo=UTC).timestamp())

    def told() -> list[str]:
        found = [record.reason for record in appliance.records.records if record.event == "rights changed"]
        appliance.records.clear()
        return found

    with appliance.started() as policies:

        def granted() -> str:
            asked = (Request(host, "/n", Category.PUBLISH, name) for name in ("/x", "/y"))
            return "".join(one.resource[1] for one in asked if policies.current.decide(one).allowed)

        assert granted() == "y"
        await asyncio.sleep(11.0)
        x, y = lines
        both = f"10.0.0.7 during night (line {x}), 10.0.0.8 during night (line {x})"
        assert (granted(), told()) == ("xy", [f"began: {both}"])
        set_wall(datetime(2026, 12, 2, 12, tzinfo=UTC).timestamp())
        await asyncio.sleep(6.0)
        assert granted() == ""
        assert told() == [
            f"ended: 10.0.0.7 during night (line {x}), 10.0.0.7 until 2026-12-01 (line {y}),"
            f" 10.0.0.8 during night (line {x})"
        ]
        set_wall(datetime(2026, 12, 1, 22, 1, tzinfo=UTC).timestamp())
        policies.time_passed()
        assert granted() == "x"
        set_wall(1000.0)
        appliance.behind = 1e9
        policies.time_passed()
        assert granted() == ""
        appliance.behind = 0.0
        set_wall(datetime(2026, 12, 1, 22, 1, tzinfo=UTC).timestamp())
        policies.time_passed()
        assert (granted(), policies.revision) == ("x", 1)
        await policies.reload(PolicyReload(), "operator")
        assert granted() == "xy"
