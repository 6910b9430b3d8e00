"""Print the verification of two logs and of the takeovers between them."""

from appliance.audit.record_format import printable, rfc3339
from appliance.audit.takeover_verification import PairVerification, TakeoverProof
from appliance.cli.audit.record_table import print_verification, write


def print_pair(pair: PairVerification) -> None:
    """Print both verifications, then one line for each finding between the logs and for each takeover."""
    for result in pair.logs:
        print_verification(result)
        write("")
    for finding in pair.findings:
        write(f"{finding.kind.value.upper()}: {printable(finding.message)}")
    for takeover in pair.takeovers:
        write(
            f"epoch {takeover.epoch}, {rfc3339(takeover.time)}: {takeover.appliance} took over from"
            f" {takeover.other} (record {takeover.sequence} of log {takeover.log}); {_link(takeover)}{_overlap(takeover)}"
        )
    write(_verdict(pair))


def _link(takeover: TakeoverProof) -> str:
    other = takeover.other
    match takeover.link:
        case "none":
            return f"no checkpoint of {other} is named, so nothing links the logs here"
        case "wrong":
            return f"the checkpoint of {other} that it names is wrong, see above"
        case "removed":
            return f"it names the log of {other} up to record {takeover.through}, which retention has removed since"
        case "proven":
            tail = f"{takeover.tail} later records of {other}, {takeover.tail_signed} of them sealed by later checkpoints"
            return f"it proves the log of {other} up to record {takeover.through}; not the {tail}"


def _overlap(takeover: TakeoverProof) -> str:
    match takeover.overlap:
        case "excluded":
            return f"; {takeover.other} decided nothing more until it took over again"
        case "found":
            return f"; {takeover.other} went on deciding, see above"
        case "unknown":
            return ""


def _verdict(pair: PairVerification) -> str:
    if not pair.ok:
        return "A log was tampered with or is damaged, or the two logs do not fit together."
    if not pair.takeovers:
        return "Both logs have no finding, but they have no takeover: nothing links them."
    return f"Both logs, and the {len(pair.takeovers)} takeovers between them, have no finding."
