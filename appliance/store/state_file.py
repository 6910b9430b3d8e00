"""The tables of control's state file: registry, parameters, policy revisions, tokens, hosts, settings.

A table of a released version keeps its columns: while a pair is upgraded, a standby of the new version stores the rows
of an active appliance of the old one. A new value gets a new table.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from appliance.signing.request_signing import TokenKeys
from appliance.store import host_tables
from appliance.store.access_tokens import TokenRow
from appliance.store.writer_thread import Database
from roswire.xmlrpc import Value

SCHEMA = f"""
CREATE TABLE IF NOT EXISTS incarnation (
    key TEXT PRIMARY KEY, name TEXT NOT NULL, host TEXT NOT NULL, api TEXT NOT NULL, told TEXT NOT NULL,
    outer_port INTEGER NOT NULL, relay_port INTEGER NOT NULL, own INTEGER NOT NULL,
    life TEXT NOT NULL, changed REAL NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS relay_port (
    key TEXT NOT NULL, relay INTEGER NOT NULL, port INTEGER NOT NULL, PRIMARY KEY (key, relay)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS registration (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, detail TEXT NOT NULL,
    ordinal INTEGER NOT NULL, PRIMARY KEY (key, kind, resource)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS permission (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, host TEXT NOT NULL, caller_id TEXT NOT NULL,
    PRIMARY KEY (key, kind, resource, host, caller_id)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS parameters (id INTEGER PRIMARY KEY CHECK (id = 1), tree BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS parameter_change (number INTEGER PRIMARY KEY, key TEXT NOT NULL, value BLOB);
CREATE TABLE IF NOT EXISTS parameter_owner (key TEXT PRIMARY KEY, host TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS policy_revision (
    revision INTEGER PRIMARY KEY, text TEXT NOT NULL, file TEXT NOT NULL, loaded REAL NOT NULL,
    who TEXT NOT NULL, note TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS policy_signature (revision INTEGER PRIMARY KEY, signature TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS monitor_revision (
    revision INTEGER PRIMARY KEY, sources TEXT NOT NULL, loaded REAL NOT NULL, who TEXT NOT NULL, note TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS token (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL,
    created REAL NOT NULL, expires REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS token_keys (
    id TEXT PRIMARY KEY, reading BLOB NOT NULL, verifying BLOB NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS token_use (id TEXT PRIMARY KEY, used REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS ends (
    kind TEXT NOT NULL, name TEXT NOT NULL, at INTEGER NOT NULL, since INTEGER NOT NULL, late INTEGER NOT NULL,
    date INTEGER, PRIMARY KEY (kind, name)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS monitor_state (
    relay INTEGER PRIMARY KEY, epoch INTEGER NOT NULL, content BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS setting (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS door (
    name TEXT PRIMARY KEY, address TEXT NOT NULL UNIQUE, added REAL NOT NULL, removed REAL, slot INTEGER,
    port INTEGER, source TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS door_ticket (
    id TEXT PRIMARY KEY, door TEXT NOT NULL, hash BLOB NOT NULL, created REAL NOT NULL, expires REAL NOT NULL,
    who TEXT NOT NULL
) WITHOUT ROWID;
{host_tables.SCHEMA}"""


REVISION_TABLES = frozenset({"policy_revision", "policy_signature", "monitor_revision"})

LARGEST_CHANGE = 64 << 10  # bytes of one parameter whose change is stored at once
_MAX_NOTED = 10_000  # keys with changes, before the tree replaces them
_EMPTY = msgspec.msgpack.encode({})


class IncarnationRow(NamedTuple):
    """An incarnation of a node. `changed` is for the order only; `relay_port` is on the first relay process."""

    key: str
    name: str
    host: str
    api: str
    told: str
    outer_port: int
    relay_port: int
    own: bool
    life: str
    changed: float
    more_relay_ports: tuple[int, ...] = ()


class RegistrationRow(NamedTuple):
    """A registration; `ordinal` counts registrations in the order they were made."""

    key: str
    kind: str
    resource: str
    detail: str
    ordinal: int


class PermissionRow(NamedTuple):
    """A grant for the relay; `kind` is "topic" or "service"."""

    key: str
    kind: str
    resource: str
    host: str
    caller_id: str


class RevisionRow(NamedTuple):
    """A policy that was in force; `loaded` is seconds since the epoch, `who` names its author."""

    revision: int
    text: str
    file: str
    loaded: float
    who: str
    note: str
    signature: str = ""


class MonitorRevisionRow(NamedTuple):
    """Specifications that were in force (`sources` is JSON); `loaded` is seconds since the epoch."""

    revision: int
    sources: str
    loaded: float
    who: str
    note: str


class EndRow(NamedTuple):
    """An end and its beginning by the age clock, in nanoseconds; `late` is 0 or 1 (see `EndKind`).

    `date` is the end of a credential by the system clock, in nanoseconds since the epoch.
    """

    kind: str
    name: str
    at: int
    since: int
    late: int
    date: int | None = None


class StateStore:
    """Control's durable state, in `directory/state.db`. Raises `StoreError` when it cannot be opened."""

    def __init__(
        self, directory: Path, *, failed: Callable[[str], None], kind: type[Database] = Database
    ) -> None:
        self.database = kind(directory / "state.db", SCHEMA, failed=failed)
        self.hosts = host_tables.HostTables(self.database)
        self._parameter_changes = 0  # the number of the last change
        self._largest_change: float = LARGEST_CHANGE
        self._only_in_tree = False  # whether a change waits for the next tree
        self._noted: dict[str, list[int]] = {}  # the changes of each key since the tree was stored, by number

    async def until_settled(self) -> None:
        """Wait until the changes are on the disk. Raises `StoreError` if they cannot be written."""
        await self.database.until_settled()

    def close(self, seconds: float | None = None) -> None:
        self.database.close(seconds)

    # --- registry ---

    def save_incarnation(self, row: IncarnationRow) -> None:
        with self.database.together():
            self.database.put("incarnation", *row[:-1])
            self.database.delete("relay_port", key=row.key)
            for relay, port in enumerate(row.more_relay_ports, start=1):
                self.database.put("relay_port", row.key, relay, port)

    def forget_incarnation(self, key: str) -> None:
        with self.database.together():
            for table in ("incarnation", "relay_port", "registration", "permission"):
                self.database.delete(table, key=key)

    def save_registration(self, row: RegistrationRow) -> None:
        self.database.put("registration", *row)

    def remove_registration(self, key: str, kind: str, resource: str) -> None:
        self.database.delete("registration", key=key, kind=kind, resource=resource)

    def load_registry(self) -> tuple[list[IncarnationRow], list[RegistrationRow]]:
        query = self.database.query
        ports: dict[str, tuple[int, ...]] = {}
        for key, port in query("SELECT key, port FROM relay_port ORDER BY key, relay"):
            ports[key] = (*ports.get(key, ()), port)
        incarnations = [
            IncarnationRow._make((*row, ports.get(row[0], ())))._replace(own=bool(row[7]))
            for row in query("SELECT * FROM incarnation ORDER BY changed")
        ]
        return incarnations, [
            RegistrationRow(*row) for row in query("SELECT * FROM registration ORDER BY ordinal")
        ]

    # --- grants ---

    def save_permission(self, row: PermissionRow) -> None:
        self.database.put("permission", *row)

    def remove_permission(self, row: PermissionRow) -> None:
        self.database.delete("permission", **row._asdict())

    def permissions(self) -> list[PermissionRow]:
        return [PermissionRow(*row) for row in self.database.query("SELECT * FROM permission")]

    # --- parameters ---

    def save_parameters(self, tree: dict[str, Value]) -> None:
        with self.database.together():  # a change that stays would undo a larger one below it
            self.database.put("parameters", 1, msgspec.msgpack.encode(tree), ahead=False)
            self.database.delete("parameter_change", ("number", "<=", self._parameter_changes), ahead=False)
        self._noted.clear()
        self._only_in_tree = False

    def note_whole_parameters(self) -> None:
        """Store even large values at once from now on: another appliance must have a value before its answer."""
        self._largest_change = math.inf

    @property
    def tree_is_due(self) -> bool:
        return self._only_in_tree or len(self._noted) > _MAX_NOTED

    def note_parameter(self, key: str, value: Value) -> None:
        """Store the change of a parameter until the next tree is stored; None: it was deleted.

        The tree, which may be large, is stored rarely, and a value larger than `LARGEST_CHANGE` only with it.
        """
        data = None if value is None else msgspec.msgpack.encode(value)
        if data is not None and len(data) > self._largest_change:
            self._only_in_tree = True
            return
        former = self._noted.pop(key, [])
        if not former:
            self._note_change(key, data)
            return
        with self.database.together():
            for number in former:
                self.database.delete("parameter_change", number=number)
            if data is None:  # what is replaced may have made the namespaces above
                self._note_change(key, _EMPTY)
            self._note_change(key, data)

    def _note_change(self, key: str, data: bytes | None) -> None:
        self._parameter_changes += 1
        self.database.put("parameter_change", self._parameter_changes, key, data)
        self._noted.setdefault(key, []).append(self._parameter_changes)

    def parameter_changes(self) -> list[tuple[str, Value]]:
        query = "SELECT number, key, value FROM parameter_change ORDER BY number"
        rows = self.database.query(query)
        self._parameter_changes = rows[-1][0] if rows else 0
        for number, key, _data in rows:
            self._noted.setdefault(key, []).append(number)
        return [(key, None if data is None else msgspec.msgpack.decode(data)) for _number, key, data in rows]

    def parameter_owned(self, key: str, host: str) -> None:
        self.database.put("parameter_owner", key, host)

    def parameters_disowned(self, key: str) -> None:
        above = key.rstrip("/")  # '0' follows '/'
        with self.database.together():
            self.database.delete("parameter_owner", key=key)
            self.database.delete("parameter_owner", ("key", ">", f"{above}/"), ("key", "<", f"{above}0"))

    def parameter_owners(self) -> list[tuple[str, str]]:
        return [(key, host) for key, host in self.database.query("SELECT key, host FROM parameter_owner")]

    def load_parameters(self) -> dict[str, Value]:
        rows = self.database.query("SELECT tree FROM parameters WHERE id = 1")
        return msgspec.msgpack.decode(rows[0][0], type=dict[str, Any]) if rows else {}

    # --- revisions of the policy and of the specifications ---

    def save_revision(self, row: RevisionRow) -> None:
        # Store the signature first: a start in between would reject a revision without its signature.
        self.database.put("policy_signature", row.revision, row.signature)
        self.database.put("policy_revision", *row[:-1])

    def revisions(self, limit: int = -1) -> list[RevisionRow]:
        rows = self.database.query(
            "SELECT policy_revision.*, coalesce(signature, '') FROM policy_revision"
            " LEFT JOIN policy_signature USING (revision) ORDER BY revision DESC LIMIT ?",
            (limit,),
        )
        return [RevisionRow(*row) for row in rows]

    def save_monitor_revision(self, row: MonitorRevisionRow) -> None:
        self.database.put("monitor_revision", *row)

    def forget_monitor_revision(self, revision: int) -> None:
        self.database.delete("monitor_revision", revision=revision)

    def monitor_revisions(self, limit: int = -1) -> list[MonitorRevisionRow]:
        rows = self.database.query("SELECT * FROM monitor_revision ORDER BY revision DESC LIMIT ?", (limit,))
        return [MonitorRevisionRow(*row) for row in rows]

    # --- the state of monitors, between two appliances ---

    def save_monitor_state(self, relay: int, epoch: int, content: bytes) -> None:
        self.database.put("monitor_state", relay, epoch, content)

    def clear_monitor_states(self) -> None:
        self.database.delete("monitor_state", ("relay", ">", -1))

    def monitor_states(self, epoch: int) -> list[bytes]:
        query = "SELECT content FROM monitor_state WHERE epoch = ? ORDER BY relay"
        return [content for (content,) in self.database.query(query, (epoch,))]

    # --- tokens ---

    def save_tokens(self, *rows: TokenRow) -> None:
        """Save tokens; after a crash, either all of these rows are stored or none."""
        with self.database.together():
            for row in rows:
                if row.keys is not None:
                    self.database.put("token_keys", row.id, *row.keys)
            for row in rows:  # consecutive rows of a table are one change
                self.database.put("token", *row[:-1])

    def tokens(self) -> list[TokenRow]:
        kept = {token: TokenKeys(*keys) for token, *keys in self.database.query("SELECT * FROM token_keys")}
        rows = self.database.query("SELECT * FROM token ORDER BY created")
        return [TokenRow._make((*row, kept.get(row[0]))) for row in rows]

    def save_token_use(self, token: str, used: float) -> None:
        self.database.put("token_use", token, used)

    def token_uses(self) -> dict[str, float]:
        return dict(self.database.query("SELECT id, used FROM token_use"))

    # --- ends ---

    def save_end(self, row: EndRow) -> None:
        self.database.put("ends", *row)

    def forget_end(self, kind: str, name: str) -> None:
        self.database.delete("ends", kind=kind, name=name)

    def ends(self) -> list[EndRow]:
        return [EndRow(*row) for row in self.database.query("SELECT * FROM ends")]

    # --- settings ---

    def save_setting(self, name: str, value: str) -> None:
        self.database.put("setting", name, value)

    def settings(self) -> dict[str, str]:
        return dict(self.database.query("SELECT name, value FROM setting"))
