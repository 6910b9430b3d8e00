import json
import os
import shutil
import threading

import pytest

from appliance.cli.connection.starting import starting
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.rosmaster import master_at
from tests.support.small_disk import small_disk
from tests.support.waiting import eventually

FAILING = "- {deny: publish, node: /a, host: 10.0.0.1, topic: /chatter}\n"


def test_a_policy_that_a_reload_refused_is_not_in_force_after_a_restart() -> None:
    with Appliance() as appliance:
        revision = appliance.status()["policy"]["revision"]
        appliance.policy_file.write_text(OPEN_POLICY + "# refused\n")
        cases = appliance.policy_file.with_name(f"{appliance.policy_file.name}.tests.yaml")
        cases.write_text(FAILING)
        assert appliance.rosrv("policy", "reload", check=False).returncode == 1
        for _ in range(2):
            assert appliance.stop() == 0
            appliance.start()
            policy = appliance.status()["policy"]
            assert (policy["revision"], cases.name in policy["file_refused"]) == (revision, True)
            assert "# refused" not in appliance.rosrv("policy", "show").stdout
        assert len(appliance.recorded(event="policy file refused")) == 2
        appliance.kill("control")
        eventually(lambda: appliance.status()["policy"]["revision"] == revision, appliance.story)
        assert appliance.rosrv("status", check=False).returncode == 1
        cases.unlink()
        appliance.rosrv("policy", "reload")
        assert appliance.status()["policy"]["revision"] == revision + 1


@pytest.mark.parametrize("left", [6 << 20, 2 << 20])
def test_a_start_on_a_nearly_full_disk_serves_the_robot(left: int) -> None:
    appliance = Appliance(settings=json.dumps({"audit": {"reserve_bytes": 16 << 20}}))
    try:
        with small_disk(appliance.state, "160m", "mode=755"):
            appliance.start()
            assert appliance.stop() == 0
            free = os.statvfs(appliance.state)
            filler = appliance.state / "filler"
            filler.write_bytes(bytes(free.f_bavail * free.f_frsize - left))
            appliance.start()
            with master_at(appliance.master_uri) as master:
                for number in range(3):
                    assert (
                        master.registerPublisher(
                            f"/n{number}", "/chatter", "std_msgs/String", "http://127.0.0.1:9/"
                        )[0]
                        == 1
                    )
                    assert master.setParam("/n", f"/p{number}", number)[0] == 1
            assert appliance.rosrv("status", check=False).returncode == 1
            appliance.stop()
    finally:
        appliance.close()


def test_a_command_during_a_start_says_that_the_appliance_starts() -> None:
    """From the first import to the first answer, also at the first start, no command says that none runs."""
    with Appliance() as appliance:
        for first in (False, True):
            appliance.stop()
            if first:
                shutil.rmtree(appliance.state)
            begun = threading.Thread(target=appliance.start)
            begun.start()
            eventually(lambda: starting(appliance.state), appliance.story)
            said = []
            while begun.is_alive():
                done = appliance.rosrv("limits", check=False)
                said.append(done.stderr)
                assert done.returncode == (2 if "try again in a few seconds" in done.stderr else 0), (
                    done.stderr
                )
            begun.join()
            assert any("the appliance is starting" in text for text in said)
            assert appliance.rosrv("limits").stderr == ""
