"""Make the parts that serve operators on the admin socket and over REST."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from appliance.channel.answers.status import AuditState
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.current import Current
from appliance.control.assembly.foundation import Foundation
from appliance.control.operators.administration import Administration
from appliance.control.operators.clock_check import ClockCheck
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.control.operators.node_connections import NodeConnections
from appliance.control.operators.overview import graph_of
from appliance.control.operators.queries import Queries
from appliance.control.operators.request_methods import request_methods
from appliance.control.operators.switched_off import SwitchedOffWatch
from appliance.control.operators.token_orders import TokenOrders
from appliance.control.rest.rest import RestLink
from appliance.control.rest.rest_certificate import RestCertificate
from appliance.control.rest.rest_uses import RestUses


@dataclass(frozen=True, slots=True)
class Operators:
    """The parts that serve operators."""

    tokens: TokenOrders
    clock: ClockCheck
    switched_off: SwitchedOffWatch
    administration: Administration
    rest: RestLink


def make_operators(base: Foundation, parts: Parts) -> Operators:
    """Make the parts; the specifications must already be loaded."""
    settings, trail, ends = base.settings, base.trail, parts.endpoints
    rest = Current[RestLink]()
    tokens = TokenOrders(
        base.store, trail, base.ends, lambda: rest().state_tokens(), sessions=base.features.sessions
    )
    base.features.bearers.set(tokens.usable)
    clock = ClockCheck(trail, lambda: base.audit.ids.ahead)
    switched_off = SwitchedOffWatch(
        parts.monitors, base.policies, base.store, trail, settings.forgotten_after
    )
    core = parts.core
    handled, looks = HandledAlarms(base.store, base.ends), Current[Queries]()
    base.features.operate(
        appliance=base.role.name,
        store=base.store,
        ends=base.ends,
        policies=base.policies,
        monitors=parts.monitors,
        processes=lambda: base.lifeline.surroundings.processes,
        received=base.receipts.received,
        graph=partial(graph_of, parts),
        tokens_changed=lambda: rest().state_tokens(),
        status=lambda: looks().present(),
        handled_alarms=handled,
        connections=NodeConnections(core.registry, ends.subscribers.delivery, base.lifeline.surroundings),
    )
    queries = Queries(
        parts,
        trail,
        base.policies,
        base.features.hosts(),
        base.lifeline.surroundings,
        features=base.features.state,
        audit=partial(_audit_state, base),
        clock=clock.state,
        queued_deliveries=lambda: ends.subscribers.delivery.waiting,
        live=core.revocation.live,
        switched_off=switched_off.rows,
        blocks=base.blocks.state,
        handled=handled.marked,
        name=base.settings.name,
    )
    looks.set(queries)
    administration = Administration(
        queries,
        base.features.methods()
        + request_methods(
            queries=queries,
            policies=base.policies,
            monitors=parts.monitors,
            tokens=tokens,
        ),
        durable=partial(_durable, base),
        require_room=base.store.database.require_room,
    )
    uses = RestUses(lambda: base.blocks.reasons)
    base.blocks.uses.add(uses.of)
    base.blocks.on_change(lambda: rest().state_tokens())
    rest.set(
        RestLink(
            administration,
            tokens,
            trail,
            served=base.features.hosts().served_by,
            certified=RestCertificate(base.store, trail, base.role.name).stated,
            connected=base.features.connected,
            require_proof=settings.api_require_proof,
            uses=uses,
        )
    )
    return Operators(
        tokens=tokens,
        clock=clock,
        switched_off=switched_off,
        administration=administration,
        rest=rest(),
    )


async def _durable(base: Foundation) -> None:
    await base.trail.durable()
    if base.role.before_answer is not None:
        await base.role.before_answer()


def _audit_state(base: Foundation, states: dict[str, Any]) -> AuditState:
    return AuditState(
        *base.audit.lag,
        failed=base.audit.failed,
        on_failure=base.settings.audit.on_audit_failure,
        degraded=base.audit.degraded,
        replaced=base.audit.replaced,
        **states,
    )
