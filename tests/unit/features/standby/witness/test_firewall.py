import pytest

from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.firewall import LeaseFirewall, chosen_backend
from appliance.features.standby.witness.firewall_rules import iptables_rules, nft_rules
from appliance.features.standby.witness.settings import AppliancePeer, WitnessSettings
from tests.unit.features.standby.witness.robot import PAIR_SETTINGS


def test_the_backend_is_nft_from_linux_4_18() -> None:
    assert chosen_backend("4.18.0-25-generic", lambda name: name) == "nft"
    assert chosen_backend("4.4.0-210", lambda name: name) == "iptables"
    assert chosen_backend("6.1", {"iptables-restore": "/sbin/iptables-restore"}.get) == "iptables"
    with pytest.raises(WitnessError, match="apt install nftables"):
        chosen_backend("6.1", lambda name: None)


@pytest.mark.parametrize(
    ("tables", "intact"), [("table inet other\n", False), ("table ip rosrv_witness\n", None), (None, None)]
)
def test_a_table_that_is_gone_differs_from_a_program_that_fails(
    tables: str | None, intact: bool | None
) -> None:
    rules = ["table ip rosrv_witness { }"]

    def run(command: list[str], _text: str, _left: object) -> str:
        found = {"-f": "", "table": rules[0], "tables": tables}[command[1 if command[1] == "-f" else 2]]
        if not found and command[1] == "list":
            raise WitnessError("nft: no")
        return found or ""

    firewall = LeaseFirewall(PAIR_SETTINGS, "nft", run)
    firewall.admit("a")
    assert firewall.intact(firewall.present())
    rules[0] = ""
    if intact is None:
        with pytest.raises(WitnessError):
            firewall.present()
    else:
        assert firewall.intact(firewall.present()) is intact


def test_rules_that_change_before_they_are_first_read_are_not_taken_for_ours() -> None:
    firewall = LeaseFirewall(PAIR_SETTINGS, "iptables", lambda _command, _text, _left: "*filter\nCOMMIT\n")
    firewall.admit("a")
    assert not firewall.intact(firewall.present())


_ARM = {"arm": AppliancePeer("10.0.0.4", b"c" * 32)}
_FOLLOWER = PAIR_SETTINGS._replace(
    appliances={name: peer._replace(key=b"") for name, peer in PAIR_SETTINGS.appliances.items()},
    followers=_ARM,
    follows_as="arm",
)


@pytest.mark.parametrize("admitted", ["", "a", "b"])
@pytest.mark.parametrize(
    "settings", [PAIR_SETTINGS, PAIR_SETTINGS._replace(followers=_ARM), _FOLLOWER], ids=["pair", "arm", "its"]
)
def test_the_port_of_the_witness_is_closed_at_its_own_address_only(
    settings: WitnessSettings, admitted: str
) -> None:
    """ROS 2 has its data of domain 0 at UDP 7411 too."""
    for text, address in (
        (nft_rules(settings, admitted), "ip daddr 10.0.0.1 "),
        (iptables_rules(settings, admitted, {}), "-d 10.0.0.1 "),
    ):
        closing = [row for row in text.splitlines() if "7411" in row and row.lower().endswith(" drop")]
        assert closing and all(address in row for row in closing), closing
