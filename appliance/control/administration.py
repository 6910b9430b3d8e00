"""What operators can do with the running appliance, over the admin socket and over REST alike.

One core for both: a request of `appliance.channel.admin` in, an answer out. Changes of the policy are made one at
a time, and a change that names the revision it is meant for is refused when another one is in force by then.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

import appliance
from appliance.channel import admin
from appliance.control.assembly import Parts
from appliance.control.measures import measures_of
from appliance.control.monitor_orders import change_monitors, monitors_body, monitors_status
from appliance.control.overview import graph_of
from appliance.control.surroundings import Surroundings
from appliance.control.tokens import TokenRefusedError, Tokens
from appliance.hosts.hosts import Hosts
from appliance.hosts.orders import MINE as HOST_ORDERS
from appliance.hosts.orders import manage_hosts
from appliance.hosts.table import (
    HostForbiddenError,
    HostRefusedError,
    HostsChangedError,
    UnknownHostError,
)
from appliance.master.graph.registry import Kind, Life
from appliance.master.policies import Loaded, Policies, PolicyRefusedError, RevisionChangedError
from appliance.policy import Known, Live
from appliance.specifications.files import SpecificationsRefusedError
from appliance.specifications.monitors import MonitorsChangedError, UnknownMonitorError
from appliance.store.state import RevisionRow, StateStore
from appliance.store.tokens import TokenRow

_View = (
    admin.StatusWanted
    | admin.PolicyRevisions
    | admin.RegistrationsWanted
    | admin.GraphWanted
    | admin.MetricsWanted
    | admin.MonitorsWanted
)
_TokenRequest = admin.TokenAdd | admin.TokenList | admin.TokenRevoke
_PolicyChange = admin.PolicyReload | admin.PolicyRollback | admin.PolicyConfirm | admin.PolicyLoad


class UnknownThingError(Exception):
    """There is nothing of the name or number that was asked for."""


class Administration:
    """Carries out requests; `lag()` is the audit log's, in records and seconds.

    `forwarded()` is how its forwarding to a syslog receiver stands; None when it is not forwarded. `live()` is what a
    change of the policy may end.
    """

    def __init__(
        self,
        parts: Parts,
        policies: Policies,
        tokens: Tokens,
        store: StateStore,
        surroundings: Surroundings,
        *,
        hosts: Hosts,
        lag: Callable[[], tuple[int, float]],
        on_audit_failure: str,
        audit_failed: Callable[[], str | None],
        audit_degraded: Callable[[], str | None],
        queued_deliveries: Callable[[], int],
        forwarded: Callable[[], dict[str, Any] | None],
        live: Callable[[], list[Live]],
    ) -> None:
        self._parts = parts
        self._policies = policies
        self._tokens = tokens
        self._store = store
        self._surroundings = surroundings
        self._hosts = hosts
        self._lag = lag
        self._on_audit_failure = on_audit_failure
        self._audit_failed = audit_failed
        self._audit_degraded = audit_degraded
        self._queued_deliveries = queued_deliveries
        self._forwarded = forwarded
        self._live = live
        self._started = time.time()
        self._changing = asyncio.Lock()

    async def carry_out(self, request: admin.AnyRequest, *, who: str) -> admin.AdminAnswer:
        """Do what is asked on behalf of `who` (the name of a token, or `operator` for the admin socket)."""
        try:
            return admin.AdminAnswer(True, await self._carry_out(request, who))
        except PolicyRefusedError as error:
            text = f"the policy was refused; revision {self._policies.revision} stays in force"
            return admin.AdminAnswer(False, error=text, findings=error.findings, trouble="refused")
        except SpecificationsRefusedError as error:
            text = f"refused; revision {self._parts.monitors.revision} of the specifications stays in force"
            return admin.AdminAnswer(False, error=text, findings=error.findings, trouble="refused")
        except (RevisionChangedError, MonitorsChangedError, HostsChangedError) as error:
            body = {"tag": error.tag} if isinstance(error, MonitorsChangedError) else {}
            return admin.AdminAnswer(False, body, error=str(error), trouble="conflict")
        except (UnknownThingError, UnknownMonitorError, UnknownHostError) as error:
            return admin.AdminAnswer(False, error=str(error), trouble="unknown")
        except (TokenRefusedError, HostRefusedError) as error:
            return admin.AdminAnswer(False, error=str(error), trouble=_trouble(error))

    async def _carry_out(self, request: admin.AnyRequest, who: str) -> dict[str, Any]:
        if isinstance(request, HOST_ORDERS):
            return await manage_hosts(self._hosts, request, who)
        match request:
            case admin.PolicyReload() | admin.PolicyRollback() | admin.PolicyConfirm() | admin.PolicyLoad():
                async with self._changing:
                    body = await self._change_policy(request, who)
                    await self._store.settled()
                    return body
            case admin.TokenAdd() | admin.TokenList() | admin.TokenRevoke():
                return await self._manage_tokens(request)
            case (
                admin.MonitorLoad()
                | admin.MonitorReplace()
                | admin.MonitorReload()
                | admin.MonitorRemove()
                | admin.MonitorSwitch()
                | admin.MonitorResume()
            ):
                return await change_monitors(self._parts.monitors, request, who)
            case admin.PolicyWanted(revision):
                return await asyncio.to_thread(self._policy, revision, self._policies.known)
            case _:
                return self._look(request)

    def _look(self, request: _View) -> dict[str, Any]:
        match request:
            case admin.StatusWanted():
                return self._status()
            case admin.PolicyRevisions():
                return {"revisions": [self._revision(row) for row in self._policies.revisions()]}
            case admin.RegistrationsWanted():
                return {"registrations": [live.fields() for live in self._live()]}
            case admin.GraphWanted():
                return graph_of(self._parts)
            case admin.MonitorsWanted(texts):
                return monitors_body(self._parts, texts=texts)
            case admin.MetricsWanted():
                return {
                    "status": self._status(),
                    "queued_deliveries": self._queued_deliveries(),
                    "hosts": self._hosts.rows(),
                    **measures_of(self._parts),
                }

    async def _manage_tokens(self, request: _TokenRequest) -> dict[str, Any]:
        match request:
            case admin.TokenAdd(name, role, seconds):
                row, text = await self._tokens.add(name, role, seconds)
                return {"token": text, **_token(row)}
            case admin.TokenList():
                return {"tokens": [_token(row) for row in self._tokens.rows()]}
            case admin.TokenRevoke(name):
                return _token(await self._tokens.revoke(name))

    # --- the policy ---

    async def _change_policy(self, request: _PolicyChange, who: str) -> dict[str, Any]:
        if request.expected is not None and request.expected != self._policies.revision:
            raise RevisionChangedError(request.expected, self._policies.revision)
        match request:
            case admin.PolicyReload(confirm_within):
                by = "disk" if who == "operator" else who
                return _loaded(await self._policies.reload(who=by, confirm_within=confirm_within))
            case admin.PolicyRollback(revision):
                return _loaded(self._policies.rollback(revision, who=who))
            case admin.PolicyConfirm():
                return {"confirmed": self._policies.confirm(who=who), "revision": self._policies.revision}
            case admin.PolicyLoad(text, note, confirm_within):
                loading: Awaitable[Loaded] = self._policies.load_text(
                    text, who=who, note=note, confirm_within=confirm_within
                )
                return _loaded(await loading)

    def _policy(self, revision: int | None, known: Known) -> dict[str, Any]:
        row = self._policies.revision_row(revision)
        if row is None:
            raise UnknownThingError(f"there is no revision {revision}")
        return {
            **self._revision(row),
            "text": row.text,
            "differs_from_file": self._policies.differs_from_file,
            "policy_file": str(self._policies.file),
            "confirm_by": self._policies.confirm_by,
            "warnings": [str(one) for one in self._policies.current.warnings],
            **self._policies.with_cases(known).fields(),
        }

    def _revision(self, row: RevisionRow) -> dict[str, Any]:
        return {
            "revision": row.revision,
            "file": row.file,
            "loaded": row.loaded,
            "who": row.who,
            "note": row.note,
            "in_force": row.revision == self._policies.revision,
        }

    # --- what is there ---

    def _status(self) -> dict[str, Any]:
        registry, relay = self._parts.registry, self._parts.relay
        lives = [one.life for one in registry.all()]
        lag_records, lag_seconds = self._lag()
        return {
            "version": appliance.__version__,
            "since": self._started,
            "master": self._surroundings.master,
            "processes": msgspec.to_builtins(self._surroundings.processes),
            "isolation": self._surroundings.firewall.isolation,
            "relaying": "all" if self._parts.mediation.relay_all else "monitored",
            "mediation": "full" if self._parts.mediation.stand_ins else "monitored",
            "firewall": self._surroundings.firewall.report,
            "probe": self._surroundings.probe,
            "policy": {
                "revision": self._policies.revision,
                "file": str(self._policies.file),
                "source": self._policies.current.file,
                "who": self._policies.in_force.who,
                "differs_from_file": self._policies.differs_from_file,
                "warnings": len(self._policies.current.warnings),
                "confirm_by": self._policies.confirm_by,
            },
            "ipsec": self._hosts.status(),
            "monitors": monitors_status(self._parts.monitors),
            "rosmaster": "reachable" if self._parts.rosmaster.reachable else "being rebuilt",
            "relay": relay.presence,
            "nodes": lives.count(Life.LIVE),
            "shadows": lives.count(Life.SHADOW),
            "topics": len(
                {one.resource for _node, one in registry.in_order() if one.kind is Kind.PUBLICATION}
            ),
            "services": len({one.resource for _node, one in registry.in_order() if one.kind is Kind.SERVICE}),
            "connections": len(relay.connections),
            "messages": relay.carried.total.messages,
            "dropped": relay.carried.total.dropped,
            "audit": {
                "lag_records": lag_records,
                "lag_seconds": lag_seconds,
                "failed": self._audit_failed(),
                "on_failure": self._on_audit_failure,
                "degraded": self._audit_degraded(),
                "forwarding": self._forwarded(),
            },
        }


def _trouble(error: TokenRefusedError | HostRefusedError) -> admin.Trouble:
    if isinstance(error, HostForbiddenError):
        return "forbidden"
    return "failed" if isinstance(error, HostRefusedError) and error.ours else "refused"


def _loaded(loaded: Loaded) -> dict[str, Any]:
    return {
        "revision": loaded.revision,
        "replaced": loaded.replaced,
        "warnings": loaded.warnings,
        "revoked": loaded.revoked,
        "confirm_by": loaded.confirm_by,
    }


def _token(row: TokenRow) -> dict[str, Any]:
    return {
        "name": row.name,
        "id": row.id,
        "role": row.role,
        "created": row.created,
        "expires": row.expires,
        "revoked": row.revoked,
    }
