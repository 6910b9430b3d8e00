"""Verify bundles with TUF.

The collector is not trusted. It can withhold a bundle, and choose among the bundles that the group's key has signed.
It cannot change a bundle, bring back a withdrawn one, or give a robot the bundle of another site, group or later
ring.

1. Every check refreshes the metadata first. Expired, older or badly signed metadata end the check.
2. The trusted metadata are on the disk before a bundle is used, so a power cut undoes nothing that the robot knows.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tuf.api.exceptions import (
    DownloadError,
    DownloadHTTPError,
    DownloadLengthMismatchError,
    RepositoryError,
)
from tuf.api.metadata import TargetFile
from tuf.ngclient import FetcherInterface, Updater, UpdaterConfig

from appliance.base import clock
from appliance.features.fleet.connection import CollectorConnection, CollectorError
from appliance.formats.bundle_api import METADATA, SELECTION, TARGETS
from appliance.formats.bundle_archive import LONGEST, BundleArchiveError, BundleContents, unpack
from appliance.formats.terms import BundlePath, TermsError, terms_of

_LONGEST_TIMESTAMP = 1 << 14
_LONGEST_SELECTION = 1024
_UNFINISHED = "tmp*"  # the names that the TUF library gives to files that it has not finished


class BundleRejectedError(Exception):
    """The collector's metadata or bundle are not accepted; the message has the reason."""


class BundleTooEarlyError(Exception):
    """The robot's ring may take the bundle from `at` on (seconds since the epoch)."""

    def __init__(self, path: BundlePath, at: float) -> None:
        super().__init__(f"{path} is for this robot's ring in {max(0.0, at - clock.wall()):.0f} s")
        self.at = at


class BundleFolderError(Exception):
    """A file cannot be written; nothing is lost, and the next check tries again."""


@dataclass(frozen=True, slots=True)
class VerifiedBundle:
    """A bundle that the robot may take; `sha256` identifies its archive."""

    path: BundlePath
    sha256: str
    contents: BundleContents


@dataclass(frozen=True, slots=True)
class SelectedBundle:
    """The signed target that the collector selects for this robot."""

    path: BundlePath
    target: TargetFile

    @property
    def sha256(self) -> str:
        return str(self.target.hashes["sha256"])


class _Fetcher(FetcherInterface):
    def __init__(self, connection: CollectorConnection) -> None:
        self._connection = connection

    def _fetch(self, url: str) -> Iterator[bytes]:
        try:
            path = url.removeprefix(f"{self._connection.url}/")
            if path == f"{METADATA}/timestamp.json":
                yield self._connection.get_changed(path, _LONGEST_TIMESTAMP)
            else:
                # TUF cuts each file at the length in the metadata; one more byte shows that it is longer.
                yield from self._connection.chunks(path, LONGEST + 1)
        except CollectorError as error:
            if error.status is not None:
                raise DownloadHTTPError(str(error), error.status) from error
            raise DownloadError(str(error)) from error


class VerifiedBundles:
    """The bundles of the robot's group; the operator trusts the root metadata in `root`. Not thread-safe.

    Methods raise `BundleRejectedError`, `BundleFolderError` and `CollectorError`.
    """

    def __init__(
        self,
        folder: Path,
        root: bytes,
        connection: CollectorConnection,
        *,
        site: str,
        group: str,
        robot: str,
        clock: Callable[[], float] = clock.wall,
    ) -> None:
        self._metadata = folder / "metadata"
        self._download = folder / "bundle.tar"
        self._root = root
        self.connection = connection
        self._place = (site, group)
        self._selection = f"{SELECTION}/{site}/{group}"
        self._robot = robot
        self._clock = clock
        self._updater: Updater | None = None

    def refresh(self) -> None:
        self._updater = None
        with _translate():
            self._metadata.mkdir(mode=0o700, parents=True, exist_ok=True)
            for left in self._metadata.glob(_UNFINISHED):
                left.unlink(missing_ok=True)
            updater = Updater(
                str(self._metadata),
                f"{self.connection.url}/{METADATA}",
                target_base_url=f"{self.connection.url}/{TARGETS}",
                fetcher=_Fetcher(self.connection),
                config=_limits(),
                bootstrap=self._root,
            )
            try:
                updater.refresh()
            finally:
                self._sync()
        self._updater = updater

    def fetch_selected(self) -> SelectedBundle | None:
        """Return the bundle that the collector selects, or None. Call `refresh` before.

        Raise `BundleTooEarlyError` if the robot's ring may not take the bundle yet.
        """
        text = (
            self.connection.get_changed(self._selection, _LONGEST_SELECTION)
            .decode("utf-8", "replace")
            .strip()
        )
        if not text:
            return None
        if self._updater is None:
            raise RuntimeError("refresh the metadata first")
        try:
            path = BundlePath.parse(text)
        except TermsError as error:
            raise BundleRejectedError(f"the collector selects an invalid bundle: {error}") from error
        if (path.site, path.group) != self._place:
            raise BundleRejectedError(f"the collector selects {path}, which is for other robots")
        with _translate():
            try:
                target = self._updater.get_targetinfo(str(path))
            finally:
                self._sync()
        if target is None:
            raise BundleRejectedError(f"the collector selects {path}, which is not signed, or withdrawn")
        self._require_its_turn(path, target)
        return SelectedBundle(path, target)

    def get(self, selected: SelectedBundle) -> VerifiedBundle:
        if self._updater is None:
            raise RuntimeError("refresh the metadata first")
        with _translate():
            self._updater.download_target(selected.target, str(self._download))
            archive = self._download.read_bytes()
            self._download.unlink()
        try:
            return VerifiedBundle(selected.path, selected.sha256, unpack(archive))
        except BundleArchiveError as error:
            raise BundleRejectedError(f"{selected.path}: {error}") from error

    def _require_its_turn(self, path: BundlePath, target: TargetFile) -> None:
        if target.length > LONGEST or "sha256" not in target.hashes:
            raise BundleRejectedError(f"{path} is longer than {LONGEST} bytes, or signed without SHA-256")
        try:
            earliest = terms_of(target.custom).earliest(self._robot, path)
        except TermsError as error:
            raise BundleRejectedError(f"{path}: {error}") from error
        if self._clock() < earliest:
            raise BundleTooEarlyError(path, earliest)

    def _sync(self) -> None:
        """Sync the files that the TUF library replaces without syncing."""
        for path in (*self._metadata.rglob("*.json"), self._metadata / "root_history", self._metadata):
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _limits() -> UpdaterConfig:
    return UpdaterConfig(
        max_root_rotations=64,
        max_delegations=4,
        root_max_length=1 << 18,
        timestamp_max_length=_LONGEST_TIMESTAMP,
        snapshot_max_length=1 << 20,
        targets_max_length=1 << 20,
    )


@contextmanager
def _translate() -> Iterator[None]:
    try:
        yield
    except (RepositoryError, DownloadLengthMismatchError) as error:
        raise BundleRejectedError(f"{type(error).__name__}: {error}") from error
    except DownloadError as error:
        raise CollectorError(str(error)) from error
    except OSError as error:
        raise BundleFolderError(f"the trusted metadata cannot be written: {error}") from error
