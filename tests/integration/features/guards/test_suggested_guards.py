"""Robots of rospy nodes behind an appliance: the proposals are those of the reviewed table, and can be pasted."""

import json
import shlex
from collections.abc import Iterable
from pathlib import Path

import pytest

from appliance.features.guards.suggestions import advice
from examples.landshark.lab import Host
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import stream
from tests.support.nodes import RosSession
from tests.support.waiting import eventually
from tests.unit.features.guards.test_suggestions import graph_of

_ROBOTS = ("two_velocities", "prefixes", "merged_scans", "arm_on_base", "manual_mode")
_ONCE = 0.001
"""Messages a second, of a node that now sends none."""


def start(ros: RosSession, robot: str) -> None:
    """Start all nodes of a robot of the table."""
    topics = graph_of(robot)
    for node in sorted({node for topic in topics for node in (*topic.publishers, *topic.subscribers)}):
        taken = [topic.name for topic in topics if node in topic.subscribers]
        streams = [
            stream(topic.type, topic.rate / len(topic.publishers) or _ONCE, {}).on(topic.name)
            for topic in topics
            if node in topic.publishers
        ]
        ros.node("rospy", "frame_talker", *taken, name=node.strip("/")).send(json.dumps(streams))


def without_rates(commands: Iterable[str]) -> list[str]:
    return sorted(
        " ".join(word for word in command.split() if not word.startswith("silent=")) for command in commands
    )


@pytest.mark.parametrize("robot", _ROBOTS)
def test_the_guards_of_a_running_robot_are_proposed_and_can_be_pasted(
    own_appliance: Appliance, common_robot: Host, tmp_path: Path, robot: str
) -> None:
    appliance, reviewed = own_appliance, advice(graph_of(robot))
    wanted = without_rates(suggestion.command for suggestion in reviewed.suggestions)
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
        start(ros, robot)

        def found() -> list[dict[str, object]]:
            rows = appliance.rows("guard", "suggest")
            commands = [str(row["command"]) for row in rows if "command" in row]
            # A button that no node subscribes to is not connected, so it has no rate.
            rated = all("silent=" in command for command in commands if " sensor " in command)
            return rows if without_rates(commands) == wanted and rated else []

        rows = eventually(found, f"the proposals for {robot}")
        assert [row["not_protected"] for row in rows if "not_protected" in row] == reviewed.not_protected
        for row in rows:
            if "command" in row:
                appliance.rosrv(*shlex.split(str(row["command"]))[1:])
        again = appliance.rows("guard", "suggest")
        assert not [row for row in again if "command" in row]
        assert len([row for row in again if "loaded" in row]) == len(wanted)
        for row in again:
            if "loaded" in row:
                appliance.rosrv("guard", "remove", str(row["loaded"]))
