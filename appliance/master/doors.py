"""Who is let in to the listeners of control, and under which limits: RVMaster's, the outer faces', the inner ones'.

A stranger (an address that no rule of the policy names) is refused before its body is read; while the real ROS Master
is not hidden, everybody is.
"""

import socket
from collections.abc import Callable

from appliance.audit.record import Severity
from appliance.config import Settings
from appliance.master.http import Handler, HttpLimits, HttpServer, Peer, Visitors
from appliance.master.recorder import Recorder
from appliance.master.turns import Turns
from appliance.policy import Policy
from appliance.ros.xmlrpc import Limits, build_fault


class Doors:
    """The limits and the visitors of all listeners; `policy()` is the one in force."""

    def __init__(self, settings: Settings, recorder: Recorder, policy: Callable[[], Policy]) -> None:
        limits = settings.limits
        self.http = HttpLimits(
            head_bytes=int(limits.header_bytes),
            head_seconds=limits.header_seconds,
            body_bytes=int(limits.body_bytes),
            idle_seconds=limits.idle_seconds,
            connections_per_host=limits.connections_per_host,
            connections=limits.connections,
        )
        self.visitors = Visitors(self.http)
        self.turns = Turns(self.http.slots, self.http.slots_per_host)
        self._recorder = recorder
        self._policy = policy
        self._unhidden = ""
        self._servers: list[HttpServer] = []

    async def open(self, sock: socket.socket, handler: Handler, *, guarded: bool) -> None:
        """Serve a listener; one that is not `guarded` is reached by the appliance's own processes only."""
        server = HttpServer(
            sock.dup(),
            handler,
            limits=self.http,
            visitors=self.visitors if guarded else Visitors(self.http),
            turns=self.turns if guarded else Turns(self.http.slots, self.http.slots),
            refuse=self.refuse if guarded else _refuse_nobody,
            troubled=self.troubled,
        )
        self._servers.append(server)
        await server.start()

    def close(self) -> None:
        """Serve nobody any more."""
        for server in self._servers:
            server.close()

    def refuse(self, peer: Peer) -> bytes | None:
        """The answer to somebody who is not to be served at all; None for the others."""
        if self._unhidden:
            return build_fault(1, f"the appliance does not serve: {self._unhidden}")
        # The rosout aggregator calls from this machine, which the policy need not name; whoever does is decided by it.
        if peer.here or self._policy().knows(peer.host):
            return None
        reason = f"no rule of the policy names {peer.text}"
        record = self._recorder.happened(
            "decision",
            reason,
            severity=Severity.WARNING,
            decision="deny",
            host=peer.text,
            category="command",
            resource="",
        )
        return build_fault(1, f"{reason} [{record}]")

    def troubled(self, peer: Peer, reason: str) -> None:
        """A peer went over a limit."""
        self._recorder.happened(
            "limit exceeded", reason, severity=Severity.WARNING, decision="deny", host=peer.text
        )

    def probed(self, reason: str) -> None:
        """The supervisor looked whether the ROS Master is hidden; `reason` is empty if it is."""
        if bool(reason) != bool(self._unhidden):
            event, severity = (
                ("probe failed", Severity.ALARM) if reason else ("probe passed", Severity.NOTICE)
            )
            self._recorder.happened(event, reason or "the ROS Master is hidden", severity=severity)
        self._unhidden = reason


def value_limits(settings: Settings) -> Limits:
    """The bounds of XML-RPC values, as configured."""
    limits = settings.limits
    return Limits(
        body=int(limits.body_bytes),
        elements=limits.elements,
        depth=limits.nesting,
        string=int(limits.string_bytes),
        parts=limits.multicall_parts,
    )


def _refuse_nobody(_peer: Peer) -> bytes | None:
    return None
