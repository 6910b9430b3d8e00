import pytest

from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.firewall import LeaseFirewall, chosen_backend
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
