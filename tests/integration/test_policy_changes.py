import signal
from datetime import UTC, datetime, timedelta

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import Client, RosSession
from tests.support.waiting import eventually

NO_CHATTER = OPEN_POLICY.replace("[Subscribers]", "/chatter =\n[Subscribers]", 1)
NO_EARS = OPEN_POLICY.replace("[Commands]", "/chatter =\n[Commands]", 1)


@pytest.fixture(scope="module")
def appliance(own_appliance: Appliance) -> Appliance:
    return own_appliance


@pytest.mark.real
@pytest.mark.parametrize("without", [NO_CHATTER, NO_EARS], ids=["publication", "subscription"])
@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_a_rollback_restores_rights_of_running_nodes(
    appliance: Appliance, ros: RosSession, client: Client, without: str
) -> None:
    listener = ros.listener(client, "/chatter")
    ros.talker(client, "/chatter", name="voice")
    listener.wait_for(event="received")
    appliance.reload(without)
    revoked = appliance.recorded("--event", "revoked")
    assert {record["resource"] for record in revoked} == {"/chatter"}
    assert all(record["rule"]["key"] == "/chatter" for record in revoked)
    assert "/voice" not in ros.run("rostopic", "info", "/chatter").stdout.partition("Subscribers")[0] or (
        without is NO_EARS
    )
    appliance.rosrv("policy", "rollback")
    after = listener.mark()
    listener.wait_for(event="received", publisher="/voice", since=after)


@pytest.mark.real
@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_revocations_survive_a_crash_of_control(
    appliance: Appliance, ros: RosSession, client: Client
) -> None:
    listener = ros.listener(client, "/chatter")
    ros.talker(client, "/chatter", name="voice")
    listener.wait_for(event="received")
    appliance.reload(NO_CHATTER)
    appliance.kill("control")
    appliance.rosrv("policy", "rollback")
    after = listener.mark()
    listener.wait_for(event="received", publisher="/voice", since=after)


def test_a_policy_changed_during_downtime_applies_to_running_nodes(
    appliance: Appliance, ros: RosSession
) -> None:
    appliance.reload(OPEN_POLICY)  # the policy in force is the file's
    listener = ros.listener("rospy", "/chatter")
    ros.talker("roscpp", "/chatter", name="voice")
    listener.wait_for(event="received")
    appliance.stop()
    appliance.policy_file.write_text(NO_CHATTER)
    appliance.start()
    eventually(lambda: appliance.audit("--event", "revoked", resource="/chatter"), "it is recorded")
    said = ros.run("rostopic", "info", "/chatter").stdout
    assert "/voice" not in said.partition("Subscribers")[0]
    appliance.rosrv("policy", "rollback")
    after = listener.mark()
    listener.wait_for(event="received", publisher="/voice", since=after)


@pytest.mark.real
def test_sighup_reloads_the_policy(appliance: Appliance) -> None:
    assert appliance.process is not None
    revision = appliance.status()["policy"]["revision"]
    appliance.policy_file.write_text(NO_CHATTER)
    appliance.process.popen.send_signal(signal.SIGHUP)
    eventually(lambda: appliance.status()["policy"]["revision"] == revision + 1, "the new policy is in force")
    appliance.policy_file.write_text("[Nonsense]\n")
    appliance.process.popen.send_signal(signal.SIGHUP)
    eventually(lambda: appliance.audit("--event", "policy refused"), "the rejection is recorded")
    assert appliance.status()["policy"]["revision"] == revision + 1


def _only(words: str, hours: str = "") -> str:
    return OPEN_POLICY.replace("[Subscribers]", f"/chatter = {words}\n[Subscribers]", 1) + hours


def test_a_right_ends_and_begins_while_its_node_publishes(appliance: Appliance, ros: RosSession) -> None:
    """Messages stop within a second, also after a crash of control, and come again without a new start of the node."""
    appliance.reload(OPEN_POLICY)
    listener = ros.listener("rospy", "/chatter")
    ros.talker("rospy", "/chatter", name="voice")
    listener.wait_for(event="received")
    appliance.ignore_earlier_records()
    end = (datetime.now(UTC) + timedelta(seconds=10)).replace(microsecond=0)
    right = f"* until {end:%Y-%m-%dT%H:%M:%S}"
    appliance.reload(_only(right))
    listener.wait_for(event="received", since=listener.mark())
    eventually(lambda: datetime.now(UTC) >= end, "the date comes")
    at_end = listener.mark()
    [record] = appliance.recorded("--event", "rights changed")
    assert record["detail"]["ended"] == [f"{right} (line 5)"]
    assert record["detail"]["revoked"] > 0
    assert (
        f"its right until {end:%Y-%m-%dT%H:%M:%S} has ended"
        in appliance.recorded("--event", "revoked")[0]["reason"]
    )
    appliance.kill("control")
    eventually(lambda: appliance.rosrv("status", check=False).returncode == 0, "control is back")
    begin = (datetime.now(UTC) + timedelta(minutes=1)).replace(second=0, microsecond=0)
    hours = f"{begin:%H:%M}-{begin + timedelta(minutes=5):%H:%M}"
    appliance.reload(_only("* during shift", f"[Hours]\nshift = {hours}\n"))
    assert listener.mark() - at_end <= 10  # the talker sends ten a second
    appliance.ignore_earlier_records()
    listener.wait_for(event="received", since=listener.mark(), timeout=90)
    assert datetime.now(UTC) >= begin
    [record] = appliance.recorded("--event", "rights changed")
    assert record["reason"] == "began: * during shift (line 5)"
    assert record["detail"]["restored"] > 0
