"""The admin socket: operators' tools ask, control answers."""

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

import msgspec
import structlog

import appliance
from appliance.channel import admin
from appliance.channel.messages import FirewallReported, ProcessInfo
from appliance.master.core import Master
from appliance.master.policies import Loaded, Policies, PolicyRefusedError
from appliance.master.registry import Kind, Life

_log = structlog.get_logger()
_LINE_LIMIT = 16 << 20
_CATEGORIES = {Kind.PUBLICATION: "publish", Kind.SUBSCRIPTION: "subscribe", Kind.SERVICE: "offer"}


class Surroundings:
    """What the supervisor told control about the rest of the appliance."""

    def __init__(self) -> None:
        self.processes: list[ProcessInfo] = []
        self.firewall = FirewallReported("unknown", {})
        self.probe = ""


class AdminServer:
    """Answers requests on the admin socket; `lag()` is the audit log's, in records and seconds."""

    def __init__(
        self,
        master: Master,
        policies: Policies,
        surroundings: Surroundings,
        *,
        lag: Callable[[], tuple[int, float]],
        audit_failed: Callable[[], str | None],
        audit_degraded: Callable[[], str | None],
    ) -> None:
        self._master = master
        self._policies = policies
        self._surroundings = surroundings
        self._lag = lag
        self._audit_failed = audit_failed
        self._audit_degraded = audit_degraded
        self._started = time.time()
        self._decoder = msgspec.json.Decoder(admin.AnyRequest)
        self._server: asyncio.Server | None = None  # held: a server that nobody holds is closed

    async def start(self, sock: socket.socket) -> None:
        """Serve the listening socket."""
        self._server = await asyncio.start_unix_server(self._serve, sock=sock, limit=_LINE_LIMIT)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                writer.write(msgspec.json.encode(self._answer(line)) + b"\n")
                await writer.drain()
        except (ValueError, ConnectionError) as error:
            _log.warning("a tool spoke nonsense on the admin socket", error=str(error))
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    def _answer(self, line: bytes) -> admin.AdminAnswer:
        try:
            request = self._decoder.decode(line)
        except msgspec.MsgspecError as error:
            return admin.AdminAnswer(False, error=f"not a request of this version: {error}")
        try:
            return admin.AdminAnswer(True, self._carry_out(request))
        except PolicyRefusedError as error:
            text = f"the policy was refused; revision {self._policies.revision} stays in force"
            return admin.AdminAnswer(False, error=text, findings=error.findings)

    def _carry_out(self, request: admin.AnyRequest) -> dict[str, Any]:
        match request:
            case admin.StatusWanted():
                return self._status()
            case admin.PolicyReload(confirm_within):
                return _loaded(self._policies.reload(confirm_within=confirm_within))
            case admin.PolicyRollback(revision):
                return _loaded(self._policies.rollback(revision, who="operator"))
            case admin.PolicyConfirm():
                return {"confirmed": self._policies.confirm(), "revision": self._policies.revision}
            case admin.PolicyRevisions():
                return {"revisions": [self._revision(row) for row in self._policies.revisions()]}
            case admin.RegistrationsWanted():
                return {"registrations": self._registrations()}

    def _status(self) -> dict[str, Any]:
        registry, relay = self._master.registry, self._master.relay
        lives = [one.life for one in registry.all()]
        lag_records, lag_seconds = self._lag()
        return {
            "version": appliance.__version__,
            "since": self._started,
            "processes": msgspec.to_builtins(self._surroundings.processes),
            "isolation": self._surroundings.firewall.isolation,
            "firewall": self._surroundings.firewall.report,
            "probe": self._surroundings.probe,
            "policy": {
                "revision": self._policies.revision,
                "file": self._policies.current.file,
                "differs_from_file": self._policies.differs_from_file,
                "warnings": len(self._policies.current.warnings),
                "confirm_by": self._policies.confirm_by,
            },
            "rosmaster": "reachable" if self._master.rosmaster.reachable else "being rebuilt",
            "relay": "connected" if relay.connected else "away",
            "nodes": lives.count(Life.LIVE),
            "shadows": lives.count(Life.SHADOW),
            "topics": len(
                {one.resource for _node, one in registry.in_order() if one.kind is Kind.PUBLICATION}
            ),
            "services": len({one.resource for _node, one in registry.in_order() if one.kind is Kind.SERVICE}),
            "connections": len(relay.connections),
            "messages": sum(one.messages for one in relay.traffic.values()),
            "dropped": sum(one.dropped for one in relay.traffic.values()),
            "audit": {
                "lag_records": lag_records,
                "lag_seconds": lag_seconds,
                "failed": self._audit_failed(),
                "degraded": self._audit_degraded(),
            },
        }

    def _revision(self, row: Any) -> dict[str, Any]:
        return {
            "revision": row.revision,
            "file": row.file,
            "loaded": row.loaded,
            "who": row.who,
            "note": row.note,
            "in_force": row.revision == self._policies.revision,
        }

    def _registrations(self) -> list[dict[str, Any]]:
        return [
            {
                "host": str(incarnation.host),
                "caller_id": incarnation.name,
                "category": _CATEGORIES[registration.kind],
                "resource": registration.resource,
            }
            for incarnation, registration in self._master.registry.in_order()
            if registration.kind in _CATEGORIES and not incarnation.own
        ]


def _loaded(loaded: Loaded) -> dict[str, Any]:
    return {
        "revision": loaded.revision,
        "replaced": loaded.replaced,
        "warnings": loaded.warnings,
        "revoked": loaded.revoked,
        "confirm_by": loaded.confirm_by,
    }
