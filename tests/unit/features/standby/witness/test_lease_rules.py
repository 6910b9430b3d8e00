from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.protocol import EXPIRY, OPERATIONS
from tests.unit.features.standby.witness.robot import BOTH, Robot, granted


def test_the_first_grant_comes_one_expiry_after_the_start() -> None:
    robot = Robot()
    assert robot.admits == [""]
    robot.now += EXPIRY - 0.01
    assert "no appliance holds the lease" in robot.asks("a", "claim")
    robot.now += 0.02
    assert robot.asks("a", "claim") == ""
    assert robot.admits == ["", "a"]
    assert robot.disk == LeaseRecord(2, "a", BOTH, "one")


def test_a_claim_waits_until_the_last_renewal_has_expired() -> None:
    robot = granted()
    robot.now += 1
    assert robot.asks("a", "renew", 2) == ""
    robot.now += 1
    assert robot.asks("b", "claim", 2) == "a holds the lease for another 0.2 s"
    assert robot.expired().asks("b", "claim", 2) == ""
    assert robot.asks("a", "renew", 2) == "b holds epoch 3"


def test_only_an_appliance_in_sync_gets_the_lease() -> None:
    robot = granted()
    assert robot.asks("b", "remove", 2) == "a holds epoch 2"
    assert robot.asks("a", "remove", 2) == ""
    assert robot.disk is not None and robot.disk.in_sync == ("a",)
    assert robot.expired().asks("b", "claim", 2) == "b is not in sync"
    assert robot.asks("a", "add", 2) == ""
    assert robot.asks("b", "claim", 2) == ""


def test_a_released_lease_is_granted_at_once() -> None:
    robot = granted()
    assert robot.asks("b", "release", 2) == "a holds epoch 2"
    assert robot.asks("a", "release", 2) == ""
    assert robot.asks("b", "claim", 2) == ""


def test_an_epoch_never_falls() -> None:
    robot = granted().expired()
    assert robot.asks("a", "claim", 2) == ""
    assert robot.asks("a", "renew", 2) == "a holds epoch 3"
    assert "run witness.py begin" in robot.expired().asks("b", "claim", 9)


def test_a_full_disk_grants_nothing_and_keeps_the_holder() -> None:
    robot = granted()
    robot.disk_full = True
    assert robot.asks("a", "renew", 2) == ""
    assert robot.asks("a", "remove", 2) == "the disk is full"
    assert robot.expired().asks("b", "claim", 2) == "the disk is full"
    assert robot.admits == ["", "a"]
    assert robot.asks("a", "renew", 2) == ""


def test_a_failing_firewall_grants_nothing() -> None:
    robot = granted().expired()
    robot.firewall_fails = True
    assert robot.asks("b", "claim", 2) == "nft: no"
    assert robot.disk == LeaseRecord(2, "a", BOTH, "one")
    assert robot.asks("a", "renew", 2) == "", "its rules have not changed"
    assert robot.admits == ["", "a"]


def test_uncertain_rules_are_written_again_before_the_next_renewal() -> None:
    robot = granted().expired()
    robot.firewall_fails = robot.uncertain = True
    assert robot.asks("b", "claim", 2) == "nft: no"
    assert robot.asks("a", "renew", 2) == "nft: no", "they may admit b"
    robot.firewall_fails = False
    assert robot.asks("a", "renew", 2) == ""
    assert robot.admits == ["", "a", "a"]


def test_rules_that_cannot_be_listed_stop_takeovers_and_no_renewal() -> None:
    robot = granted().expired()
    robot.witness.unknown_rules = "nft: not found"
    assert robot.asks("b", "claim", 2) == "nft: not found"
    assert robot.disk == LeaseRecord(2, "a", BOTH, "one")
    assert robot.asks("a", "renew", 2) == ""
    robot.witness.unknown_rules = ""
    assert robot.expired().asks("b", "claim", 2) == ""


def test_a_restart_of_the_witness_alone_changes_no_rule() -> None:
    record = LeaseRecord(2, "a", BOTH, "one")
    assert Robot(record, "one").admits == ["a"]
    robot = Robot(record, "two")
    assert robot.admits == [""]
    assert robot.asks("a", "renew", 2) == ""
    assert robot.admits == ["", "a"]
    assert robot.disk == LeaseRecord(2, "a", BOTH, "two")


def test_without_a_lease_both_are_shut_out() -> None:
    robot = Robot(None).expired()
    for operation in OPERATIONS:
        assert "witness.py begin" in robot.asks("a", operation)
    assert robot.admits == [""]
    robot.witness.enforce_again()
    assert robot.admits == ["", ""]


def test_rules_that_another_program_removed_are_written_again() -> None:
    robot = granted()
    robot.witness.enforce_again()
    assert robot.admits == ["", "a", "a"]
