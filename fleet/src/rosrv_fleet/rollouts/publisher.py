"""Publish the operator's signed bundles, with a timestamp that the collector renews."""

import asyncio
import datetime
from collections.abc import Callable, Mapping
from pathlib import Path

import structlog
from tuf.api.metadata import Metadata

from appliance.formats.terms import Terms
from rosrv_fleet.bundles.keys import KeyFileError, load_online_key
from rosrv_fleet.bundles.publication import (
    PublicationError,
    PublishedBundles,
    next_timestamp,
    read_publication,
)
from rosrv_fleet.rollouts.store import RolloutStore

_Stamp = tuple[tuple[str, int, int], ...]
_log = structlog.get_logger()


class BundlePublisher:
    """The publication in a folder, and its newest timestamp; `trouble` is the reason why robots take nothing new.

    `key` is the file of the timestamp's key.
    """

    def __init__(self, folder: Path, key: Path, store: RolloutStore, clock: Callable[[], float]) -> None:
        self.folder = folder
        self._key = key
        self._store = store
        self._clock = clock
        self._stamp: _Stamp | None = None
        self.publication: PublishedBundles | None = None
        self.timestamp: bytes | None = None
        self.trouble = "the publication is not read yet"

    @property
    def bundles(self) -> Mapping[str, Terms]:
        return {} if self.publication is None else self.publication.bundles

    @property
    def expires(self) -> float | None:
        """Return when the first signed metadata expire, in seconds since the epoch."""
        return None if self.publication is None else self.publication.expires.timestamp()

    async def renew(self) -> None:
        """Read the publication if it has changed, and renew the timestamp before it expires."""
        try:
            stamp = await asyncio.to_thread(_stamp, self.folder)
            if stamp != self._stamp or self.publication is None:
                self.publication = await asyncio.to_thread(read_publication, self.folder)
                self._stamp = stamp
            last = await asyncio.to_thread(self._store.timestamp)
            now = datetime.datetime.fromtimestamp(self._clock(), datetime.UTC)
            made = next_timestamp(self.publication, last, load_online_key(self._key), now)
        except (PublicationError, KeyFileError, OSError) as error:
            if self.trouble != str(error):
                _log.error("bundles cannot be published", reason=str(error))
            self.trouble = str(error)
            return
        if made is not None:
            await asyncio.to_thread(
                self._store.save_timestamp, Metadata.from_bytes(made).signed.version, made
            )
            last = await asyncio.to_thread(self._store.timestamp)
        self.timestamp, self.trouble = last, ""
        if self.publication.expires <= now:
            self.trouble = (
                f"the signed metadata expired at {self.publication.expires:%Y-%m-%d %H:%M} UTC, so robots take nothing:"
                " rosrv-fleet bundle sign, then bundle publish"
            )


def _stamp(folder: Path) -> _Stamp:
    found = (
        (path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in (folder / "metadata").iterdir()
    )
    return tuple(sorted(found))
