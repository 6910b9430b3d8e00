"""A command that is typed twice changes the appliance once."""

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.twice import SAME, TWICE
from tests.support.waiting import eventually

POLICY = f"""{OPEN_POLICY}
[Groups]
laptop = 10.9.8.7
[Options]
audit-only = Publishers
[Authority]
base = /cmd_vel
take base = laptop
"""
SAFE = "safe(double x) {\n  event move(double x) /chatter std_msgs/Float64 '{data:x}' { }\n}\n"
NEW = "guard new deadman /cmd_vel --type command=geometry_msgs/Twist --name"
COMMANDS = (
    "policy reload", "monitor reload", "host reload", "host block 10.1.2.3", "host block 10.1.2.3 --note fuzz",
    "alarm acknowledge hosts-blocked", "monitor load FOLDER/monitors/safe.rv", "monitor disable safe",
    "monitor enable safe", "monitor resume safe", f"{NEW} a --shadow", "guard set a silent=0.7", "guard enforce a",
    f"{NEW} b --shadow", "monitor set b silent=0.8", "monitor enforce b", "guard upgrade a",
    "drive assign base --host 10.9.8.7", "drive ask base --host 10.9.8.7", "drive free base", "policy enforce",
)  # fmt: skip
SAYS = ("no change", "no difference", "no topic", "no tunnel", "nothing to upgrade")


def changes(appliance: Appliance) -> list[object]:
    eventually(lambda: appliance.status()["audit"]["lag_records"] == 0, appliance.story)
    status = appliance.status()
    nodes = {"decision", "registered", "reconciled", "unregistered"}
    later = nodes | {"guard loaded", "stop begun", "stop ended"}  # of the relay
    records = [one for one in appliance.recorded() if one["event"] not in later]
    return [status["policy"]["revision"], status["monitors"]["tag"], len(records)]


def test_the_second_command_changes_and_records_nothing() -> None:
    typed = {" ".join(command.split()[:2]) for command in COMMANDS}
    assert typed == {name for name, second in TWICE.items() if second == SAME}
    with Appliance(policy=POLICY, monitors={"safe": SAFE}) as appliance:
        for command in COMMANDS:
            words = command.replace("FOLDER", str(appliance.directory)).split()
            first = appliance.rosrv(*words, check=False)
            assert first.returncode == 0, (command, first.stderr)
            kept = changes(appliance)
            second = appliance.rosrv(*words, check=False)
            assert second.returncode == 0, (command, second.stderr)
            assert changes(appliance) == kept, (command, [one["event"] for one in appliance.recorded()[:3]])
            says = any(one in second.stdout for one in SAYS) or second.stdout == first.stdout
            assert says, (command, second.stdout)
