"""The parts of a running collector, made from its configuration."""

from dataclasses import dataclass

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from rosrv_fleet.config import FleetConfig
from rosrv_fleet.database import Database
from rosrv_fleet.indexer import Indexer
from rosrv_fleet.receipt_key import read_receipt_key
from rosrv_fleet.robots import Robots
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.rollouts.store import RolloutStore
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.tokens import Tokens

_INDEX_CONNECTIONS = 2
_BUNDLE_CONNECTIONS = 4


@dataclass(frozen=True)
class Collector:
    """The parts of a collector, which the routers use."""

    config: FleetConfig
    database: Database
    robots: Robots
    tokens: Tokens
    store: SegmentStore
    indexer: Indexer
    receipt_key: Ed25519PrivateKey
    bundles: BundleService | None


def make_collector(config: FleetConfig) -> Collector:
    """Return the parts of a collector. Raises `ReceiptKeyError` and `OSError`."""
    limits = config.limits
    key = read_receipt_key(config.data)
    robots = Robots(config.data / "robots")
    store = SegmentStore(config.data, limits.reserve_bytes)
    database = Database(
        config.database,
        connections=limits.searches + _INDEX_CONNECTIONS + (_BUNDLE_CONNECTIONS if config.bundles else 0),
        statement_seconds=limits.search_seconds,
    )
    bundles = None
    if config.bundles is not None:
        bundles = BundleService(config.bundles.folder, config.bundles.timestamp_key, RolloutStore(database))
    return Collector(
        config=config,
        database=database,
        robots=robots,
        tokens=Tokens(config.data / "tokens.json"),
        store=store,
        indexer=Indexer(store, robots, database, limits.segment_bytes),
        receipt_key=key,
        bundles=bundles,
    )
