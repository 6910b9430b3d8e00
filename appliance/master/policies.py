"""The policy in force: loading, revisions, rollback, and the time limit of an unconfirmed change.

A new policy is checked, run against its own tests and compiled before anything changes; a bad one changes nothing
and says everything that is wrong with it. Every policy that came into force is a revision in the store.
"""

import asyncio
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import structlog

from appliance.audit.record import Severity
from appliance.master.recorder import Recorder
from appliance.policy import Policy, PolicyError, compile_policy
from appliance.policy.cases import run_cases
from appliance.policy.hosts import Network
from appliance.policy.model import Address
from appliance.store.state import RevisionRow, StateStore

_log = structlog.get_logger()
_DISK = "disk"


class PolicyRefusedError(Exception):
    """The policy was not taken; `findings` has every reason, as `file:line:column: error: text`."""

    def __init__(self, findings: list[str]) -> None:
        super().__init__("\n".join(findings))
        self.findings = findings


@dataclass(frozen=True, slots=True)
class Loaded:
    """What a load did: the revision in force now, the one before, the lint, and what was revoked."""

    revision: int
    replaced: int
    warnings: list[str]
    revoked: int
    confirm_by: float | None


class Policies:
    """Keeps the policy in force. `redecide()` decides again what is live and returns how much was revoked."""

    def __init__(
        self, file: Path, store: StateStore, recorder: Recorder, *, robot: Collection[Address | Network]
    ) -> None:
        self._file = file
        self._store = store
        self._recorder = recorder
        self._robot = robot
        self._current: Policy | None = None
        self._revert: asyncio.Task[None] | None = None
        self.confirm_by: float | None = None
        self.revision = 0
        self.changed: Callable[[Policy], int] = lambda policy: 0  # noqa: ARG005 - set by control when it is wired

    @property
    def current(self) -> Policy:
        """The policy in force."""
        if self._current is None:
            raise RuntimeError("no policy is loaded yet")
        return self._current

    @property
    def differs_from_file(self) -> bool:
        """Whether the policy in force is another than the file now has."""
        try:
            return self._file.read_text(encoding="utf-8") != self.current.text
        except (OSError, UnicodeDecodeError):
            return True

    def start(self, *, restarted: bool) -> None:
        """Bring a policy into force at start. Raises `PolicyRefusedError`.

        After a crash of control (`restarted`) it is the one that was in force. At the appliance's start it is the
        file, unless an operator's own revision (a rollback, REST) was in force when it stopped.
        """
        revisions = self._store.revisions()
        last = revisions[0] if revisions else None
        if last is not None and (restarted or last.who != _DISK):
            self._enforce(self._compile(last.text, last.file), last.revision)
            self._resume_confirmation()
            return
        text = self._read()
        policy = self._compile(text, str(self._file))
        if last is not None and last.text == text:
            self._enforce(policy, last.revision)
        else:
            self._keep(policy, who=_DISK, note="read at start")

    def reload(self, *, who: str = _DISK, confirm_within: float | None = None) -> Loaded:
        """Read the file again: check, test, swap, decide again what is live. Raises `PolicyRefusedError`."""
        before = self.revision
        try:
            policy = self._compile(self._read(), str(self._file))
            self._test(policy)
        except PolicyRefusedError as error:
            self._recorder.happened(
                "policy refused",
                f"revision {before} stays in force: {error.findings[0]}",
                severity=Severity.WARNING,
                findings=error.findings[:100],
                who=who,
            )
            raise
        revoked = self._keep(policy, who=who, note="reloaded from disk")
        return self._answer(policy, before, revoked, confirm_within)

    def rollback(self, revision: int | None, *, who: str) -> Loaded:
        """Bring a kept revision into force (None: the one before this). Raises `PolicyRefusedError`."""
        before = self.revision
        rows = {row.revision: row for row in self._store.revisions()}
        wanted = (
            revision if revision is not None else max((one for one in rows if one < before), default=None)
        )
        row = rows.get(wanted) if wanted is not None else None
        if row is None:
            known = ", ".join(str(one) for one in sorted(rows)) or "none"
            raise PolicyRefusedError(
                [f"there is no revision {revision or 'before this one'}; kept are: {known}"]
            )
        policy = self._compile(row.text, row.file)
        revoked = self._keep(policy, who=who, note=f"rolled back to revision {row.revision}")
        return self._answer(policy, before, revoked, None)

    def confirm(self) -> bool:
        """Keep an unconfirmed change; False when there is none."""
        if self.confirm_by is None:
            return False
        self._end_confirmation()
        self._recorder.happened("policy confirmed", f"revision {self.revision} was confirmed")
        return True

    def revisions(self) -> list[RevisionRow]:
        """All kept revisions, the newest first."""
        return self._store.revisions()

    # --- inside ---

    def _read(self) -> str:
        try:
            return self._file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise PolicyRefusedError([f"{self._file}: the policy cannot be read: {error}"]) from error

    def _compile(self, text: str, file: str) -> Policy:
        try:
            return compile_policy(text, file=file, hosts={}, robot=self._robot)
        except PolicyError as error:
            raise PolicyRefusedError([str(one) for one in error.findings]) from error

    def _test(self, policy: Policy) -> None:
        cases = Path(f"{policy.file}.tests.yaml")
        try:
            text = cases.read_text(encoding="utf-8")
        except FileNotFoundError:
            return
        except (OSError, UnicodeDecodeError) as error:
            raise PolicyRefusedError([f"{cases}: the policy's tests cannot be read: {error}"]) from error
        try:
            failed = [str(one) for one in run_cases(policy, text, str(cases)) if not one.passed]
        except PolicyError as error:
            raise PolicyRefusedError([str(one) for one in error.findings]) from error
        if failed:
            raise PolicyRefusedError(failed)

    def _keep(self, policy: Policy, *, who: str, note: str) -> int:
        number = max((row.revision for row in self._store.revisions()), default=0)
        number = max(number, self.revision) + 1
        self._store.save_revision(RevisionRow(number, policy.text, policy.file, time.time(), who, note))
        revoked = self._enforce(policy, number)
        self._recorder.happened(
            "policy loaded",
            f"revision {number} is in force: {note}",
            severity=Severity.NOTICE,
            who=who,
            file=policy.file,
            revoked=revoked,
            warnings=[str(one) for one in policy.warnings][:100],
        )
        return revoked

    def _enforce(self, policy: Policy, revision: int) -> int:
        self._current = policy
        self.revision = self._recorder.revision = revision
        return self.changed(policy)

    def _answer(self, policy: Policy, before: int, revoked: int, confirm_within: float | None) -> Loaded:
        self._end_confirmation()
        if confirm_within is not None:
            self._await_confirmation(before, time.time() + confirm_within)
        return Loaded(self.revision, before, [str(one) for one in policy.warnings], revoked, self.confirm_by)

    # --- back by itself unless confirmed ---

    def _await_confirmation(self, back_to: int, deadline: float) -> None:
        self.confirm_by = deadline
        self._store.save_setting("confirm", f"{back_to} {deadline}")
        self._revert = asyncio.get_running_loop().create_task(self._go_back(back_to, deadline))

    async def _go_back(self, revision: int, deadline: float) -> None:
        await asyncio.sleep(max(0.0, deadline - time.time()))
        self._revert = None
        try:
            self.rollback(revision, who="not confirmed in time")
        except PolicyRefusedError as error:
            _log.error("the policy could not go back", revision=revision, error=str(error))

    def _end_confirmation(self) -> None:
        if self._revert is not None:
            self._revert.cancel()
            self._revert = None
        if self.confirm_by is not None:
            self.confirm_by = None
            self._store.save_setting("confirm", "")

    def _resume_confirmation(self) -> None:
        kept = self._store.settings().get("confirm", "")
        if kept:
            back_to, deadline = kept.split()
            self._await_confirmation(int(back_to), float(deadline))
