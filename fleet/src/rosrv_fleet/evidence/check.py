"""Verify an evidence bundle with the robot's pinned keys. Runs in a worker.

The bundle is also compared with the robot's collected segments, so a bundle of a rewritten log is invalid.
"""

import contextlib
import re
import zlib
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_public_key

from appliance.audit.log.signatures import signature_is_valid
from appliance.formats.bundle_verifier import Verifier, printable
from appliance.signing.log_proof import Excerpt
from rosrv_fleet.config import FleetConfig
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.evidence.store import EvidenceContent
from rosrv_fleet.robots import Robots
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore
from rosrv_fleet.workers import OutOfTimeError, memory, processor_time

_MEMORY = 256 << 20
_MAX_SENTENCES = 10
_LONGEST_SENTENCE = 300
_LOG = re.compile("[0-9a-f]{32}")
_Time = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]


class _Manifest(msgspec.Struct, frozen=True):
    """The displayed part of a bundle's manifest. Its values are bounded, because a robot may sign anything."""

    log: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
    since: _Time
    until: _Time
    recording: Annotated[str, msgspec.Meta(max_length=64)]
    runs: list[tuple[_Time, _Time]]


class EvidenceError(Exception):
    """The bundle is not valid evidence of the robot."""


class _OtherKeyError(Exception):
    """The bundle has a key that is not the robot's. The message is the key in hexadecimal."""


class _RobotVerifier(Verifier):
    """The appliance's verifier without its calls of other programs, which would have no limits."""

    def __init__(self, bundle: Path, robot: Robot, store: SegmentStore) -> None:
        self._robot, self._store = robot, store
        super().__init__(bundle, None, Path(), {})

    def read_key(self, _key: Path | None) -> str:
        key = load_pem_public_key(self.read("audit.pub"))
        raw = key.public_bytes_raw().hex() if isinstance(key, Ed25519PublicKey) else "of another kind"
        if raw not in {appliance.key for appliance in self._robot.appliances.values()}:
            raise _OtherKeyError(raw)
        return raw

    def has_signed(self, key: bytes, signature: bytes, text: bytes) -> bool:
        return signature_is_valid(key, signature, text)

    def look_at_checkpoint(self, given: dict[str, Any], walk: Excerpt) -> None:
        log, number = self.manifest["log"], given["number"]
        if _LOG.fullmatch(log) is None:
            raise ValueError(f"{log[:80]!a} is not the id of a log")
        with contextlib.suppress(OSError, zlib.error, ValueError):  # `verify` reports it
            places: list[SegmentPlace] = self._store.with_number(self._robot.name, log, number)
            ends = [self._store.header(place).end for place in places]
            ends.sort(key=lambda end: end.hash != given["hash"])  # of a fork, one history is enough
            self.copies = {(self.manifest["log"], end.number): [msgspec.to_builtins(end)] for end in ends[:1]}
        super().look_at_checkpoint(given, walk)


def check_evidence(config: FleetConfig, bundle: Path, robot: Robot) -> EvidenceContent:
    """Return the verified content. Raise `EvidenceError` if it is invalid, and `OSError`."""
    store = SegmentStore(config.data, config.limits.reserve_bytes)
    try:
        with memory(_MEMORY), processor_time(config.evidence.check_seconds):
            verifier = _RobotVerifier(bundle, robot, store)
            verifier.run()
            if not verifier.findings:
                about = msgspec.convert(verifier.manifest, _Manifest)
    except _OtherKeyError as error:
        owners = (
            one.name
            for one in Robots(config.data / "robots").known().values()
            if str(error) in {own.key for own in one.appliances.values()}
        )
        owner = next(owners, None)
        whose = f"that of {owner}; use --robot {owner}" if owner else f"{error}, which no robot has"
        raise EvidenceError(f"{robot.name} has the key {robot.key}, the bundle {whose}") from None
    except OutOfTimeError as error:
        raise EvidenceError(str(error)) from None
    except Exception as error:  # noqa: BLE001  the file may contain anything
        reason = f"it is not an evidence bundle: {type(error).__name__} {error}"
        raise EvidenceError(*_limit([reason])) from None
    if verifier.findings:
        raise EvidenceError("; ".join(_limit(verifier.findings)))
    return EvidenceContent(
        log=about.log, since=about.since, until=about.until, recording=about.recording,
        records=sum(last - first + 1 for first, last in about.runs), checkpoints=verifier.checkpoints,
        collected=verifier.agreeing, unproven=_limit(verifier.notes),
    )  # fmt: skip


def _limit(sentences: list[str]) -> list[str]:
    first = [printable(sentence[:_LONGEST_SENTENCE]) for sentence in sentences[:_MAX_SENTENCES]]
    others = len(sentences) - len(first)
    return [*first, *([f"{others} more"] if others else [])]
