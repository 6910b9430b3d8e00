"""A broken appliance is replaced, as docs/standby.md says, and the pair goes on."""

import json
import shutil

from appliance.features.standby.witness.lease_file import LeaseFile
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, FIXED, ROBOT, StandbySite
from tests.support.waiting import eventually


def test_a_replaced_machine(site: StandbySite, robot: StandbyRobot) -> None:
    """The remaining appliance keeps its name, its monitors hold no topic, and both logs prove the next takeover."""
    old, remaining = site.appliances["a"], site.appliances["b"]
    site.cut("a")
    site.until_taken_over("b")
    robot.lost_nothing()
    kit = site.home / "kit"
    remaining.rosrv(
        "standby", "join", "--force", "--address", ADDRESSES["b"], "--other", ADDRESSES["a"], "--witness", ROBOT,
        "--fixed", FIXED, "--output", str(kit),
    )  # fmt: skip
    shutil.rmtree(old.state)
    old.state.mkdir(mode=0o711)
    old.rosrv("standby", "join", str(kit / "standby-a.json"))
    install(site)
    assert remaining.process is not None
    remaining.process.stop()
    site.start("b")
    site.until_active("b")
    held = [row for row in remaining.rows("topic", "list") if row.get("held")]
    assert not held
    site.restore("a")
    site.until_both_in_sync()
    robot.lost_nothing()
    eventually(lambda: remaining.rosrv("standby", "status", check=False).returncode == 0, site.story)
    site.promote("b")
    site.until_taken_over("a")
    robot.lost_nothing()
    for one in (old, remaining):
        assert one.process is not None
        one.process.stop()
    said = old.rosrv("audit", "verify", "--other", str(remaining.state), check=False).stdout
    assert "the log of b agrees with it" in said, said
    assert "LOG REPLACED" in said and "WRONG NAME" not in said, said  # the log of the broken machine is lost


def install(site: StandbySite) -> None:
    """Do what `install.sh` does on the robot's computer, without its services."""
    folder = site.home / "kit" / "witness"
    settings = json.loads((folder / "witness.json").read_text())
    settings["state"] = str(site.home / "lease-of-the-kit")
    site.stop_witness()
    site.settings.write_text(json.dumps(settings))
    begin = (folder / "install.sh").read_text().partition("witness.py begin ")[2].partition(" ||")[0].split()
    site.lease = LeaseFile(settings["state"], ("a", "b"))
    site.run_witness("begin", *begin)
    site.start_witness()
