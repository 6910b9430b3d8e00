from appliance.quotas.peers import ReportShares, peer_key


def test_addresses_of_one_peer() -> None:
    assert peer_key("10.0.0.1") == "10.0.0.1"
    assert peer_key("::ffff:10.0.0.1") == "10.0.0.1"
    assert peer_key("2001:db8::1") == peer_key("2001:db8::ffff:2") != peer_key("2001:db8:0:1::1")
    assert peer_key("::1") == "::1", "the operator's own machine"
    assert peer_key("somewhere") == "somewhere"


def test_a_flood_of_some_peers_leaves_each_other_one_a_row() -> None:
    shares = ReportShares(100)
    floods = [shares.rest_of(f"10.0.0.{number % 3}") for number in range(1000)]
    assert (floods.count(None), {*floods}) == (100, {None, "10.0.0.0", "10.0.0.1", "10.0.0.2"})
    others = [shares.rest_of(f"10.0.1.{number}") for number in range(200)]
    assert others == [None] * 97 + [""] * 103
    shares.clear()
    assert [shares.rest_of("10.0.0.1") for _ in range(100)] == [None] * 75 + ["10.0.0.1"] * 25
