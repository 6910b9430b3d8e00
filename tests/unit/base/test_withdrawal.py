import ast
import asyncio
import inspect
import textwrap
from typing import Any

import pytest

from appliance.base.withdrawal import WithdrawnError, require_awaited, take_effect, withdrawable
from appliance.control.assembly.policies import Policies
from appliance.control.operators.administration import KEPT
from appliance.control.operators.queries import Queries
from appliance.control.operators.request_methods import request_methods
from appliance.control.operators.token_orders import TokenOrders
from appliance.specifications.specification_manager import SpecificationManager
from tests.support import autojump
from tests.support.feature_parts import idle_parts
from tests.support.idle import idle


def test_an_order_of_a_disconnected_client_does_not_take_effect() -> None:
    gone = False
    with withdrawable(lambda: gone):
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
        with withdrawable(lambda: True):
            return asyncio.create_task(later())

    async def later() -> None:
        await asyncio.sleep(0)
        take_effect()

    async def play() -> None:
        await (await order())

    autojump.run(play())


AT_ONCE = {
    "alarm acknowledge", "alarm silence", "host revoke", "hosts reload", "host ports", "record now",
    "recording memory", "recording remove", "token add", "token rotate", "token revoke", "sso end", "sso sign out",
}  # fmt: skip
"""Orders whose first change comes before their first wait, so that their client cannot leave in between."""


def test_each_order_that_waits_can_be_withdrawn() -> None:
    methods = idle_parts().methods() + request_methods(
        queries=idle(Queries),
        policies=idle(Policies),
        monitors=idle(SpecificationManager),
        tokens=idle(TokenOrders),
    )
    orders = [method for method in methods if method.order and (method.request in KEPT or method.full_disk)]
    never = {str(one.request.__struct_config__.tag) for one in orders if not takes_effect(one.answer, set())}
    assert never == AT_ONCE


def takes_effect(method: Any, seen: set[Any]) -> bool:
    """Return whether a method calls `take_effect`, itself or in a method of a part of its object that it calls."""
    function, owner = inspect.unwrap(getattr(method, "__func__", method)), getattr(method, "__self__", None)
    if function in seen or not getattr(function, "__module__", "").startswith("appliance."):
        return False
    seen.add(function)
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    for call in (node.func for node in ast.walk(tree) if isinstance(node, ast.Call)):
        if isinstance(call, ast.Name) and call.id == "take_effect":
            return True
        called: Any = owner
        for name in dotted(call):
            called = inspect.getattr_static(called, name, None) and getattr(called, name, None)
        if inspect.ismethod(called) and takes_effect(called, seen):
            return True
    return False


def dotted(call: ast.expr) -> list[str]:
    """Return the names below the object: of `self.a.b` and, as `monitors` is `self._monitors`, of `a.b`."""
    names: list[str] = []
    while isinstance(call, ast.Attribute):
        names.insert(0, call.attr)
        call = call.value
    first = call.id if isinstance(call, ast.Name) else "no"
    return names if first == "self" else [f"_{first}", *names]
