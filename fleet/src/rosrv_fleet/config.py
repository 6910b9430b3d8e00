"""Define the configuration of the collector: one YAML file, checked against these types.

Relative paths are relative to the folder of this file.
"""

import os
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Annotated

import msgspec
import yaml

_DATA = Path("/var/lib/rosrv-fleet")
LEAST_SILENT_SECONDS = 120.0
"""Robots without records report every 48 to 72 s."""

_Positive = Annotated[int, msgspec.Meta(gt=0)]
_Seconds = Annotated[float, msgspec.Meta(gt=0, le=86_400)]


class FleetConfigError(Exception):
    """The configuration is missing or invalid."""


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The limits of uploads, searches and connections.

    `uploads` limits simultaneous uploads; each robot has at most one. The bytes per day include rejected uploads.
    `reserve_bytes` of the disk stay free. `check_seconds` is processor time. `searches` limits simultaneous searches;
    one token gets at most half. `header_seconds` limits a TLS handshake, and then each request's headers.
    `address_connections` limits one address, not counting connections of robots; each robot from there adds four.
    """

    segment_bytes: _Positive = 512 << 20
    upload_bytes: _Positive = 128 << 20
    upload_seconds: _Seconds = 120.0
    check_seconds: _Seconds = 60.0
    uploads: _Positive = 64
    robot_bytes_per_day: _Positive = 2 << 30
    robot_unpacked_bytes_per_day: _Positive = 8 << 30
    reserve_bytes: _Positive = 256 << 20
    search_seconds: _Seconds = 10.0
    searches: _Positive = 4
    header_seconds: _Seconds = 15.0
    connections: _Positive = 4096
    robot_connections: _Positive = 16
    address_connections: _Positive = 256


class EvidenceConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The limits of evidence bundles.

    `robot_bytes` limits the stored bundles of one robot; `check_seconds` is processor time.
    """

    bundle_bytes: _Positive = 1 << 30
    robot_bytes: _Positive = 10 << 30
    upload_seconds: _Seconds = 3600.0
    check_seconds: _Seconds = 600.0


class RetentionConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The days after arrival until records leave the index, and segments the disk. None means never.

    Records must leave the index no later than their segments, because `reindex` could not restore them.
    """

    index_days: _Positive | None = None
    segment_days: _Positive | None = None

    def __post_init__(self) -> None:
        if self.segment_days is not None and not (self.index_days and self.index_days <= self.segment_days):
            raise ValueError(f"segment_days: {self.segment_days} needs index_days, which must not be larger")

    def oldest_day(self, now_ns: int) -> date | None:
        """Return the oldest day that the index keeps, at a time of the clock of ages."""
        today = datetime.fromtimestamp(now_ns // 10**9, UTC).date()
        return None if self.index_days is None else today - timedelta(self.index_days)


class BundlesConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The folder to which `rosrv-fleet bundle publish` copies, and a copy of the repository's timestamp key."""

    folder: Path
    timestamp_key: Path


class FleetConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The configuration of a collector.

    `names` are further host names under which browsers may open the collector. `database` is a libpq connection
    string; libpq also reads PGPASSWORD and PGPASSFILE. A robot is silent after `silent_seconds` without a sign of life.
    """

    data: Path = _DATA
    listen: str = "0.0.0.0:8444"
    names: tuple[str, ...] = ()
    certificate: Path
    key: Path
    database: str = "dbname=rosrv_fleet"
    silent_seconds: _Seconds = 600.0
    limits: Limits = Limits()
    evidence: EvidenceConfig = EvidenceConfig()
    retention: RetentionConfig = RetentionConfig()
    bundles: BundlesConfig | None = None

    @property
    def address(self) -> tuple[str, int]:
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)


def load_config(path: Path) -> FleetConfig:
    """Return the configuration with absolute paths, or raise `FleetConfigError`."""
    try:
        fields = yaml.safe_load(path.read_text(encoding="utf-8"))
        if isinstance(fields, dict) and not fields.keys() & {"certificate", "key"}:
            data = str(fields.get("data", _DATA))
            fields = {"certificate": f"{data}/server.pem", "key": f"{data}/server.key"} | fields
        found = msgspec.convert(fields, FleetConfig, dec_hook=_decode)
        if not 0 <= found.address[1] <= 65_535:
            raise ValueError(f"listen: {found.listen} has no valid port")
    except OSError as error:
        advice = "name another file with --config"
        if isinstance(error, PermissionError):
            advice = f"let user {os.geteuid()} read it, for example: chmod 644 {path.name}"
        raise FleetConfigError(f"{path}: {error.strerror}; {advice}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise FleetConfigError(f"{path}: {error}; see docs/reference/fleet.md") from error
    folder = path.absolute().parent
    bundles = found.bundles and BundlesConfig(
        folder=folder / found.bundles.folder, timestamp_key=folder / found.bundles.timestamp_key
    )
    return msgspec.structs.replace(
        found,
        data=folder / found.data,
        certificate=folder / found.certificate,
        key=folder / found.key,
        bundles=bundles,
    )


def _decode(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"expected a path, got {value!r}")
