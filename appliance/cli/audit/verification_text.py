"""Print the verification of an audit log."""

import sys
from collections.abc import Iterator

from appliance.audit.log.record_format import printable, rfc3339
from appliance.audit.proof.chain_findings import Elsewhere, FindingKind, Verification
from appliance.base.counted import counted
from appliance.base.timestamps import in_local_zone, local_text
from appliance.signing.signed_logs import RememberedLog

_BESIDE = (FindingKind.LOG_REPLACED, FindingKind.MEMORY_MISSING)


def print_verification(result: Verification) -> None:
    for finding in result.findings:
        _say(f"{finding.kind.value.upper()}: {printable(finding.message)}")
    _say(
        f"{counted(result.records, 'record')} ({result.first} to {result.last}), log {printable(result.log)}"
    )
    if result.removed:
        _say(f"records up to {result.removed} were removed by retention, as recorded{_vouched(result)}")
    _say(
        f"{result.signed_checkpoints} of {counted(result.checkpoints, 'checkpoint is', 'checkpoints are')}"
        f" signed; records up to {result.signed_through} are proven by a signature,"
        f" the {result.unsealed} after it by the chain only"
    )
    if result.elsewhere is not None:
        for text in _elsewhere(result.elsewhere):
            _say(text)
    _say(_memory(result.remembered))
    for other in result.other_logs:
        if other.set_aside is not None:
            _say(
                f"log {other.log} was signed before, up to checkpoint {other.last}: it is not part of this one, and was"
                f" set aside at {rfc3339(other.set_aside)}"
            )
    _say(f"key: {result.key or 'none (nothing was signed yet)'}")
    _say(verdict_of(result))


def _vouched(result: Verification) -> str:
    if result.removal == "signed":
        return "; the signer confirmed their removal"
    return "; the signer did not confirm it: their removal is not proven"


def verdict_of(result: Verification) -> str:
    """Return what a verification proves, in a sentence."""
    if result.ok:
        return _sound(result)
    if all(finding.kind in _BESIDE for finding in result.findings):
        return "The log itself is consistent, but it is not the whole log that was signed."
    if all(finding.kind is FindingKind.PROVES_NOTHING for finding in result.findings):
        return "The log itself is consistent, but the checkpoints kept elsewhere do not confirm it."
    return "The log was tampered with or is damaged."


def _sound(result: Verification) -> str:
    if not result.signed_through:
        return "The log is consistent, but nothing is signed yet: its completeness is not proven. Verify again later."
    if not (result.remembered or result.elsewhere):
        return "The log is consistent and its signatures are valid, but records may have been cut off at its end."
    copies = result.elsewhere
    if not result.remembered and copies is not None and copies.through < result.signed_through:
        return f"The log is unchanged, and complete up to record {copies.through}; later ones may have been cut off."
    if result.other_logs or (copies is not None and copies.other_logs):
        return "This log is complete and unchanged; the other logs named above are not part of it."
    return "The log is complete and unchanged."


def _memory(remembered: int | None) -> str:
    if remembered is None:
        return "not compared with the signer's memory: run this as root, with the appliance's --state"
    if not remembered:
        return "the signer's memory has no checkpoint of this log"
    return f"compared with the signer's memory, up to checkpoint {remembered}"


def _elsewhere(found: Elsewhere) -> Iterator[str]:
    if found.checkpoints:
        agreeing = counted(
            found.checkpoints, "checkpoint kept elsewhere agrees", "checkpoints kept elsewhere agree"
        )
        yield f"{agreeing}: records up to {found.through} are unchanged since {rfc3339(found.time)}"
    else:
        yield "no checkpoint kept elsewhere belongs to this log"
    if found.other_logs:
        yield f"checkpoints of other logs: {', '.join(found.other_logs)}"


def signed_log_text(one: RememberedLog, present: str) -> str:
    state, known = one.state(present), one.acknowledgement
    since = f" at {local_text(known.time)}" if state == "set aside" and known is not None else ""
    lost = ", its beginning is not remembered" if one.lacks_memory else ""
    return f"{one.log}  {state}{since}, checkpoints {one.first} to {one.last}{lost}"


def _say(text: str) -> None:
    write(in_local_zone(text))


def write(text: str) -> None:
    """Print a line; characters that the encoding of standard output lacks are escaped."""
    encoding = sys.stdout.encoding or "ascii"
    sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding) + "\n")
