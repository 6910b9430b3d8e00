from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.master.graph.registry import Incarnation, Kind, new_key
from appliance.policy.live_rights import LiveRight, endings
from appliance.policy.policy_compiler import compile_policy
from appliance.store.state_file import PermissionRow
from tests.support import autojump
from tests.support.control_parts import ControlParts
from tests.support.examples import examples
from tests.support.incarnations import incarnation
from tests.support.parameters import mirror

HOSTS = ("10.0.0.5", "10.0.0.6")
NODES = ("/a", "/ns/b")
THINGS = ("/x", "/x/y", "/ns/z")
WORDS = {
    Kind.PUBLICATION: "publication",
    Kind.SUBSCRIPTION: "subscription",
    Kind.SERVICE: "service",
    Kind.PARAMETER: "parameter",
}
Row = tuple[str, str, str, str]


def sections(keys: tuple[str, ...], verbs: tuple[str, ...] = ("",)) -> st.SearchStrategy[dict[str, str]]:
    written = [verb + key for verb in verbs for key in (*keys, "default")]
    who = st.sampled_from(["", "*", *HOSTS, " ".join(HOSTS)])
    return st.dictionaries(st.sampled_from(written), who, max_size=4)


POLICIES = st.fixed_dictionaries(
    {
        "Nodes": sections(NODES),
        "Publishers": sections(THINGS),
        "Subscribers": sections(THINGS),
        "Commands": sections(("lookupService", "subscribeParam")),
    },
    optional={
        "Services": sections(THINGS),
        "Clients": sections(THINGS),
        "Parameters": sections((*THINGS, "/x/**"), ("read ",)),
        "Options": st.sampled_from([{"audit-only": "Publishers Clients"}, {"audit-only": "all"}]),
    },
)
REGISTRATIONS = st.frozensets(
    st.tuples(
        st.sampled_from(HOSTS), st.sampled_from(NODES), st.sampled_from(list(Kind)), st.sampled_from(THINGS)
    ),
    max_size=12,
)
GRANTS = st.frozensets(
    st.tuples(
        st.sampled_from(HOSTS),
        st.sampled_from((*NODES, "")),
        st.sampled_from(("topic", "service")),
        st.sampled_from(THINGS),
    ),
    max_size=8,
)
TREES = st.sampled_from([{}, {"x": 1}, {"x": {"y": 1}}, {"x": {"y": {"z": 1}}}])


def text_of(written: dict[str, dict[str, str]]) -> str:
    return "".join(
        f"[{name}]\n" + "".join(f"{key} = {who}\n" for key, who in lines.items())
        for name, lines in written.items()
    )


def held(world: ControlParts) -> set[Row]:
    return {
        (str(node.host), node.name, WORDS[registration.kind], registration.resource)
        for node in world.registry.all()
        for registration in node.registrations.values()
    } | {
        (row.host, row.caller_id, "subscription" if row.kind == "topic" else "call", row.resource)
        for row in world.grants.all()
    }


async def taken(
    policy: str, registrations: frozenset[Any], grants: frozenset[Any], tree: dict[str, Any]
) -> tuple[set[Row], set[Row], int]:
    world = await ControlParts.begun()
    world.parameters = mirror(tree)
    nodes: dict[tuple[str, str], Incarnation] = {}
    for number, (host, name, kind, resource) in enumerate(sorted(registrations), start=4000):
        if (host, name) not in nodes:
            node = incarnation(name, number, host=host, key=new_key())
            nodes[host, name] = node
            world.registry.add(node)
        world.graph.registered(nodes[host, name], kind, resource, "4001")
    for host, name, kind, thing in grants:
        world.grants.give(PermissionRow("key", kind, thing, host, name))
    before = held(world)
    seen = [LiveRight.of(live.fields()) for live in world.revocation.live()]
    named = endings(compile_policy(policy, file="policy"), seen)
    assert held(world) == before
    count = world.reload(policy)
    gone = before - held(world)
    await world.settle()
    return {(one.host, one.caller_id, one.what, one.resource) for one in named}, gone, count


@settings(max_examples=examples(100))
@given(POLICIES, REGISTRATIONS, GRANTS, TREES)
def test_a_dry_run_names_exactly_what_a_reload_revokes(
    written: dict[str, dict[str, str]],
    registrations: frozenset[Any],
    grants: frozenset[Any],
    tree: dict[str, Any],
) -> None:
    named, gone, count = autojump.run(taken(text_of(written), registrations, grants, tree))
    assert named == gone
    assert bool(count) == bool(gone)
