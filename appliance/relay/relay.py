"""The relay: carries out what control states, and puts peers, topics and services together.

It decides nothing. Control's messages change the `StatedTable` and what hangs on it; a peer is served when
the table has a grant for the address it comes from, the `callerid` it claims and the topic (or service) it
asks for.

Invariants:
- A connection that is served stands on a statement in the table; the withdrawal of that statement cuts it.
- Without a link to control everything goes on as stated before; nothing new is granted.
- What control states after the first specifications, or those that it begins with, is carried out when they are in
  force, in order.
"""

import os
import socket
from collections import deque
from collections.abc import Iterator, Mapping

from appliance.channel import messages
from appliance.quotas.pool import Standing
from appliance.relay.bounds import Limits
from appliance.relay.connections.admission import NOTHING, asked_for, bound_name, flaw, missing
from appliance.relay.connections.frames import Scratch
from appliance.relay.connections.headers import kept
from appliance.relay.connections.listening_ports import Ports
from appliance.relay.connections.loop_channel import Link
from appliance.relay.connections.memory import Memory
from appliance.relay.connections.own_service import OwnService
from appliance.relay.connections.pending_connections import Anteroom
from appliance.relay.connections.rate_limit import Flows
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.connections.service_client import ServiceClient, ServiceTraffic
from appliance.relay.connections.sockets import tune
from appliance.relay.connections.subscriber import Subscriber
from appliance.relay.connections.upstream import Publisher
from appliance.relay.connections.visitor import Farewell, Visitor
from appliance.relay.context import RelayContext
from appliance.relay.granted import StatedTable, Statement
from appliance.relay.loop import Loop
from appliance.relay.monitors.interceptor import Middle
from appliance.relay.monitors.observation_points import Place
from appliance.relay.monitors.own import OwnPublisher
from appliance.relay.recorder_ring import Recorded
from appliance.relay.report import Reporter
from appliance.relay.topic_taps import Looks

_TIDIED = 16  # topics between two readings of the processor time
_Grant = tuple[str, str, str, str, str]  # kind, key, name of the topic or service, host, caller id


class Engine:
    """One relay, without the process around it."""

    def __init__(self, loop: Loop, limits: Limits) -> None:
        self._loop = loop
        self._limits = limits
        self._reporter = Reporter(limits)
        self._table = StatedTable()
        self.middle = Middle(
            loop,
            self._reporter,
            budget=limits.budget / 1000,
            publish=lambda published: self._publish(published.topic, published.data),
            changed=self._monitors_changed,
            holder=self._holder,
            payer=self._table.payer,
        )
        self.memory = Memory.of(limits, self._table.standing)
        self._context = RelayContext(
            loop, limits, self._reporter, self.memory, Scratch(), self.middle, self._table.payer
        )
        self._anteroom = Anteroom(loop.clock, self._table.standing, self.memory.headers)
        self.ports = Ports(
            loop,
            limits,
            standing=self._table.standing,
            payer=self._table.payer,
            arrived=self._arrived,
            turned_away=lambda key, host, reason: self._reporter.refused(key, NOTHING, host, "", reason),
            make_room=self._make_place,
        )
        self.topics: dict[tuple[str, str], tuple[RelayedTopic, Publisher | OwnPublisher]] = {}
        self._own: dict[str, OwnPublisher] = {}
        self._own_headers: dict[str, dict[str, str]] = {}
        self._own_service = OwnService(loop, self._reporter.send)
        self.clients: set[ServiceClient] = set()
        self._by_grant: dict[_Grant, set[Subscriber | ServiceClient]] = {}
        self._services: dict[tuple[str, str], ServiceTraffic] = {}
        self.visitors: set[Visitor] = set()
        self.waiting: dict[str, set[Visitor]] = {}
        self.farewells: set[Farewell] = set()
        self._link: Link | None = None
        self._last_rows: list[messages.TopicTraffic] = []
        self._flows = Flows(loop.clock)
        self._looks = Looks(self._reporter.send)
        self._recorded: Recorded | None = None
        self._later: deque[tuple[messages.Message, tuple[int, ...]]] = deque()
        self._tidying: Iterator[None] = iter(())
        loop.after(limits.report_every, self._tick)

    def attach(self, link: Link | None) -> None:
        """Speak to this control from now on; what is stated stays until it restates."""
        self._link = link
        self._reporter.attach(link)
        self._looks.end_all()
        self._own_service.control_gone()

    def record(self, recorded: Recorded) -> None:
        """Leave what publishers say from their next connection on with the flight recorder."""
        self._recorded = recorded

    def take(self, message: messages.Message, descriptors: tuple[int, ...]) -> None:
        """Carry out one message of control."""
        if self.middle.preparing or self._later:
            self._later.append((message, descriptors))
        else:
            self._carry_out(message, descriptors)

    def _carry_out(self, message: messages.Message, descriptors: tuple[int, ...]) -> None:
        if isinstance(message, messages.StateBegan):
            self._table.begin(message.epoch)
        elif isinstance(message, messages.StateEnded):
            self._restated(message.epoch)
        elif isinstance(message, Statement):
            self._state(message, descriptors)
        elif isinstance(message, messages.UpstreamFound | messages.UpstreamRefused):
            self._upstream_answered(message)
        elif isinstance(message, messages.SpecificationsStated):
            self.middle.state(message)
        elif isinstance(message, messages.MonitorSwitched):
            self.middle.switch(message.name, message.enabled)
        elif isinstance(message, messages.MonitorResumed):
            self._ask_for_latched(self.middle.resume(message.name))
        elif isinstance(message, messages.LookWanted | messages.LookEnded):
            self._look(message)
        elif isinstance(message, messages.OwnHeaderStated | messages.OwnPublished):
            self._own_topic(message)
        elif isinstance(message, messages.OwnServiceAnswered):
            self._own_service.answered(message)
        elif isinstance(message, messages.OrdersAsked):
            self._reporter.send(messages.OrdersCarriedOut())
        else:
            self._table.withdraw(message)
            self._withdrawn(message)

    def close(self) -> None:
        """Cut everything."""
        self.middle.close()
        for _message, descriptors in self._later:
            for descriptor in descriptors:
                os.close(descriptor)
        self._later.clear()
        self.ports.close_all()
        for topic, publisher in self.topics.values():
            topic.cut_all("the relay ends")
            publisher.close()
        for client in list(self.clients):
            client.cut("the relay ends")
        for visitor in self.visitors:
            visitor.close()
        for farewell in list(self.farewells):
            farewell.close()

    # --- what control states ------------------------------------------------------------------------------

    def _state(self, message: Statement, descriptors: tuple[int, ...]) -> None:
        self._table.state(message)
        if isinstance(message, messages.NodePlaced):
            self.ports.open(message.key, descriptors[0])
        elif isinstance(message, messages.PublicationPlaced):
            self._place_topic(message.key, message.topic)
            self._limit_topic(message)
        elif isinstance(message, messages.GrantInstalled):
            self._limit_subscriber(message)
        if self.waiting and message.key in self.waiting:
            self._judge_waiting(message.key)

    def _restated(self, epoch: int) -> None:
        for message in self._table.end(epoch):
            self._withdrawn(message)
        self._reporter.repeat_connections()
        for topic, publisher in self.topics.values():
            publisher.ask_again()
            topic.repeat()
        self.middle.observations.repeat()

    def _withdrawn(self, message: messages.Message) -> None:
        if isinstance(message, messages.NodeWithdrawn):
            self.ports.close(message.key)
            for key, topic in [entry for entry in self.topics if entry[0] == message.key]:
                self._remove_topic(key, topic, "the publisher's node is gone")
            for visitor in [visitor for visitor in self.visitors if visitor.key == message.key]:
                self._visitor_failed(visitor, "")
            self._cut_clients("the service's node is gone", message.key)
            self._forget_services(message.key)
        elif isinstance(message, messages.PublicationWithdrawn):
            self._remove_topic(message.key, message.topic, "the topic is published no longer")
        elif isinstance(message, messages.GrantRevoked):
            self._cut_by(("topic", message.key, message.topic, message.host, message.caller_id))
        elif isinstance(message, messages.ServiceWithdrawn):
            self._cut_clients("the service is offered no longer", message.key, message.service)
            self._forget_services(message.key, message.service)
        elif isinstance(message, messages.ClientRevoked):
            self._cut_by(("service", message.key, message.service, message.host, message.caller_id))

    def _cut_by(self, grant: _Grant) -> None:
        for peer in list(self._by_grant.get(grant, ())):
            peer.cut("its grant is revoked")

    def _cut_clients(self, reason: str, key: str, service: str | None = None) -> None:
        for client in list(self.clients):
            if client.service.key == key and service in {None, client.service.service}:
                client.cut(reason)

    def _forget_services(self, key: str, service: str | None = None) -> None:
        for entry in [entry for entry in self._services if entry[0] == key and service in {None, entry[1]}]:
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
            limited=lambda part, messages, size: self._reporter.limited(
                (key, topic, part, host, name), messages, size
            ),
            make_room=lambda size: self._make_room(host, size),
            refused=self._reporter.send,
            recorded=self._recorded,
            over=self._loop.over,
        )
        publisher: Publisher | OwnPublisher
        if node is not None and node.monitors:
            publisher = self._own[topic] = OwnPublisher(relayed, lambda: self._header_of(topic))
            relayed.upstream = publisher
            relayed.monitor(None, wanted=True)
        else:
            publisher = Publisher(self._context, relayed, lambda header: self.middle.objection(topic, header))
            relayed.upstream = publisher
            self._let_monitor(relayed)
        self.topics[key, topic] = (relayed, publisher)

    def _limit_topic(self, message: messages.PublicationPlaced) -> None:
        relayed, _publisher = self.topics[message.key, message.topic]
        own = self._flows.of(message.limit, message.topic, relayed.host, holder=message.key)
        together = self._flows.of(message.together, message.topic, holder=message.counted_as)
        relayed.flow.set(own, together)

    def _limit_subscriber(self, message: messages.GrantInstalled) -> None:
        """Limit the connections of this grant so from now on."""
        flow = self._flows.of(message.limit, message.topic, message.host, message.caller_id)
        grant = ("topic", message.key, message.topic, message.host, message.caller_id)
        for subscriber in self._by_grant.get(grant, ()):
            if isinstance(subscriber, Subscriber):
                subscriber.flow = flow

    def _make_room(self, host: str, size: int) -> None:
        """A host wants to have a message latched: those that have more than it would have make room."""
        latched, share = self.memory.latched, self.memory.latched.of(host)
        while share.refusal(size):
            greatest, held = max(latched.holders(), key=lambda holder: holder[1], default=("", 0))
            of_greatest = (topic for topic, _publisher in self.topics.values() if topic.host == greatest)
            largest = max(of_greatest, key=lambda topic: topic.latched, default=None)
            if held <= share.used + size or largest is None or not largest.latched:
                return
            largest.give_up_latched()

    def _let_monitor(self, relayed: RelayedTopic) -> None:
        """Messages of a topic go through the monitors if one stands there, and past them otherwise."""
        middle, topic = self.middle, relayed.topic
        place = Place(relayed.key, topic, relayed.host, relayed.name)
        through = middle.lane(place).through if middle.stands(topic) else None
        relayed.monitor(through, wanted=middle.wants(topic))

    def _holder(self, host: str) -> str:
        """A host that has a registration is told apart; all others are one."""
        return host if self._table.standing(host) is Standing.REGISTERED else ""

    def _monitors_changed(self, topics: frozenset[str] | None) -> None:
        monitors = self.middle.monitors
        self._context.scratch.move(None if monitors is None else monitors.area)
        for relayed, publisher in list(self.topics.values()):
            publisher.judge_again()
            if isinstance(publisher, Publisher):
                self._let_monitor(relayed)
        for client in list(self.clients):
            client.judge_again()
        self._ask_for_latched(topics)
        while self._later and not self.middle.preparing:
            self._carry_out(*self._later.popleft())

    def _ask_for_latched(self, topics: frozenset[str] | None) -> None:
        """What monitors kept back of a latching publisher may go through now: it gives it to a new connection.

        Only of these topics (None: all); what did not change would judge the same message twice.
        """
        for relayed, publisher in list(self.topics.values()):
            concerned = topics is None or relayed.topic in topics
            if concerned and relayed.lacks_latched and isinstance(publisher, Publisher):
                publisher.give_again()

    def _own_topic(self, message: messages.OwnHeaderStated | messages.OwnPublished) -> None:
        if isinstance(message, messages.OwnPublished):
            self._publish(message.topic, message.data)
            return
        self._own_headers[message.topic] = {
            "type": message.type,
            "md5sum": message.md5sum,
            "message_definition": message.definition,
            "latching": "0",
        }

    def _header_of(self, topic: str) -> dict[str, str] | None:
        """The connection header of what the appliance publishes: of the monitors' definitions, or as control says."""
        return self.middle.header_of(topic) or self._own_headers.get(topic)

    def _publish(self, topic: str, data: bytes) -> None:
        """Between two messages, or in the middle of a batch of another topic: never of this one."""
        publisher = self._own.get(topic)
        if publisher is not None:
            publisher.publish(data)

    def _remove_topic(self, key: str, topic: str, reason: str) -> None:
        if (key, topic) not in self.topics:
            return
        relayed, publisher = self.topics.pop((key, topic))
        if self._own.get(topic) is publisher:
            del self._own[topic]
        publisher.close()  # nothing more comes to those that are still connected
        self._cut_members(relayed, reason)

    def _cut_members(self, relayed: RelayedTopic, reason: str) -> None:
        """Close the connections for a topic that is gone, a quantum at a time: there may be thousands."""
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
            placed[1].found(message.host, message.port)
        else:
            placed[1].refused()

    def _look(self, message: messages.LookWanted | messages.LookEnded) -> None:
        if isinstance(message, messages.LookWanted):
            topics = [topic for topic, _publisher in self.topics.values() if topic.topic == message.topic]
            self._looks.begin(message, topics)
        else:
            self._looks.end(message.number)

    # --- peers --------------------------------------------------------------------------------------------

    def _arrived(self, key: str, sock: socket.socket, host: str) -> None:
        try:
            tune(sock)
        except OSError:
            sock.close()
            self.ports.left(host)
            return
        visitor = Visitor(
            self._context,
            sock,
            key,
            host,
            payer=self._table.payer(host),
            anteroom=self._anteroom,
            introduced=self._introduced,
            failed=self._visitor_failed,
        )
        self.visitors.add(visitor)

    def _make_place(self, host: str) -> bool:
        """End a connection so that one of this host has room: of a peer that waits, else of the host that has most."""
        if self._anteroom.make_room(host):
            return True
        pool = self.ports.connected
        if self._table.standing(host) is not Standing.REGISTERED:
            return False
        largest, most = max(pool.holders(), key=lambda holder: holder[1], default=("", 0))
        if most <= pool.held(host) + 1:
            return False
        for member in self._served():
            if member.host == largest:
                member.cut("its host has most connections, and there was no room for others")
                return True
        return False

    def _served(self) -> Iterator[Subscriber | ServiceClient]:
        yield from list(self.clients)
        for relayed, _publisher in self.topics.values():
            yield from [member for member in relayed.members if isinstance(member, Subscriber)]

    def _visitor_failed(self, visitor: Visitor, reason: str) -> None:
        """It is gone. What one asked for without a grant is recorded, although it did not wait for the answer."""
        visitor.close()
        self._forget_visitor(visitor)
        self.ports.left(visitor.host)
        fields = visitor.fields
        if fields and not reason and not self._not_all_is_stated():
            reason = missing(self._table, visitor.key, visitor.host, fields)
        if reason:
            caller_id = fields.get("callerid", "")
            self._reporter.refused(visitor.key, asked_for(fields), visitor.host, caller_id, reason)

    def _introduced(self, visitor: Visitor) -> None:
        if self._link is not None:
            self._link.catch_up()
        if visitor in self.visitors:
            self._judge(visitor, patient=True)

    def _judge(self, visitor: Visitor, *, patient: bool) -> None:
        """Serve the visitor, or refuse it; a `patient` one waits for what the table does not have yet."""
        fields, rest = visitor.fields, visitor.rest
        reason = flaw(fields, rest)
        if not reason:
            reason = missing(self._table, visitor.key, visitor.host, fields)
            if reason and (patient or self._not_all_is_stated()):
                visitor.wait(self._limits.grant_seconds, lambda: self._judge(visitor, patient=False))
                self.waiting.setdefault(visitor.key, set()).add(visitor)
                return
        self._forget_visitor(visitor)
        sock = visitor.take()
        if reason:
            self._refuse(visitor, asked_for(fields), fields.get("callerid", ""), sock, reason)
        elif "topic" in fields:
            self._subscribe(visitor, sock, kept(fields))
        else:
            self._serve_client(visitor, sock, kept(fields), rest)

    def _not_all_is_stated(self) -> bool:
        """Whether a grant that is missing may still be stated, however long that takes."""
        return self._table.restating or self.middle.preparing

    def _judge_waiting(self, key: str) -> None:
        """Something new is stated of this incarnation: peers that can be served now are."""
        for visitor in list(self.waiting.get(key, ())):
            if not missing(self._table, key, visitor.host, visitor.fields):
                self._judge(visitor, patient=True)

    def _forget_visitor(self, visitor: Visitor) -> None:
        self.visitors.discard(visitor)
        waiting = self.waiting.get(visitor.key)
        if waiting is not None:
            waiting.discard(visitor)
            if not waiting:
                del self.waiting[visitor.key]

    def _serve_client(
        self, visitor: Visitor, sock: socket.socket, fields: Mapping[str, str], rest: bytes
    ) -> None:
        service = self._table.service(visitor.key, fields["service"])
        caller_id = bound_name(self._table, visitor.key, visitor.host, fields)
        if service is None or caller_id is None:  # `missing` has looked
            return
        node = self._table.node(visitor.key)
        traffic = self._services.setdefault((service.key, service.service), ServiceTraffic())

        grant = ("service", service.key, service.service, visitor.host, caller_id)

        def refuse(sock: socket.socket, reason: str) -> None:
            self._forget(grant, client)
            self._refuse(visitor, ("service", service.service), caller_id, sock, reason)

        def ended() -> None:
            self._forget(grant, client)
            self.ports.left(visitor.host)

        client = ServiceClient(
            self._context,
            sock,
            service,
            visitor.host,
            fields,
            caller_id=caller_id,
            traffic=traffic,
            refuse=refuse,
            ended=ended,
            own=self._own_service if node is not None and node.monitors else None,
        )
        self.clients.add(client)
        self._by_grant.setdefault(grant, set()).add(client)
        client.start(rest)

    def _subscribe(self, visitor: Visitor, sock: socket.socket, fields: Mapping[str, str]) -> None:
        relayed, _publisher = self.topics[visitor.key, fields["topic"]]
        grant = ("topic", visitor.key, relayed.topic, visitor.host, fields["callerid"])

        def refuse(sock: socket.socket, reason: str) -> None:
            self._forget(grant, subscriber)
            self._refuse(visitor, ("topic", relayed.topic), fields["callerid"], sock, reason)

        def ended() -> None:
            self._forget(grant, subscriber)
            self.ports.left(visitor.host)

        subscriber = Subscriber(
            self._context, sock, relayed, visitor.host, fields, refuse=refuse, ended=ended
        )
        stated = self._table.grant(visitor.key, relayed.topic, visitor.host, subscriber.caller_id)
        if stated is not None:
            subscriber.flow = self._flows.of(stated.limit, relayed.topic, stated.host, stated.caller_id)
        self._by_grant.setdefault(grant, set()).add(subscriber)
        relayed.join(subscriber)

    def _forget(self, grant: _Grant, peer: Subscriber | ServiceClient) -> None:
        if isinstance(peer, ServiceClient):
            self.clients.discard(peer)
        peers = self._by_grant.get(grant, set())
        peers.discard(peer)
        if not peers:
            self._by_grant.pop(grant, None)

    def _refuse(
        self, visitor: Visitor, asked: tuple[str, str], caller_id: str, sock: socket.socket, reason: str
    ) -> None:
        """Tell the peer why and close; it counts for its host until then."""
        self._reporter.refused(visitor.key, asked, visitor.host, caller_id, reason)

        def ended(farewell: Farewell) -> None:
            self.farewells.discard(farewell)
            self._anteroom.leave(farewell)
            self.ports.left(visitor.host)

        payer = self._table.payer(visitor.host)
        farewell = Farewell(self._loop, sock, reason, self._limits.farewell, ended, payer=payer)
        if farewell.live:
            self.farewells.add(farewell)
            self._anteroom.enter(farewell, visitor.host)

    def _rows(self) -> list[messages.TopicTraffic]:
        """What went through since the last call."""
        rows = [row for topic, _publisher in self.topics.values() if (row := topic.traffic()) is not None]
        rows += [
            row
            for (key, name), service in self._services.items()
            if (row := service.row(key, name)) is not None
        ]
        rows, self._last_rows = self._last_rows + rows, []
        return rows

    def _tick(self) -> None:
        """A second is over."""
        self._tidying = self._tidy()
        self._go_on_tidying()

    def _go_on_tidying(self) -> None:
        """Tidy up for a quantum at a time: there may be thousands of topics."""
        for _ in self._tidying:
            if self._loop.over():
                self._loop.after(0, self._go_on_tidying)
                return
        self._own_service.tidy()
        self.middle.tick()
        self._reporter.tick(self._rows, self.memory.held())
        self._loop.after(self._limits.report_every, self._tick)

    def _tidy(self) -> Iterator[None]:
        for number, (topic, publisher) in enumerate(list(self.topics.values())):
            topic.tidy()
            if isinstance(publisher, Publisher):
                publisher.look()
            if not number % _TIDIED:
                yield
        for number, client in enumerate(list(self.clients)):
            client.look()
            if not number % _TIDIED:
                yield
