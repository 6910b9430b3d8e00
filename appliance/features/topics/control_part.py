"""Build the part of control for topics."""

from appliance.base.clock import now
from appliance.control.core import ControlPart, Core, GraphFacts, RelayOrders
from appliance.control.errors import SenselessError, UnavailableError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.topics.requests import TopicLook, TopicMessage, TopicMessages
from appliance.telemetry.audit_trail import AuditTrail

# Show operators the next messages of a topic, from the relay that carries it. Each look is recorded.

ONE_LOOK = 60.0
"""The seconds for which all queries of one token for one topic make only one audit record."""


class TopicLooks:
    """Answers `TopicLook`."""

    def __init__(self, graph: GraphFacts, relay: RelayOrders, trail: AuditTrail) -> None:
        self._graph = graph
        self._relay = relay
        self._trail = trail
        self._shown: dict[tuple[str, str], float] = {}

    async def messages(self, request: TopicLook, who: str) -> TopicMessages:
        topic = self._graph.topic(request.topic)
        if not topic.mediated:
            raise SenselessError(
                f"the messages of {topic.name} do not pass the appliance (relaying: monitored), so it cannot show them"
            )
        self._record_look(topic.name, who)
        failure = await self._trail.durable()
        if failure is not None:
            raise UnavailableError(f"no message is shown while the look cannot be recorded: {failure}")
        seen = await self._relay.look(
            topic.name, request.messages, request.seconds, who, latched=request.latched
        )
        rows = [
            TopicMessage(
                message.time, self._graph.name_of(message.key), message.size, message.fields, message.why
            )
            for message in seen
        ]
        return TopicMessages(
            topic.name,
            seen[0].type if seen else topic.type,
            [publisher.node for publisher in topic.publishers],
            topic.subscribers,
            rows,
        )

    def _record_look(self, topic: str, who: str) -> None:
        """Record only the first of equal queries within `ONE_LOOK`, because a plot in the console polls."""
        moment = now()
        for key in [key for key, since in self._shown.items() if moment - since >= ONE_LOOK]:
            del self._shown[key]
        if (who, topic) in self._shown:
            return
        self._shown[who, topic] = moment
        self._trail.happened(
            "topic looked into",
            f"messages of {topic} are shown, for {ONE_LOOK:g} seconds from now",
            category="topic",
            resource=topic,
            who=who,
            seconds=ONE_LOOK,
        )


async def begin(core: Core) -> ControlPart:
    looks = TopicLooks(core.graph, core.relay, core.trail)
    return ControlPart((RequestMethod(TopicLook, looks.messages, who=True, order=False),))
