"""Define the configuration of the collector: one YAML file, checked against these types.

Each part of the collector has a section here. Relative paths are relative to the file.
"""

from pathlib import Path
from typing import Annotated, Any

import msgspec
import yaml

_Positive = Annotated[int, msgspec.Meta(gt=0)]
_Seconds = Annotated[float, msgspec.Meta(gt=0, le=86_400)]


class ConfigError(Exception):
    """The configuration is missing or invalid; the message has the file, the key and the remedy."""


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The limits of uploads and searches.

    `segment_bytes` is the largest uncompressed segment, `upload_bytes` the largest compressed one; `upload_seconds` is
    the longest upload. `uploads` run at the same time, one for each robot. `robot_bytes_per_day` limits the compressed
    bytes that one robot stores in 24 hours. `reserve_bytes` of the disk stay free. `search_seconds` is the longest
    search, `searches` run at the same time. `header_seconds` is the longest wait for a request's headers,
    `connections` the number of open connections.
    """

    segment_bytes: _Positive = 512 << 20
    upload_bytes: _Positive = 128 << 20
    upload_seconds: _Seconds = 120.0
    uploads: _Positive = 64
    robot_bytes_per_day: _Positive = 2 << 30
    reserve_bytes: _Positive = 256 << 20
    search_seconds: _Seconds = 10.0
    searches: _Positive = 4
    header_seconds: _Seconds = 15.0
    connections: _Positive = 4096


class BundlesConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bundles that robots get. `folder` is the one of `rosrv-fleet bundle publish`.

    `timestamp_key` is the file `timestamp.pem` of the operator's repository.
    """

    folder: Path
    timestamp_key: Path


class FleetConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The configuration of a collector.

    `data` is the folder with robots, tokens, keys and segments. `listen` is HOST:PORT. `certificate` and `key` are the
    server's (PEM). `database` is a libpq connection string; libpq also reads PGPASSWORD and PGPASSFILE. A robot is
    silent after `silent_seconds` without a segment. Without `bundles`, robots get none.
    """

    data: Path = Path("/var/lib/rosrv-fleet")
    listen: str = "0.0.0.0:8444"
    certificate: Path
    key: Path
    database: str = "dbname=rosrv_fleet"
    silent_seconds: _Seconds = 600.0
    limits: Limits = Limits()
    bundles: BundlesConfig | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Return `listen` as host and port. Raises `ValueError`."""
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)


def load_config(path: Path) -> FleetConfig:
    """Return the configuration in a YAML file. Raises `ConfigError`."""
    try:
        fields = yaml.safe_load(path.read_text(encoding="utf-8"))
        found = msgspec.convert(fields, FleetConfig, dec_hook=_decoded)
        if not 0 <= found.address[1] <= 65_535:
            raise ValueError(f"listen: {found.listen} has no valid port")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name another file with --config") from error
    except (yaml.YAMLError, msgspec.ValidationError, ValueError) as error:
        raise ConfigError(f"{path}: {error}; see docs/fleet.md") from error
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


def _decoded(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"expected a path, got {value!r}")
