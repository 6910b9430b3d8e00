"""Keep and record the connections and the traffic that the relays report."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest

import msgspec

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel import messages
from appliance.channel.answers.graph_answers import Flow
from appliance.channel.messages import TopicTraffic
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.policy.model import Address
from appliance.policy.rate_limits import LimitRule
from appliance.store.state_file import PermissionRow
from appliance.telemetry.audit_trail import AuditTrail

MAX_RESOURCES = 2000
MAX_DELAYED = 200
"""The most topics that have their own histogram."""
OTHERS = "(others)"  # ROS names cannot contain brackets

_STILL_SECONDS = 3.0  # after this time without a report, rates are 0
_MOVING_SECONDS = 60.0
_UNHEARD_SECONDS = 20.0
"""The time without a report in which a publisher may have sent: its relay hangs, starts, or is not connected to it."""


@dataclass(slots=True)
class Traffic:
    """Counters of one relayed topic or service of one incarnation, since control started."""

    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    seconds: float = 0.0  # the time of the last report (monotonic)
    moved: float = 0.0  # the time of the last report with messages (monotonic)
    silent: float = 0.0  # seconds since then in which a relay was connected, and reported silence
    heard: float = 0.0  # the time of the last report of messages or silence (monotonic)
    messages_per_second: float = 0.0  # the rate between the last two reports
    bytes_per_second: float = 0.0
    delays: list[int] = field(default_factory=list)  # as in `TopicTraffic`
    delay_seconds: float = 0.0
    delay: float = 0.0  # mean seconds per message in the last report
    md5sum: str = ""  # the publisher's md5sum; empty until a relay has seen it
    name: str = ""  # of its metrics
    delay_name: str = ""  # of its histogram; empty until it has delays

    def add(self, row: TopicTraffic, now: float, over: float) -> None:
        self.messages += row.messages
        self.bytes += row.bytes
        self.dropped += row.dropped
        self.md5sum = row.md5sum or self.md5sum
        self.moved = now if row.messages else self.moved
        # A relay that hung may report before it reads what waited.
        self.silent = 0.0 if row.messages else self.silent + min(row.silent, over)
        self.heard = now if row.messages or row.silent else self.heard
        passed = max(now - self.seconds, 1.0) if self.seconds else max(over, 1.0)
        self.messages_per_second = row.messages / passed
        self.bytes_per_second = row.bytes / passed
        self.seconds = now
        if row.delays:
            self.delays = [a + b for a, b in zip_longest(self.delays, row.delays, fillvalue=0)]
            self.delay_seconds += row.delay_seconds
        self.delay = row.delay_seconds / sum(row.delays) if row.delays else 0.0

    def silence(self, since: float) -> float:
        """Return the seconds of silence after a time, without `_UNHEARD_SECONDS` of which no relay reports."""
        unheard = clock.now() - max(self.heard, since)
        return min(self.silent, max(0.0, self.heard - since)) + max(0.0, unheard - _UNHEARD_SECONDS)

    def include(self, other: "Traffic") -> None:
        self.messages += other.messages
        self.bytes += other.bytes
        self.dropped += other.dropped
        self.delays = [a + b for a, b in zip_longest(self.delays, other.delays, fillvalue=0)]
        self.delay_seconds += other.delay_seconds


class SeriesNames:
    """Names metrics: at most `most` resources have their own, the others share `OTHERS`.

    A present resource keeps its name. One that has ended gives it up if a present one needs it. A host gets no more
    than three quarters of the names. `past` has the sums of forgotten incarnations, so that counters never decrease.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._hosts: dict[str, Address] = {}  # that got a name, by name
        self._named: Counter[Address] = Counter()
        self._present: Counter[str] = Counter()
        self._ended: dict[str, None] = {}  # names without a present resource, the earliest first
        self.past: dict[str, Traffic] = {}

    def name(self, resource: str, host: Address) -> str:
        if resource not in self._hosts:
            has_share = self._named[host] < self._most - self._most // 4
            if not has_share or len(self._hosts) >= self._most:
                ended = next((one for one in self._ended if has_share or self._hosts[one] == host), None)
                if ended is None:
                    return OTHERS
                self._named[self._hosts.pop(ended)] -= 1
                del self._ended[ended]
                self.end(OTHERS, self.past.pop(ended))
            self._hosts[resource] = host
            self._named[host] += 1
        self._present[resource] += 1
        self._ended.pop(resource, None)
        return resource

    def end(self, name: str, traffic: Traffic) -> None:
        self.past.setdefault(name, Traffic()).include(traffic)
        if name in self._hosts:
            self._present[name] -= 1
            if not self._present[name]:
                self._ended[name] = None


class RelayTraffic:
    """The connections and traffic of all relays.

    `cut_off(subscriber, topic)` is called for a connection that ended although both of its nodes are registered.
    """

    def __init__(
        self,
        trail: AuditTrail,
        registry: Registry,
        relays: int,
        cut_off: Callable[[Incarnation, str], None],
    ) -> None:
        self._trail = trail
        self._cut_off = cut_off
        self._registry = registry
        self._relays = relays
        self._began = clock.now()
        self.connections: dict[tuple[int, int], messages.ConnectionOpened] = {}
        """The connections, by relay and the relay's own number. `number` is unique among all relays."""
        self.traffic: dict[tuple[str, str], Traffic] = {}
        self.limited_messages: Counter[tuple[str, str]] = Counter()
        """The messages that limits dropped, by topic and limit; at most `MAX_RESOURCES` topics."""
        self._limited_topics: set[str] = set()
        self.memory: dict[int, dict[str, int]] = {}
        """The bytes that each relay holds, by kind."""
        self.counted, self.delayed = SeriesNames(MAX_RESOURCES), SeriesNames(MAX_DELAYED)

    def used_permissions(self) -> set[PermissionRow]:
        return {
            PermissionRow(
                connection.key, connection.kind, connection.resource, connection.host, connection.caller_id
            )
            for connection in self.connections.values()
        }

    def connects(self, host: Address, caller_id: str) -> bool:
        return any(
            (connection.caller_id, connection.host) == (caller_id, str(host))
            for connection in self.connections.values()
        )

    @property
    def total(self) -> Traffic:
        total = Traffic()
        for traffic in (*self.counted.past.values(), *self.traffic.values()):
            total.include(traffic)
        return total

    def flow(self, key: str, resource: str) -> Flow:
        traffic = self.traffic.get((key, resource), Traffic())
        flows = clock.now() - traffic.seconds < _STILL_SECONDS
        return Flow(
            messages=traffic.messages,
            bytes=traffic.bytes,
            dropped=traffic.dropped,
            messages_per_second=round(traffic.messages_per_second, 2) if flows else 0.0,
            bytes_per_second=round(traffic.bytes_per_second, 1) if flows else 0.0,
            delay_seconds=round(traffic.delay, 6) if flows else 0.0,
        )

    def moving(self, key: str, resource: str) -> bool:
        moved = self.traffic.get((key, resource), Traffic()).moved
        return clock.now() - max(moved, self._began) < _MOVING_SECONDS

    def lost(self, relay: int) -> None:
        self.memory.pop(relay, None)
        for number in [connection for connection in self.connections if connection[0] == relay]:
            del self.connections[number]

    def forgotten(self, key: str) -> None:
        for carried in [carried for carried in self.traffic if carried[0] == key]:
            traffic = self.traffic.pop(carried)
            self.counted.end(traffic.name, traffic)
            if traffic.delay_name:
                self.delayed.end(traffic.delay_name, traffic)

    def received(self, relay: int, message: messages.Message) -> bool:
        """Take a report of a relay; return False for another message."""
        match message:
            case messages.TrafficReported():
                self.reported(message.rows, message.over)
                self.unrecorded(message.unrecorded)
                self.memory[relay] = message.memory
            case messages.ConnectionOpened():
                self.opened(relay, message)
            case messages.ConnectionClosed():
                self.closed(relay, message)
            case messages.ConnectionRefused():
                self.refused(message)
            case messages.PublicationRefused():
                self.publication_refused(message)
            case messages.LatchRefused():
                if (node := self._registry.by_key(message.key)) is not None:
                    self.latch_refused(message, str(node.host))
            case _:
                return False
        return True

    def reported(self, rows: list[TopicTraffic], over: float = 1.0) -> None:
        now = clock.now()
        for row in rows:
            if (node := self._registry.by_key(row.key)) is None:
                continue
            about = row.resource, node.host
            traffic = self.traffic.get((row.key, row.resource))
            if traffic is None:
                traffic = self.traffic[row.key, row.resource] = Traffic(name=self.counted.name(*about))
            if row.delays and not traffic.delay_name:
                traffic.delay_name = self.delayed.name(*about)
            traffic.add(row, now, over)

    def unrecorded(self, connections: int) -> None:
        if connections:
            self._trail.happened(
                "records lost",
                f"{counted(connections, 'connection')} through a relay ended unrecorded while it was not"
                " connected to control",
                lost=connections,
            )

    def opened(self, relay: int, message: messages.ConnectionOpened) -> None:
        number = message.number * self._relays + relay
        self.connections[relay, message.number] = msgspec.structs.replace(message, number=number)
        name = self._name(message.key)
        self._trail.happened(
            "connection opened",
            f"{message.caller_id} ({message.host}) is connected to {message.resource} of {name}",
            host=message.host,
            caller_id=message.caller_id,
            category=message.kind,
            resource=message.resource,
            node=name,
        )

    def closed(self, relay: int, message: messages.ConnectionClosed) -> None:
        connection = self.connections.pop((relay, message.number), None)
        if connection is None:
            return
        self._trail.happened(
            "connection closed",
            message.reason or "closed in an orderly way",
            host=connection.host,
            caller_id=connection.caller_id,
            category=connection.kind,
            resource=connection.resource,
            node=self._name(connection.key),
        )
        subscriber = self._subscriber(connection)
        if subscriber is not None:
            self._cut_off(subscriber, connection.resource)

    def _subscriber(self, connection: messages.ConnectionOpened) -> Incarnation | None:
        topic, subscriber = connection.resource, self._registry.holder(connection.caller_id)
        publishers = self._registry.registrants(Kind.PUBLICATION, topic)
        if (
            subscriber is None
            or str(subscriber.host) != connection.host
            or (Kind.SUBSCRIPTION, topic) not in subscriber.registrations
            or all(publisher.key != connection.key for publisher in publishers)
        ):
            return None
        return subscriber

    def refused(self, message: messages.ConnectionRefused) -> None:
        """Record a refused connection, but not as an attack if one of the appliance's nodes connected too late."""
        own = self._is_own(message.host, message.caller_id, message.resource)
        self._trail.happened(
            "connection refused",
            message.reason,
            severity=Severity.INFO if own else Severity.WARNING,
            decision=None if own else "deny",
            host=message.host,
            caller_id=message.caller_id,
            category=message.kind or None,
            resource=message.resource,
            node=self._name(message.key),
            count=message.count,
        )

    def upstream_lost(self, message: messages.UpstreamLost, host: str) -> None:
        if message.violation:
            self._trail.happened(
                message.violation,
                message.reason,
                severity=Severity.WARNING,
                decision="deny",
                host=host,
                caller_id=self._name(message.key),
                category="topic",
                resource=message.topic,
            )

    def latch_refused(self, message: messages.LatchRefused, host: str) -> None:
        self._trail.happened(
            "limit exceeded",
            "its latched message is not stored for later subscribers: its host has no memory left for it in the relay",
            severity=Severity.ALARM,
            decision="deny",
            host=host,
            caller_id=self._name(message.key),
            category="topic",
            resource=message.topic,
            size=message.size,
        )

    def limited(self, row: messages.LimitedRow, rule: LimitRule | None) -> None:
        topic = row.topic or OTHERS
        known = topic in self._limited_topics or len(self._limited_topics) < MAX_RESOURCES
        self._limited_topics.add(name := topic if known else OTHERS)
        self.limited_messages[name, row.part] += row.messages
        whose = {
            "publisher": "a host's publishers",
            "subscriber": "a subscriber",
            "topic": "all publishers together",
        }[row.part]
        self._trail.happened(
            "rate limited",
            f"messages beyond the limit for {whose} were dropped",
            severity=Severity.INFO if row.part == "subscriber" else Severity.WARNING,
            host=row.host or None,
            caller_id=row.caller_id or None,
            category="topic",
            resource=row.topic,
            rule=rule.rule if rule is not None else None,
            part=row.part,
            publisher=self._name(row.key),
            count=row.messages,
            bytes=row.bytes,
        )

    def publication_refused(self, message: messages.PublicationRefused) -> None:
        self._trail.happened(
            "publication refused",
            message.reason,
            decision="deny",
            caller_id=self._name(message.key),
            category="monitor",
            resource=message.resource,
        )

    def _name(self, key: str) -> str:
        node = self._registry.by_key(key)
        return node.name if node is not None else ""

    def _is_own(self, host: str, caller_id: str, topic: str) -> bool:
        holder = self._registry.holder(caller_id)
        return (
            holder is not None
            and holder.own
            and host in (str(holder.host), holder.told)
            and (Kind.SUBSCRIPTION, topic) in holder.registrations
        )
