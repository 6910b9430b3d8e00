import json
import subprocess
import sys
from pathlib import Path

from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.requirements import need_root
from tests.support.script_host import ScriptHost
from tests.support.tunnels import JoinedHost, need_strongswan

ROBOT, OCU, BARE = "10.89.0.10", "10.89.0.20", "10.89.0.2"
POLICY = f"""\
[Groups]
trusted = host:ocu-1, {ROBOT}
[Nodes]
default = trusted
[Publishers]
default = trusted
[Subscribers]
default = trusted
[Commands]
default = trusted
"""


def test_the_host_forwards_the_tunnel(tmp_path: Path) -> None:
    need_root()
    need_strongswan()
    with Lab("rosrv-ipsecn") as lab:
        # A default route, as on real hosts: it also leads to the virtual addresses, and must not be used for them.
        bare = lab.host("bare", f"{BARE}/24", gateway="10.89.0.1")
        robot, ocu = lab.host("robot", f"{ROBOT}/24"), lab.host("ocu", f"{OCU}/24")
        with Appliance(bare, policy=POLICY, isolation="netns") as appliance:
            kit = tmp_path / "kit.tar.gz"
            said = appliance.rosrv("host", "add", "ocu-1", "--output", str(kit)).stdout
            assert f"the appliance is at {BARE} (this machine's address towards its default route)" in said
            with JoinedHost(ocu, kit, tmp_path / "ocu") as joined:
                joined.wait_until_up()
                with (
                    RosSession(f"http://{BARE}:11311", tmp_path, robot) as on_robot,
                    RosSession(joined.master, tmp_path, joined) as on_ocu,
                ):
                    on_robot.talker("rospy", "/chatter", name="voice")
                    on_ocu.listener("rospy", "/chatter", name="ear").wait_for(event="received")
                    told = on_ocu.run("/usr/bin/rosnode", "info", "/voice", check=False).stdout
                    assert "contacting node http://10.113.11.1:" in told
                assert authority_seen_from(joined).startswith("-----BEGIN CERTIFICATE-----")
            rules = [rule["purpose"] for rule in appliance.status()["firewall"]["forwarding"]]
            assert "UDP 4500 to the appliance, IPv4" in rules


PRIVATE_DEVICE = """\
mount --make-rprivate / && mount -t tmpfs tmpfs /dev/net && mknod -m 600 /dev/net/tun c 10 200 && exec "$@"
"""


def test_a_device_that_only_root_may_open_carries_the_tunnel() -> None:
    need_root()
    need_strongswan()
    mine = f"{Path(__file__).resolve()}::{test_the_host_forwards_the_tunnel.__name__}"
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-ec", PRIVATE_DEVICE, "sh", sys.executable, "-m", "pytest", "-n0", "-q", mine],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout


def authority_seen_from(joined: JoinedHost) -> str:
    asked = joined.popen(
        [
            "curl",
            "--silent",
            "--show-error",
            "--insecure",
            "--max-time",
            "20",
            "https://10.113.11.1:8443/v1/authority",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    out, _ = asked.communicate(timeout=30)
    return str(out)


def test_a_host_enrols_itself_through_the_forwarding(tmp_path: Path) -> None:
    need_root()
    need_strongswan()
    config = tmp_path / "appliance.yaml"
    config.write_text(f"api: 0.0.0.0:8443\napi_networks: [{OCU}/32]\n")
    with Lab("rosrv-ipsect") as lab:
        bare = lab.host("bare", f"{BARE}/24", gateway="10.89.0.1")
        ocu, robot = lab.host("ocu", f"{OCU}/24"), lab.host("robot", f"{ROBOT}/24")
        script = tmp_path / "join.sh"
        options = ("--config", str(config))
        with (
            Appliance(bare, policy=POLICY, isolation="netns", options=options) as appliance,
            ScriptHost(ocu, tmp_path / "ocu") as laptop,
            ScriptHost(robot, tmp_path / "robot") as unknown,
        ):
            done = appliance.rosrv(
                "host", "add", "ocu-1", "--appliance", BARE, "--token", "--output", str(script), "--json"
            )
            token = json.loads(done.stdout)["token"]
            refused = unknown.run("sh", str(script), token, check=False)
            assert refused.returncode == 1
            assert "no answer from the appliance" in refused.stderr
            assert "the tunnel is up" in laptop.run("sh", str(script), token).stdout
            assert "in force" in laptop.run("/etc/rosrv/renew.sh", "--now").stdout
