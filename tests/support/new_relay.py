from collections.abc import Callable
from typing import Any, cast

from appliance.channel import messages
from appliance.master.endpoints.node_api import NodeApiClient
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.grants import Grants
from appliance.master.graph.registry import Registry
from appliance.policy.policy import Policy
from appliance.specifications.allocation import Allocation
from tests.support.idle import idle


def told_to_a_new_relay(
    registry: Registry, grants: Grants, policy: Callable[[], Policy]
) -> list[messages.Message]:
    link = _Link()
    relay = RelayControl(
        registry,
        grants,
        cast(Any, _Ports()),
        idle(NodeApiClient),
        idle(RelayTraffic),
        allocation=Allocation(1),
        policy=policy,
        monitors=cast(Any, _Monitors),
        broken=lambda _node: None,
        own_header=None,
        own_call=cast(Any, None),
    )
    relay.attach(0, cast(Any, link))
    return link.told


class _Ports:
    def socket(self, port: int) -> "_Ports":
        self._port = port
        return self

    def fileno(self) -> int:
        return self._port


class _Monitors:
    def statement(self, _relay: int) -> messages.SpecificationsStated:
        return messages.SpecificationsStated(0, b"", {}, restarted=False)


class _Link:
    def __init__(self) -> None:
        self.told: list[messages.Message] = []

    def attach(self, *_given: object) -> None: ...

    def send(self, message: messages.Message, _descriptors: tuple[int, ...] = (), **_when: bool) -> None:
        if not isinstance(message, messages.StateBegan | messages.StateEnded | messages.SpecificationsStated):
            self.told.append(message)
