"""The doors in the state, which control reads before the policy comes into force."""

from collections.abc import Mapping
from typing import Protocol

from appliance.control.operators.request_method import RequestMethod
from appliance.features.doors import door_requests as requests
from appliance.features.doors.door_table import DoorTable
from appliance.features.feature import FeaturePart, OperatorContext
from appliance.policy.model import Address


class Orders(Protocol):
    """The operators' requests about doors."""

    async def listed(self, request: requests.DoorsWanted) -> requests.DoorList: ...

    async def add(self, request: requests.DoorAdd, who: str) -> requests.DoorState: ...

    async def remove(self, request: requests.DoorRemove, who: str) -> requests.DoorState: ...

    async def ticket(self, request: requests.DoorTicket, who: str) -> requests.NewTicket: ...

    async def own(self, request: requests.OwnDoorWanted, who: str) -> requests.OwnDoor: ...

    async def visit(self, request: requests.DoorVisit, who: str) -> requests.NewTicket: ...


class KeptDoors:
    """The doors in the state."""

    def __init__(self, table: DoorTable) -> None:
        self.table = table
        self.orders: Orders  # set once control has its other parts

    def addresses(self) -> Mapping[str, Address]:
        return self.table.addresses()


class LateOrders(Orders):
    """The orders about doors, which exist once control has its other parts."""

    def __init__(self, context: OperatorContext) -> None:
        self._context = context

    async def listed(self, request: requests.DoorsWanted) -> requests.DoorList:
        return await self._orders().listed(request)

    async def add(self, request: requests.DoorAdd, who: str) -> requests.DoorState:
        return await self._orders().add(request, who)

    async def remove(self, request: requests.DoorRemove, who: str) -> requests.DoorState:
        return await self._orders().remove(request, who)

    async def ticket(self, request: requests.DoorTicket, who: str) -> requests.NewTicket:
        return await self._orders().ticket(request, who)

    async def own(self, request: requests.OwnDoorWanted, who: str) -> requests.OwnDoor:
        return await self._orders().own(request, who)

    async def visit(self, request: requests.DoorVisit, who: str) -> requests.NewTicket:
        return await self._orders().visit(request, who)

    def _orders(self) -> Orders:
        return _kept(self._context).orders


def operate(context: OperatorContext) -> FeaturePart:
    orders = LateOrders(context)
    return FeaturePart(
        methods=(
            RequestMethod(requests.DoorsWanted, orders.listed),
            RequestMethod(requests.DoorAdd, orders.add, who=True),
            RequestMethod(requests.DoorRemove, orders.remove, who=True, full_disk=True),
            RequestMethod(requests.DoorTicket, orders.ticket, who=True),
            RequestMethod(requests.OwnDoorWanted, orders.own, who=True),
            RequestMethod(requests.DoorVisit, orders.visit, who=True, full_disk=True),
        )
    )


def _kept(context: OperatorContext) -> KeptDoors:
    kept = context.kept["doors"]
    assert isinstance(kept, KeptDoors)  # noqa: S101  `control_part.keep` made it
    return kept
