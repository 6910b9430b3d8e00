"""The policy changes while a robot works: what is taken back stops at once, what is granted again goes on by itself."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import Client, RosSession, has_ros
from tests.support.requirements import needs
from tests.support.waiting import eventually

NO_CHATTER = OPEN_POLICY.replace("[Subscribers]", "/chatter =\n[Subscribers]", 1)
NO_EARS = OPEN_POLICY.replace("[Commands]", "/chatter =\n[Commands]", 1)


@pytest.fixture
def ros(appliance: Appliance, common_robot: Host, tmp_path: Path) -> Iterator[RosSession]:
    """The robot's nodes behind the appliance."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with RosSession(appliance.master_uri, tmp_path, common_robot) as session:
        yield session


@pytest.mark.parametrize("without", [NO_CHATTER, NO_EARS], ids=["publication", "subscription"])
@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_a_rollback_gives_running_nodes_back_what_a_bad_policy_took(
    appliance: Appliance, ros: RosSession, client: Client, without: str
) -> None:
    """Messages stop with the bad revision and come again with the rollback; no node is started again."""
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


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_what_was_taken_is_remembered_over_a_crash_of_control(
    appliance: Appliance, ros: RosSession, client: Client
) -> None:
    """Control is killed between the bad revision and the rollback: it makes no difference."""
    listener = ros.listener(client, "/chatter")
    ros.talker(client, "/chatter", name="voice")
    listener.wait_for(event="received")
    appliance.reload(NO_CHATTER)
    appliance.kill("control")
    appliance.rosrv("policy", "rollback")
    after = listener.mark()
    listener.wait_for(event="received", publisher="/voice", since=after)


def test_a_policy_that_changed_while_the_appliance_was_down_holds_for_nodes_that_run(
    appliance: Appliance, ros: RosSession
) -> None:
    """The file is edited between a stop and a start: what it no longer allows is taken from the nodes at the start."""
    appliance.reload(OPEN_POLICY)  # what is in force is the file's
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


def test_a_node_that_stood_still_over_a_reload_has_lost_what_the_policy_took(
    lab: Lab, robot: Host, tmp_path: Path
) -> None:
    """It is lost, the policy changes, it goes on: nothing of the topic goes through it until a rollback."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    config = tmp_path / "appliance.yaml"
    config.write_text("liveness: {interval: 0.5, silent: 2}\n")
    with (
        Appliance(
            lab.host("appliance", "10.77.0.2/24"), options=("--config", str(config), "--api", "off")
        ) as appliance,
        RosSession(appliance.master_uri, tmp_path, robot) as ros,
    ):
        listener = ros.listener("rospy", "/chatter")
        clients: list[Client] = ["rospy", "roscpp"]
        voices = {
            f"/{client}_voice": ros.talker(client, "/chatter", name=f"{client}_voice") for client in clients
        }
        for name, voice in voices.items():
            listener.wait_for(event="received", publisher=name)
            voice.popen.send_signal(signal.SIGSTOP)
        for name in voices:
            appliance.recorded("--event", "node lost", caller_id=name)
        appliance.reload(NO_CHATTER)
        for name, voice in voices.items():
            appliance.recorded("--event", "revoked", caller_id=name, resource="/chatter")
            voice.popen.send_signal(signal.SIGCONT)
        for name in voices:
            appliance.recorded("--event", "node returned", caller_id=name)
        assert "_voice" not in ros.run("rostopic", "info", "/chatter").stdout.partition("Subscribers")[0]
        appliance.rosrv("policy", "rollback")
        after = listener.mark()
        for name in voices:
            listener.wait_for(event="received", publisher=name, since=after)


def test_sighup_reads_the_policy_again(appliance: Appliance) -> None:
    """As `rosrv policy reload` does; a file with errors changes nothing, and the log says what is wrong."""
    assert appliance.process is not None
    revision = appliance.status()["policy"]["revision"]
    appliance.policy_file.write_text(NO_CHATTER)
    appliance.process.popen.send_signal(signal.SIGHUP)
    eventually(lambda: appliance.status()["policy"]["revision"] == revision + 1, "the new policy is in force")
    appliance.policy_file.write_text("[Nonsense]\n")
    appliance.process.popen.send_signal(signal.SIGHUP)
    eventually(lambda: appliance.audit("--event", "policy refused"), "the refusal is recorded")
    assert appliance.status()["policy"]["revision"] == revision + 1
