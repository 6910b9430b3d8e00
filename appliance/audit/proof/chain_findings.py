"""Results of a verification, as the CLI, REST and the console show them."""

import enum
from typing import Annotated

import msgspec

from appliance.signing.signed_logs import OtherLog


class FindingKind(enum.StrEnum):
    """The kind of a finding."""

    CHANGED = "changed"
    MISSING = "missing"
    INSERTED = "inserted"
    REORDERED = "reordered"
    TRUNCATED = "truncated"
    UNREADABLE = "unreadable"
    STRUCTURE = "structure"
    CHECKPOINT_CHANGED = "checkpoint changed"
    CHECKPOINT_MISSING = "checkpoint missing"
    SIGNATURE_WRONG = "signature wrong"
    SIGNATURE_MISSING = "signature missing"
    WRONG_KEY = "wrong key"
    NO_KEY = "no key"
    REWRITTEN = "rewritten"
    LOG_REPLACED = "log replaced"
    MEMORY_MISSING = "memory missing"
    REMOVAL_UNFOUNDED = "removal unfounded"
    PROVES_NOTHING = "proves nothing"


class LogFinding(msgspec.Struct, frozen=True):
    """A fault of the log; `first` and `last` are sequences of records, or numbers of checkpoints."""

    kind: FindingKind
    first: Annotated[int, msgspec.Meta(description="sequence of a record, or number of a checkpoint")]
    last: Annotated[int, msgspec.Meta(description="sequence of a record, or number of a checkpoint")]
    message: Annotated[str, msgspec.Meta(description="in words")]


class Elsewhere(msgspec.Struct, frozen=True, kw_only=True):
    """The comparison with checkpoints kept on another machine.

    `checkpoints` is the number that agree with the chain. `through` and `time` are the sequence and time (nanoseconds
    since the epoch) of the last of them; `other_logs` are the ids of the logs to which the other checkpoints belong.
    """

    checkpoints: Annotated[int, msgspec.Meta(description="number of copies that agree with the chain")]
    through: Annotated[int, msgspec.Meta(description="sequence of the last checkpoint that agrees")]
    time: Annotated[int, msgspec.Meta(description="nanoseconds since the epoch")]
    other_logs: Annotated[list[str], msgspec.Meta(description="ids of other logs that the copies belong to")]


class Verification(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a verification; `ok` if nothing is wrong.

    `records` is the number of records, from sequence `first` to `last`; retention removed all up to sequence `removed`.
    Signatures prove the chain up to `signed_through`; `unsealed` records come after it. `key` is the public key that
    was used. `elsewhere` is the comparison with checkpoints of another machine, if they were given. `removal` is ""
    (no records were removed), "signed", or "unsigned": nothing proves that the settings required the removal, for
    example because a version that did not sign removals made it. `remembered` is the number of the last checkpoint in
    the signer's memory of this log, 0 without one; None if the log was not compared with that memory. `other_logs` are
    those that the signer signed besides this one; each that no operator set aside is a finding.
    """

    ok: Annotated[bool, msgspec.Meta(description="whether there is no error")]
    log: Annotated[str, msgspec.Meta(description="id of the log")]
    records: Annotated[int, msgspec.Meta(description="number of records")]
    first: Annotated[int, msgspec.Meta(description="sequence of the first record")]
    last: Annotated[int, msgspec.Meta(description="sequence of the last record")]
    removed: Annotated[
        int, msgspec.Meta(description="number of records that retention removed before the first one")
    ]
    checkpoints: Annotated[int, msgspec.Meta(description="number of checkpoints that were made")]
    signed_checkpoints: Annotated[
        int, msgspec.Meta(description="number of those checkpoints with a signature")
    ]
    signed_through: Annotated[
        int, msgspec.Meta(description="sequence up to which a signature proves the chain")
    ]
    unsealed: Annotated[int, msgspec.Meta(description="number of later records, which only the chain proves")]
    key: Annotated[str | None, msgspec.Meta(description="public key, in hexadecimal")]
    findings: Annotated[list[LogFinding], msgspec.Meta(description="all findings")]
    elsewhere: Annotated[
        Elsewhere | None,
        msgspec.Meta(
            description="what the checkpoints stored on another machine prove, or null if none were given"
        ),
    ] = None
    removal: Annotated[
        str,
        msgspec.Meta(description="proof of the removal: signed or unsigned, or empty if nothing was removed"),
    ] = ""
    remembered: Annotated[
        int | None,
        msgspec.Meta(
            description="number of the last checkpoint in the signer's memory of this log, 0 without one, or null if "
            "it was not compared"
        ),
    ] = None
    other_logs: Annotated[
        list[OtherLog], msgspec.Meta(description="ids of other logs that the copies belong to")
    ] = []


class VerificationResult(msgspec.Struct, frozen=True, kw_only=True):
    """The last stored result of `rosrv audit verify`, which is not part of the report's own work.

    `through` is the sequence of the last record that it read, of the log `log`. `complete` says that it had no finding,
    and `verdict` in words what that proves; a result of an earlier version has no verdict.
    """

    time_utc: str
    complete: bool
    records: int
    text: str
    log: str = ""
    through: int = 0
    verdict: str = ""
