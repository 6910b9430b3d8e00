"""Each kind of ends, whatever happens to the machine and its clocks. Kinds and owners are found in the code."""

import asyncio
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from inspect import isawaitable
from itertools import count
from pathlib import Path

import pytest

from appliance.base import age_clock, clock
from appliance.base.age_clock import AgeClock
from appliance.control.errors import TokenRefusedError
from appliance.store import access_tokens
from appliance.store.changes import Change
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import SCHEMA, RevisionRow, StateStore
from appliance.store.writer_thread import StoreError
from tests.support.ends import WALL, Ending
from tests.support.engines import InlineDatabase, KilledError
from tests.support.sources import ROOT
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
HOUR, DAY, YEAR = 3600.0, 86_400.0, 365 * 86_400.0
_MADE = re.compile(r'EndKind\(\s*"([^"]+)"')


Owner = Callable[[StateStore, EndTable], Ending]


def owned() -> Iterator[tuple[EndKind, Owner]]:
    for path in sorted((ROOT / "tests").rglob("ending.py")):
        module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        yield from module.ENDINGS.items()


OWNED = [*owned()]
KINDS = [kind for kind, _owner in OWNED]


def test_each_kind_of_ends_has_one_owner_in_this_table() -> None:
    made = [name for path in (ROOT / "appliance").rglob("*.py") for name in _MADE.findall(path.read_text())]
    assert sorted(made) == sorted(kind.name for kind in KINDS)


DATES = {
    "the end of a certificate, which is a date": "host.expires host_certificate.next_expires revocation.expires"
    " appliance.expires",
    "the date of an end, for people": "token.expires door_ticket.expires enrolment_token.expires",
    "the past": "policy_revision.loaded monitor_revision.loaded token.created token.revoked token_use.used"
    " host.enrolled host.revoked host_certificate.made host_ports.checked enrolment_token.created"
    " revoked_certificate.moment revocation.moment host_block.since door.added door.removed door_ticket.created"
    " authority.signed",
    "monotonic seconds, for the order": "incarnation.changed",
    "a length": "enrolment_token.days",
}


class Site:
    """Two machines that may serve from the same state; `a` begins."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.clocks = {"a": VirtualClock(wall=WALL, now=100.0), "b": VirtualClock(wall=WALL, now=9000.0)}
        self.active = "a"
        self.built = 0.0  # the date of the program's files
        self.cut_short: list[str] = []
        self.store: StateStore | None = None

    def start(self, name: str = "", *, away: float | None = None, paired: bool = False) -> None:
        self.active = name or self.active
        if self.store is not None:
            self.store.close()
        self.store = StateStore(self.home, failed=pytest.fail, kind=InlineDatabase)
        (self.home / self.active).mkdir(exist_ok=True)
        with clock.using(self.clocks[self.active]):
            age = AgeClock(self.home / self.active / "age")
            appliance = self.active if paired else ""
            self.ends = EndTable(
                self.store,
                age,
                appliance=appliance,
                away_seconds=away,
                behind=lambda: max(0.0, self.built - clock.wall()),
            )
            self.ends.when_cut_short(lambda kind, _name, _seconds: self.cut_short.append(kind))
            self.things = {kind: owner(self.store, self.ends) for kind, owner in OWNED}

    def off(self, seconds: float, ahead: float = 0.0) -> None:
        """Let the machine be off for some time; then its clock is `ahead`. Its time since the boot begins again."""
        wall = self.clocks["a"].wall_ns() / 1e9 + seconds + ahead
        self.clocks["a"] = VirtualClock(wall=wall, now=5.0)
        self.start()

    def run(self, seconds: float) -> None:
        for machine in self.clocks.values():
            machine.advance(seconds)
        with clock.using(self.clocks[self.active]):
            self.ends.read_clock()
            self.ends.look()

    async def begin(self) -> None:
        with clock.using(self.clocks[self.active]):
            for thing in self.things.values():
                if isawaitable(begun := thing.begin(HOUR)):
                    await begun

    async def lasting(self) -> set[str]:
        with clock.using(self.clocks[self.active]):
            self.ends.look()
            for _ in range(3):  # an owner may end a thing in a task
                await asyncio.sleep(0)
            return {kind.name for kind, thing in self.things.items() if thing.lasts()}

    async def end_after(self, left: Callable[[EndKind], float]) -> None:
        """Assert that each thing has this many seconds left, within the time between two notes of the clocks."""
        passed = 0.0
        for moment in sorted({left(kind) + play for kind in self.things for play in (-35.0, 35.0)} | {0.0}):
            if moment >= passed:
                self.run(moment - passed)
                passed = moment
                expected = {kind.name for kind in self.things if left(kind) > moment}
                assert await self.lasting() == expected, f"after {moment} s"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setattr(access_tokens, "hash_secret", lambda _secret, _salt: b"hash")  # which takes 40 ms
    monkeypatch.setattr(age_clock, "write_whole", lambda path, data, _mode: path.write_bytes(data))
    site = Site(tmp_path)
    yield site
    if site.store is not None:
        site.store.close()


async def begun(site: Site, *, paired: bool = False) -> None:
    site.start(paired=paired)
    await site.begin()
    site.run(600.0)


async def test_each_thing_has_its_time(site: Site) -> None:
    await begun(site)
    await site.end_after(lambda _kind: 3000.0)


async def test_a_clock_that_is_set_while_control_runs_ends_credentials_early_and_moves_no_other_end(
    site: Site,
) -> None:
    await begun(site)
    for ahead in (-HOUR, -YEAR, 0.0):
        site.clocks["a"].set_wall(WALL + ahead)
        site.run(10.0)
        assert len(await site.lasting()) == len(KINDS)
    for ahead in (HOUR, YEAR, 0.0):
        site.clocks["a"].set_wall(WALL + ahead)
        site.run(10.0)
        assert await site.lasting() == {kind.name for kind in KINDS if not kind.dated}
    assert sorted(site.cut_short) == sorted(kind.name for kind in KINDS if kind.dated)
    await site.end_after(lambda kind: 0.0 if kind.dated else 2940.0)
    assert len(site.cut_short) == sum(kind.dated for kind in KINDS)


WRITTEN = {kind for kind in KINDS if kind.name == "change of rights"}
"""Kinds whose date people write, so that it does not depend on the clock at the beginning."""
BEFORE, BUILT = 1000.0, WALL - 40 * DAY
"""The system clock of a machine that has not set it yet, and the date of the program's files."""


@pytest.mark.parametrize("before", [BEFORE, BUILT - 2 * DAY], ids=["1970", "the date of an image"])
async def test_a_right_that_began_before_the_clock_was_set_keeps_its_time(site: Site, before: float) -> None:
    site.built = BUILT
    site.clocks["a"].set_wall(before)
    await begun(site)
    site.clocks["a"].set_wall(WALL)
    kept = [(kind, name) for kind in site.things for name in site.ends.names(kind)]
    for seconds in (0.0, 10.0):  # before the table sees the step, and after it
        with clock.using(site.clocks["a"]):
            assert not any(site.ends.is_over(*one) for one in kept)
            dates = [site.ends.date(*one) for one in kept]
        assert dates == pytest.approx([WALL + 3000.0] * len(kept), abs=1.0)
        site.run(seconds)
    site.run(0.0)
    assert len(await site.lasting()) == len(KINDS)
    await site.end_after(lambda _kind: 2990.0)
    assert site.cut_short == []


async def test_a_right_that_began_before_a_restart_is_dated_from_the_programs_files(site: Site) -> None:
    site.built = BUILT
    site.clocks["a"].set_wall(BEFORE)
    await begun(site)
    site.off(5.0)
    site.clocks["a"].set_wall(BUILT + 1800.0)
    site.run(10.0)
    assert len(await site.lasting()) == sum(kind.stored for kind in KINDS)
    site.clocks["a"].set_wall(WALL)
    dated = {kind for kind in KINDS if kind.dated} - WRITTEN
    await site.end_after(
        lambda kind: 0.0 if kind in dated or not kind.stored else 3000.0 if kind in WRITTEN else 2985.0
    )
    assert sorted(site.cut_short) == sorted(kind.name for kind in KINDS if kind.dated)


async def test_time_off_that_a_late_correction_of_the_clock_shows_counts_for_credentials(site: Site) -> None:
    await begun(site)
    site.off(2400.0, ahead=-2400.0)  # a machine without a clock of its own begins where it ended
    site.clocks["a"].set_wall(WALL + 3000.0)
    await site.end_after(lambda kind: (600.0 if kind.dated else 3000.0) if kind.stored else 0.0)


@pytest.mark.parametrize(
    ("ahead", "left", "late"),
    [
        (0.0, 2995.0, 2995.0),
        (HOUR, 0.0, 0.0),  # like an hour off
        (-HOUR, 3000.0, 3000.0),  # the time off is not known
        (YEAR, 0.0, 3000.0),  # may be a year off, or a wrong clock
        (-YEAR, 3000.0, 3000.0),
    ],
)
async def test_no_restart_gives_an_end_more_time(site: Site, ahead: float, left: float, late: float) -> None:
    await begun(site)
    site.off(5.0, ahead)
    await site.end_after(lambda kind: (late if kind.late else left) if kind.stored else 0.0)
    told = [kind.name for kind in KINDS if kind.stored and not kind.late]
    assert sorted(site.cut_short) == (sorted(told) if ahead == YEAR else [])


@pytest.mark.parametrize("ahead", [0.0, HOUR, -HOUR, YEAR, -YEAR])
async def test_each_stored_end_keeps_its_time_over_takeovers(site: Site, ahead: float) -> None:
    site.clocks["b"].set_wall(WALL + ahead)
    await begun(site, paired=True)
    site.run(5.0)
    for away in (5.0, None):  # a second start of the same appliance moves nothing again
        site.start("b", away=away, paired=True)
    site.run(600.0)
    site.start("a", away=0.0, paired=True)
    await site.end_after(lambda kind: 2395.0 if kind.stored else 0.0)


async def test_a_takeover_from_a_machine_whose_clock_was_not_set_prolongs_no_right(site: Site) -> None:
    site.built = BUILT
    site.clocks["a"].set_wall(BEFORE)
    await begun(site, paired=True)
    site.start("b", away=0.0, paired=True)
    for machine in site.clocks.values():
        machine.set_wall(WALL + 1000.0)  # the other one's clock was right, and is set again
    site.run(10.0)
    left = {
        kind: 1990.0 if kind in WRITTEN else 2590.0 if kind.dated else 2990.0 for kind in KINDS if kind.stored
    }
    await site.end_after(lambda kind: left.get(kind, 0.0))


@pytest.mark.parametrize("paired", [True, False], ids=["paired", "left the pair"])
@pytest.mark.parametrize("ahead", [0.0, HOUR, -HOUR, YEAR, -YEAR])
async def test_a_takeover_without_a_view_of_the_other_appliance_prolongs_no_right(
    site: Site, ahead: float, paired: bool
) -> None:
    site.clocks["b"].set_wall(WALL + ahead)
    await begun(site, paired=True)
    for machine in site.clocks.values():
        machine.advance(600.0)
    site.start("b", paired=paired)
    right = 3000.0 if ahead < 0 else max(0.0, 2400.0 - ahead)  # no more than by either clock
    await site.end_after(lambda kind: (3000.0 if kind.late else right) if kind.stored else 0.0)


async def test_on_a_full_disk_each_thing_ends(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    await begun(site)

    def full() -> None:
        raise StoreError("the disk is full")

    assert site.store is not None
    monkeypatch.setattr(site.store.database, "require_room", full)
    site.run(60.0)
    monkeypatch.undo()
    await site.end_after(lambda _kind: 2940.0)


async def _after_a_kill(owner: Owner, home: Path, writes: int) -> bool | None:
    """Return whether a thing lasts 1.5 hours after it began for one, and control died after some writes of a change
    to a day. None: control lived.
    """
    machine, killed, left = VirtualClock(wall=WALL, now=100.0), False, iter(range(writes))
    with clock.using(machine):
        store = StateStore(home, failed=pytest.fail, kind=InlineDatabase)
        thing = owner(store, EndTable(store, AgeClock(home / "age")))
        if isawaitable(begun := thing.begin(HOUR)):
            await begun
        keep = store.database.keep

        def keep_some(changes: list[tuple[Change, bool]]) -> None:
            if next(left, None) is None:
                raise KilledError
            keep(changes)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(store.database, "keep", keep_some)
            try:
                with suppress(TokenRefusedError):  # there is one already
                    if isawaitable(begun := thing.begin(DAY)):
                        await begun
            except KilledError:
                killed = True
        store.close()
        machine.advance(1.5 * HOUR)
        again = StateStore(home, failed=pytest.fail, kind=InlineDatabase)
        ends = EndTable(again, AgeClock(home / "age"))
        thing = owner(again, ends)
        ends.look()
        for _ in range(3):
            await asyncio.sleep(0)
        lasts = thing.lasts()
        again.close()
    return lasts if killed else None


@pytest.mark.parametrize(
    ("kind", "owner"),
    [(kind, owner) for kind, owner in OWNED if kind.stored],
    ids=lambda one: one.name if isinstance(one, EndKind) else "",
)
async def test_a_kill_at_any_write_gives_no_thing_the_end_of_another(
    kind: EndKind, owner: Owner, tmp_path: Path, site: Site
) -> None:
    del site
    for writes in count():
        home = tmp_path / str(writes)
        home.mkdir()
        lasts = await _after_a_kill(owner, home, writes)
        assert not lasts, f"{kind.name} after {writes} writes"
        if lasts is None:
            break


async def test_time_off_that_counts_later_takes_no_time_from_a_later_beginning(site: Site) -> None:
    site.start()
    site.off(90 * DAY)
    await site.begin()
    site.run(HOUR - 1)
    assert len(await site.lasting()) == len(KINDS)
    site.run(2.0)
    assert await site.lasting() == set()


async def test_a_long_time_off_is_added_to_the_ends_of_its_first_day(site: Site) -> None:
    kind = EndKind("test", late=True)
    site.start()
    site.off(90 * DAY)
    with clock.using(site.clocks["a"]):
        site.ends.set(kind, "x", 2 * DAY)
    for _ in range(30):
        site.run(HOUR)
    site.off(60.0)
    with clock.using(site.clocks["a"]):
        assert site.ends.time_left(kind, "x") == pytest.approx(2 * DAY - 30 * HOUR - 60.0, abs=1.0)


async def test_a_fault_of_one_owner_keeps_no_other_end(site: Site) -> None:
    site.start()
    called: list[str] = []

    def faulty(_names: list[str]) -> None:
        raise ValueError("a defect")

    with clock.using(site.clocks["a"]):
        for name, call in (("faulty", faulty), ("good", called.extend)):
            kind = EndKind(name)
            site.ends.when_due(kind, call)
            site.ends.set(kind, name, 0.0)
        site.ends.look()
        site.ends.look()
    assert called == ["good", "good"], "an end that its owner does not forget is due again"


async def test_the_owner_is_called_at_the_end(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    ends, kind, called = EndTable(store, AgeClock(tmp_path / "age")), EndKind("test"), asyncio.Queue[float]()

    def due(names: list[str]) -> None:
        ends.forget(kind, *names)
        called.put_nowait(clock.now())

    ends.when_due(kind, due)
    running = asyncio.create_task(ends.run())
    await asyncio.sleep(7.0)
    began = clock.now()
    ends.set(kind, "x", 3.25)
    assert await called.get() - began == pytest.approx(3.25, abs=0.01)
    assert ends.next_due() is None
    running.cancel()
    store.close()


def test_no_other_column_of_the_state_is_an_end() -> None:
    columns = {
        f"{table}.{column}"
        for table, body in re.findall(
            r"CREATE TABLE IF NOT EXISTS (\w+) \((.*?)\)(?: WITHOUT ROWID)?;", SCHEMA, re.S
        )
        for column in re.findall(r"(\w+) REAL", body)
    }
    assert columns == {column for group in DATES.values() for column in group.split()}


@pytest.mark.parametrize(("paired", "notes"), [(True, 12), (False, 2)])
async def test_the_clocks_are_noted_more_often_in_a_pair(site: Site, paired: bool, notes: int) -> None:
    site.start(paired=paired)
    assert site.store is not None
    before = site.store.database.number
    for _ in range(12):
        site.run(5.0)
    assert site.store.database.number - before == notes


def test_the_state_of_a_version_before_0_4_is_refused(tmp_path: Path) -> None:
    """Its rights would have no end in the table, so each of them would have ended."""
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    store.save_revision(RevisionRow(1, "", "", 0.0, "disk", ""))
    with pytest.raises(StoreError, match=r"before 0\.4: install 0\.4\.1, start it once"):
        EndTable(store, AgeClock(tmp_path / "age"))
    store.close()
