"""What a verification finds, as data that the CLI, REST and the console show alike."""

import enum
from typing import Annotated

import msgspec


class Kind(enum.StrEnum):
    """What is wrong."""

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
    REMOVAL_UNFOUNDED = "removal unfounded"
    PROVES_NOTHING = "proves nothing"


class LogFinding(msgspec.Struct, frozen=True):
    """One thing that is wrong; `first` and `last` are sequences of records, or numbers of checkpoints."""

    kind: Kind
    first: int
    last: int
    message: str


class Elsewhere(msgspec.Struct, frozen=True, kw_only=True):
    """What checkpoints kept on another machine prove: how many agree with the chain, and how far.

    `through` is the sequence of the last one that agrees, `time` when it was made (nanoseconds since the epoch);
    `other_logs` are the ids of logs that the others are of.
    """

    checkpoints: int
    through: int
    time: Annotated[int, msgspec.Meta(description="nanoseconds since the epoch")]
    other_logs: list[str]


class Verification(msgspec.Struct, frozen=True, kw_only=True):
    """The result: `ok` when nothing is wrong.

    `first` and `last` are the sequences of the first and last record; `records` how many there are; `removed`
    how many retention removed before them; `signed_through` is the sequence up to which the chain is
    proven by a signature, `unsealed` how many records come after it; `key` the public key it was held
    against; `elsewhere` what another machine's checkpoints prove, when they were given. `removal` says what vouches for
    the removal: "" (nothing was removed), "signed", or "unsigned": by a version of before removals were signed, so that
    nothing proves that they followed from the settings.
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
