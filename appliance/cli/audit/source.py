"""Where the audit verbs read: the log's file here. `RestLog` reads the running appliance's, with the same methods."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from appliance.audit.chain_findings import Verification
from appliance.audit.chain_proofs import evidence, evidence_line
from appliance.audit.copies import SignedCheckpoint, signed_checkpoints
from appliance.audit.log_database import LogUnreadableError
from appliance.audit.query import Filter
from appliance.audit.record_format import Entry
from appliance.audit.search import Follower, Page, Shown, export, last_sequence, search, show
from appliance.audit.verification import verify

_POLL_SECONDS = 0.2
Progress = Callable[[int], None]


class FileLog:
    """The log in a state directory; works while the appliance runs, when it is stopped, and on a copy.

    All raise `LogUnreadableError`, those of `RestLog` `NotRunningError`.
    """

    def __init__(self, state: Path) -> None:
        self._state = state

    @property
    def _path(self) -> Path:
        if not self._state.is_dir():
            raise LogUnreadableError(
                f"{self._state}: no such directory; is the state directory right (--state)?"
            )
        return self._state / "control" / "audit.db"

    def search(self, wanted: Filter, cursor: str | None, limit: int, *, newest_first: bool) -> Page:
        """A page of records."""
        return search(self._path, wanted, cursor, limit, newest_first=newest_first)

    def show(self, record_id: str, neighbours: int) -> Shown | None:
        """One record with its neighbours; None when there is none."""
        return show(self._path, record_id, neighbours)

    def export(self, wanted: Filter) -> Iterator[Entry]:
        """All records that match, the oldest first."""
        return export(self._path, wanted)

    def evidence(self, wanted: Filter) -> Iterator[tuple[int, str]]:
        """The same as evidence: sequences, and lines of NDJSON with their places in the chain."""
        return (
            (entry.sequence, evidence_line(entry, chain)) for entry, chain in evidence(self._path, wanted)
        )

    def follow(self, wanted: Filter, lines: int, *, on: bool) -> Iterator[list[Entry]]:
        """The last records that match, the oldest first; then, if `on`, those that come, without end."""
        path = self._path
        follower = Follower(path, wanted)
        if lines:
            yield search(path, wanted, str(follower.position + 1), lines).entries[::-1]
        pause = threading.Event()
        while on:
            yield follower.poll()
            pause.wait(_POLL_SECONDS)

    def verify(
        self, key: bytes | None, copies: Sequence[SignedCheckpoint] | None, progress: Progress
    ) -> Verification:
        """Whether it is complete and unchanged, held against the signer's memory if that can be read.

        `progress` is told the sequence that was looked at last.
        """
        path = self._path
        signer = path.parent.parent / "signer"
        may = os.access(signer, os.R_OK | os.X_OK)
        return verify(path, key, signer if may else None, copies, progress)

    def checkpoints(self, after: int) -> list[SignedCheckpoint]:
        """Signed checkpoints after a number, in order; some of them, none when there is no more."""
        return signed_checkpoints(self._path, after)

    def last(self) -> int:
        """The sequence of the last record."""
        return last_sequence(self._path)
