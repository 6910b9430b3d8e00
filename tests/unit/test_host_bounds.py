"""Each bound and each loop that hosts may share has a share for each host, or a reason why none keeps another out."""

import ast
import re
from pathlib import Path

import pytest

from distribution.fact_cache import facts_of_files
from tests.support.rows import require_rows
from tests.support.sources import ROOT

FOLDERS = ("appliance", "roswire/node")
OF_OPERATORS = re.compile(r"appliance/(api/console|cli|configuration|audit/proof|policy/policy_findings)")

SHARES = {
    "api/front/rates.py::_buckets": "self._buckets.get(peer_key(host)",
    "features/doors/lookout.py::gather": "in_turn([(one, [hosts.get(name, name)",
    "features/recorder/recording_plan.py::_begun": "setdefault((charged_to, what), deque())",
    "features/sso/routes.py::_waiting": "if most <= waiting[key] + 1",
    "features/sso/sign_on.py::_pending": "held.update(peer_key(one.address)",
    "master/endpoints/delivery.py::Semaphore": "self._turns.setdefault(node.host",
    "master/endpoints/traffic.py::_hosts": "self._named[host] < self._most - self._most // 4",
    "quotas/peers.py::_rows": "self._rows[peer] >= self._most - self._most // 4",
    "relay/loop.py::_payers": "self._payers[name] = _Payer(name",
    "rpc/graph_reader.py::gather": "lambda place: self._node(place, counts)",  # the master itself answers the others
    "rpc/host_shares.py::gather": "map(serve_host, hosts.values())",
    "rpc/host_shares.py::Semaphore": "of_host",
}
"""The text of the module that gives each host its share. Paths begin at `appliance/`."""
REASONS = {
    "one connection, client or publication has it": """
        features/doors/foxglove.py::_calls features/doors/foxglove.py::_channels
        features/doors/foxglove.py::_parameters features/doors/foxglove.py::_subscriptions
        features/doors/rosbridge.py::_asked features/doors/rosbridge.py::_calls features/doors/rosbridge.py::_told
        features/doors/session.py::_times features/doors/session.py::gather
        relay/connections/named_subscribers.py::_data relay/connections/relayed_topic.py::_passed
        relay/transport/frames.py::_torn relay/transport/frames.py::view roswire/node/network.py::gather
        roswire/node/topics.py::frames rpc/server.py::_body rpc/xmlrpc_client.py::_idle
    """,
    "beyond it something is read, made or asked for again, and no request is refused": """
        features/approvals/approval_table.py::_unanswered features/doors/door_node.py::_refused
        features/doors/door_processes.py::_host_numbers features/doors/known_types.py::_failed
        features/doors/known_types.py::_first features/doors/known_types.py::_read
        features/sso/routes.py::_used master/endpoints/node_ports.py::_routes
        master/graph/registry.py::_unused_types policy/policy.py::standings
        relay/monitors/interceptor.py::_known
    """,
    "beyond it reports are shortened or counted as one, and each act is decided without them": """
        api/front/control.py::_kept features/doors/heard_topic.py::told
        features/doors/known_types.py::_differing
        features/recorder/recorder.py::_told features/tunnels/process.py::_packets
        features/tunnels/refusals.py::_rest master/endpoints/traffic.py::_limited_topics
        relay/monitors/observation_points.py::_points relay/monitors/observations.py::_waiting
        relay/monitors/observer.py::_stopping relay/monitors/shadow.py::waiting relay/report.py::_ended
    """,
    "only operators, people who sign on, and programs with their tokens fill it": """
        api/front/access.py::_shown api/front/listener.py::gather api/front/services.py::Semaphore
        control/rest/rest.py::_recent control/rest/rest.py::_waiting control/rest/rest_proof.py::_taken
        features/blocks/orders.py::_blocks features/doors/door_table.py::_rows
        features/recorder/recording_store.py::_temporary features/recorder/timeline.py::_first
        features/sso/process.py::_tasks features/standby/passive.py::_serving hosts/host_table.py::ports
        hosts/host_table.py::rows hosts/hosts_file.py::mistakes relay/topic_taps.py::_open
    """,
    "only the appliance's processes, the two of a pair and the robot's witness fill it": """
        channel/channel.py::_descriptors features/standby/process.py::_pending
        features/standby/replication.py::_connections features/standby/replication.py::gather
        features/standby/replication_sender.py::gather features/standby/witness/follower.py::_pending
        roswire/node/ros_node.py::_tasks specifications/rollout.py::gather
        supervisor/listener_store.py::_sockets supervisor/process_handle.py::_rest
    """,
    "it is as long as the policy's groups, the guards or the topics in force": """
        control/motion_stop.py::gather features/approvals/orders.py::gather features/authority/orders.py::gather
        features/guards/proof_tests.py::gather specifications/records.py::_allowances
    """,
    "it bounds nothing: a batch, a threshold to tidy up, or another way to the same result": """
        master/rosmaster.py::_differing relay/connections/relayed_topic.py::_served
        relay/transport/rate_limit.py::flows store/state_file.py::_noted
    """,
    "the robot's own master or the kernel answers, and no other host": """
        control/links/supervisor_link.py::Semaphore rpc/graph_reader.py::Semaphore rpc/master_reader.py::Semaphore
        rpc/master_reader.py::gather supervisor/isolation_watchdog.py::Semaphore
    """,
}


def bounds(path: Path) -> set[str]:
    """Return the attributes whose length is compared with a bound, and the loops over many at once."""
    found = set[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Compare(
                left=ast.Call(
                    func=ast.Name(id="len"), args=[ast.Attribute(value=ast.Name(id="self"), attr=name)]
                ),
                ops=[ast.Gt() | ast.GtE() | ast.Lt() | ast.LtE()],
                comparators=[ast.Name() | ast.Attribute()],
            ):
                found.add(name)
            case ast.Call(func=ast.Attribute(attr="gather"), args=[ast.Starred(), *_]):
                found.add("gather")
            case ast.Call(func=ast.Attribute(attr="Semaphore")):
                found.add("Semaphore")
    return found


def test_each_bound_and_loop_has_a_share_of_each_host_or_a_reason() -> None:
    files = [
        file
        for folder in FOLDERS
        for file in (ROOT / folder).rglob("*.py")
        if not OF_OPERATORS.match(str(file.relative_to(ROOT)))
    ]
    found = {
        f"{file.removeprefix('appliance/')}::{name}"
        for file, names in facts_of_files(set[str], bounds, files, code=(__file__,)).items()
        for name in names
    }
    listed = [*SHARES, *(name for names in REASONS.values() for name in names.split())]
    assert len(listed) == len({*listed})
    require_rows(found, listed, "SHARES or REASONS in tests/unit/test_host_bounds.py")
    lacking = [
        name
        for name, text in SHARES.items()
        if text not in (ROOT / "appliance" / name.partition("::")[0]).read_text(encoding="utf-8")
    ]
    assert lacking == [], "the module no longer has this share"


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("if len(self._held) >= _MOST: return", {"_held"}),
        ("while len(self._held) > self._limits.most: pass", {"_held"}),
        ("asyncio.gather(*map(one, names))", {"gather"}),
        ("asyncio.gather(one(), other())", set()),
        ("asyncio.Semaphore(8)", {"Semaphore"}),
    ],
)
def test_each_form_of_a_bound_is_found(line: str, found: set[str], tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(line)
    assert bounds(tmp_path / "module.py") == found
