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
    first: int
    last: int
    message: str


class Elsewhere(msgspec.Struct, frozen=True, kw_only=True):
    """The comparison with checkpoints kept on another machine.

    `checkpoints` is the number that agree with the chain. `through` and `time` are the sequence and time (nanoseconds
    since the epoch) of the last of them; `other_logs` are the ids of the logs to which the other checkpoints belong.
    """

    checkpoints: int
    through: int
    time: Annotated[int, msgspec.Meta(description="nanoseconds since the epoch")]
    other_logs: list[str]


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

    ok: bool
    log: str
    records: int
    first: int
    last: int
    removed: int
    checkpoints: int
    signed_checkpoints: int
    signed_through: int
    unsealed: int
    key: str | None
    findings: list[LogFinding]
    elsewhere: Elsewhere | None = None
    removal: str = ""
    remembered: int | None = None
    other_logs: list[OtherLog] = []
