"""Keep the last result of `rosrv audit verify` beside the log, for reports that do not verify it themselves.

The file proves nothing, because any program that can change the log's folder can change it. A report says so.
"""

import contextlib
from pathlib import Path

import msgspec

from appliance.audit.log.record_format import rfc3339
from appliance.audit.proof.chain_findings import Verification, VerificationResult
from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.cli.audit.verification_text import verdict_of

_NAME = "verified.json"
_MODE = 0o640


def keep_verification(log: Path, result: Verification, seconds: float) -> None:
    """Store a result beside the log, if this user may write there."""
    parts = [
        f"records {result.first} to {result.last}, signed through {result.signed_through}, in {seconds:.0f} s"
    ]
    parts += [finding.message for finding in result.findings[:3]]
    kept = VerificationResult(
        time_utc=rfc3339(clock.wall_ns()), complete=result.ok, records=result.records, text="; ".join(parts),
        log=result.log, through=result.last, verdict=verdict_of(result).rstrip("."),
    )  # fmt: skip
    with contextlib.suppress(OSError):
        owner = log.parent.stat()
        write_whole(log.parent / _NAME, msgspec.json.encode(kept), _MODE, (owner.st_uid, owner.st_gid))


def last_verification(log: Path) -> VerificationResult | None:
    """Return the stored result, or null without a readable one."""
    try:
        return msgspec.json.decode((log.parent / _NAME).read_bytes(), type=VerificationResult)
    except (OSError, ValueError):
        return None
