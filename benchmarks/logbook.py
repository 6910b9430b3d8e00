"""A report over a year's audit log: python -m benchmarks.logbook [--records 10000000] [--folder DIR] [--verify]

The log is that of a busy robot: a year of decisions, connections, folded repetitions and REST calls, and among them
the interventions of each day: drivers that change, approvals, guards that are set and switched, sign-ons, loads. The
chain, the checkpoints (one a minute, all signed) and the signer's memory are as the appliance makes them. The rows are
inserted without waiting for the disk, the indices are made at the end, and the full-text index, which no report reads,
is left out. With `--folder`, the log is kept and used again.

The table has the seconds, the processor time and the memory of each command, as a process of its own.
"""

import argparse
import random
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rich.console import Console
from rich.table import Table

from appliance.audit.log import log_database
from appliance.audit.log.columns import StoredColumns, record_hash, to_columns
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.log.signatures import pinned_key_path, write_public_key
from appliance.signing.log_proof import NO_CHECKPOINT, Checkpoint, checkpoint_hash, genesis
from appliance.signing.signed_logs import HEADER_BYTES

_SECOND = 1_000_000_000
_YEAR = 365 * 86_400
_BATCH = 20_000
_ROW = f"INSERT INTO record VALUES ({', '.join('?' * (len(StoredColumns._fields) + 1))})"
_PEOPLE = ("ann", "bob", "eve")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--records", type=int, default=10_000_000)
    arguments.add_argument("--folder", type=Path, help="keep the log here, and use it again")
    arguments.add_argument("--verify", action="store_true", help="also verify the log, which takes minutes")
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory(dir=".") as folder:
        state = given.folder or Path(folder)
        if not (state / "control" / "audit.db").exists():
            Year(state, given.records).write()
        table = Table("command", "seconds", "processor time", "memory (MB)", "output (MB)")
        for words in _commands(state, verify=given.verify):
            table.add_row(*_measured(state, words))
    Console(width=110).print(table)


def _commands(state: Path, *, verify: bool) -> Iterator[list[str]]:
    page = state / f"year-{time.time():.0f}.html"
    yield ["report", "interventions", "--since", "366d", "--output", str(page)]
    yield ["report", "interventions", "--since", "366d", "--json"]
    yield ["report", "interventions", "--since", "30d"]
    yield ["who-drove", "--between", "360d", "300d"]
    if verify:
        yield ["audit", "verify"]


# A process of its own, because the memory of a new process counts that of the one that forked it.
_LAUNCHER = """
import os, sys, time
began = time.monotonic()
process = os.spawnv(os.P_NOWAIT, sys.argv[1], sys.argv[1:])
_pid, status, usage = os.wait4(process, 0)
print(os.waitstatus_to_exitcode(status), time.monotonic() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss,
      file=sys.stderr)
"""


def _measured(state: Path, words: list[str]) -> tuple[str, ...]:
    output, program = state / "output", str(Path(sys.executable).with_name("rosrv"))
    with output.open("wb") as written:
        command = [sys.executable, "-c", _LAUNCHER, program, *words, "--state", str(state)]
        done = subprocess.run(command, stdout=written, stderr=subprocess.PIPE, text=True, check=True)
    status, seconds, processor, memory = map(float, done.stderr.splitlines()[-1].split())
    if status:
        raise SystemExit(f"{' '.join(words)}: {done.stderr}")
    shown = [word for word in words if not word.endswith(".html")]
    size = (output if len(shown) == len(words) else Path(words[-1])).stat().st_size
    return " ".join(shown), *(f"{one:,.1f}" for one in (seconds, processor, memory * 1024 / 1e6, size / 1e6))


class Year:
    """Writes the log of a year that ends now."""

    def __init__(self, state: Path, records: int) -> None:
        self._path = state / "control" / "audit.db"
        self._signer = state / "signer"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._signer.mkdir(exist_ok=True)
        self._minutes = _YEAR // 60
        self._each_minute = records / self._minutes
        self._begin = time.time_ns() - _YEAR * _SECOND
        self._random = random.Random(7)
        self._key = Ed25519PrivateKey.generate()
        self._public = self._key.public_key().public_bytes_raw()
        self._sequence, self._hash, self._sealed = 0, b"", NO_CHECKPOINT
        self._memory = bytearray((1).to_bytes(HEADER_BYTES, "big"))
        self._common = _common(self._random)

    def write(self) -> None:
        log_database.create(self._path, self._begin)
        with closing(sqlite3.connect(self._path, isolation_level=None)) as connection:
            for setting in (
                "journal_mode = OFF",
                "synchronous = OFF",
                "temp_store = FILE",
                "cache_size = -200000",
            ):
                connection.execute(f"PRAGMA {setting}")
            indices = [sql for sql in log_database.TABLES if sql.startswith("CREATE INDEX record")]
            for sql in indices:
                connection.execute(f"DROP INDEX {sql.split()[2]}")
            (self._log,) = connection.execute("SELECT id FROM log").fetchone()
            self._hash = genesis(self._log)
            connection.execute("BEGIN")
            self._fill(connection)
            connection.execute("COMMIT")
            for sql in indices:
                connection.execute(sql)
            connection.execute("UPDATE indexed SET through = ?", (self._sequence,))
        write_public_key(pinned_key_path(self._path), self._public)
        (self._signer / f"{self._log}.signed").write_bytes(self._memory)

    def _fill(self, connection: sqlite3.Connection) -> None:
        rows: list[tuple[object, ...]] = []
        wanted = 0.0
        for minute in range(self._minutes):
            begin = self._begin + minute * 60 * _SECOND
            wanted += self._each_minute
            here = [*self._interventions(minute), *self._usual(max(0, round(wanted) - self._sequence - 1))]
            step = 60 * _SECOND // (len(here) + 1)
            for place, one in enumerate(here):
                rows.append(self._linked(one, begin + place * step))
            text = self._checkpoint(minute + 1, begin + 59 * _SECOND)
            connection.execute(
                "INSERT INTO checkpoint VALUES (?, ?, ?, ?, ?)",
                (minute + 1, self._sequence, text, self._key.sign(text), self._public),
            )
            detail = {"number": minute + 1, "sequence": self._sequence, "hash": self._hash.hex()}
            rows.append(self._linked(_record("checkpoint", Severity.DEBUG, detail), begin + 59 * _SECOND))
            if len(rows) > _BATCH:
                connection.executemany(_ROW, rows)
                rows.clear()
        connection.executemany(_ROW, rows)

    def _checkpoint(self, number: int, moment: int) -> bytes:
        sealed = Checkpoint(self._log, number, self._sequence, self._hash.hex(), moment, self._sealed, 0)
        self._sealed = checkpoint_hash(sealed.text())
        self._memory += bytes.fromhex(self._sealed)
        return sealed.text()

    def _linked(self, columns: StoredColumns, moment: int) -> tuple[object, ...]:
        self._sequence += 1
        found = (self._sequence, f"{moment:016x}00ff", moment, *columns[3:])
        self._hash = record_hash(self._hash, found)
        return *found, self._hash

    def _usual(self, number: int) -> Iterator[StoredColumns]:
        return (self._random.choice(self._common) for _ in range(number))

    def _interventions(self, minute: int) -> Iterator[StoredColumns]:
        """Yield those of a minute: of work by day, in the average of `_EACH_DAY` a day."""
        for event, each_day in _EACH_DAY.items():
            if self._random.random() < each_day / 1440:
                who = self._random.choice(_PEOPLE)
                for detail in _details(event, minute, self._random):
                    yield _record(*detail[:2], {"who": who, **detail[2]}, detail[3])
                    if self._random.random() < 0.5:
                        yield _call(who)


_EACH_DAY = {
    "authority": 20, "approval": 15, "sign-on": 8, "ticket": 15, "value": 3, "switch": 2, "policy": 1,
    "specifications": 0.2, "block": 0.3, "restart": 1, "token": 0.2, "alarm": 3, "host": 0.3,
}  # fmt: skip
"""How often each kind of intervention is; most have two records."""


def _details(  # noqa: PLR0911  a table of kinds
    kind: str, minute: int, rng: random.Random
) -> list[tuple[str, Severity, dict[str, Any], str]]:
    notice, end = Severity.NOTICE, float(minute)
    started: dict[str, Any] = {
        "version": f"0.{minute // 50_000}.0",
        "configuration": {"sso": "11"},
        "off": {},
    }
    host = f"10.0.0.{rng.randrange(5, 9)}"
    match kind:
        case "authority":
            return [
                ("authority handed over", notice, {"earlier": "nobody", "holder": host}, "base"),
                ("authority handed over", notice, {"earlier": host, "holder": "nobody"}, "base"),
            ]
        case "approval":
            given = {"approval": minute, "earlier": "waits", "now": "approved once"}
            return [
                ("approval wanted", notice, {"approval": minute}, "/arm/move"),
                ("approval given", notice, given, "/arm/move"),
            ]
        case "sign-on":
            person = {"name": "ann", "subject": "77", "role": "operator", "groups": [], "expires": end}
            return [("signed on", notice, person, ""), ("signed off", notice, person, "")]
        case "ticket":
            return [("door ticket made", notice, {"ticket": f"{minute:x}", "expires": end}, "agent")]
        case "value":
            old, new = rng.uniform(0.2, 2), rng.uniform(0.2, 2)
            return [("monitor set", notice, {"before": {"vMax": old}, "values": {"vMax": new}}, "limit")]
        case "switch":
            return [
                ("monitor disabled", notice, {"earlier": "enabled"}, "limit"),
                ("monitor enabled", notice, {"earlier": "disabled"}, "limit"),
            ]
        case "policy" | "specifications":
            lines = [
                f"{rng.choice('+-')}/topic_{rng.randrange(99)} = host_{rng.randrange(9)}" for _ in range(12)
            ]
            hashes = {"sha256": f"{minute + 1:064x}", "earlier_sha256": f"{minute:064x}"}
            monitors = {"monitors": ["limit", "fence"], "off": {}} if kind == "specifications" else {}
            return [(f"{kind} loaded", notice, {**hashes, "diff": lines, **monitors}, "")]
        case "block":
            blocked = {"address": host, "until": None, "earlier": "not blocked"}
            return [
                ("host blocked", Severity.WARNING, blocked, host),
                ("host unblocked", notice, blocked | {"earlier": "blocked by ann"}, host),
            ]
        case "restart":
            return [("appliance stopped", notice, {}, ""), ("appliance started", notice, started, "")]
        case "token":
            return [("token added", notice, {"token": f"t{minute}", "role": "viewer", "expires": end}, "")]
        case "alarm":
            detail = {"earlier": "not handled", "note": "known"}
            return [("alarm acknowledged", notice, detail, "audit-not-forwarded")]
        case _:
            enrolled = {
                "name": f"tablet{minute % 9}",
                "address": f"10.77.0.{minute % 9}",
                "serial": f"{minute:x}",
            }
            return [("host enrolled", notice, enrolled | {"expires": end}, "")]


def _common(rng: random.Random) -> list[StoredColumns]:
    """Return a thousand records that are not interventions, in the proportions of a busy robot."""
    made: list[StoredColumns] = []
    for number in range(1000):
        host, node = f"10.0.0.{number % 7}", f"/node{number % 60}"
        fields: dict[str, Any] = {"host": host, "caller_id": node, "resource": f"/topic_{number % 80}"}
        rule = RuleReference("Publishers", "/topic_*", "robot.ini", 10 + number % 40)
        match rng.choices(("allow", "deny", "folded", "call", "dropped", "connection"), (70, 3, 9, 5, 3, 10))[
            0
        ]:
            case "allow":
                made.append(
                    _plain("decision", fields, "allow", "publish", rule, detail={"call": "registerPublisher"})
                )
            case "deny":
                made.append(
                    _plain("decision", fields, "deny", "publish", rule, detail={"call": "registerPublisher"})
                )
            case "folded":
                detail = {
                    "count": 41,
                    "hosts": {host: 41},
                    "first_time": 1,
                    "last_time": 2,
                    "recorded_id": "0" * 20,
                }
                made.append(_plain("repetitions folded", fields, "allow", "read", rule, detail=detail))
            case "call":
                made.append(_call(rng.choice(_PEOPLE), "GET"))
            case "dropped":
                detail = {
                    "monitor": "limit",
                    "at": "limit.rv:12",
                    "conditions": [{"text": "v > vMax", "values": "1.4"}],
                }
                made.append(_plain("message dropped", fields, None, "monitor", None, detail=detail))
            case _:
                made.append(_plain("connection opened", fields, None, "subscribe", None, detail={"bytes": 0}))
    return made


def _plain(  # noqa: PLR0917  a table's row
    event: str,
    fields: dict[str, Any],
    decision: str | None,
    category: str,
    rule: RuleReference | None,
    detail: dict[str, Any],
) -> StoredColumns:
    reason = f"{category} {fields['resource']} by {fields['caller_id']}"
    record = AuditRecord(
        id="", time=0, event=event, decision=decision, category=category, rule=rule, revision=7, reason=reason,
        duration_us=40, detail=detail, **fields,
    )  # fmt: skip
    return to_columns(record, 0)


def _record(event: str, severity: Severity, detail: dict[str, Any], what: str = "") -> StoredColumns:
    reason = f"{event} {what}".strip()
    record = AuditRecord(
        id="", time=0, event=event, severity=severity, resource=what or None, reason=reason, detail=detail
    )
    return to_columns(record, 0)


def _call(who: str, method: str = "POST") -> StoredColumns:
    detail = {"who": who, "method": method, "status": 200}
    record = AuditRecord(
        id="", time=0, event="rest call", decision="allow", host="10.0.0.9", category="rest", resource="/v1/status",
        reason=f"{method} /v1/status", detail=detail,
    )  # fmt: skip
    return to_columns(record, 0)


if __name__ == "__main__":
    main()
