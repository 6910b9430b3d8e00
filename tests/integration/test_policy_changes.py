import signal

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
