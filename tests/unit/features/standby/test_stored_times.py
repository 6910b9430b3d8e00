import asyncio
import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.base.age_clock import AgeClock
from appliance.channel.answers.status import HandledAlarm, Status
from appliance.control.assembly.host_blocks import BlockTable
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.features.standby.lease_client import LeaseClient
from appliance.features.standby.replication import Pair
from appliance.features.standby.standby_tunnels import StandbyTunnels
from appliance.features.standby.stored_times import adopt_times, note_times
from appliance.policy.model import address_of
from appliance.store import host_tables
from appliance.store.access_tokens import make_token
from appliance.store.host_tables import EnrolmentTokenRow
from appliance.store.revisions import LIMITS
from appliance.store.state_file import SCHEMA, StateStore
from tests.support.answers import example
from tests.support.engines import InlineDatabase
from tests.support.features.standby.standby_site import memberships
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
HOUR = 3600.0
HOST = address_of("10.0.0.66")
WALL = 1_790_000_000.0


@pytest.fixture(scope="module")
def members(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Pair]:
    made, *_settings = memberships(tmp_path_factory.mktemp("members"))
    return {
        name: Pair(one, LeaseClient(), 0, None, taken_over=True, tunnels=StandbyTunnels())
        for name, one in made.items()
    }


class Two:
    def __init__(self, home: Path, members: dict[str, Pair], ahead: float) -> None:
        self.members, self.home = members, home
        self.clocks = {
            "a": VirtualClock(wall=WALL, now=100.0),
            "b": VirtualClock(wall=WALL + ahead, now=9000.0),
        }
        self.store = StateStore(home, failed=pytest.fail, kind=InlineDatabase)

    def let_pass(self, seconds: float) -> None:
        for machine in self.clocks.values():
            machine.advance(seconds)

    @contextlib.contextmanager
    def active(self, name: str, away_seconds: float | None = None) -> Iterator[BlockTable]:
        folder = self.home / name
        folder.mkdir(exist_ok=True)
        with clock.using(self.clocks[name]):
            age = AgeClock(folder / "age")
            adopt_times(self.store, self.members[name]._replace(away_seconds=away_seconds), age)
            yield BlockTable(self.store, age)

    async def note(self, name: str, blocks: BlockTable) -> None:
        blocks.read_clock()
        noting = asyncio.create_task(note_times(self.store, self.members[name], blocks.age_now))
        await asyncio.sleep(0)
        noting.cancel()

    def left(self, blocks: BlockTable) -> dict[str, float]:
        blocks.read_clock()
        settings, now = self.store.settings(), clock.wall()
        [row] = self.store.tokens()
        [awaited] = self.store.hosts.awaited()
        returns = re.search(r'"until":([\d.]+)', settings["monitor returns"])
        assert returns is not None
        return {
            **{name: float(settings[name].split()[1]) - now for name in LIMITS},
            "disable": float(returns[1]) - now,
            "silence": self.silenced() - now,
            "block": blocks.seconds_left() or 0.0,
            "token": row.expires - now,
            "awaited": awaited.expires - now,
        }

    def silenced(self) -> float:
        """Return the end of the silence, or now if it has ended."""
        for row in self.handled().marked(example(Status)).handled_alarms:
            if row.until is not None:
                return row.until
        return clock.wall()

    def handled(self) -> HandledAlarms:
        return HandledAlarms(self.store)

    def begin(self, blocks: BlockTable) -> None:
        now = clock.wall()
        for name in LIMITS:
            self.store.save_setting(name, f"1 {now + HOUR} {HOUR}")
        returns = f'{{"gun":{{"until":{now + HOUR},"seconds":{HOUR},"back":true}}}}'
        self.store.save_setting("monitor returns", returns)
        self.handled().put(HandledAlarm("rosmaster", "ann", now, now + HOUR))
        blocks.put(HOST, seconds=HOUR, who="ann", note="")
        self.store.save_tokens(make_token("ci", "viewer", now=now, seconds=HOUR)[0])
        self.store.hosts.save_awaited(
            EnrolmentTokenRow("ocu", "id", b"hash", now, now + HOUR, "10.0.0.9", 1.0, {}, "ann")
        )


@pytest.fixture
def two(tmp_path: Path, members: dict[str, Pair]) -> Iterator[Callable[[float], Two]]:
    made: list[Two] = []

    def make(ahead: float) -> Two:
        made.append(Two(tmp_path, members, ahead))
        return made[-1]

    yield make
    for one in made:
        one.store.close()


@pytest.mark.parametrize("ahead", [0.0, HOUR, -HOUR, 3e8, -3e8])
async def test_every_duration_keeps_its_length_over_takeovers(
    two: Callable[[float], Two], ahead: float
) -> None:
    pair = two(ahead)
    with pair.active("a") as blocks:
        blocks.read_clock()
        pair.begin(blocks)
        pair.let_pass(600.0)
        await pair.note("a", blocks)
    pair.let_pass(5.0)
    for _ in range(2):  # a start of the same appliance moves nothing again
        with pair.active("b", away_seconds=5.0) as blocks:
            assert pair.left(blocks) == {name: pytest.approx(HOUR - 605.0) for name in pair.left(blocks)}
    with pair.active("b") as blocks:
        pair.let_pass(600.0)
        await pair.note("b", blocks)
    with pair.active("a", away_seconds=0.0) as blocks:
        assert pair.left(blocks) == {name: pytest.approx(HOUR - 1205.0) for name in pair.left(blocks)}
        assert HOST in blocks.rows()
        assert not blocks.due()


async def test_without_a_view_of_the_other_appliance_durations_go_on_from_the_last_reading(
    two: Callable[[float], Two],
) -> None:
    pair = two(HOUR)
    with pair.active("a") as blocks:
        blocks.read_clock()
        pair.begin(blocks)
        pair.let_pass(600.0)
        await pair.note("a", blocks)
    pair.let_pass(86_400.0)
    with pair.active("b") as blocks:
        left = pair.left(blocks)
        assert left.pop("token") == pytest.approx(-86_400.0 - 600.0)
        assert left == {name: pytest.approx(HOUR - 600.0) for name in left}


MOVED = {"token.expires", "door_ticket.expires", "enrolment_token.expires", "host_block.ends"}
DATES = {
    "incarnation.changed": "monotonic seconds, used only for the order",
    "policy_revision.loaded": "shown to people",
    "monitor_revision.loaded": "shown to people",
    "token.created": "shown to people",
    "token.revoked": "shown to people",
    "token_use.used": "shown to people",
    "token_left.seconds": "a length",
    "host.expires": "the end of a certificate, which is a date",
    "host.enrolled": "shown to people",
    "host.revoked": "shown to people",
    "host_certificate.made": "shown to people",
    "host_certificate.next_expires": "the end of a certificate, which is a date",
    "host_ports.checked": "shown to people", "enrolment_token.created": "shown to people",
    "enrolment_token.days": "a length", "revoked_certificate.moment": "a date of the list of revoked certificates",
    "revocation.moment": "a date of the list of revoked certificates",
    "revocation.expires": "the end of a certificate, which is a date", "host_block.since": "shown to people",
    "door.added": "shown to people", "door.removed": "shown to people", "door_ticket.created": "shown to people",
    "authority.signed": "a date of the list of revoked certificates",
    "appliance.expires": "the end of a certificate, which is a date",
}  # fmt: skip


async def test_every_stored_time_is_moved_or_a_date() -> None:
    found = {"host_block.ends"}
    for table, columns in re.findall(
        r"CREATE TABLE IF NOT EXISTS (\w+) \((.*?)\)(?: WITHOUT ROWID)?;", SCHEMA, re.DOTALL
    ):
        found |= {f"{table}.{column}" for column in re.findall(r"(\w+) REAL", columns)}
    assert host_tables.SCHEMA in SCHEMA
    assert found == MOVED | DATES.keys()
