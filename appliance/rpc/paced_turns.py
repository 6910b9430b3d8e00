"""Turns in which a host that owes for its audit records waits until it has paid.

It waits before it takes a slot: whoever waits for his own debt keeps nothing that others need.
"""

import asyncio
from collections.abc import Callable, Hashable

from appliance.policy.model import Address
from appliance.rpc.turns import Turns, itself
from appliance.shares.pool import Bounds, Standing


class PacedTurns(Turns):
    """`pause(host)` is for how many seconds this host waits before it is asked again; 0 when it need not."""

    def __init__(
        self,
        bounds: Bounds,
        standing: Callable[[Address], Standing],
        pause: Callable[[str], float],
        alike: Callable[[Address], Hashable] = itself,
    ) -> None:
        super().__init__(bounds, standing, alike)
        self._pause = pause

    async def enter(self, host: Address) -> None:
        """Take a slot, once this host's records are paid, waiting for its turn when there is none."""
        while seconds := self._pause(str(host)):
            await asyncio.sleep(seconds)
        await super().enter(host)
