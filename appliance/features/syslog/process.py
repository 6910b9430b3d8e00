"""Run the forwarder of the audit log to a syslog receiver, as a process of the appliance."""

import asyncio
import ssl
from collections.abc import Callable
from pathlib import Path

from appliance.configuration.settings import Settings, load_resolved
from appliance.features.syslog.log_forwarder import LogForwarder
from appliance.features.syslog.receiver import DatagramReceiver, Receiver, StreamReceiver, tls_context
from appliance.features.syslog.settings import Syslog
from appliance.features.syslog.syslog import LONGEST_DATAGRAM, LONGEST_IN_STREAM, Formatter
from appliance.forwarding.process import ForwardingProcess


def main(lifeline_fd: int, config: Path) -> None:
    forwarder = make_forwarder(load_resolved(config), Path.cwd() / "position.json")
    asyncio.run(ForwardingProcess(forwarder, lifeline_fd).run())


def make_forwarder(settings: Settings, kept: Path) -> LogForwarder:
    wanted = settings.of(Syslog)
    longest = LONGEST_DATAGRAM if wanted.destination[0] == "udp" else LONGEST_IN_STREAM
    return LogForwarder(
        settings.state / "control" / "audit.db",
        kept,
        receiver_of(wanted),
        Formatter(
            facility=wanted.facility,
            longest=longest,
            host_name=wanted.host_name or settings.name or None,
        ),
        chosen=wanted.send,
    )


def receiver_of(wanted: Syslog) -> Receiver:
    protocol, host, port = wanted.destination
    if protocol == "udp":
        return DatagramReceiver(host, port)
    context: Callable[[], ssl.SSLContext] | None = None
    if protocol == "tls":
        # Made for each connection, so that replaced certificate files apply to the next connection.
        def context() -> ssl.SSLContext:
            return tls_context(wanted.ca, wanted.certificate, wanted.key)

    return StreamReceiver(host, port, context, wanted.name)
