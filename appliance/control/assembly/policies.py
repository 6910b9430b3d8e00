"""Manage the policy in force: load it, store revisions, roll back, and limit the time of an unconfirmed change.

Each policy passes the gate (`policy_gate.py`) before it takes effect, even at a start. A change is answered once it
is on disk and the relays have carried it out: revoked traffic no longer passes.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec
import structlog

from appliance.base import clock
from appliance.base.actors import DISK, UNCONFIRMED
from appliance.base.withdrawal import take_effect
from appliance.channel import admin
from appliance.channel.answers import policy_answers as answers
from appliance.channel.answers.policy_answers import Loaded
from appliance.control.assembly.policy_gate import (
    KeptPolicy,
    accept,
    policy_at_start,
    read_policy,
    with_cases,
)
from appliance.control.errors import PolicyRefusedError, UnknownThingError
from appliance.policy.host_names import HostNames, in_words
from appliance.policy.host_sets import Network
from appliance.policy.hours import changes_of
from appliance.policy.judgement import PolicyContext
from appliance.policy.live_rights import LiveRight, lost_rights, may_keep
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.signing.fingerprints import fingerprint
from appliance.signing.site_keys import signer
from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions, reloaded_by
from appliance.store.state_file import RevisionRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail
from appliance.telemetry.text_changes import changed_lines

_REFUSED = "policy file refused"
_log = structlog.get_logger()
_SHOWN_NODES = 3
_UTC = "%Y-%m-%dT%H:%M:%SZ"


class PolicyCases(NamedTuple):
    """The file and text of test cases that come with a policy."""

    file: str
    text: str | None


def kept_policy(row: RevisionRow) -> KeptPolicy:
    return KeptPolicy(row.revision, row.text, row.file, row.who, row.signature)


class RevisionChangedError(Exception):
    """Another revision is in force than the change expects; the message has both numbers."""

    def __init__(self, expected: int, found: int) -> None:
        super().__init__(f"revision {found} is in force, not {expected}: read it before you change it")


class Policies(Revisions[RevisionRow]):
    """The policy in force and its revisions. Operators' changes are made one at a time."""

    refusal = PolicyRefusedError
    outdated = RevisionChangedError
    unconfirmed = EndKind("confirm")
    changes = EndKind("change of rights", dated=True)
    """The times at which a right of the policy ends or begins; their names are the times in UTC."""

    def __init__(
        self,
        file: Path,
        store: StateStore,
        ends: EndTable,
        trail: AuditTrail,
        policy: CurrentPolicy,
        *,
        known: Callable[[], PolicyContext],
        live: Callable[[], Iterable[LiveRight]],
        changed: Callable[[Policy, Policy], int],
        carried_out: Callable[[], Awaitable[None]],
    ) -> None:
        """`start` brings a policy into force, and sets it in `policy`.

        `known()` returns the present facts. The owners of its `hosts` and `own` call `hosts_changed`; those of other
        facts call `decide_again`. `changed(before, policy)` decides all live rights again, and returns the number of
        revocations.
        """
        nothing = RevisionRow(0, "", "", 0.0, "", "")
        super().__init__(store, ends, store.revisions, store.save_revision, nothing)
        self.file = file
        self._trail = trail
        self._known = known
        self._live = live
        self._changed = changed
        self._carried_out = carried_out
        self.policy = policy
        self._passed: set[str] = set()  # the changes that no clock can undo
        ends.when_due(self.changes, lambda _times: self.time_passed())
        self._labelled: Policy | None = None  # whose labels are kept
        self._labels: list[tuple[Network, str]] = []
        self.file_refused = store.settings().get(_REFUSED, "")
        """Why the file was refused at the last start or reload, in one line; empty if it was accepted."""

    @property
    def current(self) -> Policy:
        return self.policy()

    def in_words(self, host: str) -> str:
        policy = self.current
        if self._labelled is not policy:
            self._labels = HostNames.of(policy.text, policy.enrolled, policy.robot).labels()
            self._labelled = policy
        return in_words(host, self._labels)

    @property
    def differs_from_file(self) -> bool:
        try:
            return read_policy(self.file) != (self.current.text, self.in_force.signature)
        except PolicyRefusedError:
            return True

    def look_at_file(self) -> tuple[bool, str]:
        """Return whether the file differs from the policy in force, and why it is refused.

        A file that has the policy in force again is accepted, unless its test cases were the reason.
        """
        differs = self.differs_from_file
        if not differs and self.file_refused.startswith(f"{self.file}:"):
            self._note_refused("")
        return differs, self.file_refused

    def start(self, *, restarted: bool) -> None:
        """Bring a policy into force at the start of control. Raises `PolicyRefusedError`.

        After a crash of control (`restarted`), the previous policy stays in force. At the start of the appliance, an
        operator's revision that was in force at its stop comes first, and then the file. If the file is refused, the
        last revision stays in force, with an alarm.
        """
        kept_first = self.find_last(restarted=restarted)
        kept = kept_policy(self.in_force) if self.revision else None
        policy, signature, refused = policy_at_start(kept, self.file, self.known, kept_first=kept_first)
        if kept is None or (kept.text, kept.signature) != (policy.text, signature):
            self._keep(policy, signature, who=DISK, note="read at start")
            return
        self._enforce(policy)
        if refused is not None:
            self._file_refused(refused)
        elif not kept_first:
            self._note_refused("")

    @contextlib.asynccontextmanager
    async def changing(self, expected: int | str | None) -> AsyncIterator[None]:
        async with super().changing(expected):
            yield
            await self.store.until_settled()
            await self._carried_out()

    async def reload(self, request: admin.PolicyReload, who: str) -> Loaded:
        """Read the file again. Raises `PolicyRefusedError` and `RevisionChangedError`.

        The text in force makes no new revision, but begins rights again that a wrong clock ended. Others are
        recorded as loaded from disk; the note names who ordered it.
        """
        within, note = request.confirm_within, reloaded_by(who)
        async with self.changing(request.expected):
            try:
                policy, signature = await self._prepare(lambda: read_policy(self.file), str(self.file), who)
            except PolicyRefusedError as error:
                self._note_refused(error.findings[0])
                raise
            now = self.in_force
            if (now.who, now.text, now.signature) == (DISK, policy.text, signature):
                self._note_refused("")
                return self._unchanged()
            return self._keep(policy, signature, who=DISK, note=note, by=who, within=within)

    def _unchanged(self) -> Loaded:
        """Begin rights again that a wrong clock ended, as each load does."""
        self.ends.forget(self.changes, *self.ends.names(self.changes))
        self.time_passed()
        return self._load(self.revision, 0)

    async def attempt(self, text: str, signature: str, cases: PolicyCases) -> None:
        await asyncio.to_thread(self._test, lambda: (text, signature), "policy.ini", self.known, cases)

    async def load(self, request: admin.PolicyLoad, who: str) -> Loaded:
        """Bring a given text into force. Raises `PolicyRefusedError` and `RevisionChangedError`.

        The same text makes no new revision, but begins rights again that a wrong clock ended. Messages
        cite its rules as `revision N:line`, because the file's lines may differ.
        """
        return await self.load_with(request, who, None)

    async def load_with(self, request: admin.PolicyLoad, who: str, cases: PolicyCases | None) -> Loaded:
        given, within = (request.text, request.signature), request.confirm_within
        async with self.changing(request.expected):
            now = self.in_force
            if now.who != DISK and (now.text, now.signature) == given:
                return self._unchanged()
            name = f"revision {self.revision + 1}"
            policy, signature = await self._prepare(lambda: given, name, who, cases)
            return self._keep(policy, signature, who=who, note=request.note or "posted", within=within)

    def hosts_changed(self) -> int:
        try:
            policy = accept(self.current.text, self.in_force.signature, self.current.file, self.known)
        except PolicyRefusedError as error:  # a defect: the same text was valid before
            _log.error("the policy does not know the new hosts", findings=error.findings)
            return 0
        return self._enforce(policy)

    def decide_again(self) -> int:
        return self._enforce(self.current)

    def time_passed(self) -> None:
        """End and begin the rights with a time. Call it also after each step of the system clock."""
        if not self.policy:
            return
        self._expect_changes(self.current)
        if self.known.complete(self.current).closed.keys() != self.current.closed.keys():
            self._enforce(self.current)

    async def roll_back(self, request: admin.PolicyRollback, who: str) -> Loaded:
        async with self.changing(request.expected):
            return await self.rollback(request.revision, who=who)

    async def rollback(self, revision: int | None, *, who: str) -> Loaded:
        """Bring a kept revision into force (None: the previous one).

        Raises `PolicyRefusedError` and `RevisionChangedError`.
        """
        row = await self.require(revision)
        policy = accept(row.text, row.signature, row.file, self.known)
        note = f"rolled back to revision {row.revision}"
        settled = self.settles(row.revision)
        return self._keep(policy, row.signature, who=who, note=note, settled=settled)

    async def confirm(self, request: admin.PolicyConfirm, who: str) -> answers.PolicyConfirmed:
        async with self.changing(request.expected):
            waited = self.confirm_by is not None
            if waited:
                take_effect()
                self.end_limit()
                self._trail.happened("policy confirmed", f"revision {self.revision} was confirmed", who=who)
            return answers.PolicyConfirmed(waited, self.revision)

    async def revisions(self, _request: admin.PolicyRevisions) -> answers.PolicyRevisionList:
        rows = [self.describe(row) for row in await self.rows()]
        return answers.PolicyRevisionList(msgspec.convert(rows, list[answers.PolicyRevision]))

    async def text(self, request: admin.PolicyWanted) -> answers.PolicyKnown:
        row = await self._kept_revision(self.revision if request.revision is None else request.revision)
        return await asyncio.to_thread(self._text, row, self.known)

    async def one_revision(self, request: admin.PolicyRevisionWanted) -> answers.RevisionText:
        row = await self._kept_revision(request.revision)
        return msgspec.convert(self.describe(row), answers.RevisionText)

    async def compile_revision(self, number: int) -> Policy | None:
        try:
            row = await self._kept_revision(number)
            return accept(row.text, row.signature, row.file, self.known)
        except (UnknownThingError, PolicyRefusedError):
            return None

    async def _kept_revision(self, number: int) -> RevisionRow:
        row = self.in_force if number == self.revision else await self.find(number)
        if row is None:
            raise UnknownThingError(f"there is no revision {number}: rosrv policy revisions lists all")
        return row

    def _text(self, row: RevisionRow, known: PolicyContext) -> answers.PolicyKnown:
        return answers.PolicyKnown(
            **self.describe(row),
            policy_file=str(self.file),
            differs_from_file=self.differs_from_file,
            warnings=[str(warning) for warning in self.current.warnings],
            confirm_by=self.confirm_by,
            **with_cases(known, self.file).fields(),
        )

    @property
    def known(self) -> PolicyContext:
        return self._known()

    # --- inside ---

    async def _prepare(
        self, read: Callable[[], tuple[str, str]], file: str, who: str, cases: PolicyCases | None = None
    ) -> tuple[Policy, str]:
        """Prepare in a thread, so that nodes are not delayed; return the policy with its signature."""
        before = self.revision
        try:
            while True:
                known = self.known
                policy, signature = await asyncio.to_thread(self._test, read, file, known, cases)
                now = self.known
                if (now.hosts, now.own) == (known.hosts, known.own):
                    break
        except PolicyRefusedError as error:
            self._refused(error, who)
            raise
        if self.revision != before:  # changed by a signal, or a late confirmation
            raise RevisionChangedError(before, self.revision)
        return policy, signature

    def _refused(self, error: PolicyRefusedError, who: str) -> None:
        self._trail.happened(
            "policy refused",
            f"revision {self.revision} stays in force: {error.findings[0]}",
            findings=error.findings[:100],
            who=who,
        )

    def _note_refused(self, reason: str) -> None:
        """Store the reason, so that it survives a crash of control."""
        if reason != self.file_refused:
            self.file_refused = reason
            self.store.save_setting(_REFUSED, reason)

    def _file_refused(self, error: PolicyRefusedError) -> None:
        self._note_refused(error.findings[0])
        text = f"revision {self.revision} stays in force, because {self.file} is rejected"
        _log.error(text, findings=error.findings[:100])
        self._trail.happened(
            "policy file refused",
            f"{text}: {self.file_refused}",
            findings=error.findings[:100],
            revision=self.revision,
        )

    def _test(
        self,
        read: Callable[[], tuple[str, str]],
        file: str,
        known: PolicyContext,
        cases: PolicyCases | None = None,
    ) -> tuple[Policy, str]:
        text, signature = read()
        tested = (
            with_cases(known, self.file)
            if cases is None
            else replace(known, cases_file=cases.file, cases=cases.text)
        )
        return accept(text, signature, file, tested), signature

    def _keep(
        self,
        policy: Policy,
        signature: str,
        *,
        who: str,
        note: str,
        by: str | None = None,
        within: float | None = None,
        settled: bool = False,
    ) -> Loaded:
        take_effect()
        self._note_refused("")
        before = self.revision
        row = RevisionRow(before + 1, policy.text, policy.file, clock.wall(), who, note, signature)
        known = self.known
        lost = _losses(known.complete(policy), self.policy(), self._live()) if self.policy else []
        earlier = {"policy": self.policy().text} if self.policy else {}
        with self.store.database.together():
            self._put_in_force(row, within, settled=settled)
            self.ends.forget(self.changes, *self.ends.names(self.changes))
            self._expect_changes(policy)
        revoked = self._enforce(policy)
        self._trail.happened(
            "policy loaded",
            f"revision {row.revision} is in force: {note}{self.unless_confirmed}",
            who=by or who,
            file=policy.file,
            sha256=fingerprint(policy.text),
            earlier_sha256=fingerprint(earlier["policy"]) if earlier else "",
            diff=changed_lines(earlier, {"policy": policy.text}),
            signed_by=signer(known.site_keys, policy.text, signature),
            revoked=revoked,
            warnings=[*lost, *map(str, policy.warnings)][:100],
        )
        return self._load(before, revoked, lost)

    def _enforce(self, policy: Policy) -> int:
        before = self.policy() if self.policy else None
        self._expect_changes(policy)
        self.policy.set(self.known.complete(policy))
        self._trail.revision = self.revision
        if before is None:
            return 0
        now, same = self.policy(), before.text == policy.text
        closed, was = _closed(now), _closed(before)
        ended, began = sorted(closed.keys() - was.keys()), sorted(was.keys() - closed.keys())
        if not same or not (ended or began):
            return self._changed(before, now)
        count, revoked = len(list(self._live())), self._changed(before, now)
        words = {"ended": ended, "began": began}
        self._trail.happened(
            "rights changed",
            "; ".join(f"{word}: {_some(some)}" for word, some in words.items() if some),
            ended=ended[:100],
            began=began[:100],
            why=sorted({closed[word] for word in ended})[:100],
            revoked=revoked,
            restored=len(list(self._live())) - count + revoked,
        )
        return revoked

    def _expect_changes(self, policy: Policy) -> None:
        """Set the ends at which rights change next.

        One that has passed by any clock stays so until a policy is loaded: no clock that is set back begins its right
        again.
        """
        now = self.known.now
        if now is None:  # rights with a time grant nothing until the clock is set
            return
        wanted = {
            f"{datetime.fromtimestamp(change, UTC):{_UTC}}": change
            for change in changes_of(policy.times, now)
        }
        known = set(self.ends.names(self.changes))
        self._passed &= known
        self.ends.forget(self.changes, *known.difference(wanted))
        for name, change in wanted.items():
            if name not in known:  # also a date that passed before the load has passed for good
                self.ends.set(self.changes, name, max(0.0, change - now))
            elif name in known - self._passed and self.ends.is_over(self.changes, name):
                self._passed.add(name)
                self.ends.forget(self.changes, name)
                self.ends.set(self.changes, name, 0.0)

    def _load(self, before: int, revoked: int, lost: Sequence[str] = ()) -> Loaded:
        warnings = [*lost, *map(str, self.current.warnings)]
        return Loaded(self.revision, before, warnings, revoked, self.confirm_by)

    async def _go_back(self, revision: int) -> None:
        await self.rollback(revision, who=UNCONFIRMED)


def passed_changes(ends: EndTable) -> dict[float, bool]:
    """Return whether each of the expected changes of rights has passed; the keys are seconds since the epoch."""
    kind = Policies.changes
    return {datetime.fromisoformat(name).timestamp(): ends.is_over(kind, name) for name in ends.names(kind)}


def _closed(policy: Policy) -> dict[str, str]:
    """Return the rights that grant nothing now, with their lines and reasons."""
    words = ((policy.times[atom], closed) for atom, closed in policy.closed.items())
    return {f"{time.text} (line {time.line})": closed.why for time, closed in words}


def _losses(policy: Policy, before: Policy, live: Iterable[LiveRight]) -> list[str]:
    had = [one for one in live if may_keep(before, one).allowed]
    return [
        f"warning: {host} has nodes ({_some(nodes)}) and loses all its rights: if that is a mistake, "
        "`rosrv policy rollback` and name the host in the policy"
        for host, nodes in lost_rights(policy, had).items()
    ]


def _some(names: Collection[str]) -> str:
    more = f" and {len(names) - _SHOWN_NODES} more" if len(names) > _SHOWN_NODES else ""
    return ", ".join(sorted(names)[:_SHOWN_NODES]) + more
