"""What operators ask about the policy.

Changes are made one at a time, and one that names the revision it is meant for is refused when another is in force by
then. A change is answered when it is on the disk and the relays have carried it out: who was told that something is
taken back can rely on it that nothing of it goes through any more.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from appliance.channel import admin
from appliance.channel.answers import policy as answers
from appliance.control.errors import UnknownThingError
from appliance.control.policies import Policies, RevisionChangedError
from appliance.policy import Known
from appliance.store.state import RevisionRow, StateStore


class PolicyOrders:
    """Each method answers the request that it takes. They raise `PolicyRefusedError`, `RevisionChangedError`.

    `carried_out()` waits until the relays have carried out what they were told.
    """

    def __init__(
        self, policies: Policies, store: StateStore, carried_out: Callable[[], Awaitable[None]]
    ) -> None:
        self._policies = policies
        self._store = store
        self._carried_out = carried_out
        self._lock = asyncio.Lock()

    async def reload(self, request: admin.PolicyReload, who: str) -> answers.Loaded:
        """Read the policy file again."""
        by = "disk" if who == "operator" else who
        async with self._changing(request.expected):
            return await self._policies.reload(who=by, confirm_within=request.confirm_within)

    async def load(self, request: admin.PolicyLoad, who: str) -> answers.Loaded:
        """Bring another text into force."""
        async with self._changing(request.expected):
            return await self._policies.load_text(
                request.text,
                request.signature,
                who=who,
                note=request.note,
                confirm_within=request.confirm_within,
            )

    async def roll_back(self, request: admin.PolicyRollback, who: str) -> answers.Loaded:
        """Bring a kept revision into force."""
        async with self._changing(request.expected):
            return self._policies.rollback(request.revision, who=who)

    async def confirm(self, request: admin.PolicyConfirm, who: str) -> answers.PolicyConfirmed:
        """Keep a change that would go back by itself."""
        async with self._changing(request.expected):
            return answers.PolicyConfirmed(self._policies.confirm(who=who), self._policies.revision)

    async def revisions(self, _request: admin.PolicyRevisions) -> answers.PolicyRevisionList:
        """The kept revisions."""
        rows = self._store.revisions()
        return answers.PolicyRevisionList([answers.PolicyRevision(**self._revision(row)) for row in rows])

    async def text(self, request: admin.PolicyWanted) -> answers.PolicyKnown:
        """A revision, and with what its text is judged. Raises `UnknownThingError`."""
        return await asyncio.to_thread(self._known, request.revision, self._policies.known)

    @contextlib.asynccontextmanager
    async def _changing(self, expected: int | None) -> AsyncIterator[None]:
        """Around a change; it is on the disk and carried out afterwards."""
        async with self._lock:
            if expected not in (None, self._policies.revision):
                raise RevisionChangedError(expected, self._policies.revision)
            yield
            await self._store.settled()
            await self._carried_out()

    def _known(self, revision: int | None, known: Known) -> answers.PolicyKnown:
        policies = self._policies
        row = policies.revision_row(revision)
        if row is None:
            raise UnknownThingError(f"there is no revision {revision}")
        return answers.PolicyKnown(
            **self._revision(row),
            text=row.text,
            signature=row.signature,
            policy_file=str(policies.file),
            differs_from_file=policies.differs_from_file,
            warnings=[str(warning) for warning in policies.current.warnings],
            confirm_by=policies.confirm_by,
            **policies.with_cases(known).fields(),
        )

    def _revision(self, row: RevisionRow) -> dict[str, Any]:
        """The fields of `PolicyRevision`."""
        return {
            "revision": row.revision,
            "file": row.file,
            "loaded": row.loaded,
            "who": row.who,
            "note": row.note,
            "in_force": row.revision == self._policies.revision,
        }
