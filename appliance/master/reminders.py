"""After a relay is new: subscribers that do not come back are told their lists again, a few times.

rospy forgets a connection that broke and opens another only for a list that arrives *after* it saw the break; a list
that overtakes the break (the machine is busy, the relay hung before it died) changes nothing, and there would never
be another. roscpp comes back by itself and takes a list it knows for no news, so reminding it costs nothing.
"""

import asyncio

from appliance.master.graph import Graph
from appliance.master.registry import Incarnation, Kind, Registry
from appliance.master.relays import RelayControl

_PAUSES = (0.5, 0.5, 1.0, 1.0, 2.0, 4.0, 8.0, 16.0)  # seconds before each look


class Reminders:
    """Looks whether everybody is back whenever a relay was attached."""

    def __init__(self, registry: Registry, relay: RelayControl, graph: Graph) -> None:
        self._registry = registry
        self._relay = relay
        self._graph = graph
        self._round: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """A relay is new."""
        self.close()
        self._round = asyncio.get_running_loop().create_task(self._remind())

    def close(self) -> None:
        """Stop looking."""
        if self._round is not None:
            self._round.cancel()

    async def _remind(self) -> None:
        for pause in _PAUSES:
            await asyncio.sleep(pause)
            absent = self.absent()
            if not absent:
                return
            for subscriber, topic in absent:
                self._graph.remind(subscriber, topic)

    def absent(self) -> list[tuple[Incarnation, str]]:
        """Subscribers, and their topics, that hold a grant and are not connected."""
        found = {}
        for row in self._relay.unconnected():
            for subscriber in self._registry.registered(Kind.SUBSCRIPTION, row.resource):
                if subscriber.name == row.caller_id and str(subscriber.host) == row.host:
                    found[subscriber.key, row.resource] = subscriber
        return [(subscriber, topic) for (_key, topic), subscriber in found.items()]
