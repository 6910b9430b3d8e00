from pathlib import Path

from appliance.channel.messages import TunnelHost, TunnelsStated
from appliance.ipsec.strongswan import (
    ESP_PROPOSALS,
    IKE_PROPOSALS,
    Proposals,
    configuration,
    connection,
    host_of,
    plugins,
    pool,
    proposals_of,
)

HOST = TunnelHost("ocu-1", "10.113.11.2", "a1")
STATED = TunnelsStated(1, "kernel", "10.113.11.1", b"A", b"C", b"R", [HOST])


def test_a_host_gets_one_address_and_reaches_the_appliance_only() -> None:
    assert pool(HOST) == {"host-ocu-1": {"addrs": "10.113.11.2-10.113.11.2"}}
    made = connection(HOST, STATED, Proposals())["host-ocu-1"]
    assert made["pools"] == ["host-ocu-1"]
    assert made["children"]["ros"]["local_ts"] == ["10.113.11.1/32"]
    assert made["children"]["ros"]["remote_ts"] == ["dynamic"]


def test_a_host_is_identified_by_its_certificate() -> None:
    """A valid certificate of this authority must have the name. Without a valid revocation list, no host connects."""
    remote = connection(HOST, STATED, Proposals())["host-ocu-1"]["remote"]
    assert remote == {"auth": "pubkey", "cacerts": [b"A"], "id": "fqdn:ocu-1", "revocation": "strict"}


def test_nothing_weak_is_offered() -> None:
    assert {proposal.rpartition("-")[0] for proposal in IKE_PROPOSALS} == {"aes256gcm16-prfsha384"}
    assert {proposal.rpartition("-")[0] for proposal in ESP_PROPOSALS} == {"aes256gcm16"}
    assert {proposal.rpartition("-")[2] for proposal in (*IKE_PROPOSALS, *ESP_PROPOSALS)} == {
        "x25519",
        "ecp384",
    }


def test_charon_loads_what_it_needs_and_runs_no_programs() -> None:
    in_user_space, in_kernel = plugins("user space").split(), plugins("kernel").split()
    assert in_user_space.index("kernel-libipsec") < in_user_space.index("kernel-netlink")
    assert "kernel-libipsec" not in in_kernel
    assert not {"updown", "ext-auth", "curl", "stroke", "resolve"} & set(in_user_space)
    assert "socket = unix:///state/ipsec/vici.sock" in configuration(Path("/state/ipsec"), "kernel")


def test_an_unknown_connection_has_no_host() -> None:
    assert host_of("host-ocu-1") == "ocu-1"
    assert host_of("(unnamed)") is None


def test_ml_kem_is_offered_where_charon_has_it() -> None:
    assert proposals_of(["CURVE_25519", "ECP_384"]).key_exchange == ["x25519", "ecp384"]
    proposals = proposals_of(["ECP_384", "CURVE_25519", "ML_KEM_768", "MODP_1024"])
    assert proposals.key_exchange == ["x25519+mlkem768", "x25519", "ecp384"]
    assert proposals.ike[0] == "aes256gcm16-prfsha384-x25519-ke1_mlkem768"
    assert proposals.esp[0] == "aes256gcm16-x25519-ke1_mlkem768"
    (row,) = connection(HOST, STATED, proposals).values()
    assert row["proposals"] == list(proposals.ike)


def test_two_hundred_addresses_leave_handshakes_for_hosts() -> None:
    said = configuration(Path("/state/ipsec"), "kernel")
    limits = dict(line.strip().split(" = ") for line in said.splitlines() if " = " in line)
    each, whole = int(limits["block_threshold"]), int(limits["init_limit_half_open"])
    assert 200 * each * 2 <= whole
    assert int(limits["cookie_threshold"]) < whole
