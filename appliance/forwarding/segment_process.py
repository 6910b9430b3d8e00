"""Run the pusher of segments as a process of the appliance, like the forwarder of the log."""

import asyncio
from pathlib import Path

from appliance.audit.signatures import read_public_key
from appliance.configuration.settings import Settings, load_resolved
from appliance.forwarding.collector_connection import https_collector
from appliance.forwarding.process import ForwardingProcess
from appliance.forwarding.segment_pusher import SegmentPusher


def main(lifeline_fd: int, config: Path) -> None:
    """Push segments until the supervisor ends the process."""
    pusher = make_pusher(load_resolved(config), Path.cwd())
    asyncio.run(ForwardingProcess(pusher, lifeline_fd).run())


def make_pusher(settings: Settings, folder: Path) -> SegmentPusher:
    """Return the pusher for these settings, which must configure a collector. Raises `KeyUnreadableError`."""
    fleet = settings.fleet
    if fleet.ca is None or fleet.certificate is None or fleet.key is None or fleet.receipt_key is None:
        raise ValueError("fleet: ca, certificate, key and receipt_key must be given")
    return SegmentPusher(
        settings.state / "control" / "audit.db",
        folder,
        https_collector(fleet.destination, fleet.ca, fleet.certificate, fleet.key, fleet.name),
        read_public_key(fleet.receipt_key),
    )
