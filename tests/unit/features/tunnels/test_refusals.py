import pytest

from appliance.features.tunnels.refusals import (
    REFUSALS_OF_A_SOURCE,
    REFUSALS_PER_SECOND,
    REFUSED_SOURCES,
    Refusal,
    RefusalParser,
    RefusalShares,
)

REVOKED = """\
09[NET] received packet: from 10.88.0.20[4500] to 10.88.0.2[4500] (1184 bytes)
11[NET] received packet: from 10.88.0.66[500] to 10.88.0.2[500] (268 bytes)
09[CFG] checking certificate status of "O=ROSRV, CN=ocu-1"
09[CFG] certificate was revoked on Nov 20 06:53:25 UTC 2026, reason: unspecified
11[IKE] 10.88.0.66 is initiating an IKE_SA
11[ENC] generating IKE_SA_INIT response 0 [ SA KE No N(NATD_S_IP) N(NATD_D_IP) CERTREQ ]
09[ENC] generating IKE_AUTH response 1 [ N(AUTH_FAILED) ]
"""


def refusals(text: str) -> list[Refusal]:
    reader = RefusalParser()
    return [found for line in text.splitlines() if (found := reader.read(line)) is not None]


def test_the_reason_belongs_to_the_packet_of_its_thread() -> None:
    (found,) = refusals(REVOKED)
    assert found.remote == "10.88.0.20"
    assert found.reason.startswith("authentication failed; ")
    assert "revoked on Nov 20" in found.reason


def test_a_successful_handshake_is_not_a_refusal() -> None:
    lines = REVOKED.replace("N(AUTH_FAILED)", "IDr CERT AUTH CPRP(ADDR) SA TSi TSr N(MOBIKE_SUP)")
    assert refusals(lines) == []


def test_the_answer_may_have_more_than_the_error() -> None:
    (found,) = refusals(
        REVOKED.replace("[ N(AUTH_FAILED) ]", "[ IDr CERT AUTH N(MOBIKE_SUP) N(TS_UNACCEPT) ]")
    )
    assert found.reason.startswith("traffic that is not allowed")


def test_a_name_chosen_by_an_unknown_host_makes_no_long_reason() -> None:
    (found,) = refusals(REVOKED.replace("unspecified", "x" * 5000))
    assert len(found.reason) <= 400


def test_unknown_lines_of_the_log_are_skipped() -> None:
    assert refusals("\n\nrubbish\n09[ENC] generating IKE_AUTH response 1 [ N(AUTH_FAILED) ]\n") == []


def test_packets_that_esp_dropped() -> None:
    found = refusals("""\
16[ESP] ESP sequence number verification failed:
16[ESP]   src 10.88.0.20, dst 10.88.0.2, SPI 7ce6406b [seq 2]
16[ESP] ESP decryption or ICV verification failed
16[ESP] discarding inbound IP packet 10.113.11.2[4000] == 10.113.11.1[49312] [17] due to policy
16[ESP] discarding inbound IP packet 10.113.11.3 == 10.113.11.1 [1] due to policy
""")
    assert [(one.remote, one.packet) for one in found] == [
        ("10.88.0.20", True),
        ("10.113.11.2", True),
        ("10.113.11.3", True),
    ]
    assert "replayed" in found[0].reason
    assert "another host's tunnel" in found[1].reason


def test_a_refusal_at_the_first_packet_may_have_a_forged_address() -> None:
    first = """\
11[NET] received packet: from 10.88.0.66[500] to 10.88.0.2[500] (268 bytes)
11[ENC] generating IKE_SA_INIT response 0 [ N(NO_PROP) ]
"""
    assert [refusal.answered for refusal in refusals(first + REVOKED)] == [False, True]


@pytest.mark.parametrize("forged", [False, True], ids=["one host", "forged addresses"])
def test_no_unknown_host_hides_the_refusals_of_others(forged: bool) -> None:
    """Whatever comes first in a second; and each refusal is passed on or counted."""
    shares, honest = RefusalShares(), Refusal("10.0.0.5", "authentication failed", answered=True)
    for second in range(3):
        passed, flood = 0, 5_000
        for number in range(flood):
            remote = f"10.9.{number // 200}.{number % 200}" if forged else "10.9.0.1"
            passed += shares.passes(Refusal(remote, "no acceptable proposal", answered=not forged), second)
        assert passed < REFUSALS_PER_SECOND
        assert [shares.passes(honest, second) for _ in range(3)] == [True] * REFUSALS_OF_A_SOURCE + [False]
        rest = shares.rest()
        assert len(rest) <= REFUSED_SOURCES + 1
        assert sum(int(one.reason.split()[0]) for one in rest) == flood - passed + 1
        assert shares.rest() == []
