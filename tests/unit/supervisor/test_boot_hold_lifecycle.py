from collections.abc import Callable
from typing import Literal

import pytest

from appliance.configuration.settings import FirewallSection, Settings
from appliance.network.boot_hold import BootHold, HeldPorts
from appliance.network.firewall.backend import FirewallError
from appliance.network.namespaces import Namespace
from appliance.supervisor.boot_hold_lifecycle import HoldAround


class RecordedHold(BootHold):
    is_present = True

    def __init__(self, *, lapsed: bool = False, broken: bool = False) -> None:
        super().__init__(Namespace.own())
        self.calls: list[object] = []
        self._lapsed, self._broken = lapsed, broken

    def put(self) -> None:
        self.calls.append("put")
        if self._broken:
            raise FirewallError("no back end works")

    def lift(self) -> bool:
        self.calls.append("lift")
        return self._lapsed

    def arm(self, held: HeldPorts | None) -> None:
        self.calls.append(held and (held.master, held.link, held.own_seconds))


def around(
    hold: BootHold,
    mode: Literal["others", "own", "off"] = "others",
    *,
    isolation: Literal["netns", "none"] = "netns",
    used: bool = True,
) -> HoldAround:
    settings = Settings(isolation=isolation, firewall=FirewallSection(hold=mode))
    return HoldAround(settings, used=used, link="veth-rosrv", hold=hold)


@pytest.mark.parametrize(
    ("made", "armed"),
    [
        (around, (11311, "veth-rosrv", None)),
        (lambda hold: around(hold, "own"), (11311, "veth-rosrv", 60)),
    ],
)
def test_the_service_holds_until_it_serves_and_at_its_end(
    made: Callable[[BootHold], HoldAround], armed: object
) -> None:
    hold = RecordedHold()
    run = made(hold)
    run.put()
    assert run.served() == ""
    run.put()
    assert hold.calls == ["put", "lift", armed, "put"]


@pytest.mark.parametrize(
    "made",
    [
        lambda hold: around(hold, "off"),
        lambda hold: around(hold, isolation="none"),
        lambda hold: around(hold, used=False),
    ],
)
def test_a_run_without_a_hold_ends_an_earlier_one(made: Callable[[BootHold], HoldAround]) -> None:
    hold = RecordedHold()
    run = made(hold)
    run.put()
    run.served()
    assert hold.calls == ["lift", None]


def test_a_lapsed_hold_is_an_alarm_only_if_the_robot_waited() -> None:
    assert "served more than 60 s" in around(RecordedHold(lapsed=True), "own").served()
    assert around(RecordedHold(lapsed=True)).served() == ""


def test_a_hold_that_fails_does_not_end_the_appliance() -> None:
    around(RecordedHold(broken=True)).put()
