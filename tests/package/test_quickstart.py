import re
from pathlib import Path

import pytest

from tests.package.conftest import SLOW_SECONDS, clean_machine
from tests.support.page_steps import steps

pytestmark = pytest.mark.timeout(3600)  # a machine boots, perhaps emulated
_NETWORK = """
grep -q "$(hostname)" /etc/hosts || echo "127.0.1.1 $(hostname)" >> /etc/hosts
ip netns add visitor
ip link add eth0 type veth peer name eth0 netns visitor
ip address add 10.84.0.2/24 dev eth0
ip link set eth0 up
ip -n visitor address add 10.84.0.66/24 dev eth0
ip -n visitor link set lo up
ip -n visitor link set eth0 up
"""
_ID, _NUMBER = "18e9f97c154d8b0bb7a9", "#47"  # on the page, for the record of this run
_DRIVES = "until ROS_MASTER_URI=http://localhost:11311 rosnode ping -c 1 /drive; do sleep 1; done"


@pytest.mark.parametrize("page", ["quickstart.md", "try-for-an-hour.md"])
def test_the_page_is_true(page: str, package: Path, tmp_path: Path) -> None:
    record = dict[str, str]()

    def here(text: str) -> str:
        for shown, own in record.items():
            text = text.replace(shown, own)
        return text

    with clean_machine(
        tmp_path, package, {package.name: package}, more=("sudo", "python3-rosmaster"), name="quickstart"
    ) as machine:
        machine.run("bash", "-euc", _NETWORK)
        for step in steps(page):
            command = ["bash", "-euo", "pipefail", "-c", here(step.script)]
            if step.host == "visitor":
                command = ["ip", "netns", "exec", "visitor", *command]
            if step.how == "stays":
                machine.run("systemd-run", "--unit=drive", *command)
                machine.run("bash", "-c", _DRIVES)
                continue
            done = machine.run(*command, seconds=SLOW_SECONDS, check=False)
            assert (done.status != 0) == (step.how == "fails"), f"{step.script}{done.output}"
            if step.how == "fails":
                record[_ID] = re.findall(r"\[(\w+)\]", done.output)[-1]
            if "audit search" in step.script:
                record[_NUMBER] = re.findall(r"#\d+", done.output)[-1]
            missing = [line for line in step.shown if here(line) not in done.output]
            assert missing == [], f"{step.script}{done.output}"
