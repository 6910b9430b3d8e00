import json
import subprocess

import pytest

from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.requirements import need_root


@pytest.mark.parametrize("isolation", ["container", "netns"])
def test_a_message_goes_through_behind_the_firewall(isolation: str) -> None:
    need_root()
    with Lab("rosrv-self") as lab:
        machine = lab.host("machine", "10.84.0.2/24")
        with Appliance(machine, isolation=isolation) as appliance:
            command = [ROSRV, "selftest", "--json", "--state", str(appliance.state)]
            process = machine.popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            output, said = process.communicate(timeout=120)
            rows = {row["check"]: row for row in map(json.loads, output.splitlines())}
            assert process.returncode == 0, (said, [row for row in rows.values() if row["outcome"] == "fail"])
            for check in ("namespaces", "firewall", "ports", "status", "audit log", "RVMaster", "relay"):
                assert rows[check]["outcome"] == "ok", rows[check]
            assert "probe of the ROS master passed" in rows["status"]["text"]
            assert "a message came through" in rows["relay"]["text"]
