"""The measured values, in numbers; `Meter` of `appliance/telemetry/audit_trail.py` defines their names."""

import msgspec

from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.status import Status

Observed = tuple[list[int], float]
"""The counts of a histogram's buckets, and the sum of the values in seconds."""


class Measures(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that control measures, in rows.

    `decisions` are category, outcome and number; `calls` the times of calls by name; `relayed` messages, bytes and
    dropped messages by topic or service; `delayed` buckets and their sum by topic; `monitors` kind, monitor and
    number; `slices` the present and the largest number for each parametric specification; `limited` topic, limit and
    number.
    """

    decisions: list[tuple[str, str, int]]
    decision_seconds: Observed
    calls: list[tuple[str, Observed]]
    status: Status
    hosts: list[Host]
    queued_deliveries: int
    nodes: dict[str, int]
    registrations: dict[str, int]
    relayed: dict[str, list[int]]
    delayed: dict[str, list[float]]
    monitors: list[tuple[str, str, int]]
    slices: dict[str, tuple[int, int]]
    drop_at: dict[str, int]
    change_at: dict[str, int]
    limited: list[tuple[str, str, int]]
    memory: dict[str, int]
    connections: dict[str, int]
