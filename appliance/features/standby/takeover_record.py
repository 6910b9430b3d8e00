"""Record takeovers of a pair of appliances, and replicate the newest signed checkpoint of this appliance's log.

A record names only a valid checkpoint of the other appliance's chain.
"""

import asyncio
from typing import TypeVar

import msgspec
import structlog

from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.signatures import KeyUnreadableError, pinned_key_path, read_public_key
from appliance.audit.proof.copies import SignedCheckpoint, newest_checkpoint
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.features.standby.takeovers import TOOK_OVER, EpochOf, TookOver
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_CHECKPOINT = "audit checkpoint of "
_LAST_TAKEOVER = "last takeover"
_T = TypeVar("_T")
_log = structlog.get_logger()


class TakeoverRecorder:
    """The recorder of the active appliance `name`, whose partner is `other`.

    `signed` is set with each signature of a checkpoint. Call `took_over`, then run `follow` as a task.

    """

    def __init__(
        self,
        trail: AuditTrail,
        audit: AuditLog,
        store: StateStore,
        signed: asyncio.Event,
        *,
        name: str,
        other: str,
    ) -> None:
        self._trail = trail
        self._audit = audit
        self._store = store
        self._signed = signed
        self._name = name
        self._other = other
        self._replicated = 0  # the number of the newest replicated checkpoint

    async def took_over(self, epoch: int) -> None:
        """Record the takeover, unless an earlier process did so in this epoch.

        The state gets the takeover once the record is on the disk.
        """
        own = await asyncio.to_thread(self._last_recorded)
        if own is None or own.epoch != epoch:
            state = await asyncio.to_thread(self._store.settings)
            checkpoint, reason = await asyncio.to_thread(self._others_checkpoint, state)
            named = _decoded(state.get(_LAST_TAKEOVER, ""), EpochOf)
            previous = max((one for one in (own, named) if one is not None), key=_epoch, default=None)
            self._trail.happened(
                "took over",
                f"{self._name} is active from epoch {epoch}; {reason}",
                epoch=epoch,
                appliance=self._name,
                other=self._other,
                checkpoint=None if checkpoint is None else msgspec.to_builtins(checkpoint),
                previous=None if previous is None else msgspec.to_builtins(previous),
            )
        if await self._audit.wait_durable() is None:
            last = EpochOf(epoch, self._name)
            self._store.save_setting(_LAST_TAKEOVER, msgspec.json.encode(last).decode())

    async def handed_over(self, epoch: int) -> None:
        """Record the hand-over, and return when the state has the sealed log.

        If the hand-over fails, the event `switchover failed` revokes this record. The caller bounds the wait, because
        the signer may be slow or away.
        """
        self._trail.happened(
            "handed over",
            f"{self._name} handed over to {self._other} in epoch {epoch}",
            epoch=epoch,
            appliance=self._name,
            to=self._other,
        )
        await self._audit.wait_signed()
        await self._replicate()

    async def follow(self) -> None:
        await self._replicate()
        await self._audit.wait_signed()
        while True:
            await self._replicate()
            await self._signed.wait()
            self._signed.clear()
            await self._audit.wait_durable()  # the log has stored the signature before this

    async def _replicate(self) -> None:
        try:
            checkpoint = await asyncio.to_thread(newest_checkpoint, self._audit.path)
        except LogUnreadableError as error:
            _log.error("the checkpoint of the audit log is not replicated", reason=str(error))
            return
        if checkpoint is not None and checkpoint.number > self._replicated:
            self._replicated = checkpoint.number
            self._store.save_setting(_CHECKPOINT + self._name, checkpoint.as_json())

    def _last_recorded(self) -> EpochOf | None:
        try:
            found = search(self._audit.path, Filter(event=TOOK_OVER), None, 1).entries
        except LogUnreadableError:
            return None  # `AuditLog.failed` reports it
        try:
            detail = msgspec.convert(found[0].record.detail, TookOver) if found else None
        except msgspec.ValidationError:
            return None
        return None if detail is None else EpochOf(detail.epoch, detail.appliance)

    def _others_checkpoint(self, state: dict[str, str]) -> tuple[SignedCheckpoint | None, str]:
        stored = state.get(_CHECKPOINT + self._other)
        if not stored:
            return None, f"no checkpoint of {self._other} was replicated"
        found = _decoded(stored, SignedCheckpoint)
        if found is None or found.fault() is not None:
            fault = "it is not a checkpoint" if found is None else "its signature is wrong"
            return None, f"the replicated checkpoint of {self._other} is not valid: {fault}"
        if found.key == self._own_key():
            return None, f"the replicated checkpoint of {self._other} is of this appliance's own log"
        return (
            found,
            f"the last replicated checkpoint of {self._other} is {found.number}, of record {found.sequence}",
        )

    def _own_key(self) -> str:
        pin = pinned_key_path(self._audit.path)
        try:
            return read_public_key(pin).hex() if pin.exists() else ""
        except KeyUnreadableError:
            return ""  # the log refuses signatures with this reason


def _epoch(takeover: EpochOf) -> int:
    return takeover.epoch


def _decoded(text: str, kind: type[_T]) -> _T | None:
    try:
        return msgspec.json.decode(text, type=kind)
    except (ValueError, RecursionError):
        return None
