from appliance.channel.messages import (
    ClientGranted,
    GrantInstalled,
    NodePlaced,
    PublicationPlaced,
    ServicePlaced,
)
from appliance.relay.grant_table import GrantTable, ServiceEndpoint
from appliance.relay.loop import ANYBODY, UNKNOWN

NODE = NodePlaced("k", "/talker", "10.0.0.1")
TOPIC = PublicationPlaced("k", "/chatter", "std_msgs/String")
GRANT = GrantInstalled("k", "/chatter", "10.0.0.2", "/listener")
SERVICE = ServicePlaced("k", "/add", "10.0.0.1", 4000)
CLIENT = ClientGranted("k", "/add", "10.0.0.2", "/c")
EVERYTHING = (NODE, TOPIC, GRANT, SERVICE, CLIENT)


def stated() -> GrantTable:
    table = GrantTable()
    for message in EVERYTHING:
        table.state(message)
    return table


def test_a_grant_is_for_one_host_one_caller_one_topic_and_one_incarnation() -> None:
    table = stated()
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener")
    assert table.grant("other", "/chatter", "10.0.0.2", "/listener") is None
    assert table.grant("k", "/secret", "10.0.0.2", "/listener") is None
    assert table.grant("k", "/chatter", "10.0.0.3", "/listener") is None
    assert table.grant("k", "/chatter", "10.0.0.2", "/unknown") is None
    assert table.may_call("k", "/add", "10.0.0.2", "/c")
    assert not table.may_call("k", "/add", "10.0.0.3", "/c")


def test_withdrawn_statements_are_gone() -> None:
    table = stated()
    table.withdraw(("grant", "k", "/chatter", "10.0.0.2", "/listener"))
    table.withdraw(("client", "k", "/add", "10.0.0.2", "/c"))
    table.withdraw(("publication", "k", "/chatter"))
    table.withdraw(("service", "k", "/add"))
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener") is None
    assert not table.may_call("k", "/add", "10.0.0.2", "/c")
    assert table.publication("k", "/chatter") is None
    assert table.service("k", "/add") is None
    assert table.node("k") == NODE


def test_a_node_takes_everything_of_its_incarnation_with_it() -> None:
    table = stated()
    table.state(GrantInstalled("other", "/chatter", "10.0.0.2", "/listener"))
    table.withdraw(("node", "k"))
    assert table.publication("k", "/chatter") is None
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener") is None
    assert not table.may_call("k", "/add", "10.0.0.2", "/c")
    assert table.grant("other", "/chatter", "10.0.0.2", "/listener")


def test_hosts_that_only_a_star_names_pay_as_one() -> None:
    """All of them with a registration share one quota, and all hosts without a registration another."""
    table = stated()
    for number in range(200):
        host = f"10.9.0.{number}"
        table.state(NodePlaced(host, "/guest", host))
        assert table.payer(host) == ANYBODY
        table.state(PublicationPlaced(host, "/guest", "*", named=False))
        table.state(GrantInstalled("k", "/chatter", f"10.9.1.{number}", "/ear", named=False))
        table.state(ClientGranted("k", "/add", f"10.9.2.{number}", "/c", named=False))
        assert {table.payer(f"10.9.{kind}.{number}") for kind in range(3)} == {ANYBODY}
    assert [table.payer(f"10.0.0.{last}") for last in (1, 2, 3)] == ["10.0.0.1", "10.0.0.2", UNKNOWN]
    table.state(GrantInstalled("k", "/chatter", "10.0.0.2", "/listener", named=False))
    assert table.payer("10.0.0.2") == ANYBODY
    table.state(GrantInstalled("k", "/chatter", "10.9.1.1", "/ear", named=True))
    assert table.payer("10.9.1.1") == "10.9.1.1"
    table.withdraw(("node", "k"))
    assert table.payer("10.9.1.1") == UNKNOWN


def test_the_latest_place_of_a_service_counts() -> None:
    table = stated()
    table.state(ServicePlaced("k", "/add", "10.0.0.1", 5000))
    assert table.service("k", "/add") == ServiceEndpoint("k", "/add", "10.0.0.1", 5000, "/talker", own=False)


def test_the_end_of_a_restatement_withdraws_the_rest() -> None:
    table = stated()
    table.begin(2)
    for message in (NODE, TOPIC):
        table.state(message)
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener")
    gone = table.end(2)
    assert {fact[0] for fact in gone} == {"grant", "service", "client"}
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener") is None
    assert table.publication("k", "/chatter") == TOPIC


def test_a_restatement_that_another_control_begins_again_withdraws_nothing() -> None:
    table = stated()
    table.begin(2)
    table.state(NODE)
    table.begin(3)
    assert table.end(2) == []
    for message in EVERYTHING:
        table.state(message)
    assert table.end(3) == []
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener")


def test_a_withdrawal_during_a_restatement_stays() -> None:
    table = stated()
    table.begin(2)
    for message in EVERYTHING:
        table.state(message)
    table.withdraw(("grant", "k", "/chatter", "10.0.0.2", "/listener"))
    assert table.end(2) == []
    assert table.grant("k", "/chatter", "10.0.0.2", "/listener") is None
