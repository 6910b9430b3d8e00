"""The data plane of a relay: carries out control's messages, and connects peers with topics and services.

It makes no decisions: a peer is served while the `GrantTable` has a grant for its address, its `callerid`, and the
topic or service in its header.
"""

import socket
from collections.abc import Iterator, Mapping, Sequence

from appliance.channel import messages
from appliance.relay.connections.admission import NOTHING, asked_for, bound_name, flaw, missing
from appliance.relay.connections.headers import peer_fields
from appliance.relay.connections.incoming_connection import (
    IncomingConnection,
    PendingConnections,
    RefusedConnection,
)
from appliance.relay.connections.listening_ports import ListeningPorts
from appliance.relay.connections.message_sink import MessageSink
from appliance.relay.connections.monitor_calls import OwnAnswer, ServiceCalls
from appliance.relay.connections.named_subscribers import ActionServers
from appliance.relay.connections.own_topic import OwnTopicPublisher
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.connections.served_subscribers import TopicSubscriber
from appliance.relay.connections.service_client import ServiceClient, ServiceTraffic
from appliance.relay.connections.subscriber import Subscriber
from appliance.relay.connections.upstream import PublisherConnection
from appliance.relay.context import RelayContext
from appliance.relay.grant_table import GrantTable, PeerGrant
from appliance.relay.loop import EventLoop
from appliance.relay.monitors.guard_trial import GuardTrials
from appliance.relay.monitors.heartbeat import Heartbeat
from appliance.relay.monitors.interceptor import Interceptor, MonitorOrder
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.relay.monitors.topic_pipeline import TopicPipeline
from appliance.relay.ranked_topics import RankedTopics
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.report import Reporter
from appliance.relay.topic_taps import TopicTaps
from appliance.relay.transport.loop_channel import LoopLink
from appliance.relay.transport.rate_limit import RateAllowance, RateLimits

_TIDIED = 16  # number of topics between two checks of the processor time


class DataPlane:
    """Topics, services and peers of one relay, without the process around it."""

    def __init__(self, loop: EventLoop, limits: RelayLimits) -> None:
        self._loop = loop
        self._limits = limits
        self._reporter = Reporter(limits)
        self._table = GrantTable()
        self.interceptor = Interceptor(
            loop,
            self._reporter,
            budget=limits.budget / 1000,
            publish=lambda m: self._calls.call(m) if m.is_call else self._publish(m.topic, m.data),
            changed=self._monitors_changed,
            holder=lambda host: host if self._table.is_registered(host) else "",
            payer=self._table.payer,
            publishers=lambda topic: [relayed.point for relayed in self._publications(topic)],
            late=limits.late / 1000,
        )
        self._context = RelayContext.of(loop, limits, self._reporter, self.interceptor, self._table)
        self.memory = self._context.memory
        self._pending = PendingConnections(loop.clock, self._table.quota_class, self.memory.headers)
        self.ports = ListeningPorts(
            self._context,
            arrived=self._on_arrival,
            turned_away=lambda key, host, reason: self._reporter.refused(key, NOTHING, host, "", reason),
            make_room=self._make_connection_room,
        )
        self.topics: dict[tuple[str, str], RelayedTopic] = {}
        self._ranks = RankedTopics(loop, self._reporter.send, self._publications)
        self._servers = ActionServers()
        self._own: dict[str, OwnTopicPublisher] = {}
        self._own_headers: dict[str, dict[str, str]] = {}
        self._calls = ServiceCalls(self._context)
        self.clients: set[ServiceClient] = set()
        self._by_grant: dict[PeerGrant, set[Subscriber | ServiceClient]] = {}
        self._services: dict[tuple[str, str], ServiceTraffic] = {}
        self.incoming_connections: set[IncomingConnection] = set()
        self.waiting: dict[str, dict[str, set[IncomingConnection]]] = {}  # by incarnation and host
        self.refused_connections: set[RefusedConnection] = set()
        self._link: LoopLink | None = None
        self._last_rows: list[messages.TopicTraffic] = []
        self._flows = RateLimits(loop.clock)
        self._topic_taps = TopicTaps(self._reporter.send)
        self._sink: MessageSink | None = None
        self._tidying: Iterator[tuple[int, RelayedTopic | ServiceClient]] = iter(())
        self.heartbeat = Heartbeat(
            loop,
            limits,
            self.interceptor,
            publish=lambda data: self._publish(limits.heartbeat, data),
            topics=lambda: [topic for topic in self.topics.values() if topic.delays.judged],
            unwritten=self._unwritten_stop,
        )
        self._trials = GuardTrials(loop, self.interceptor, self._deliver, self._reporter.send)
        loop.after(limits.report_every, self._tick)

    def attach(self, link: LoopLink | None) -> None:
        """Report to this control from now on; earlier statements stay valid until the restatement ends."""
        self._link = link
        self._reporter.attach(link)
        self._topic_taps.end_all()
        self._trials.forget()
        self._calls.attach(link is not None)

    def copy_to(self, sink: MessageSink) -> None:
        self._sink = sink

    def take(self, message: messages.Message, descriptors: tuple[int, ...]) -> bool:
        """Carry out a message; return True if it must wait for specifications, with all later ones."""
        if self.interceptor.preparing:
            return True
        self._carry_out(message, descriptors)
        return False

    def _carry_out(  # noqa: PLR0912  one branch for each kind of message
        self, message: messages.Message, descriptors: tuple[int, ...]
    ) -> None:
        if isinstance(message, messages.StateBegan):
            self._table.begin(message.epoch)
        elif isinstance(message, messages.StateEnded):
            self._restated(message.epoch)
        elif isinstance(message, messages.RelayFact):
            self._state(message, descriptors)
        elif isinstance(message, messages.UpstreamFound | messages.UpstreamRefused):
            self._upstream_answered(message)
        elif isinstance(message, messages.SpecificationsStated | messages.StateWanted):
            self.interceptor.state(message)
        elif isinstance(message, MonitorOrder):
            self.interceptor.order(message)
        elif isinstance(message, messages.MonitorResumed | messages.RankFreed):
            self._release(message)
        elif isinstance(message, messages.LookWanted | messages.LookEnded):
            self._topic_taps.order(message, self.topics.values())
        elif isinstance(message, messages.OwnHeaderStated | messages.OwnPublished):
            self._own_topic(message)
        elif isinstance(message, messages.GuardTestWanted):
            self._trials.order(message)
        elif isinstance(message, OwnAnswer):
            self._calls.answered(message)
        elif isinstance(message, messages.OrdersAsked):
            self._reporter.send(messages.OrdersCarriedOut())
        elif isinstance(message, messages.FactWithdrawn):
            self._table.withdraw(message.fact)
            self._withdrawn(message.fact)
        else:
            raise TypeError(f"control does not send {type(message).__name__} to a relay")

    def close(self) -> None:
        self.interceptor.close()
        self._trials.close()
        self.heartbeat.close()
        self.ports.close_all()
        for topic in self.topics.values():
            topic.cut_all("the relay ends")
            topic.upstream.close()
        for client in list(self.clients):
            client.cut("the relay ends")
        for incoming in self.incoming_connections:
            incoming.close()
        for farewell in list(self.refused_connections):
            farewell.close()

    # --- control's statements ------------------------------------------------------------------------------

    def _state(self, message: messages.RelayFact, descriptors: tuple[int, ...]) -> None:
        self._table.state(message)
        if isinstance(message, messages.NodePlaced):
            self.ports.open(message.key, descriptors[0])
        elif isinstance(message, messages.PublicationPlaced):
            self._place_topic(message.key, message.topic)
            self._limit_topic(message)
            relayed = self.topics[message.key, message.topic]
            self._ranks.place(message, relayed)
            relayed.upstream.silence(silent=message.silent)
            relayed.keep_open(kept=message.wanted)
        elif isinstance(message, messages.GrantInstalled):
            self._limit_subscriber(message)
        if self.waiting and message.key in self.waiting:
            self._recheck_waiting(message)

    def _restated(self, epoch: int) -> None:
        for fact in self._table.end(epoch):
            self._withdrawn(fact)
        self._reporter.repeat_connections()
        self._ranks.repeat()
        for topic in self.topics.values():
            topic.upstream.ask_again()
            topic.latch.repeat()
        self.interceptor.observations.repeat()

    def _withdrawn(self, fact: messages.Fact) -> None:
        match fact:
            case "node", gone:
                self.ports.close(gone)
                for key, topic in [entry for entry in self.topics if entry[0] == gone]:
                    self._remove_topic(key, topic, "the publisher's node is gone")
                for incoming in [one for one in self.incoming_connections if one.key == gone]:
                    self._incoming_failed(incoming, "")
                self._remove_services("the service's node is gone", gone)
            case "publication", key, topic:
                self._remove_topic(key, topic, "the topic is no longer published")
            case "grant", key, topic, host, caller_id:
                self._cut_by(("topic", key, topic, host, caller_id))
            case "service", key, service:
                self._remove_services("the service is no longer offered", key, service)
            case "client", key, service, host, caller_id:
                self._cut_by(("service", key, service, host, caller_id))

    def _cut_by(self, grant: PeerGrant) -> None:
        for peer in list(self._by_grant.get(grant, ())):
            peer.cut("its grant is revoked")

    def _remove_services(self, reason: str, key: str, service: str | None = None) -> None:
        for client in list(self.clients):
            if client.service.key == key and service in {None, client.service.service}:
                client.cut(reason)
        for entry in [entry for entry in self._services if entry[0] == key and service in {None, entry[1]}]:
            self.interceptor.shadow.understand(ObservationPoint(*entry), "")
            row = self._services.pop(entry).row(*entry)
            if row is not None:
                self._last_rows.append(row)

    def _place_topic(self, key: str, topic: str) -> None:
        if (key, topic) in self.topics:
            return
        node = self._table.node(key)
        name, host = (key, "") if node is None else (node.name, node.host)
        relayed = RelayedTopic(
            key,
            topic,
            name,
            host,
            grace=self._limits.queue_grace,
            clock=self._loop.clock,
            share=self.memory.latched.of(host),
            fresh=not self._table.restating,
            late=self._limits.late / 1000,
            limited=lambda part, messages, size: self._reporter.limited(
                (key, topic, part, host, name), messages, size
            ),
            make_room=lambda size: self.memory.latched.make_room(
                host, size, ((other.host, other.latch) for other in self.topics.values())
            ),
            refused=self._reporter.send,
            sink=self._sink,
            replayed=self._may_pass_again,
            over=self._loop.over,
            servers=self._servers.of,
        )
        if node is not None and node.monitors:
            relayed.upstream = self._own[topic] = OwnTopicPublisher(relayed, lambda: self._header_of(topic))
            relayed.monitor(None, wanted=True)
        else:
            relayed.upstream = PublisherConnection(self._context, relayed)
            self._attach_monitors(relayed)
        relayed.withhold(self.interceptor.mask(topic))
        self.topics[key, topic] = relayed
        waiting = self._servers.add(key, topic, name)
        for other in self.topics.values() if waiting else ():
            if other.topic in waiting:
                other.announce()

    def _limit_topic(self, message: messages.PublicationPlaced) -> None:
        relayed = self.topics[message.key, message.topic]
        own = self._flows.of(message.limit, message.topic, relayed.host, holder=message.key)
        together = self._flows.of(message.together, message.topic, holder=message.counted_as)
        relayed.limit(own, together)

    def _limit_subscriber(self, message: messages.GrantInstalled) -> None:
        flow = self._allowance(message)
        grant = ("topic", message.key, message.topic, message.host, message.caller_id)
        for subscriber in self._by_grant.get(grant, ()):
            if isinstance(subscriber, Subscriber):
                subscriber.limit(flow)

    def _allowance(self, grant: messages.GrantInstalled) -> RateAllowance | None:
        """Return the allowance of a grant; None for own topics, so motions cannot use up that of a guard's stop."""
        node = self._table.node(grant.key)
        if node is not None and node.monitors:
            return None
        return self._flows.of(grant.limit, grant.topic, grant.host, grant.caller_id)

    def _may_pass_again(self, relayed: RelayedTopic, body: memoryview) -> bool:
        if self.interceptor.is_stop(relayed.topic, bytes(body)):
            return True
        self.interceptor.refuse_replay(relayed.point, body)
        return False

    def _publications(self, topic: str) -> list[RelayedTopic]:
        return [
            relayed
            for relayed in self.topics.values()
            if relayed.topic == topic and isinstance(relayed.upstream, PublisherConnection)
        ]

    def _attach_monitors(self, relayed: RelayedTopic) -> None:
        interceptor, topic = self.interceptor, relayed.topic
        wanted, guarded = interceptor.wants(topic), interceptor.has_stoppers(topic)
        if interceptor.intercepts(topic):
            pipeline = TopicPipeline(interceptor, relayed.point)
            relayed.monitor(pipeline.through, wanted=wanted, call=pipeline.module_call, guarded=guarded)
        else:
            relayed.monitor(None, wanted=wanted)

    def _monitors_changed(self, topics: frozenset[str] | None) -> None:
        monitors = self.interceptor.monitors
        self._context.scratch.move(None if monitors is None else monitors.area)
        for relayed in list(self.topics.values()):
            relayed.upstream.recheck()
            relayed.withhold(self.interceptor.mask(relayed.topic))
            if isinstance(relayed.upstream, PublisherConnection):
                self._attach_monitors(relayed)
        for client in list(self.clients):
            client.recheck()
        self._ask_for_latched(topics)
        if self._link is not None and not self.interceptor.preparing:
            self._link.go_on()

    def _ask_for_latched(self, topics: frozenset[str] | None) -> None:
        """Request the messages that monitors held back, and let monitors judge the kept ones.

        This is for these topics only (None: all). On others, monitors would judge the same message twice.
        """
        for relayed in list(self.topics.values()):
            if topics is not None and relayed.topic not in topics:
                continue
            if relayed.lacks_latched:
                relayed.upstream.request_latched()
            elif not self.interceptor.holds(relayed.topic):
                relayed.judge_latched()

    def _release(self, message: messages.MonitorResumed | messages.RankFreed) -> None:
        if isinstance(message, messages.RankFreed):
            self._ranks.free(message.topic)
        else:
            self._ask_for_latched(self.interceptor.resume(message.name))

    def _own_topic(self, message: messages.OwnHeaderStated | messages.OwnPublished) -> None:
        if isinstance(message, messages.OwnPublished):
            self._publish(message.topic, message.data)
            return
        self._own_headers[message.topic] = {
            "type": message.type,
            "md5sum": message.md5sum,
            "message_definition": message.definition,
            "latching": "1" if message.latching else "0",
        }

    def _header_of(self, topic: str) -> dict[str, str] | None:
        return self.interceptor.header_of(topic) or self._own_headers.get(topic)

    def _publish(self, topic: str, data: bytes) -> None:
        publisher = self._own.get(topic)
        if publisher is not None:
            publisher.publish(data)
        if self.interceptor.has_stoppers(topic):
            commands, stop = topic, data if self.interceptor.is_stop(topic, data) else None
        elif topic.endswith("/cancel"):  # no message stops an action, but a goal must not be repeated
            commands, stop = topic.removesuffix("cancel") + "goal", None
        else:
            return
        for relayed in list(self.topics.values()):
            if relayed.topic == commands and relayed.upstream is not publisher:
                relayed.supersede(stop)

    def _deliver(self, topic: str, data: bytes) -> Sequence[TopicSubscriber]:
        """Publish a message on the appliance's own connections alone; return the subscribers that get it."""
        publisher = self._own.get(topic)
        if publisher is None:
            return ()
        publisher.publish(data)
        return publisher.members()

    def _unwritten_stop(self) -> str:
        """Return which subscriber has not taken the last stop of a guard, or an empty text."""
        for topic, publisher in self._own.items():
            if self.interceptor.has_stoppers(topic) and (waiting := publisher.waiting()):
                return f"{waiting} does not take the stop on {topic}"
        return ""

    def _remove_topic(self, key: str, topic: str, reason: str) -> None:
        relayed = self.topics.pop((key, topic), None)
        if relayed is None:
            return
        self._servers.remove(key, topic)
        if self._own.get(topic) is relayed.upstream:
            del self._own[topic]
        relayed.upstream.close()  # its remaining subscribers get nothing more
        relayed.latch.forget()  # a stop, which outlives its publisher's connection
        self.interceptor.shadow.understand(relayed.point, "")
        self._ranks.withdraw(key, topic)
        self.interceptor.invalidate_prepared()  # its pipeline's counts are collected once more, and then freed
        self._cut_members(relayed, reason)

    def _cut_members(self, relayed: RelayedTopic, reason: str) -> None:
        """Cut the subscribers, which may be thousands, one quantum at a time."""
        for member in relayed.members:
            member.cut(reason)
            if self._loop.over():
                self._loop.later(lambda: self._cut_members(relayed, reason), self._table.payer(relayed.host))
                return
        row = relayed.traffic()
        if row is not None:
            self._last_rows.append(row)

    def _upstream_answered(self, message: messages.UpstreamFound | messages.UpstreamRefused) -> None:
        placed = self.topics.get((message.key, message.topic))
        if placed is None:
            return
        if isinstance(message, messages.UpstreamFound):
            placed.upstream.found(message.host, message.port)
        else:
            placed.upstream.refused()

    # --- peers --------------------------------------------------------------------------------------------

    def _on_arrival(self, key: str, sock: socket.socket, host: str) -> None:
        incoming = IncomingConnection(
            self._context,
            sock,
            key,
            host,
            pending=self._pending,
            introduced=self._on_introduction,
            failed=self._incoming_failed,
        )
        self.incoming_connections.add(incoming)

    def _make_connection_room(self, host: str) -> bool:
        if self._pending.make_room(host):
            return True
        pool = self.ports.connected
        if not self._table.is_registered(host):
            return False
        largest, most = max(pool.holders(), key=lambda holder: holder[1], default=("", 0))
        if most <= pool.held(host) + 1:
            return False
        for member in self._served():
            if member.host == largest:
                member.cut("its host has the most connections, and the limit of connections was reached")
                return True
        return False

    def _served(self) -> Iterator[Subscriber | ServiceClient]:
        yield from list(self.clients)
        for relayed in self.topics.values():
            yield from [member for member in relayed.members if isinstance(member, Subscriber)]

    def _incoming_failed(self, incoming: IncomingConnection, reason: str) -> None:
        incoming.close()
        self._forget_incoming(incoming)
        self.ports.left(incoming.host)
        fields = incoming.fields
        if fields and not reason and not self._context.unsettled:
            reason = missing(self._table, incoming.key, incoming.host, fields)
        if reason:
            caller_id = fields.get("callerid", "")
            self._reporter.refused(incoming.key, asked_for(fields), incoming.host, caller_id, reason)

    def _on_introduction(self, incoming: IncomingConnection) -> None:
        if self._link is not None:
            self._link.catch_up()
        if incoming in self.incoming_connections:
            self._judge(incoming, patient=True)

    def _judge(self, incoming: IncomingConnection, *, patient: bool) -> None:
        fields, rest = incoming.fields, incoming.rest
        reason = flaw(fields, rest)
        if not reason:
            reason = missing(self._table, incoming.key, incoming.host, fields)
            if reason and (patient or self._context.unsettled):
                incoming.wait(self._limits.grant_seconds, lambda: self._judge(incoming, patient=False))
                self.waiting.setdefault(incoming.key, {}).setdefault(incoming.host, set()).add(incoming)
                return
        self._forget_incoming(incoming)
        sock = incoming.take()
        if reason:
            kind, name = asked_for(fields)
            asked = (kind, incoming.key, name, incoming.host, fields.get("callerid", ""))
            self._refuse(asked, sock, reason)
        elif "topic" in fields:
            self._subscribe(incoming, sock, peer_fields(fields))
        else:
            self._serve_client(incoming, sock, peer_fields(fields), rest)

    def _recheck_waiting(self, message: messages.RelayFact) -> None:
        hosts = self.waiting[message.key]
        if isinstance(message, messages.GrantInstalled | messages.ClientGranted):
            found = list(hosts.get(message.host, ()))
        else:
            found = [incoming for waiting in hosts.values() for incoming in waiting]
        for incoming in found:
            if not missing(self._table, message.key, incoming.host, incoming.fields):
                self._judge(incoming, patient=True)

    def _forget_incoming(self, incoming: IncomingConnection) -> None:
        self.incoming_connections.discard(incoming)
        hosts = self.waiting.get(incoming.key, {})
        waiting = hosts.get(incoming.host)
        if waiting is not None:
            waiting.discard(incoming)
            if not waiting:
                del hosts[incoming.host]
            if not hosts:
                del self.waiting[incoming.key]

    def _serve_client(
        self, incoming: IncomingConnection, sock: socket.socket, fields: Mapping[str, str], rest: bytes
    ) -> None:
        service = self._table.service(incoming.key, fields["service"])
        caller_id = bound_name(self._table, incoming.key, incoming.host, fields)
        if service is None or caller_id is None:  # excluded by `missing`
            return
        client = ServiceClient(
            self._context,
            sock,
            service,
            incoming.host,
            fields,
            caller_id=caller_id,
            traffic=self._services.setdefault((service.key, service.service), ServiceTraffic()),
            calls=self._calls,
            refuse=self._peer_refused,
            ended=self._peer_ended,
        )
        self.clients.add(client)
        self._by_grant.setdefault(client.grant, set()).add(client)
        client.start(rest)

    def _subscribe(
        self, incoming: IncomingConnection, sock: socket.socket, fields: Mapping[str, str]
    ) -> None:
        relayed = self.topics[incoming.key, fields["topic"]]
        refuse, ended = self._peer_refused, self._peer_ended
        subscriber = Subscriber(
            self._context, sock, relayed, incoming.host, fields, refuse=refuse, ended=ended
        )
        stated = self._table.grant(incoming.key, relayed.topic, incoming.host, subscriber.caller_id)
        if stated is not None:
            subscriber.limit(self._allowance(stated))
        self._by_grant.setdefault(subscriber.grant, set()).add(subscriber)
        relayed.join(subscriber)

    def _peer_ended(self, peer: Subscriber | ServiceClient) -> None:
        self._forget(peer)
        self.ports.left(peer.host)

    def _peer_refused(self, peer: Subscriber | ServiceClient, sock: socket.socket, reason: str) -> None:
        self._forget(peer)
        self._refuse(peer.grant, sock, reason)

    def _forget(self, peer: Subscriber | ServiceClient) -> None:
        if isinstance(peer, ServiceClient):
            self.clients.discard(peer)
        peers = self._by_grant.get(peer.grant, set())
        peers.discard(peer)
        if not peers:
            self._by_grant.pop(peer.grant, None)

    def _refuse(self, asked: PeerGrant, sock: socket.socket, reason: str) -> None:
        """Refuse the peer; its connection counts for its host until it is closed."""
        kind, key, name, host, caller_id = asked
        self._reporter.refused(key, (kind, name), host, caller_id, reason)
        farewell = RefusedConnection(self._context, sock, host, reason, self._refused_left)
        if farewell.live:
            self.refused_connections.add(farewell)
            self._pending.enter(farewell, host)

    def _refused_left(self, farewell: RefusedConnection) -> None:
        self.refused_connections.discard(farewell)
        self._pending.leave(farewell)
        self.ports.left(farewell.host)

    def _rows(self) -> list[messages.TopicTraffic]:
        of_topics = (self._traffic(topic) for topic in self.topics.values())
        of_services = (service.row(*entry) for entry, service in self._services.items())
        rows = [*self._last_rows, *filter(None, of_topics), *filter(None, of_services)]
        self._last_rows = []
        return rows

    def _traffic(self, topic: RelayedTopic) -> messages.TopicTraffic | None:
        longest, row = topic.counters.longest / 1e9, topic.traffic()
        if row is not None and row.delays and (judges := self.interceptor.judges(topic.topic)):
            what = f"a message of {topic.topic}"
            self.interceptor.observer.count_times(judges, what, sum(row.delays), longest, late=0)
        return row

    def _tick(self) -> None:
        self._tidying = enumerate([*self.topics.values(), *self.clients])
        self._go_on_tidying()

    def _go_on_tidying(self) -> None:
        for number, part in self._tidying:
            part.tidy()
            if not number % _TIDIED and self._loop.over():
                self._loop.after(0, self._go_on_tidying)
                return
        self._calls.own.tidy()
        self.interceptor.tick()
        self._reporter.tick(self._rows, self.memory.bytes_held())
        self._loop.after(self._limits.report_every, self._tick)
