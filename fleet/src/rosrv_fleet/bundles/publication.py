"""Verify the operator's publication, and sign the timestamp that makes it visible to robots.

The timestamp names a snapshot only if every file in it is present and verifies, so no robot sees half a publication.
"""

import datetime
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from securesystemslib.signer import CryptoSigner
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Metadata, MetaFile, Root, Snapshot, TargetFile, Targets, Timestamp
from tuf.api.serialization import DeserializationError
from tuf.api.serialization.json import JSONSerializer

from appliance.formats.terms import Terms, TermsError, terms_of

S = TypeVar("S", Root, Snapshot, Targets)
_ROOT = re.compile(r"([1-9][0-9]*)\.root\.json")
_SNAPSHOT = re.compile(r"([1-9][0-9]*)\.snapshot\.json")
LIFETIME = datetime.timedelta(hours=24)
"""The lifetime of a timestamp. After it, robots notice that newer metadata are withheld."""

_RENEW = datetime.timedelta(hours=8)  # the age at which a timestamp is signed again


class PublicationError(Exception):
    """The published files are incomplete or invalid."""


@dataclass(frozen=True, slots=True)
class PublishedBundles:
    """A complete publication: the root, the snapshot's version, the terms of each bundle, and the earliest expiry."""

    root: Root
    snapshot: int
    bundles: dict[str, Terms]
    expires: datetime.datetime


def read_publication(folder: Path) -> PublishedBundles:
    """Return the newest publication, or raise `PublicationError` if it does not verify."""
    metadata = folder / "metadata"
    try:
        root = _load(metadata / f"{_newest(metadata, _ROOT)}.root.json", Root)
        root.signed.verify_delegate("root", root.signed_bytes, root.signatures)
        version = _newest(metadata, _SNAPSHOT)
        snapshot = _load(metadata / f"{version}.snapshot.json", Snapshot)
        root.signed.verify_delegate("snapshot", snapshot.signed_bytes, snapshot.signatures)
        top = _listed(metadata, "targets", snapshot.signed)
        root.signed.verify_delegate("targets", top.signed_bytes, top.signatures)
        bundles: dict[str, Terms] = {}
        expires = [root.signed.expires, snapshot.signed.expires, top.signed.expires]
        for role in _delegated_roles(top.signed):
            listed = _listed(metadata, role, snapshot.signed)
            top.signed.verify_delegate(role, listed.signed_bytes, listed.signatures)
            expires.append(listed.signed.expires)
            for name, target in listed.signed.targets.items():
                _require_target(folder / "targets", target)
                bundles[name] = terms_of(target.custom)
    except (RepositoryError, DeserializationError, OSError, ValueError, TermsError) as error:
        raise PublicationError(
            f"{folder} is not a complete publication: {error}; publish it again"
        ) from error
    return PublishedBundles(root.signed, version, bundles, min(expires))


def next_timestamp(
    publication: PublishedBundles, last: bytes | None, key: CryptoSigner, now: datetime.datetime
) -> bytes | None:
    """Return a new timestamp, or None if the last one still serves.

    The version is at least the time in seconds, so a collector that lost its state still signs higher versions than
    before. Raise `PublicationError` if the key is not the root's, or if robots already know a newer snapshot.
    """
    keyids = publication.root.roles["timestamp"].keyids
    if key.public_key.keyid not in keyids:
        raise PublicationError("the root names another timestamp key: copy timestamp.pem of the repository")
    before = _signed_before(last, publication.root)
    expires = min(now + LIFETIME, publication.expires).replace(microsecond=0)
    if before is not None:
        if before.snapshot_meta.version > publication.snapshot:
            there = f"snapshot {publication.snapshot} is older than {before.snapshot_meta.version}"
            raise PublicationError(f"{there}, which robots know: publish the newest repository")
        fresh = before.expires - now > LIFETIME - _RENEW or before.expires >= expires
        # A clock that was ahead may have signed a longer life, in which robots would not notice a freeze.
        good = fresh and before.expires <= now + LIFETIME
        if before.snapshot_meta.version == publication.snapshot and good:
            return None
    least = 1 if before is None else before.version + 1
    signed = Timestamp(
        version=max(least, int(now.timestamp())),
        expires=expires,
        snapshot_meta=MetaFile(publication.snapshot),
    )
    document = Metadata(signed)
    document.sign(key)
    return document.to_bytes(JSONSerializer(compact=True))


def _signed_before(last: bytes | None, root: Root) -> Timestamp | None:
    """Return the last timestamp, or None if the present root does not accept it: robots then discard it too."""
    if last is None:
        return None
    try:
        document = Metadata[Timestamp].from_bytes(last)
        root.verify_delegate("timestamp", document.signed_bytes, document.signatures)
    except (RepositoryError, DeserializationError, ValueError):
        return None
    return document.signed


def _newest(metadata: Path, names: re.Pattern[str]) -> int:
    found = [int(name[1]) for path in metadata.iterdir() if (name := names.fullmatch(path.name))]
    if not found:
        raise ValueError("there are no signed metadata")
    return max(found)


def _load(path: Path, kind: type[S]) -> Metadata[S]:
    document = Metadata.from_file(str(path))
    if not isinstance(document.signed, kind):
        raise ValueError(f"{path.name} contains metadata of another role or version")
    return document


def _listed(metadata: Path, role: str, snapshot: Snapshot) -> Metadata[Targets]:
    meta = snapshot.meta.get(f"{role}.json")
    if meta is None:
        raise ValueError(f"the snapshot does not list {role}")
    return _load(metadata / f"{meta.version}.{role}.json", Targets)


def _delegated_roles(top: Targets) -> list[str]:
    return [] if top.delegations is None else list(top.delegations.roles or {})


def _require_target(targets: Path, target: TargetFile) -> None:
    for name in target.get_prefixed_paths():
        target.verify_length_and_hashes((targets / name).read_bytes())
