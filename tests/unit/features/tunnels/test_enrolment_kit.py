import io
import re
import subprocess
import tarfile
from dataclasses import replace

import pytest
from msgspec import structs

from appliance.features.tunnels.enrolment_kit import Kit, archive, swanctl_conf
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.tunnel_answers import KitParts

HOST = KitParts(
    revision=1, name="ocu-1", address="10.113.11.2", appliance="10.113.11.1",
    master="http://10.113.11.1:11311", rest_url="", rest_trouble="REST is off", pin="", warning=None,
    serial="1a", expires=0.0, certificate="CERTIFICATE\n", authority="AUTHORITY\n",
)  # fmt: skip
KIT = kit_of(HOST, KitOptions("192.168.1.20"), "KEY\n")


def unpack(kit: Kit) -> dict[str, tuple[str, int]]:
    with tarfile.open(fileobj=io.BytesIO(archive(kit))) as tar:
        found = {}
        for member in tar:
            file = tar.extractfile(member)
            assert file is not None
            found[member.name] = (file.read().decode(), member.mode)
        return found


def test_a_kit_is_one_folder_with_a_private_key_for_its_owner_only() -> None:
    found = unpack(KIT)
    assert {path.split("/")[0] for path in found} == {"rosrv-ocu-1"}
    assert found["rosrv-ocu-1/swanctl/private/rosrv.key"] == ("KEY\n", 0o600)
    assert found["rosrv-ocu-1/swanctl/x509/rosrv.pem"][0] == "CERTIFICATE\n"
    assert found["rosrv-ocu-1/swanctl/x509ca/rosrv-ca.pem"][0] == "AUTHORITY\n"
    for script in ("join.sh", "leave.sh", "keep.sh", "renew.sh"):
        assert found[f"rosrv-ocu-1/{script}"][1] == 0o755


def test_a_host_that_made_its_key_gets_none() -> None:
    assert "rosrv-ocu-1/swanctl/private/rosrv.key" not in unpack(replace(KIT, key=None))


@pytest.mark.nightly
@pytest.mark.parametrize("script", ["join.sh", "leave.sh", "keep.sh", "renew.sh"])
def test_scripts_are_complete_shell(script: str) -> None:
    text = unpack(KIT)[f"rosrv-ocu-1/{script}"][0]
    done = subprocess.run(["/bin/sh", "-n"], input=text, text=True, capture_output=True, check=False)
    assert done.stderr == ""
    for word in ("@name@", "@address@", "@endpoint@", "@master@", "@child@", "@connection@", "@appliance@"):
        assert word not in text


def test_join_prints_the_settings_for_ros() -> None:
    assert (
        "ROS_MASTER_URI=http://10.113.11.1:11311 ROS_IP=10.113.11.2" in unpack(KIT)["rosrv-ocu-1/join.sh"][0]
    )


def test_the_tunnel_leads_to_the_appliance_only() -> None:
    text = swanctl_conf(KIT)
    assert "remote_ts = 10.113.11.1/32" in text
    assert "local_ts = dynamic" in text
    assert "id = fqdn:ocu-1" in text
    proposals = [line for line in text.splitlines() if "proposals" in line]
    assert proposals
    for line in proposals:
        for one in line.split("=")[1].split(","):
            assert one.strip().startswith("aes256gcm16-")
            assert one.strip().endswith(("-x25519", "-ecp384"))


CLEAR_TEXT = {
    "in the kernel": ("meta ipsec missing ip saddr", "rt ipsec missing ip daddr"),
    "in user space": ('iifname != "ipsec*" ip saddr', 'oifname != "ipsec*" ip daddr'),
}


def test_the_firewall_of_a_host_keeps_the_appliances_address_for_the_tunnel() -> None:
    """In both directions, in a table that `rosrv protect` does not replace, without a rule before these."""
    text = unpack(KIT)["rosrv-ocu-1/protect.nft"][0]
    assert "        ip saddr { 10.113.11.1 } accept\n" in text.partition("table inet rosrv_tunnel {")[0]
    for hook, either in zip(
        ("prerouting", "postrouting"), zip(*CLEAR_TEXT.values(), strict=True), strict=True
    ):
        (chain,) = re.findall(
            rf"hook {hook} [^\n]*\n([^}}]*)}}", text.partition("table inet rosrv_tunnel {")[2]
        )
        assert [line.strip() for line in chain.strip().splitlines()] == [
            f"{rule} 10.113.11.1 counter drop" for rule in either
        ]


def test_the_script_removes_the_rules_that_do_not_apply() -> None:
    """The correct rules depend on where ESP runs, and a kernel without IPsec cannot even load the others."""
    files = unpack(KIT)
    script, text = files["rosrv-ocu-1/join.sh"][0], files["rosrv-ocu-1/protect.nft"][0]
    found = re.findall(r"""say "ESP runs (.*)"\n    never=(?:'(.*)'|"(.*)")$""", script, re.MULTILINE)
    assert {where for where, *_ in found} == CLEAR_TEXT.keys()
    for where, single, double in found:
        left = [line.strip() for line in text.splitlines() if (single or double) not in line]
        assert len(left) == len(text.splitlines()) - 2
        assert [line for line in left if "ipsec" in line] == [
            f"{rule} 10.113.11.1 counter drop" for rule in CLEAR_TEXT[where]
        ]


@pytest.mark.nightly
def test_a_kit_says_where_its_certificate_is_renewed() -> None:
    host = structs.replace(HOST, rest_url="https://10.113.11.1:8443", pin="sha256//pin=")
    text = unpack(replace(KIT, host=host))["rosrv-ocu-1/renew.sh"][0]
    assert 'rest="https://10.113.11.1:8443"' in text
    assert 'pin="sha256//pin="' in text
    without = unpack(KIT)["rosrv-ocu-1/renew.sh"][0]
    done = subprocess.run(["/bin/sh"], input=without, text=True, capture_output=True, check=False)
    assert done.returncode == 2
    assert "rosrv host kit ocu-1" in done.stderr


TWO = replace(KIT, host=structs.replace(HOST, second="192.168.1.21"))


def test_a_kit_for_two_appliances_has_a_connection_to_each() -> None:
    text = swanctl_conf(TWO)
    assert re.findall(r"^  (\S+) \{$", text, re.MULTILINE) == ["rosrv", "rosrv-2"]
    assert re.findall(r"remote_addrs = (\S+)", text) == ["192.168.1.20", "192.168.1.21"]
    files = unpack(TWO)
    assert files["rosrv-ocu-1/keep.sh"][0].count("rosrv rosrv-2") == 1
    for script in ("join.sh", "leave.sh"):
        assert "rosrv rosrv-2" in files[f"rosrv-ocu-1/{script}"][0]
    assert "192.168.1.20 or 192.168.1.21" in files["rosrv-ocu-1/README"][0]


@pytest.mark.parametrize("kit", [KIT, TWO], ids=["one", "two"])
def test_charon_opens_no_tunnel_itself(kit: Kit) -> None:
    """keep.sh opens it, as otherwise tunnels to both appliances could be open."""
    found = re.findall(r"(start|close|dpd)_action = (\S+)", swanctl_conf(kit))
    assert set(found) == {("start", "none"), ("close", "none"), ("dpd", "clear")}


def test_a_second_appliance_at_the_same_address_is_not_another_one() -> None:
    assert swanctl_conf(KIT).count("remote_addrs") == 1
    assert swanctl_conf(replace(TWO, endpoint="192.168.1.21")).count("remote_addrs") == 1
