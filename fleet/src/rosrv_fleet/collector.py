"""Make the parts of a running collector from its configuration."""

import os
from dataclasses import dataclass

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from rosrv_fleet.config import FleetConfig
from rosrv_fleet.database import IndexDatabase
from rosrv_fleet.evidence.store import EvidenceStore
from rosrv_fleet.indexer import LANES, Indexer
from rosrv_fleet.presence import RobotPresence
from rosrv_fleet.quotas import RobotQuotas
from rosrv_fleet.receipt_key import read_receipt_key
from rosrv_fleet.retention import Pruner
from rosrv_fleet.robots import Robots
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.rollouts.store import RolloutStore
from rosrv_fleet.search import Searches
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.tokens import OperatorTokens
from rosrv_fleet.workers import Workers

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
