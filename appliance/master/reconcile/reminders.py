"""After a relay is new: subscribers that do not come back are told their lists again, a few times.

rospy forgets a connection that broke and opens another only for a list that arrives *after* it saw the break; a list
that overtakes the break (the machine is busy, the relay hung before it died) changes nothing, and there would never
be another. roscpp comes back by itself to a port that stayed open; where it was shut for a while (the whole appliance
was restarted) it gives up, and takes a list it knows for no news. So who is still away after the first reminders is
told to drop the publisher and to take it again. So is who has no grant any more: the policy took it, and gave the topic
back, while the subscriber or control did not hear of it.
"""

import asyncio

from appliance.master.graph.graph import Graph
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.enactor import Enactor

_GENTLE = 2  # reminders before the publisher is to be dropped and taken again
_PAUSES = (0.5, 0.5, 1.0, 1.0, 2.0, 4.0, 8.0, 16.0)  # seconds before each look


class Reminders:
    """Looks whether everybody is back whenever a relay was attached."""

    def __init__(self, registry: Registry, graph: Graph, enactor: Enactor) -> None:
        self._registry = registry
        self._graph = graph
        self._enactor = enactor
        self.round: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """A relay is new."""
        self.close()
        self.round = asyncio.get_running_loop().create_task(self._remind())

    def close(self) -> None:
        """Stop looking."""
        if self.round is not None:
            self.round.cancel()

    async def _remind(self) -> None:
        for number, pause in enumerate(_PAUSES):
            await asyncio.sleep(pause)
            absent = list(self._graph.absent(self._registry.live()))
            if not absent:
                return
            for subscriber, topic, publishers in absent:
                self._enactor.carry_out(
                    self._graph.renew(subscriber, topic, publishers if number >= _GENTLE else ())
                )
