"""Tests of which nodes the appliance takes for gone."""

import os
import xmlrpc.client
from pathlib import Path

from appliance.network.lab import Host, Lab
from tests.support.appliance import ROSRV, Appliance
from tests.support.processes import Process, ThisMachine

MONITORS = Path(__file__).parents[3] / "monitors"
NOBODY = "http://10.77.0.10:1/"


def test_what_publishes_for_monitors_is_there_behind_the_firewall(
    lab: Lab, robot: Host, tmp_path: Path
) -> None:
    """A node whose port refuses is lost; the appliance's own publisher, which the firewall hides, is not."""
    config = tmp_path / "appliance.yaml"
    config.write_text("liveness: {interval: 0.1}\n")
    options = ("--config", str(config), "--monitors", str(MONITORS))
    with Appliance(lab.host("appliance", "10.77.0.2/24"), options=options) as appliance:

        def register() -> None:
            with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
                answer = master.registerSubscriber("/brief", "/chatter", "std_msgs/String", NOBODY)
            assert isinstance(answer, list)
            assert answer[0] == 1, answer

        command = [ROSRV, "audit", "tail", "--json", "--state", str(appliance.state)]
        tail = Process(ThisMachine(), command, env=os.environ, label="rosrv audit tail")
        try:
            tail.wait_for(lambda event: "sequence" in event)
            robot.run(register)
            tail.wait_for(event="node lost", caller_id="/brief")
        finally:
            tail.stop()
        assert [record["caller_id"] for record in appliance.audit("--event", "node lost")] == ["/brief"]
