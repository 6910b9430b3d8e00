import pytest

from appliance.api.routes.named_hosts import has_name, labels_of, with_networks
from appliance.audit.search.query import Filter, FilterError
from appliance.channel.answers.policy_answers import PolicyInForce

KNOWN = PolicyInForce(
    revision=1, file="p.ini", loaded=0.0, who="disk", note="", in_force=True, signature="", policy_file="p.ini",
    text="[Groups]\ntablet = 10.77.0.66 fd00::66\nguests = 10.77.0.0/24\n", differs_from_file=False, warnings=[],
    confirm_by=None, site_keys=[], robot=["10.88.0.10/32"], hosts={"laptop": "10.113.0.5"},
)  # fmt: skip


@pytest.mark.parametrize("host", [None, "10.0.0.1", "10.0.0.0/24", "FD00:0::66", "10.*", "[12]", "\udcff"])
def test_addresses_networks_and_globs_need_no_policy(host: str | None) -> None:
    assert not has_name(Filter(host=host))


def test_a_name_becomes_its_networks() -> None:
    for name, networks in (
        ("tablet", ("10.77.0.66/32", "fd00::66/128")),
        ("laptop", ("10.113.0.5/32",)),
    ):
        wanted = Filter(host=name, event="decision")
        assert has_name(wanted)
        assert with_networks(wanted, KNOWN) == Filter(hosts=networks, event="decision")
    with pytest.raises(FilterError, match=r"tabled.* did you mean .?tablet"):
        with_networks(Filter(host="tabled"), KNOWN)
    assert [(one.network, one.name) for one in labels_of(KNOWN).labels][-1] == ("10.77.0.0/24", "guests")
