"""Run the pusher of segments as a process of the appliance, like the forwarder of the log."""

import asyncio
from pathlib import Path

from appliance.audit.log.signatures import read_public_key
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.fleet.connection import robot_connection
from appliance.features.fleet.segment_pusher import SegmentPusher
from appliance.features.fleet.settings import Fleet
from appliance.forwarding.process import ForwardingProcess


def main(lifeline_fd: int, config: Path) -> None:
    pusher = make_pusher(load_resolved(config), Path.cwd())
    asyncio.run(ForwardingProcess(pusher, lifeline_fd).run())


def make_pusher(settings: Settings, folder: Path) -> SegmentPusher:
    fleet = settings.of(Fleet)
    assert fleet.receipt_key is not None  # noqa: S101  the role runs only with it
    return SegmentPusher(
        settings.state / "control" / "audit.db",
        folder,
        robot_connection(*fleet.connection),
        read_public_key(fleet.receipt_key),
    )
