"""Compare the compiled policy with a naive decider written from the documentation."""

import fnmatch
import ipaddress
import itertools
import re

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from tests.support.examples import examples

Rules = list[tuple[str, str, list[str]]]  # section, key, words of the value


def group_members(word: str, groups: dict[str, list[str]], seen: tuple[str, ...] = ()) -> list[str]:
    if word not in groups or word in seen:
        return [word]
    return [leaf for inner in groups[word] for leaf in group_members(inner, groups, (*seen, word))]


def names_host(words: list[str], groups: dict[str, list[str]], host: str) -> bool:
    address = ipaddress.ip_address(host)
    for leaf in (leaf for word in words for leaf in group_members(word, groups)):
        if leaf == "*" or address in ipaddress.ip_network(leaf):
            return True
    return False


def key_matches(key: str, name: str) -> bool:
    if key.endswith("/**"):
        beginning = re.escape(key[:-3]).replace(r"\*", "[^/]*")
        return re.fullmatch(beginning + "(/.*)?", name) is not None
    return fnmatch.fnmatchcase(name, key) and key.count("/") == name.count("/")


def rank(key: str) -> tuple[int, int, int]:
    return ("*" not in key, len(key.partition("*")[0]), "**" not in key)


def decide_slowly(
    rules: Rules, groups: dict[str, list[str]], section: str, host: str, name: str
) -> bool | None:
    mine = [(key, words) for its, key, words in rules if its == section]
    if not mine:
        return None
    matching = sorted(
        ((rank(key), key, words) for key, words in mine if key != "default" and key_matches(key, name)),
        reverse=True,
    )
    chosen = matching[0][2] if matching else dict(mine).get("default", [])
    return names_host(chosen, groups, host)


NAMES = ["a", "b", "ab", "arm"]
KEY = st.lists(st.sampled_from([*NAMES, "*", "a*", "ar*"]), min_size=1, max_size=3).map(
    lambda p: "/" + "/".join(p)
)
KEYS = st.one_of(KEY, KEY.map(lambda key: key + "/**"), st.just("/**"), st.just("default"))
WORDS = st.sampled_from(
    ["g0", "g1", "g2", "10.0.0.1", "10.0.0.0/30", "10.0.0.0/8", "fd00::1", "fd00::/16", "*", "10.0.0.3"]
)
VALUES = st.lists(WORDS, max_size=3, unique=True)
HOSTS = st.sampled_from(["10.0.0.1", "10.0.0.3", "10.0.0.9", "11.0.0.1", "fd00::1", "fd01::1"])
NAME = st.lists(st.sampled_from([*NAMES, "arms"]), min_size=1, max_size=4).map(lambda p: "/" + "/".join(p))


@st.composite
def policies(draw: st.DrawFn) -> tuple[Rules, dict[str, list[str]]]:
    leaves = st.lists(WORDS.filter(lambda word: not word.startswith("g")), max_size=2, unique=True)
    groups = {
        f"g{n}": draw(leaves) + ([f"g{n + 1}"] if n < 2 and draw(st.booleans()) else []) for n in range(3)
    }
    keys = draw(st.lists(KEYS, max_size=8, unique=True))
    rules: Rules = []
    for key in keys:
        if not any(
            rank(key) == rank(other) and key != "default" != other and "*" in key for _, other, _ in rules
        ):
            rules.append(("Publishers", key, draw(VALUES)))
    return rules, groups


@settings(max_examples=examples(400))
@given(policies(), st.lists(st.tuples(HOSTS, NAME), min_size=1, max_size=20))
def test_compiled_decisions_are_those_of_the_naive_decider(
    policy: tuple[Rules, dict[str, list[str]]], requests: list[tuple[str, str]]
) -> None:
    rules, groups = policy
    text = "[Groups]\n" + "".join(f"{name} = {' '.join(words)}\n" for name, words in groups.items())
    text += "[Publishers]\n" + "".join(f"{key} = {', '.join(words)}\n" for _, key, words in rules)
    fast = compile_policy(text, file="p.ini")
    for host, name in requests:
        expected = decide_slowly(rules, groups, "Publishers", host, name) or False
        decision = fast.decide(Request(ipaddress.ip_address(host), "/n", Category.PUBLISH, name))
        assert decision.allowed == expected
        assert len(decision.reason) < 300


# Covers every literal of the keys, and a new name for each prefix before a star.
LEVELS = ["a", "b", "ab", "arm", "ax", "arx", "zz"]
BELOW = ["/" + "/".join(parts) for depth in (1, 2, 3) for parts in itertools.product(LEVELS, repeat=depth)]
BELOW += [f"{below}/zz" for below in BELOW if below.count("/") == 3]


@settings(max_examples=examples(100))
@given(policies(), HOSTS, st.sampled_from(["/", "/a", "/b", "/arm", "/a/b", "/a/arm"]))
def test_namespace_may_be_touched_only_if_everything_in_it_may(
    policy: tuple[Rules, dict[str, list[str]]], host: str, key: str
) -> None:
    rules, groups = policy
    text = "[Groups]\n" + "".join(f"{name} = {' '.join(words)}\n" for name, words in groups.items())
    text += "[Parameters]\n" + "".join(f"write {key} = {', '.join(words)}\n" for _, key, words in rules)
    request = Request(ipaddress.ip_address(host), "/n", Category.WRITE, key)
    allowed = compile_policy(text, file="p.ini").decide_parameter(request, namespace=True).allowed
    inside = [key + below if key != "/" else below for below in BELOW]
    wanted = all(decide_slowly(rules, groups, "Publishers", host, name) for name in [key, *inside])
    star_before_the_end = any(re.search(r"\*(?!\**$)", rule_key) for _, rule_key, _ in rules)
    if allowed or not star_before_the_end:
        assert allowed == wanted


@settings(max_examples=examples(400))
@given(st.lists(KEYS, min_size=2, max_size=2, unique=True), st.lists(NAME, max_size=30))
def test_keys_that_load_together_never_tie(keys: list[str], names: list[str]) -> None:
    text = "[Publishers]\n" + "".join(f"{key} = *\n" for key in keys)
    try:
        compile_policy(text, file="p.ini")
    except PolicyError:
        assert rank(keys[0]) == rank(keys[1])
        return
    patterns = [key for key in keys if key != "default"]
    for name in names:
        ranks = [rank(key) for key in patterns if key_matches(key, name)]
        assert len(ranks) == len(set(ranks))
