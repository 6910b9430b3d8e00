"""Check on a standby that control could start if this appliance took over now, and would not give the lease away.

The check also writes to the disk of the state and to the audit log, and compiles the specifications, so that a
takeover need not. It
is repeated, because the appliance's own files, disk and ports may change. While it fails, this appliance does not
claim the lease, but still follows the active one and stays in the in-sync set.
"""

import asyncio
import contextlib
import json
import os
import sqlite3
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import structlog

from appliance.audit.log import log_database
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.log_writer import ChainWriter
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import STATE_ERRORS
from appliance.control.assembly.foundation import open_listener
from appliance.control.assembly.host_authority import make_host_table
from appliance.control.assembly.policies import kept_policy
from appliance.control.assembly.policy_gate import policy_at_start
from appliance.control.assembly.robot import robot_addresses
from appliance.features.standby.link_certificates import replication_context
from appliance.features.standby.membership import Membership
from appliance.features.standby.summary import UNCHECKED
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import restore
from appliance.policy.judgement import PolicyContext
from appliance.specifications.in_force import InForce
from appliance.specifications.rollout import Parts, parts_wanted
from appliance.specifications.specification_files import SpecificationFolder
from appliance.specifications.specification_revisions import Check, specifications_at_start
from appliance.specifications.switches import SWITCHES, Switches
from appliance.store.changes import Change, Value
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.store.writer_thread import Database, StoreError


class ReadOnlyDatabase(Database):
    """The state file without a thread or queued changes."""

    def __init__(self, path: Path, schema: str, *, failed: Callable[[str], None]) -> None:
        del schema, failed
        self._path = path

    def query(self, sql: str, parameters: Sequence[Value] = ()) -> list[tuple[Any, ...]]:
        try:
            with contextlib.closing(sqlite3.connect(f"{self._path.as_uri()}?mode=ro", uri=True)) as reader:
                return reader.execute(sql, parameters).fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}") from error

    def _submit(self, change: Change, *, ahead: bool) -> None:
        del change, ahead
        raise StoreError(f"{self._path}: it is read only here")


_AGAIN_SECONDS = 15.0
_ROOM = 4 << 20  # bytes, as for an order (`Database.require_room`)

_log = structlog.get_logger()


class TakeoverCheck:
    """The check; set `news` when the policy or the specifications of the active appliance have changed."""

    def __init__(
        self,
        settings: Settings,
        membership: Membership,
        compile_specifications: Check,
        parts: Parts,
        *,
        again: float = _AGAIN_SECONDS,
    ) -> None:
        self._settings = settings
        self._membership = membership
        self._compile = compile_specifications
        self._parts = parts
        self._again = again
        self._folder = settings.state / "control"
        self.obstacle = UNCHECKED
        self.news = asyncio.Event()

    async def run(self, changed: Callable[[], None]) -> None:
        while True:
            self.news.clear()
            obstacle = await self._find_obstacle()
            if obstacle != self.obstacle:
                if self.obstacle not in ("", UNCHECKED):
                    _log.info("the reason why this appliance cannot take over is gone", reason=self.obstacle)
                self.obstacle = obstacle
                changed()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._again):
                    await self.news.wait()

    async def _find_obstacle(self) -> str:
        try:
            await self._load()
        except STATE_ERRORS as error:
            reason, *more = str(error).splitlines() or [repr(error)]
        except Exception as error:  # noqa: BLE001  whatever it is, it would also end the start
            what = f"the state of the active appliance is not understood ({error!r})"
            reason, more = f"{what}; update this appliance to the same version", []
        else:
            return ""
        if reason != self.obstacle:
            _log.error("this appliance cannot take over", reason=reason, more=more)
        return reason

    async def _load(self) -> None:
        settings = self._settings
        await asyncio.to_thread(_require_room, self._folder)
        if settings.audit.on_audit_failure == "deny":
            await asyncio.to_thread(_require_log, self._folder / "audit.db")
        last, said = await asyncio.to_thread(self._load_state)
        switches = Switches(settings.enable, json.loads(said))
        found = await specifications_at_start(
            last,
            SpecificationFolder(settings.monitors),
            self._compile,
            settings.site_keys,
            named=switches.named,
        )
        wanted = parts_wanted(InForce(0, found.sources, found.checked, switches), settings.relays)
        if wanted:
            await self._parts(found.checked.compiled, wanted)
        if self.obstacle != "":  # the membership stays the same, and each call writes files
            replication_context(self._membership, self._folder, server=True)
        open_listener(*settings.listen_address).close()

    def _load_state(self) -> tuple[MonitorRevisionRow | None, str]:
        settings = self._settings
        store = StateStore(self._folder, failed=_log.error, kind=ReadOnlyDatabase)
        known = PolicyContext(
            make_host_table(settings, store).addresses(),
            robot_addresses(settings, self._membership.witness),
            site_keys=settings.site_keys,
        )
        last = next(iter(store.revisions(1)), None)
        kept = None if last is None else kept_policy(last)
        policy_at_start(kept, settings.policy, known, kept_first=True)
        restore(Registry(), store)
        return next(iter(store.monitor_revisions(1)), None), store.settings().get(SWITCHES, "{}")


def lacking_room(folder: Path) -> str:
    disk = os.statvfs(folder)
    free = disk.f_bavail * disk.f_frsize
    if free >= _ROOM:
        return ""
    return f"{folder}: {free} bytes are free on its disk, {_ROOM} are wanted: free space"


def _require_room(folder: Path) -> None:
    if reason := lacking_room(folder):
        raise OSError(reason)
    with tempfile.TemporaryFile(dir=folder) as file:  # it has no name, so nothing stays
        file.write(b"\0")


def _require_log(path: Path) -> None:
    """Raise `OSError` unless the audit log, if it exists, can be continued. Its records stay as they are."""
    if not path.exists():
        return
    try:
        ChainWriter(path, 0).close()
        with contextlib.closing(log_database.open_for_writing(path)) as connection:
            connection.execute(f"PRAGMA user_version = {log_database.LAYOUT_VERSION}")  # as before
    except (LogUnreadableError, sqlite3.Error, OSError) as error:
        name = "" if str(path) in str(error) else f"{path}: "
        raise OSError(f"the audit log cannot be written: {name}{error}") from error
