import asyncio
from contextlib import suppress

import pytest

from appliance.channel.messages import MessageSeen
from appliance.master.endpoints.topic_taps_control import TapRequests, TooManyTapsError
from appliance.quotas.table import TOPIC_LOOKS

pytestmark = pytest.mark.anyio


async def test_the_queries_of_one_person_leave_some_for_others() -> None:
    taps = TapRequests(lambda _topic: 0, lambda _message, _relay: True)
    looks: list[asyncio.Task[list[MessageSeen]]] = []

    async def begun(who: str) -> bool:
        look = asyncio.ensure_future(taps.look("/odom", 1, 60, who, latched=False))
        await asyncio.sleep(0)
        if look.done():
            with pytest.raises(TooManyTapsError, match=f"of {who}: try again"):
                look.result()
            return False
        looks.append(look)
        return True

    most = TOPIC_LOOKS.bounds.whole
    shares = [sum([await begun(who) for _ in range(most)]) for who in ("ann", "bob", "cy")]
    assert shares == [TOPIC_LOOKS.bounds.host, 1, 1]
    for look in looks:
        look.cancel()
        with suppress(asyncio.CancelledError):
            await look
    assert [await begun("bob") for _ in range(3)] == [True] * 3
    for look in looks:
        look.cancel()
