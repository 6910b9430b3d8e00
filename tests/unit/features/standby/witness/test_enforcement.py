from collections.abc import Callable

import pytest

from appliance.features.standby.witness.enforcement import BoundedLog, LeaseEnforcement, RegularCheck
from appliance.features.standby.witness.errors import UncertainError, WitnessError
from appliance.features.standby.witness.firewall import LeaseFirewall
from appliance.features.standby.witness.firewall_rules import nft_rules
from appliance.features.standby.witness.idle_connections import IdleConnections
from appliance.features.standby.witness.protocol import Left
from tests.support.idle import idle, replace
from tests.unit.features.standby.witness.robot import PAIR_SETTINGS


def test_a_slow_check_is_reported_while_it_runs() -> None:
    now, seen = [0.0], []

    def check() -> None:
        for seconds in (4.9, 0.2):
            now[0] += seconds
            seen.append(checked.trouble())

    checked = RegularCheck("the rules cannot be listed", check, lambda: now[0])
    checked.run()
    assert seen == ["", "the rules cannot be listed: that takes more than 5 s"]
    assert checked.trouble() == ""


def test_the_log_is_bounded() -> None:
    lines: list[str] = []
    now = [0.0]
    log = BoundedLog(lines.append, lambda: now[0])
    for number in range(100):
        log.add(str(number))
    now[0] = 11.0
    log.add("later")
    assert lines == [f"{number}\n" for number in range(20)] + ["80 more lines were left out\n", "later\n"]


class FakeProgram:
    """The programs of the firewall. `meanwhile` happens while the given kind of them runs."""

    def __init__(self) -> None:
        self.rules = ""
        self.fails: dict[str, type[WitnessError]] = {}
        self.meanwhile: dict[str, Callable[[], None]] = {}
        self.ran: list[str] = []

    def __call__(self, command: list[str], text: str, _left: Left) -> str:
        kinds = {"-f": "write", "--noflush": "write", "-c": "trial", "--test": "trial"}
        kind = next((kinds[word] for word in command[1:] if word in kinds), "list")
        self.ran.append(kind)
        listed = self.rules
        self.meanwhile.pop(kind, lambda: None)()
        if kind in self.fails:
            raise self.fails[kind]("nft: no")
        if kind == "write":
            self.rules = text
        return listed


def no_connections() -> IdleConnections:
    connections = idle(IdleConnections)
    replace(connections, connecting=list)
    return connections


def enforced(backend: str = "nft") -> tuple[FakeProgram, LeaseEnforcement, list[str]]:
    program, lines = FakeProgram(), list[str]()
    log = BoundedLog(lines.append, lambda: 0.0)
    firewall = LeaseFirewall(PAIR_SETTINGS, backend, program)
    connections = no_connections()
    return program, LeaseEnforcement(firewall, connections, PAIR_SETTINGS.appliances, log, lambda: 0.0), lines


def looked_after(enforcement: LeaseEnforcement) -> bool:
    """Return whether the rules are written again."""
    again = []
    enforcement.go_on(lambda: again.append(True))
    return bool(again)


def test_a_change_by_another_program_is_undone_and_named() -> None:
    program, enforcement, lines = enforced()
    enforcement.admit("a")
    enforcement.listing.run()
    assert not looked_after(enforcement)
    program.rules = "changed"
    enforcement.listing.run()
    assert looked_after(enforcement)
    assert "another program changed the firewall rules" in lines[-1]


def test_a_listing_that_overlaps_a_write_accuses_no_program() -> None:
    """A list is begun, in turn, at each step of a write, and ended at each later one."""
    program, enforcement, lines = enforced()
    enforcement.admit("a")
    program.meanwhile["list"] = lambda: enforcement.admit("b")  # a whole write during a listing
    enforcement.listing.run()
    assert not looked_after(enforcement)
    program.meanwhile["write"] = enforcement.listing.run  # a whole listing during a write
    enforcement.admit("a")
    assert not looked_after(enforcement)

    def begin() -> None:  # a listing during the reading that follows a write
        program.meanwhile["list"] = enforcement.listing.run

    program.meanwhile["write"] = begin
    enforcement.admit("b")
    assert not looked_after(enforcement)
    assert all("another program" not in line for line in lines)


def test_rules_that_were_not_read_are_written_again_and_accuse_no_program() -> None:
    program, enforcement, lines = enforced()
    program.fails["list"] = UncertainError
    enforcement.admit("a")
    program.fails.clear()
    enforcement.listing.run()
    assert looked_after(enforcement)
    assert "could not be read after they were written" in lines[-1]


def test_rules_that_could_not_be_written_leave_the_earlier_ones_intact() -> None:
    program, enforcement, _ = enforced()
    enforcement.admit("a")
    program.fails["write"] = WitnessError
    with pytest.raises(WitnessError):
        enforcement.admit("b")
    enforcement.listing.run()
    assert not looked_after(enforcement)


@pytest.mark.parametrize("backend", ["nft", "iptables"])
def test_a_takeover_whose_rules_cannot_be_written_is_known_before(backend: str) -> None:
    program, enforcement, _ = enforced(backend)
    enforcement.trial.run()
    assert enforcement.trouble() == ""
    program.fails["trial"] = WitnessError
    enforcement.trial.run()
    assert enforcement.trouble() == "the firewall rules of a takeover cannot be written: nft: no"
    enforcement.admit("a")
    assert program.ran[-1] == "list", "a trial that fails delays no write"
    program.fails.clear()
    enforcement.trial.run()
    assert enforcement.trouble() == ""


@pytest.mark.parametrize("admitted", ["", "a", "b"])
def test_the_trial_is_of_the_other_appliances_rules(admitted: str) -> None:
    texts = []

    def run(command: list[str], text: str, _left: Left) -> str:
        texts.extend([text] if "-c" in command else [])
        return ""

    firewall = LeaseFirewall(PAIR_SETTINGS, "nft", run)
    log = BoundedLog(lambda _line: None, lambda: 0.0)
    enforcement = LeaseEnforcement(firewall, no_connections(), PAIR_SETTINGS.appliances, log, lambda: 0.0)
    enforcement.admit(admitted)
    enforcement.trial.run()
    assert texts == [nft_rules(PAIR_SETTINGS, "b" if admitted == "a" else "a")]


def test_a_trial_gives_way_to_a_write_and_keeps_its_earlier_result() -> None:
    program, enforcement, _ = enforced("iptables")
    program.fails["trial"] = WitnessError
    enforcement.trial.run()
    failure = enforcement.trouble()
    firewall, left = enforcement.firewall, list[float]()

    def run(_command: list[str], _text: str, still: Left) -> str:
        left.append(still())
        firewall.waiting = True  # as `admit` does in another thread
        left.append(still())
        raise UncertainError("iptables-restore: ended")

    firewall._run = run
    enforcement.trial.run()
    assert left[0] > 0 == left[1]
    assert enforcement.trouble() == failure != ""
