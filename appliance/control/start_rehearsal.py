"""Rehearse the start of control on its stored state: disk, audit log, policy, registry, specifications, and the port.

The functions are those of the start. Nothing comes into force, and the state stays as it is.
"""

import asyncio
import contextlib
import json
import os
import sqlite3
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import structlog

from appliance.audit.log import log_database
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.log_writer import ChainWriter
from appliance.configuration.settings import Settings
from appliance.control.assembly.hosts import make_host_table
from appliance.control.assembly.listener_limits import open_listener
from appliance.control.assembly.policies import kept_policy
from appliance.control.assembly.policy_gate import policy_at_start
from appliance.control.assembly.robot import robot_addresses
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
from appliance.store.writer_thread import Database, StoreError, require_0_4

_ROOM = 4 << 20  # bytes, as for an order (`Database.require_room`)
SERVING_ROOM = (
    16 << 20
)  # that an active appliance may need before its log is written back (`wal_autocheckpoint`)

_log = structlog.get_logger()


class ReadOnlyDatabase(Database):
    """The state file without a thread or queued changes."""

    def __init__(self, path: Path, schema: str, *, failed: Callable[[str], None]) -> None:
        del schema, failed
        self._path = path

    def query(self, sql: str, parameters: Sequence[Value] = ()) -> list[tuple[object, ...]]:
        try:
            with contextlib.closing(sqlite3.connect(f"{self._path.as_uri()}?mode=ro", uri=True)) as reader:
                return reader.execute(sql, parameters).fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}") from error

    def _submit(self, change: Change, *, ahead: bool) -> None:
        del change, ahead
        raise StoreError(f"{self._path}: it is read only here")


class StartRehearsal:
    """A start with the present settings. `run` raises `STATE_ERRORS`, and others for a state that is not understood."""

    def __init__(
        self, settings: Settings, compile_specifications: Check, parts: Parts, *, robot: str
    ) -> None:
        """`robot` is an address of the robot's machine, or empty."""
        self._settings = settings
        self._compile = compile_specifications
        self._parts = parts
        self._robot = robot
        self.folder = settings.state / "control"

    async def run(self) -> None:
        settings = self._settings
        await asyncio.to_thread(_require_room, self.folder)
        if settings.audit.on_audit_failure == "deny":
            await asyncio.to_thread(_require_log, self.folder / "audit.db")
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
        open_listener(*settings.listen_address).close()

    def _load_state(self) -> tuple[MonitorRevisionRow | None, str]:
        settings = self._settings
        store = StateStore(self.folder, failed=_log.error, kind=ReadOnlyDatabase)
        require_0_4(store.database.query)
        known = PolicyContext(
            make_host_table(settings, store).addresses(),
            robot_addresses(settings, self._robot),
            site_keys=settings.site_keys,
        )
        last = next(iter(store.revisions(1)), None)
        kept = None if last is None else kept_policy(last)
        policy_at_start(kept, settings.policy, known, kept_first=True)
        restore(Registry(), store)
        return next(iter(store.monitor_revisions(1)), None), store.settings().get(SWITCHES, "{}")


def lacking_room(folder: Path, wanted: int = _ROOM) -> str:
    disk = os.statvfs(folder)
    free = disk.f_bavail * disk.f_frsize
    if free >= wanted:
        return ""
    return f"{folder}: {free} bytes are free on its disk, {wanted} are wanted: free space"


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
