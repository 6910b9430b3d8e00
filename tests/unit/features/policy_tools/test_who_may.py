import ipaddress
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.features.policy_tools import who_may as module
from appliance.features.policy_tools.who_may import who_may
from appliance.policy.host_sets import Network
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import decide, rights_of
from tests.support.examples import examples


def test_no_answer_for_other_hosts_if_the_networks_are_all() -> None:
    policy = compile_policy("[Nodes]\ndefault = 0.0.0.0/0 ::/0\n", file="p.ini")
    assert [answer.hosts for answer in who_may(policy, Category.NODE, "/n")] == ["0.0.0.0/0", "::/0"]


def test_hosts_that_need_an_approval_are_listed() -> None:
    text = "[Nodes]\ndefault = *\n[Publishers]\n/cmd_vel = 10.0.0.1 ask 10.0.0.7\n"
    policy = compile_policy(text, file="p.ini")
    verdicts = [answer.decision.verdict for answer in who_may(policy, Category.PUBLISH, "/cmd_vel")]
    assert verdicts == ["allow", "ask", "deny"]


_NEAR = st.builds(
    lambda last, prefix: str(ipaddress.ip_network((10 << 24 | last, prefix), strict=False)),
    st.integers(0, 7),
    st.integers(29, 32),
)
_FAR = st.sampled_from(
    ["0.0.0.0/0", "0.0.0.0/1", "255.255.255.254/31", "::/0", "::1", "::/127", "::ffff:10.0.0.0/125", "8000::/1"]
)  # fmt: skip
_NETWORKS = _NEAR | _NEAR | _FAR
_WORDS = _NETWORKS | _NETWORKS | st.sampled_from(["*", "robot", "host:a", "one", "two"])
_VALUES = st.lists(_WORDS, max_size=4, unique=True).map(" ".join)
_KEYS = {
    "Nodes": ["default", "/n"],
    "Publishers": ["default", "/t"],
    "Commands": ["default", "getParam", "setParam", "lookupService"],
    "Clients": ["default", "/t"],
    "Parameters": ["read default", "read /t", "write /t/b"],
}
_ACTIONS = [
    (Category.PUBLISH, "/t"), (Category.NODE, "/n"), (Category.COMMAND, "getParam"), (Category.CALL, "/t"),
    (Category.READ, "/t"), (Category.WRITE, "/t"),
]  # fmt: skip


@st.composite
def _policies(draw: st.DrawFn) -> str:
    groups = [f"{name} = {draw(st.lists(_NETWORKS, max_size=3).map(' '.join))}" for name in ("one", "two")]
    lines = ["[Groups]", *groups]
    for section, keys in _KEYS.items():
        if draw(st.integers(0, 3)):
            chosen = draw(st.lists(st.sampled_from(keys), unique=True))
            lines += [f"[{section}]", *(f"{key} = {draw(_VALUES)}" for key in chosen)]
    audited = draw(st.lists(st.sampled_from(sorted(_KEYS)), max_size=2, unique=True))
    if audited:
        lines += ["[Options]", f"audit-only = {' '.join(audited)}"]
    return "\n".join(lines)


def _edges(networks: dict[Network, int]) -> Iterator[Address]:
    for network in networks:
        first, last = int(network.network_address), int(network.broadcast_address)
        for number in (first - 1, first, (first + last) // 2, last, last + 1):
            if 0 <= number < 1 << network.max_prefixlen:
                yield type(network.network_address)(number)


@given(_policies(), st.sampled_from(_ACTIONS), st.sampled_from(["", "/n"]))
@settings(max_examples=examples(1200), deadline=None)
def test_every_host_has_the_answer_of_its_network(text: str, action: tuple[Category, str], node: str) -> None:
    robot = [ipaddress.ip_network("10.0.0.2/31"), ipaddress.ip_network("::1")]
    policy = compile_policy(text, file="p.ini", hosts={"a": ipaddress.ip_address("10.0.0.5")}, robot=robot)
    answers = {answer.network: answer for answer in who_may(policy, *action, node)}
    for host in _edges(policy.hosts.networks()):
        rights = [right for right in rights_of(Request(host, node, *action)) if right.request.resource]
        assert (
            answers[policy.named_as(host) if policy.names(host) else None].decision.word
            == decide(policy, rights).word
        )


def test_many_addresses_are_not_compared_with_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []

    def count(outer: Network, inner: Network) -> bool:
        compared.append(inner)
        return inner.version == outer.version and inner.network_address in outer

    monkeypatch.setattr(module, "_within", count)
    many = " ".join(f"10.0.{number >> 8}.{number & 255}" for number in range(500))
    policy = compile_policy(f"[Nodes]\ndefault = 10.0.0.0/8 {many}\n", file="p.ini")
    assert len(list(who_may(policy, Category.NODE, "/n"))) == 502
    assert len(compared) <= 3 * 500
