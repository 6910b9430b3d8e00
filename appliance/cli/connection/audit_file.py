"""Read the audit log from its file in a state directory; `RestLog` has the same methods over REST."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.record_format import LogEntry
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.chain_proofs import evidence, evidence_line
from appliance.audit.proof.copies import SignedCheckpoint, signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.audit.search.denial_summary import DenialSummary, summary_of_log
from appliance.audit.search.query import Filter
from appliance.audit.search.search import (
    Follower,
    LogSnapshot,
    RecordInContext,
    SearchPage,
    export,
    last_sequence,
    search,
    show,
)
from appliance.base import clock
from appliance.base.owner_access import acting_as, open_named
from appliance.signing.signed_logs import RememberedLog, acknowledge, remembered_logs

_POLL_SECONDS = 0.2
Progress = Callable[[int], None]


class FileLog:
    """Reads the log of a running or stopped appliance, or of a copy of its state directory.

    All methods raise `LogUnreadableError`.
    """

    def __init__(self, state: Path, robot: Callable[[], str] = str) -> None:
        self._state = state
        self._robot = robot

    @property
    def path(self) -> Path:
        if not self._state.is_dir():
            raise LogUnreadableError(
                f"{self._state}: no such directory; give the appliance's state directory with --state"
            )
        return self._state / "control" / "audit.db"

    def search(self, wanted: Filter, cursor: str | None, limit: int, *, newest_first: bool) -> SearchPage:
        return search(self.path, wanted, cursor, limit, newest_first=newest_first)

    def denials(self, wanted: Filter, limit: int) -> DenialSummary:
        return summary_of_log(self.path, wanted, limit)

    def show(self, record_id: str, neighbours: int) -> RecordInContext | None:
        return show(self.path, record_id, neighbours)

    def export(self, wanted: Filter) -> Iterator[LogEntry]:
        return export(self.path, wanted)

    def snapshot(self) -> LogSnapshot:
        return LogSnapshot(self.path)

    def evidence(self, wanted: Filter) -> Iterator[tuple[int, str]]:
        found, robot = evidence(self.path, wanted), self._robot()
        return ((entry.sequence, evidence_line(entry, chain, robot)) for entry, chain in found)

    def follow(self, wanted: Filter, lines: int, *, on: bool) -> Iterator[list[LogEntry]]:
        path = self.path
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
        path = self.path
        return verify(path, key, path.parent.parent / "signer", copies, progress)

    def present(self) -> str:
        """Return the id of the log."""
        with reading(self.path) as connection:
            (found,) = connection.execute("SELECT id FROM log").fetchone()
        return str(found)

    def signed_logs(self) -> list[RememberedLog]:
        """Return the logs that the signer of this machine signed."""
        with self._signer() as folder:
            return remembered_logs(folder, open_named)

    def acknowledge(self, log: RememberedLog) -> None:
        """Acknowledge, as root, that a log is no longer the present one, or that its memory is not whole."""
        with self._signer() as folder, acting_as(folder.stat().st_uid):  # in a container, root as the signer
            acknowledge(folder, log, clock.wall_ns(), os.getuid())

    @contextmanager
    def _signer(self) -> Iterator[Path]:
        folder = self._state / "signer"
        try:
            yield folder
        except (OSError, ValueError) as error:
            why = f"{folder}: {error}; run this as root, with the appliance's --state"
            raise LogUnreadableError(why) from error

    def checkpoints(self, after: int) -> list[SignedCheckpoint]:
        return signed_checkpoints(self.path, after)

    def last(self) -> int:
        return last_sequence(self.path)
