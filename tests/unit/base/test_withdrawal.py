import asyncio

import pytest

from appliance.base.withdrawal import WithdrawnError, awaited, require_awaited, take_effect
from tests.support import autojump


def test_an_order_of_a_disconnected_client_does_not_take_effect() -> None:
    gone = False
    with awaited(lambda: gone):
        require_awaited()
        gone = True
        with pytest.raises(WithdrawnError, match="nothing was changed"):
            take_effect()
        gone = False
        take_effect()
        gone = True
        require_awaited()
        take_effect()


def test_only_orders_are_withdrawn() -> None:
    take_effect()

    async def order() -> asyncio.Task[None]:
        with awaited(lambda: True):
            return asyncio.create_task(later())

    async def later() -> None:
        await asyncio.sleep(0)
        take_effect()

    async def play() -> None:
        await (await order())

    autojump.run(play())
