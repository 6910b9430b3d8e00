"""The collector's paths for bundles, and the report that a robot sends there."""

import msgspec

METADATA, TARGETS, SELECTION = "v1/bundles/metadata", "v1/bundles/targets", "v1/bundles/selection"
EVENTS = "v1/bundles/events"
"""The path of the collector's event stream."""
REPORT = "v1/bundles/report"


class RobotReport(msgspec.Struct, frozen=True):
    """Bundles by path (empty: none), the robot's health, and polling problems."""

    site: str
    group: str
    in_force: str
    trying: str
    refused: str
    reason: str
    changed: bool
    denials: int
    failing: int
    trouble: str
