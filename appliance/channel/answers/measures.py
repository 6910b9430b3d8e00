"""The measured values, in numbers; `appliance.telemetry.metrics` defines their names."""

import msgspec

from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.status import Status

Observed = tuple[list[int], float]
"""How many were in each bucket of a histogram, and their sum in seconds."""


class Measures(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that control measures.

    `decisions` has category, outcome and how often; `calls` the time of calls by name; `relayed` messages, bytes and
    dropped messages by topic or service; `delayed` buckets and their sum by topic; `monitors` the kind, the monitor and
    how often; `slices` how many a parametric specification has and may have; `limited` the topic, what of it was
    limited and how often.
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
