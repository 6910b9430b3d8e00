import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from appliance.audit.log import log_database
from appliance.audit.log.log_writer import ChainWriter
from appliance.base.actors import DISK
from appliance.channel import messages
from appliance.configuration.settings import Audit, Settings
from appliance.features.standby.membership import Membership
from appliance.features.standby.passive import TakeoverCheck
from appliance.features.standby.summary import CHECKING, UNCHECKED
from appliance.specifications.checking import contents_at_start
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_files import CheckedSpecifications, Sources
from appliance.specifications.specification_revisions import text_of
from appliance.specifications.switches import SWITCHES
from appliance.store.state_file import IncarnationRow, MonitorRevisionRow, RevisionRow, StateStore
from tests.support.appliance import OPEN_POLICY
from tests.support.engines import InlineDatabase
from tests.support.features.standby.standby_site import memberships
from tests.support.site_key import LINE, signed
from tests.support.stated import parts_here
from tests.unit.specifications.monitor_desk import TEXTS, Desk, here

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]
SECONDS = 60


class Standby:
    def __init__(self, home: Path) -> None:
        self.home = home
        (home / "control").mkdir()
        self.monitors = home / "monitors"
        self.monitors.mkdir()
        self.policy = home / "policy.ini"
        self.policy.write_text(OPEN_POLICY)
        self.store = StateStore(home / "control", failed=pytest.fail, kind=InlineDatabase)
        self.store.save_setting("ends", "1")
        self.membership = memberships(home)[0]["b"]
        self.store.save_revision(self.revision(OPEN_POLICY))

    def revision(self, text: str, signature: str = "") -> RevisionRow:
        number = len(self.store.revisions()) + 1
        return RevisionRow(number, text, f"revision {number}", 0.0, "alice", "", signature)

    def save_specification(self, text: str, who: str = "alice") -> None:
        number = len(self.store.monitor_revisions()) + 1
        sources = text_of(Sources({"one.rv": text}))
        self.store.save_monitor_revision(MonitorRevisionRow(number, sources, 0.0, who, ""))

    @contextlib.asynccontextmanager
    async def checked(
        self,
        *,
        again: float = 3600.0,
        membership: Membership | None = None,
        compiler: SpecificationCompiler | None = None,
        **settings: Any,
    ) -> AsyncIterator["Checked"]:
        await self.store.until_settled()
        given: dict[str, Any] = {
            "listen": "127.0.0.1:0",
            "isolation": "none",
            "monitors": self.monitors,
        } | settings
        whole = Settings(state=self.home, policy=self.policy, **given)
        compiling = (strictly, parts_here) if compiler is None else (compiler.check_at_start, compiler.parts)
        checked = Checked(
            TakeoverCheck(whole, membership or self.membership, *compiling, again=again), self.store
        )
        task = asyncio.create_task(checked.check.run(checked.changed.set))
        try:
            async with asyncio.timeout(SECONDS):
                yield checked
        finally:
            task.cancel()
            await asyncio.wait([task])


async def strictly(
    sources: Sources, site_keys: Sequence[str], _known: Sequence[str] | None
) -> CheckedSpecifications:
    return await here(sources, site_keys)


class Checked:
    def __init__(self, check: TakeoverCheck, store: StateStore) -> None:
        self.check = check
        self.changed = asyncio.Event()
        self._store = store

    async def next_obstacle(self) -> str:
        await self.changed.wait()
        self.changed.clear()
        assert self.check.obstacle != UNCHECKED
        return self.check.obstacle

    async def replicate(self) -> None:
        await self._store.until_settled()
        self.check.note_news()


@pytest.fixture
def standby(tmp_path: Path) -> Iterator[Standby]:
    made = Standby(tmp_path)
    yield made
    made.store.close()


async def test_a_standby_without_obstacles(standby: Standby) -> None:
    standby.save_specification(TEXTS["a"])
    async with standby.checked() as checked:
        assert checked.check.obstacle == UNCHECKED
        assert await checked.next_obstacle() == ""


async def test_a_standby_with_little_room_takes_over_only_what_the_other_one_has_lost(
    standby: Standby, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would serve, but in service it needs more than it has: the two could pass the lease to and fro."""
    free = 16 << 20
    monkeypatch.setattr("os.statvfs", lambda _folder: SimpleNamespace(f_bavail=free, f_frsize=1))
    async with standby.checked() as checked:
        assert (await checked.next_obstacle(), checked.check.scarce) == ("", "")
        free -= 1
        await checked.replicate()
        assert await checked.next_obstacle() == ""
        assert "16777215 bytes are free on its disk, 16777216 are wanted" in checked.check.scarce
        assert "takes over only while a is away" in checked.check.scarce
        free = (4 << 20) - 1
        await checked.replicate()
        assert "4194303 bytes are free" in await checked.next_obstacle()
        assert checked.check.scarce == ""


async def test_a_change_keeps_the_lease_from_it_until_a_check_that_began_later_has_ended(
    standby: Standby,
) -> None:
    """It still takes over what the other one has lost."""
    begun: asyncio.Queue[Sources] = asyncio.Queue()
    goes_on = asyncio.Semaphore(1)

    class Slow(SpecificationCompiler):
        async def check_at_start(self, sources: Sources, *_: object) -> CheckedSpecifications:
            begun.put_nowait(sources)
            await goes_on.acquire()
            return await here(sources, [])

    async with standby.checked(compiler=Slow(lambda: None)) as checked:
        assert (await checked.next_obstacle(), checked.check.scarce) == ("", "")
        for _ in range(2):
            await checked.replicate()
            assert (checked.check.obstacle, checked.check.scarce) == ("", CHECKING)
            await begun.get()
        for left in (CHECKING, ""):
            goes_on.release()
            assert (await checked.next_obstacle(), checked.check.scarce) == ("", left)


async def test_the_state_of_an_active_appliance_before_0_4(standby: Standby) -> None:
    standby.store.database.delete("setting", name="ends")
    async with standby.checked() as checked:
        assert "made by a version before 0.4: install 0.4.1" in await checked.next_obstacle()


async def test_other_site_keys(standby: Standby) -> None:
    """The active appliance's policy and specifications must have signatures that this one accepts."""
    async with standby.checked(site_keys=[LINE]) as checked:
        assert "revision 1:1:1: error: it has no signature of the site" in await checked.next_obstacle()
        standby.store.save_revision(standby.revision(OPEN_POLICY, signed(OPEN_POLICY)))
        await checked.replicate()
        assert await checked.next_obstacle() == ""
        standby.save_specification(TEXTS["a"])
        await checked.replicate()
        assert "one.rv:1:1: error: it has no signature of the site" in await checked.next_obstacle()


async def test_a_policy_and_a_specification_that_this_version_cannot_load(standby: Standby) -> None:
    standby.store.save_revision(standby.revision(f"{OPEN_POLICY}[Tomorrow]\n"))
    async with standby.checked() as checked:
        assert "revision 2:9:" in await checked.next_obstacle()
        standby.store.save_revision(standby.revision(OPEN_POLICY))
        standby.save_specification(TEXTS["nonsense"])
        await checked.replicate()
        assert "one.rv:1:" in await checked.next_obstacle()
        standby.save_specification(TEXTS["a"])
        await checked.replicate()
        assert await checked.next_obstacle() == ""


async def test_state_that_this_version_does_not_understand(standby: Standby) -> None:
    row = IncarnationRow(
        "k", "/n", "10.0.0.7", "http://10.0.0.7:1/", "10.0.0.7", 1, 2, False, "dreaming", 0.0
    )
    standby.store.save_incarnation(row)
    async with standby.checked(again=0.05) as checked:
        obstacle = await checked.next_obstacle()
        assert "'dreaming' is not a valid Life" in obstacle
        assert obstacle.endswith("update this appliance to the same version")
        standby.store.forget_incarnation("k")
        assert await checked.next_obstacle() == ""


async def test_an_unreadable_folder_of_specifications(standby: Standby) -> None:
    standby.monitors.rmdir()
    async with standby.checked(again=0.05) as checked:
        assert await checked.next_obstacle() == (
            f"{standby.monitors}: the folder of specifications does not exist;"
            " create it, or name another with --monitors"
        )
        standby.monitors.mkdir()
        assert await checked.next_obstacle() == ""


async def test_an_unreadable_policy(standby: Standby) -> None:
    """Only a standby that has no replicated policy yet would read its own file."""
    standby.policy.unlink()
    async with standby.checked() as checked:
        assert await checked.next_obstacle() == ""
    standby.store.database.delete("policy_revision", revision=1)
    async with standby.checked(again=0.05) as checked:
        assert f"{standby.policy}: the policy cannot be read" in await checked.next_obstacle()
        standby.policy.write_text(OPEN_POLICY)
        assert await checked.next_obstacle() == ""


async def test_a_monitor_to_enable_that_does_not_exist(standby: Standby) -> None:
    standby.save_specification(TEXTS["a"], who=DISK)
    async with standby.checked(enable="a,other") as checked:
        assert "no monitor is named other; there are: a" in await checked.next_obstacle()


async def test_a_port_in_use(standby: Standby) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        async with standby.checked(again=0.05, listen=f"127.0.0.1:{port}") as checked:
            assert f"127.0.0.1:{port} cannot be listened on" in await checked.next_obstacle()
            taken.close()
            assert await checked.next_obstacle() == ""
            socket.create_server(("127.0.0.1", port)).close()


async def test_a_damaged_certificate(standby: Standby) -> None:
    damaged = msgspec.structs.replace(standby.membership, certificate="")
    async with standby.checked(membership=damaged) as checked:
        assert "the certificates of the two appliances cannot be used" in await checked.next_obstacle()


async def test_an_audit_log_that_cannot_be_written(standby: Standby) -> None:
    """With `deny` nothing would be granted, so the new active appliance would give the lease away again."""
    path = standby.home / "control" / "audit.db"
    log_database.create(path, 1)
    refused = f"the audit log cannot be written: {path}: "
    async with standby.checked(again=0.05) as checked:
        assert await checked.next_obstacle() == ""
        with contextlib.closing(ChainWriter(path, 1)):
            assert (
                await checked.next_obstacle()
                == f"{refused}another process writes this log: stop that appliance"
            )
        assert await checked.next_obstacle() == ""
        path.with_name("audit.db-wal").mkdir()
        assert await checked.next_obstacle() == f"{refused}unable to open database file"
        path.with_name("audit.db-wal").rmdir()
        assert await checked.next_obstacle() == ""
        path.write_bytes(b"not a log")
        assert (await checked.next_obstacle()).startswith(refused)
    async with standby.checked(audit=Audit(on_audit_failure="allow")) as checked:
        assert await checked.next_obstacle() == ""


async def test_a_takeover_compiles_nothing(standby: Standby, monkeypatch: pytest.MonkeyPatch) -> None:
    questions: list[messages.Message] = []

    async def asked(question: Callable[[int], messages.Message], *_: Any, **__: Any) -> messages.Message:
        questions.append(wanted := question(0))
        if isinstance(wanted, messages.PartsWanted):
            return messages.PartsMade(0, await parts_here(wanted.compiled, wanted.parts))
        assert isinstance(wanted, messages.ContentsWanted)
        return messages.ContentsFound(0, contents_at_start(wanted.files, wanted.definitions, wanted.topics))

    files = {f"{name}.rv": TEXTS[name] for name in ("a", "b", "c")}
    standby.store.save_monitor_revision(MonitorRevisionRow(1, text_of(Sources(files)), 0.0, "alice", ""))
    standby.store.save_setting(SWITCHES, json.dumps({"b": "shadow"}))
    compiler = SpecificationCompiler(lambda: None)
    monkeypatch.setattr(compiler, "_ask", asked)
    async with standby.checked(relays=2, compiler=compiler) as checked:
        for _ in range(2):
            assert await checked.next_obstacle() == ""
            standby.store.save_revision(standby.revision(f"{OPEN_POLICY}[Tomorrow]\n"))
            await checked.replicate()
            assert await checked.next_obstacle() != ""
            standby.store.save_revision(standby.revision(OPEN_POLICY))
            await checked.replicate()
    assert len(questions) == 2

    home = standby.home / "desk"
    home.mkdir()
    other = Desk(home)
    other.store.close()
    other.store, other.relays = standby.store, 2
    other.check_at_start, other.parts = compiler.check_at_start, compiler.parts
    manager = await other.monitors(taken_over=True)
    assert manager.rollout.allocation.of_file("a.rv") != manager.rollout.allocation.of_file("b.rv")
    assert manager.switches.shadowed_monitors() == ["b"]
    assert len(questions) == 2
    other.log.close()


async def test_the_check_changes_nothing(standby: Standby) -> None:
    before = standby.store.database.number
    async with standby.checked() as checked:
        await checked.next_obstacle()
    assert standby.store.database.number == before
    assert {path.name for path in (standby.home / "control").iterdir()} <= {
        "state.db", "state.db-wal", "state.db-shm", "state.ahead", "standby.pem", "standby-key.pem",
    }  # fmt: skip
