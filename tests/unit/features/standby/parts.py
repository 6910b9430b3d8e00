"""The membership of `a`, whose standby is `b`, and the parts around its replication and its orders."""

import threading

from appliance.features.standby.answers import StandbyState
from appliance.features.standby.lease_client import HandOverError
from appliance.features.standby.membership import Membership
from appliance.store.writer_thread import Database
from tests.support.answers import example

MEMBERSHIP = Membership(
    name="a", other="b", address="10.0.0.2", other_address="10.0.0.3", fixed="10.0.0.100", witness="10.0.0.1",
    witness_port=7411, witness_key="aa" * 32, peer_key="cc" * 32, certificate="", key="", other_certificate="",
)  # fmt: skip


class CountedDatabase(Database):
    """A state file without content: only the number of its last change is known, and nothing waits for the disk."""

    def __init__(self, number: int = 0) -> None:
        self.history, self._number, self._feeds, self._order = "history", number, (), threading.Lock()

    def change(self) -> int:
        self._number += 1
        return self._number

    async def until_settled(self) -> None: ...


class Member:
    """The appliance `a` as a source of orders: it hands over unless there is a `refusal`. `did` has what it did."""

    def __init__(self, role: str = "active", refusal: str = "") -> None:
        self.role, self.refusal = role, refusal
        self.did: list[str] = []

    def state(self) -> StandbyState:
        return example(StandbyState, name="a", role=self.role, other={"name": "b", "address": "10.0.0.2"})

    async def hand_over(self) -> None:
        if self.refusal:
            raise HandOverError(self.refusal)
        self.did.append("handed over")
        self.role = "standby" if self.role == "active" else "active"
