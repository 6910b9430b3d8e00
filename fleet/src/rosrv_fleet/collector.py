"""Make the parts of a running collector from its configuration."""

import os
import threading
import zlib
from dataclasses import dataclass
from datetime import date

import structlog
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from psycopg import sql

from rosrv_fleet.config import FleetConfig, RetentionConfig
from rosrv_fleet.database import IndexDatabase
from rosrv_fleet.evidence.store import EvidenceStore
from rosrv_fleet.failures import failure_of
from rosrv_fleet.indexer import LANES, Indexer
from rosrv_fleet.presence import RobotPresence
from rosrv_fleet.quotas import RobotQuotas
from rosrv_fleet.receipt_key import read_receipt_key
from rosrv_fleet.robots import Robots
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.rollouts.store import RolloutStore
from rosrv_fleet.search import Searches
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.tokens import OperatorTokens
from rosrv_fleet.workers import Workers

# Remove old data: whole partitions of the index, and segments from the beginning of a log.
#
# The last segment of a log stays. The last removed checkpoint is noted first, so that `verify` can prove the rest. Then
# segments that were set aside wait for the index again, because the reason may have passed.

_EVERY_SECONDS = 3600.0
_AGAIN_SECONDS = 60.0  # after a failure, which health reports until the next step
_LOCK_MS = 3000  # searches wait behind this lock
_DAY = 86_400 * 10**9
_DAYS = """
    SELECT day FROM (
        SELECT day FROM segment
        UNION
        SELECT to_date(right(relname, 8), 'YYYYMMDD') FROM pg_inherits JOIN pg_class ON pg_class.oid = inhrelid
        WHERE inhparent = 'record'::regclass
    ) AS known WHERE day < %s ORDER BY day
"""  # a partition without segments is left if none of a day could be indexed
_UNREADABLE = (OSError, ValueError, zlib.error)
_log = structlog.get_logger()


class Pruner:
    """Removes old data every hour, and after a failure every minute, in its own thread."""

    def __init__(
        self, store: SegmentStore, robots: Robots, database: IndexDatabase, retention: RetentionConfig
    ) -> None:
        self._store = store
        self._robots = robots
        self._database = database
        self._retention = retention
        self._ending = threading.Event()
        self.trouble: str | None = None

    def run(self) -> None:
        while not self._ending.is_set():
            self._ending.wait(self.turn())

    def turn(self) -> float:
        """Remove old data, and return the seconds until the next turn. Note a failure in `trouble`."""
        try:
            self.step()
        except Exception as error:  # noqa: BLE001  after any failure, it tries again
            self.trouble = f"retention: {failure_of(error)}"
            _log.error("old data was not removed", reason=self.trouble)
            return _AGAIN_SECONDS
        return _EVERY_SECONDS

    def stop(self) -> None:
        self._ending.set()

    def step(self) -> None:
        """Remove the data that is old now. A damaged log stays and is reported."""
        trouble, now = None, self._store.time_ns()
        if self._retention.segment_days is not None:
            by = f"retention.segment_days: {self._retention.segment_days}"
            before = now - self._retention.segment_days * _DAY
            for robot in self._robots.known():
                for log in self._store.logs(robot):
                    if self._ending.is_set():
                        return
                    try:
                        removed = self._store.prune(robot, log, before, by)
                    except _UNREADABLE as error:
                        trouble = f"retention: {robot}: log {log}: {error}; run 'rosrv-fleet verify {robot}'"
                        _log.error("old segments were not removed", reason=trouble)
                        continue
                    if removed:
                        _log.warning("old segments were removed", robot=robot, log=log, segments=removed)
        oldest = self._retention.oldest_day(now)
        if oldest is not None:
            for day in drop_partitions(self._database, oldest):
                _log.warning("an old day of the index was removed", day=day.isoformat())
        self.trouble = trouble
        self._store.try_again()  # last: a segment that waits is not removed


def drop_partitions(database: IndexDatabase, oldest: date) -> list[date]:
    with database.writing() as connection:
        found = connection.execute(_DAYS, (oldest,))
        days: list[date] = [day for (day,) in found]
    for day in days:
        with database.writing() as connection:
            connection.execute("SELECT set_config('lock_timeout', %s, true)", (str(_LOCK_MS),))
            connection.execute(
                sql.SQL("DROP TABLE IF EXISTS {}").format(sql.Identifier(f"record_{day:%Y%m%d}"))
            )
            connection.execute("DELETE FROM segment WHERE day = %s", (day,))
    return days


PROCESSORS = min(8, len(os.sched_getaffinity(0)))  # each worker needs memory
SHORT_CHECKS = max(4, PROCESSORS)
LONG_CHECKS = max(1, PROCESSORS // 2)
_EVIDENCE_CHECKS = 1
_BUNDLE_CONNECTIONS = 4


@dataclass(frozen=True)
class Collector:
    """The parts that the routers use.

    Searches and indexing have their own connections, so they cannot take those of rollouts and retention.
    """

    config: FleetConfig
    searches: Searches
    database: IndexDatabase
    robots: Robots
    presence: RobotPresence
    tokens: OperatorTokens
    store: SegmentStore
    evidence: EvidenceStore
    quotas: RobotQuotas
    workers: Workers
    indexer: Indexer
    pruner: Pruner
    receipt_key: Ed25519PrivateKey
    bundles: BundleService | None


def make_collector(config: FleetConfig) -> Collector:
    limits = config.limits
    key = read_receipt_key(config.data)
    robots = Robots(config.data / "robots")
    store = SegmentStore(config.data, limits.reserve_bytes)
    searching = IndexDatabase(
        config.database, connections=limits.searches, statement_seconds=limits.search_seconds
    )
    database = IndexDatabase(
        config.database, connections=_BUNDLE_CONNECTIONS, statement_seconds=limits.search_seconds
    )
    presence = RobotPresence(config.data / "heard")
    workers = Workers(SHORT_CHECKS + LONG_CHECKS + _EVIDENCE_CHECKS + len(LANES))
    bundles = None
    if config.bundles is not None:
        bundles = BundleService(
            config.bundles.folder, config.bundles.timestamp_key, RolloutStore(database), robots.groups,
            off=lambda: {name for name, robot in robots.known().items() if presence.is_off(robot)},
        )  # fmt: skip
    return Collector(
        config=config,
        searches=Searches(searching, limits.searches),
        database=database,
        robots=robots,
        presence=presence,
        tokens=OperatorTokens(config.data / "tokens.json"),
        store=store,
        evidence=EvidenceStore(config.data / "evidence"),
        quotas=RobotQuotas(config.data / "quotas", limits),
        workers=workers,
        indexer=Indexer(store, robots, workers, config),
        pruner=Pruner(store, robots, database, config.retention),
        receipt_key=key,
        bundles=bundles,
    )
