"""Prepare the tunnels on a standby: close the pool in the firewall, and start the process that will run charon.

That process makes its own key, for which the active appliance stores a certificate, so a takeover needs neither
the authority's key nor the start of this process.
"""

import structlog

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.features.standby.replication_frames import Introduction
from appliance.hosts.tunnel_state import Tunnels

_log = structlog.get_logger()


class StandbyTunnels:
    """The link to the process that runs charon, until the appliance is activated."""

    def __init__(self) -> None:
        self._link = Link(self._heard)
        self._needed: messages.CertificateNeeded | None = None
        self.pin = ""

    def attach(self, channel: Channel) -> None:
        self._needed = None
        self._link.attach(channel)

    def answered(self, message: messages.TunnelsEnclosed) -> None:
        if message.esp is None:
            _log.warning("this appliance cannot take over the tunnels of hosts", reason=message.reason)

    def introduction(self, endpoint: str, pin: str) -> Introduction | None:
        needed = self._needed
        return None if needed is None else Introduction(needed.request, needed.key, endpoint, pin)

    def hand_to(self, tunnels: Tunnels) -> None:
        channel = self._link.release()
        if channel is not None:
            tunnels.attach(channel, self._needed)

    def _heard(self, message: object) -> None:
        if isinstance(message, messages.CertificateNeeded):
            self._needed = message
