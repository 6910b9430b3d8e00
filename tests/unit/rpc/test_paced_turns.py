"""Who owes for its audit records waits before it takes a slot; the others do not notice."""

import asyncio
import ipaddress

from appliance.rpc.paced_turns import PacedTurns
from appliance.shares.pool import Bounds, Standing

GUEST = ipaddress.ip_address("10.0.0.66")
ROBOT = ipaddress.ip_address("10.0.0.1")
WAIT = 20.0


def test_who_owes_waits_outside_the_slots() -> None:
    """However many requests of a host in debt wait, every slot is free for others; paid, they are served."""

    async def test() -> None:
        debts = {str(GUEST): 0.01}
        bounds = Bounds(1, 1, 0, 0)
        turns = PacedTurns(bounds, lambda _host: Standing.REGISTERED, lambda host: debts.get(host, 0.0))
        waiting = [asyncio.create_task(turns.enter(GUEST)) for _ in range(50)]
        for _ in range(100):
            async with asyncio.timeout(WAIT):
                await turns.enter(ROBOT)
            turns.leave(ROBOT)
            await asyncio.sleep(0)
        assert not any(task.done() for task in waiting)
        debts.clear()
        for _ in waiting:
            async with asyncio.timeout(WAIT):
                await asyncio.wait(
                    [task for task in waiting if not task.done()] or waiting, return_when="FIRST_COMPLETED"
                )
            turns.leave(GUEST)
        async with asyncio.timeout(WAIT):
            await asyncio.gather(*waiting)

    asyncio.run(test())
