"""Make the parts that serve operators on the admin socket and over REST."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from appliance.channel.answers.status import AuditState
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.current import Current, Provided
from appliance.control.assembly.foundation import Foundation
from appliance.control.core import Alarms, Bearers, Core, Links
from appliance.control.core_assembly import make_core
from appliance.control.feature_parts import FeatureParts
from appliance.control.operators.administration import Administration
from appliance.control.operators.clock_check import ClockCheck
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.control.operators.new_state import StateAge
from appliance.control.operators.queries import Queries
from appliance.control.operators.request_methods import request_methods
from appliance.control.operators.switched_off import SwitchedOffWatch
from appliance.control.operators.token_orders import Sessions, TokenOrders
from appliance.control.rest.rest import RestLink, RestUses
from appliance.control.rest.rest_certificate import RestCertificate


@dataclass(frozen=True, slots=True)
class QueryParts:
    """The parts that answer queries, and the core of features, before a policy is in force."""

    core: Core
    queries: Queries
    tokens: TokenOrders
    clock: ClockCheck
    switched_off: SwitchedOffWatch
    rest: Current[RestLink]
    state_age: StateAge


@dataclass(frozen=True, slots=True)
class Operators:
    """The parts that serve operators."""

    tokens: TokenOrders
    clock: ClockCheck
    switched_off: SwitchedOffWatch
    administration: Administration
    rest: RestLink
    links: Links


def make_queries(base: Foundation, parts: Parts, features: FeatureParts) -> QueryParts:
    settings, trail, ends = base.settings, base.trail, parts.endpoints

    def stepped() -> None:
        base.hosts.tunnels.state_anew()
        base.policies.time_passed()

    rest, sessions = Current[RestLink](), Provided[Sessions]()
    tokens = TokenOrders(base.store, trail, base.ends, lambda: rest().state_tokens(), sessions=sessions)
    clock = ClockCheck(trail, lambda: base.audit.ids.ahead, stepped=stepped)
    base.ends.when_cut_short(clock.cut_short)
    switched_off = SwitchedOffWatch(
        lambda: parts.monitors.switches.switched_off(),  # noqa: PLW0108  of those in force then
        parts.monitors.until,
        lambda: base.policies.current,
        store=base.store,
        trail=trail,
        forgotten_after=settings.forgotten_after,
    )
    handled, state_age = HandledAlarms(base.store, base.ends), StateAge(base.store, trail)
    queries = Queries(
        parts,
        trail,
        base.policies,
        base.hosts,
        base.lifeline.surroundings,
        features=features.status,
        audit=partial(_audit_state, base),
        clock=clock.state,
        queued_deliveries=lambda: ends.subscribers.delivery.waiting,
        live=parts.core.revocation.live,
        switched_off=switched_off.rows,
        blocks=base.hosts.blocks.state,
        handled=handled.marked,
        new_state=state_age.state,
        name=settings.name,
    )
    bearers = Bearers(tokens.usable, lambda: rest().state_tokens(), sessions)
    core = make_core(base, parts, bearers, Alarms(queries.present, handled))
    return QueryParts(core, queries, tokens, clock, switched_off, rest, state_age)


def make_operators(base: Foundation, made: QueryParts, features: FeatureParts) -> Operators:
    administration = Administration(
        features.methods()
        + request_methods(
            queries=made.queries,
            policies=base.policies,
            monitors=made.core.specifications,
            tokens=made.tokens,
        ),
        in_force=lambda: (base.policies.revision, made.queries.parts.monitors.revision),
        durable=partial(_durable, base),
        require_room=base.store.database.require_room,
    )
    blocks = base.hosts.blocks
    uses = RestUses(lambda: blocks.reasons)
    blocks.uses.add(uses.of)
    blocks.on_change(lambda: made.rest().state_tokens())
    made.rest.set(
        RestLink(
            administration,
            made.tokens,
            base.trail,
            served=base.hosts.enrolment.served_by,
            certified=RestCertificate(base.store, base.trail, base.role.name).stated,
            connected=made.core.rest.connected,
            require_proof=base.settings.api_require_proof,
            uses=uses,
        )
    )
    return Operators(
        tokens=made.tokens,
        clock=made.clock,
        switched_off=made.switched_off,
        administration=administration,
        rest=made.rest(),
        links=made.core.links,
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
