"""Store rollouts, robots' reports and the timestamp in PostgreSQL. Each method blocks, so it is called in a thread.

Several collectors may share the database. A change of a rollout names the state that it was computed from, so a
collector with an old state changes nothing.
"""

from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

import msgspec
import structlog
from psycopg import Connection

from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.rollouts.machine import BundleRollout, RobotSeen

_log = structlog.get_logger()
_LOCK_GROUP = "SELECT pg_advisory_xact_lock(hashtextextended(%s, 0))"


class StoredReport(NamedTuple):
    """A robot's last report, and its group at that time."""

    group: RobotGroup
    seen: RobotSeen


class StoredRollout(NamedTuple):
    """A rollout with its number in the database."""

    number: int
    rollout: BundleRollout


class Connections(Protocol):
    """A pool of connections to the database."""

    def writing(self) -> AbstractContextManager[Connection[tuple[Any, ...]]]:
        """Run the block in one transaction. Raise `psycopg.Error`."""


class RolloutStore:
    """The tables of rollouts. Each method raises `psycopg.Error` if the database does not answer."""

    def __init__(self, database: Connections) -> None:
        self._database = database

    # --- robots ---

    def save_report(self, name: str, group: RobotGroup, seen: RobotSeen) -> None:
        query = """
            INSERT INTO bundle_robot (name, site, robot_group, report) VALUES (%s, %s, %s, %s)
            ON CONFLICT (name) DO UPDATE SET site = excluded.site, robot_group = excluded.robot_group,
                report = excluded.report
        """
        document = msgspec.json.encode(seen).decode()
        with self._database.writing() as connection:
            connection.execute(query, (name, *group, document))

    def reports(self) -> dict[str, StoredReport]:
        """Return the last reports by robot. Unreadable ones are logged and left out."""
        query = "SELECT name, site, robot_group, report::text FROM bundle_robot"
        found = {}
        with self._database.writing() as connection:
            for name, site, group, report in connection.execute(query):
                try:
                    seen = msgspec.json.decode(report, type=RobotSeen)
                except ValueError as error:
                    _log.error("the stored report of a robot is unreadable", robot=name, reason=str(error))
                    continue
                found[name] = StoredReport(RobotGroup(site, group), seen)
        return found

    # --- rollouts ---

    def latest(self) -> dict[RobotGroup, StoredRollout]:
        query = """
            SELECT DISTINCT ON (site, robot_group) id, site, robot_group, document::text FROM rollout
            ORDER BY site, robot_group, id DESC
        """
        with self._database.writing() as connection:
            cursor = connection.execute(query)
            return {
                RobotGroup(site, group): StoredRollout(
                    number, msgspec.json.decode(document, type=BundleRollout)
                )
                for number, site, group, document in cursor
            }

    def begin(
        self, group: RobotGroup, last: StoredRollout | None, rollout: BundleRollout, now: float
    ) -> int | None:
        """Store a new rollout and return its number, or None if `last` is no longer the last one or still runs."""
        newest = """
            SELECT id, document = %s::jsonb FROM rollout WHERE site = %s AND robot_group = %s
            ORDER BY id DESC LIMIT 1
        """
        query = """
            INSERT INTO rollout (site, robot_group, document, state, changed) VALUES (%s, %s, %s, %s, %s)
            ON CONFLICT (site, robot_group) WHERE state = 'running' DO NOTHING RETURNING id
        """
        old = None if last is None else msgspec.json.encode(last.rollout).decode()
        document = msgspec.json.encode(rollout).decode()
        with self._database.writing() as connection:
            connection.execute(_LOCK_GROUP, (str(group),))
            found = connection.execute(newest, (old, *group)).fetchone()
            if found != (None if last is None else (last.number, True)):
                return None
            row = connection.execute(query, (*group, document, rollout.state, now)).fetchone()
        return None if row is None else int(row[0])

    def replace(self, group: RobotGroup, before: StoredRollout, rollout: BundleRollout, now: float) -> bool:
        query = """
            UPDATE rollout SET document = %s, state = %s, changed = %s WHERE id = %s AND document = %s::jsonb
            AND id = (SELECT max(id) FROM rollout WHERE site = %s AND robot_group = %s)
        """
        new, old = (msgspec.json.encode(one).decode() for one in (rollout, before.rollout))
        with self._database.writing() as connection:
            connection.execute(_LOCK_GROUP, (str(group),))
            cursor = connection.execute(query, (new, rollout.state, now, before.number, old, *group))
            return cursor.rowcount == 1

    def history(self, group: RobotGroup, limit: int) -> list[StoredRollout]:
        query = """
            SELECT id, document::text FROM rollout WHERE site = %s AND robot_group = %s ORDER BY id DESC LIMIT %s
        """
        with self._database.writing() as connection:
            cursor = connection.execute(query, (*group, limit))
            return [
                StoredRollout(number, msgspec.json.decode(document, type=BundleRollout))
                for number, document in cursor
            ]

    # --- the timestamp ---

    def timestamp(self) -> bytes | None:
        with self._database.writing() as connection:
            cursor = connection.execute("SELECT document FROM bundle_timestamp")
            row = cursor.fetchone()
        return None if row is None else bytes(row[0])

    def save_timestamp(self, version: int, document: bytes) -> None:
        query = """
            INSERT INTO bundle_timestamp (version, document) VALUES (%s, %s)
            ON CONFLICT (one) DO UPDATE SET version = excluded.version, document = excluded.document
            WHERE bundle_timestamp.version < excluded.version
        """
        with self._database.writing() as connection:
            connection.execute(query, (version, document))
