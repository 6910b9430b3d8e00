"""Print the verification of two logs and of the takeovers between them."""

from collections.abc import Callable, Iterator
from pathlib import Path

from appliance.audit.log.record_format import printable, rfc3339
from appliance.audit.proof.chain_findings import Verification
from appliance.cli.audit.audit_errors import fail
from appliance.cli.audit.verification_text import print_verification, write
from appliance.features.standby.membership import MembershipError, load_membership, path_of
from appliance.features.standby.takeover_verification import (
    PairVerification,
    TakeoverProof,
    VerifiedLog,
    verify_alone,
    verify_takeovers,
)


def verification(
    own: Path, verified: Verification, other: Path, state: Path, verify: Callable[[], Verification]
) -> tuple[PairVerification, Callable[[PairVerification], None]]:
    first, missing = VerifiedLog(own, verified), _absent(other, state)
    pair = verify_alone(first, missing) if missing else verify_takeovers(first, VerifiedLog(other, verify()))
    return pair, print_pair


def _absent(log: Path, state: Path) -> str:
    if log.exists():
        return ""
    try:
        membership = load_membership(path_of(state))
    except MembershipError as error:
        fail(str(error), 2)
    return membership.name if membership is not None else ""


def print_pair(pair: PairVerification) -> None:
    names = {takeover.log: takeover.appliance for takeover in pair.takeovers}
    for result in pair.logs:
        if result.log in names:
            write(f"Log of {names[result.log]}:")
        print_verification(result)
        write("")
    for finding in pair.findings:
        write(f"{finding.kind.value.upper()}: {printable(finding.message)}")
    for takeover in pair.takeovers:
        by = f"{takeover.appliance} took over from {takeover.other}"
        write(f"epoch {takeover.epoch}, {rfc3339(takeover.time)}: {by} (record {takeover.sequence})")
        for text in _proven(takeover):
            write(f"    {text}")
    write(_verdict(pair))


def _proven(takeover: TakeoverProof) -> Iterator[str]:
    other, through = takeover.other, takeover.through
    match takeover.link:
        case "none":
            yield f"it names no checkpoint of {other}, so it proves nothing about that log"
        case "wrong":
            yield f"it names a checkpoint of {other} that is wrong, see above"
        case "removed":
            yield f"retention has removed the records of {other} up to record {through}, which it names"
        case "proven":
            yield f"the log of {other} agrees with it up to record {through}"
    if through:
        yield (
            f"records of {other} after that, until its next takeover: {takeover.tail};"
            f" later checkpoints seal {takeover.tail_signed}"
        )
    match takeover.overlap:
        case "excluded":
            yield f"{other} decided nothing more until it took over again"
        case "found":
            yield f"{other} went on deciding, see above"
        case "unknown":
            yield f"the logs do not show whether {other} went on deciding"


def _verdict(pair: PairVerification) -> str:
    if not pair.ok:
        return "A log was tampered with or is damaged, or the two logs do not fit together."
    if pair.absent:
        return f"{pair.absent} has no log yet, because it was never active: there is no takeover to verify."
    if not pair.takeovers:
        return "Both logs are consistent, but neither has a takeover: nothing links them."
    count = len(pair.takeovers)
    takeovers, verb = ("the takeover", "is") if count == 1 else (f"the {count} takeovers", "are")
    return f"Both logs are consistent, and so {verb} {takeovers} between them."
