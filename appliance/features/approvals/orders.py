"""Hold calls that need an approval, and give and end approvals.

An approval of a topic or a parameter is enforced like a change of the policy. A service call is decided here, because
the relay asks about each request. Nothing is stored, so a restart or a takeover ends all approvals.
"""

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial

from appliance.base import clock
from appliance.base.actors import OPERATOR
from appliance.base.withdrawal import take_effect
from appliance.channel.answers.limit_answers import LimitUse
from appliance.channel.answers.token_answers import may
from appliance.channel.messages import HeldRequestDecided, RequestHeld
from appliance.channel.messages.api import TokenKept
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.control.motion_stop import StopAfter
from appliance.control.operators.limit_use import of_pool
from appliance.features.approvals import requests
from appliance.features.approvals.approval_table import (
    WAIT_SECONDS,
    ApprovalEntry,
    ApprovalState,
    ApprovalTable,
    ChargedHost,
    HeldCall,
)
from appliance.features.approvals.view import ApprovalCounts
from appliance.master.calls.call import denial_text
from appliance.master.endpoints.host_signs import HostSigns
from appliance.policy.model import Address, CallHold, Category, Decision, Request, address_of
from appliance.policy.policy import Policy
from appliance.policy.rights import Right, decide_right
from appliance.store.ends import EndTable
from appliance.telemetry.audit_trail import NOT_RECORDED, Asker, AuditTrail

CHECK_SECONDS = 0.25
APPROVED_SECONDS = 60.0
"""The default time of an approval on a topic or a parameter."""
SILENT_SECONDS = 5.0
"""The silence that ends an approval of a motion outside the groups of `[Authority]`."""
UNANSWERED_SECONDS = 600.0


class ApprovalOrders:
    """Answers operators and relays. Requests raise `SenselessError` or `UnknownThingError`.

    Each change takes effect before it waits for a relay, so a hanging relay delays no other order.
    """

    def __init__(
        self,
        policy: Callable[[], Policy],
        trail: AuditTrail,
        signs: HostSigns,
        stop: StopAfter,
        ends: EndTable,
        *,
        first: int,
        decide_again: Callable[[], int],
        carried_out: Callable[[Iterable[str]], Awaitable[None]],
        bearers: Callable[[], Iterable[TokenKept]],  # the usable tokens and sessions
        # The monitors that have a safe message for a topic; None: its relay does not answer.
        guards: Callable[[str], Awaitable[list[str] | None]],
        held: Callable[[ApprovalEntry, float], None],  # gets each call that begins to wait, with its seconds
    ) -> None:
        self._policy = policy
        self._trail = trail
        self._signs = signs
        self._stop = stop
        self._decide_again = decide_again
        self._carried_out = carried_out
        self._bearers = bearers
        self._guards = guards
        self._table = ApprovalTable(first, ends, held)
        self._unanswered: list[float] = []
        self._cut_off: list[ApprovalEntry] = []  # by a change of the policy
        self._moved: dict[int, float] = {}  # the last message, even after its publisher ended
        self._still: dict[
            int, float
        ] = {}  # of approvals for some time: the last message before a silence about which guards were asked
        self.approved = self._table.approvals

    # --- calls ---

    def hold_call(self, request: Request) -> CallHold:
        call = HeldCall(request.host, request.category, request.resource)
        return self._hold(call, request.caller_id)

    async def approve_call(self, wanted: RequestHeld) -> HeldRequestDecided:
        answer = partial(HeldRequestDecided, wanted.number)
        if obstacle := self._trail.obstacle or self._trail.shut_out(wanted.host):
            return answer(obstacle)
        asker = Asker(wanted.host, wanted.caller_id, clock.now_ns())
        policy, host = self._policy(), address_of(wanted.host)
        decision = policy.decide(Request(host, wanted.caller_id, Category.CALL, wanted.service))
        if decision.allowed and decision.asks is not None:
            decision = self._decide(decision, wanted, host)
        record = self._trail.decided(asker, "call", Category.CALL, wanted.service, decision)
        if not decision.allowed:
            return answer(denial_text(decision, record, policy.tell))
        if self._trail.strict and await self._trail.durable() is not None:
            return answer(NOT_RECORDED)
        return answer("")

    def _decide(self, decision: Decision, wanted: RequestHeld, host: Address) -> Decision:
        call = HeldCall(host, Category.CALL, wanted.service, wanted.digest)
        entry = self._table.find(call)
        approved = entry is not None and entry.state is ApprovalState.APPROVED
        if entry is not None and approved and (reason := self._ended(entry, self._approvers())):
            self._end(entry, reason)
            approved = False
        if entry is None or not approved:
            return self._hold(call, wanted.caller_id, wanted.type, wanted.shown, wanted.size).of(decision)
        if entry.once:
            self._table.end(entry)
            self._record("approval used", entry, f"used approval {entry.number}")
        return replace(decision, reason=f"{decision.reason}; approval {entry.number} by {entry.who}")

    def _hold(
        self, call: HeldCall, caller_id: str, type_: str = "", arguments: bytes = b"", size: int = 0
    ) -> CallHold:
        now = clock.now()
        entry = self._table.find(call)
        if entry is None:
            held = self._table.hold(
                call,
                ChargedHost.of(self._policy(), call.host),
                now,
                caller_id=caller_id,
                type_=type_,
                arguments=arguments,
                size=size,
            )
            if isinstance(held, str):
                return CallHold(f"not held: {held}; ask the operator about those first", waits=False)
            entry = held
            self._record("approval wanted", entry, f"waits for approval {entry.number}")
        left = max(1, round(self._table.seconds_left(entry)))
        if entry.state is ApprovalState.REFUSED:
            refused = f"an operator refused approval {entry.number}"
            return CallHold(refused, waits=False, again=f"; ask again in {left} s")
        text = f"held for approval {entry.number}; ask the operator, then repeat; expires in {left} s"
        return CallHold(text, waits=True)

    # --- operators ---

    async def list_approvals(self, _request: requests.ApprovalsWanted) -> requests.Approvals:
        return requests.Approvals(
            [self._show(entry) for entry in sorted(self._table.entries(), key=lambda e: e.number)]
        )

    async def approve(self, request: requests.ApproveCall, who: str) -> requests.Approval:
        """Approve a held call, or give an approval a new time. A refusal is replaced only by its own person."""
        entry = self._entry(request.number)
        seconds = request.seconds
        refused = entry.state is ApprovalState.REFUSED
        another = entry.who != who or who == OPERATOR  # which everyone on the machine is
        if (request.waits and entry.state is not ApprovalState.WAITS) or (refused and another):
            again = (
                f": it may be asked for again in {self._table.seconds_left(entry):.0f} s" if refused else ""
            )
            raise SenselessError(f"approval {entry.number} is already {entry.state} by {entry.who}{again}")
        if seconds is None and entry.for_some_time and entry.call.category is Category.CALL:
            raise SenselessError(
                f"approval {entry.number} is for some time: give its new time with --for, or run:"
                f" rosrv approval refuse {entry.number}"
            )
        if seconds is None and entry.call.category is not Category.CALL:
            seconds = APPROVED_SECONDS  # a publisher registers once, so only a time bounds its messages
        if not self._asks(entry):
            raise SenselessError(
                f"the policy no longer asks about {entry.call.resource}: there is nothing to approve"
            )
        take_effect()
        for other in self._table.equal_entries(entry) if seconds is not None else ():
            self._end(other, f"approval {entry.number} covers it", who)
        credentials = frozenset(number for number, name in self._approvers().items() if name == who)
        earlier = entry.state.value
        entry = self._table.approve(entry, seconds, who, clock.now(), credentials=credentials)
        self._unanswered.clear()
        what = "once" if seconds is None else f"for {seconds:g} s"
        text = f"{who} gave approval {entry.number}, {what}"
        self._record("approval given", entry, text, who=who, earlier=earlier, now=f"approved {what}")
        if self._enforce():
            await self._carried_out({entry.call.resource})
        return self._show(entry)

    async def refuse(self, request: requests.RefuseCall, who: str) -> requests.Approval:
        """Refuse a held call, or end an approval. A refused call is not held again until its entry expires."""
        entry = self._entry(request.number)
        take_effect()
        if entry.state is ApprovalState.APPROVED:
            self._end(entry, f"{who} ended it", who)
            self._enforce()
            await self._stop_motion(entry)
            return self._show(replace(entry, state=ApprovalState.REFUSED, who=who))
        earlier = entry.state.value
        entry = self._table.refuse(entry, who)
        text = f"{who} refused approval {entry.number}"
        self._record("approval refused", entry, text, who=who, earlier=earlier, now=entry.state.value)
        return self._show(entry)

    # --- the end of approvals ---

    def policy_changed(self) -> None:
        """End all entries about which the policy no longer asks. The next check stops their motions."""
        for entry in self._table.entries():
            if not self._asks(entry):
                self._end(entry, "the policy no longer asks")
                self._cut_off.append(entry)
        self._table.forget_unanswered(lambda call: self._asks_about(call, ""))

    async def watch(self) -> None:
        async with asyncio.TaskGroup() as checks:
            while True:
                checks.create_task(self.check())
                await asyncio.sleep(CHECK_SECONDS)

    async def check(self) -> None:
        """End expired approvals, those of an earlier approver, and those of silent hosts.

        All of them end before the first wait for a relay.

        Silence only ends approvals of motions: topics of a group of `[Authority]`, or with a safe message of an enabled
        guard.
        """
        ended, still = self._cut_off.copy(), []
        self._cut_off.clear()
        entries = self._table.entries()
        approved = any(entry.state is ApprovalState.APPROVED for entry in entries)
        approvers = self._approvers() if approved else {}
        for entry in entries:
            silence, in_group = (
                self._silence(entry),
                self._policy().command_group(entry.call.resource) is not None,
            )
            if reason := self._ended(entry, approvers) or (silence if in_group else ""):
                self._end(entry, reason)
                ended.append(entry)
            elif silence and self._still.get(entry.number) != self._moved[entry.number]:
                self._still[entry.number] = self._moved[entry.number]
                still.append(entry)
        self._enforce()
        await asyncio.gather(*map(self._stop_motion, ended), *map(self._end_if_guarded, still))

    def _approvers(self) -> dict[str, str]:
        """Return the names of all who may approve now, by the ids of their tokens and sessions."""
        found = {bearer.id: bearer.name for bearer in self._bearers() if may(bearer.role, "operator")}
        return found | {OPERATOR: OPERATOR}

    def _ended(self, entry: ApprovalEntry, approvers: Mapping[str, str]) -> str:
        approved = entry.state is ApprovalState.APPROVED
        if not self._table.seconds_left(entry):
            waited = entry.state is ApprovalState.WAITS
            return "no operator answered in time" if waited else "its time is over"
        if approved and entry.credentials.isdisjoint(approvers):
            return f"{entry.who}, who approved it, no longer has a token or session with the role operator"
        return "" if self._asks(entry) else "the policy no longer asks"

    def _asks(self, entry: ApprovalEntry) -> bool:
        return self._asks_about(entry.call, entry.caller_id)

    def _asks_about(self, call: HeldCall, caller_id: str) -> bool:
        request = Request(call.host, caller_id, call.category, call.resource)
        asking = (decide_right(self._policy(), Right(request, below)).asks for below in (False, True))
        return any(asking)  # a parameter may be held because of a rule for what is below it

    def _silence(self, entry: ApprovalEntry) -> str:
        moved, group = self._last_message(entry), self._policy().command_group(entry.call.resource)
        seconds = SILENT_SECONDS if group is None else group.release_after
        about = entry.call.host, frozenset({entry.call.resource})
        silent = moved > entry.since and self._signs.silence(*about, moved) >= seconds
        return f"its host was silent for {seconds:g} s" if silent else ""

    async def _end_if_guarded(self, entry: ApprovalEntry) -> None:
        """End the approval if a guard has a safe message for its topic. `check` calls this once in each silence."""
        guards = await self._guards(entry.call.resource)
        present = self._table.entry(entry.number)
        if guards is None:
            self._still.pop(entry.number, None)  # the relay did not answer, so ask again
        elif guards and present is not None and (reason := self._silence(present)):
            self._end(present, reason)
            self._enforce()
            await self._stop_motion(present)

    def _last_message(self, entry: ApprovalEntry) -> float:
        if not entry.for_some_time or entry.call.category is not Category.PUBLISH:
            return 0.0
        moved = self._signs.moved(entry.call.host, frozenset({entry.call.resource}))
        self._moved[entry.number] = max(moved, self._moved.get(entry.number, 0.0))
        return self._moved[entry.number]

    def _end(self, entry: ApprovalEntry, reason: str, who: str = "") -> None:
        if entry.state is ApprovalState.WAITS and not self._table.seconds_left(entry):
            self._unanswered.append(clock.now())
            self._table.end_unanswered(entry)
        self._table.end(entry)
        self._moved.pop(entry.number, None)
        self._still.pop(entry.number, None)
        text = f"approval {entry.number} ended: {reason}"
        self._record("approval ended", entry, text, who=who, earlier=entry.state.value, now="ended")

    def _enforce(self) -> bool:
        differ = self._policy().approved != self.approved()
        if differ:
            self._decide_again()
        return differ

    async def _stop_motion(self, entry: ApprovalEntry) -> None:
        """Let the guards stop the robot once the relays have cut the host off.

        They do so even if no message was reported, because relays report once a second, and forget the traffic of a
        node that has ended.
        """
        call = entry.call
        if not entry.for_some_time or call.category is not Category.PUBLISH:
            return
        await self._carried_out({call.resource})
        if self._policy().may_command(call.resource, call.host):
            await self._stop(str(call.host), {call.resource}, f"approval {entry.number} ended")

    # --- inside ---

    def state(self) -> ApprovalCounts:
        self._unanswered = [at for at in self._unanswered if clock.now() - at < UNANSWERED_SECONDS]
        entries = self._table.entries()
        waiting = [entry for entry in entries if entry.state is ApprovalState.WAITS]
        oldest = max((clock.now() - entry.since for entry in waiting), default=0.0)
        for_some_time = sum(entry.for_some_time for entry in entries)
        return ApprovalCounts(len(waiting), round(oldest, 1), for_some_time, len(self._unanswered))

    def limits(self) -> tuple[LimitUse, ...]:
        return (of_pool("approvals", "", self._table.pool),)

    def _entry(self, number: int) -> ApprovalEntry:
        entry = self._table.entry(number)
        if entry is None or not self._table.seconds_left(entry):
            raise UnknownThingError(
                f"no call has the approval number {number}, or its {WAIT_SECONDS:g} s have passed: rosrv approve"
                " lists all"
            )
        return entry

    def _record(self, event: str, entry: ApprovalEntry, reason: str, *, who: str = "", **more: str) -> None:
        call = entry.call
        self._trail.happened(
            event,
            f"{call.host} {call.category} {call.resource}: {reason}",
            host=str(call.host),
            caller_id=entry.caller_id,
            category=call.category.value,
            resource=call.resource,
            whole=bool(who) or entry.state is ApprovalState.APPROVED,
            approval=entry.number,
            sha256=call.digest,
            who=who,
            more=more,
        )

    def _show(self, entry: ApprovalEntry) -> requests.Approval:
        call = entry.call
        return requests.Approval(
            entry.number,
            "lease" if entry.for_some_time else entry.state.value,
            str(call.host),
            entry.caller_id,
            call.category.value,  # type: ignore[arg-type]  # only these categories ask
            call.resource,
            entry.type,
            call.digest,
            entry.arguments.hex(),
            entry.size,
            round(self._table.seconds_left(entry), 1),
            entry.who,
        )
