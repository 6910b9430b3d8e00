"""Each cache states what becomes of a failure: one that keeps successes only lets its caller repeat the work.

So does each dictionary that a function asks first and fills itself, by hand.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from distribution.fact_cache import facts_of_files
from tests.support.rows import require_rows
from tests.support.sources import LANGUAGE_TESTS, ROOT

FOLDERS = ("appliance", "roswire", "rosmop", "fleet/src/rosrv_fleet")
CACHES = {"cache", "lru_cache", "functools.cache", "functools.lru_cache"}
NEVER = "cannot fail"
KEPT = "a failure is a result, and kept"
SHORT = "a failure costs no more than reading its text, which is bounded"
OURS = "its argument is ours or an operator's"

FAILURES = {
    "appliance/api/front/moments.py::_units": OURS,
    "appliance/audit/log/log_writer.py::_count": NEVER,
    "appliance/audit/log/log_writer.py::_insert": NEVER,
    "appliance/audit/search/denial_summary.py::_without_numbers": NEVER,
    "appliance/audit/search/search.py::_networks_of": OURS,
    "appliance/base/varying_numbers.py::without_numbers": NEVER,
    "appliance/channel/admin.py::_decoder": OURS,
    "appliance/channel/rest_operation.py::_fields": OURS,
    "appliance/cli/verb_table.py::_text": OURS,
    "appliance/cli/robot_motions.py::_definitions": NEVER,
    "appliance/configuration/config_sources.py::_reader": OURS,
    "appliance/configuration/inventory.py::inventory": OURS,
    "appliance/features/doors/rosbridge_frames.py::_publish_head": NEVER,
    "appliance/features/guards/released.py::origin_of": OURS,
    "appliance/features/standby/witness/protocol.py::tag_of": NEVER,
    "appliance/network/cut.py::_libc": NEVER,
    "appliance/policy/model.py::address_of": SHORT,
    "appliance/relay/monitors/monitor_sets.py::prepare": NEVER,
    "appliance/specifications/checking.py::_standard": NEVER,
    "appliance/specifications/specification_files.py::_definitions": KEPT,
    "rosmop/check/function_library.py::functions": OURS,
    "rosmop/fast/build.py::_part": OURS,
    "rosmop/fast/build.py::_set": OURS,
    "rosmop/fast/wasm_instance.py::_engine": OURS,
    "rosmop/fast/wasm_instance.py::load": OURS,
    "rosmop/run/interpreter.py::_nobody": OURS,
    "rosmop/text/parser.py::_parser": OURS,
    "rosmop/text/parser.py::roles": OURS,
    "rosmop/types/roles.py::types_of_roles": OURS,
    "roswire/parameter_tree.py::parts_of": NEVER,
    "roswire/uris.py::parse_node_uri": SHORT,
}


def caches(path: Path) -> Iterator[str]:
    """Yield the functions with a cache: decorated ones, and names that are bound to one."""
    name, text = str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text if "cache" in text else "")):
        if isinstance(node, ast.FunctionDef) and any(map(_is_cache, node.decorator_list)):
            yield f"{name}::{node.name}"
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and _is_cache(node.value.func):
            yield from (f"{name}::{ast.unparse(target)}" for target in node.targets)


def _is_cache(expression: ast.expr) -> bool:
    called = expression.func if isinstance(expression, ast.Call) else expression
    return ast.unparse(called) in CACHES


def test_each_cache_says_what_becomes_of_a_failure() -> None:
    files = [
        file
        for folder in FOLDERS
        for file in (ROOT / folder).rglob("*.py")
        if LANGUAGE_TESTS not in file.parents
    ]
    found = {cache for file in files for cache in caches(file)}
    assert found == FAILURES.keys()


@pytest.mark.parametrize(
    "text",
    [
        "@cache\ndef one(): ...",
        "@functools.lru_cache(8)\ndef one(): ...",
        "one = lru_cache(maxsize=1)(other)",
    ],
)
def test_each_form_of_a_cache_is_found(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.unit.test_caches.ROOT", tmp_path)
    (tmp_path / "module.py").write_text(text)
    assert [*caches(tmp_path / "module.py")] == ["module.py::one"]


OPEN = "an entry is something open of a client, node or host, within its quota, and ends with it"
LOCKS = "a lock, which lives while it is in use, or one of each robot of the collector"
TEXT = "as many as the text has of a policy, a definition or a specification, which is bounded and read as a whole"
ANSWER = "it lives as long as one answer, or one recording"
ONE_EACH = "one for each token; a wrong one is limited by `Buckets`, or checked one at a time"
OURS_ONLY = "its keys are ours: files, paths of a service, threads, the two appliances, groups of the policy"
NO_CACHE = "memory or a line, in which a place is looked at before it is written"

BY_HAND = {
    "appliance/api/front/access.py::_recognised": ONE_EACH,
    "appliance/audit/log/folding.py::_coming": OPEN,  # a record that a thread is about to write
    "appliance/audit/log/folding.py::_due": "if host in self._kinds or len(self._kinds) < 2 *",
    "appliance/audit/log/folding.py::_kinds": "if host in self._kinds or len(self._kinds) < 2 *",
    "appliance/control/operators/token_orders.py::_stored": ONE_EACH,
    "appliance/control/rest/rest_proof.py::_checked": ONE_EACH,
    "appliance/control/rest/rest_proof.py::_taken": "if len(self._taken) >= _MAX_TAKEN",
    "appliance/features/approvals/orders.py::_moved": OPEN,
    "appliance/features/authority/orders.py::_turns": LOCKS,
    "appliance/features/authority/orders.py::_held": OURS_ONLY,
    "appliance/features/doors/door_node.py::_heard": OPEN,
    "appliance/features/doors/door_node.py::_locks": LOCKS,
    "appliance/features/doors/door_node.py::_offers": OPEN,
    "appliance/features/doors/door_node.py::_publications": OPEN,
    "appliance/features/doors/door_parameters.py::_clients": OPEN,
    "appliance/features/doors/door_parameters.py::_reads": "if self._reads[client] >= _MAX_READS",
    "appliance/features/doors/door_processes.py::_host_numbers": "if len(self._host_numbers) >= _MAX_HOSTS",
    "appliance/features/doors/foxglove.py::_channels": "if len(self._channels) >= self._limits.channels",
    "appliance/features/doors/foxglove.py::_parameters": "if len(self._parameters) >= self._limits.parameters",
    "appliance/features/doors/heard_topic.py::told": "len(self.told) >= _MAX_TOLD",
    "appliance/features/doors/known_types.py::_failed": "while len(self._failed) > _MAX_FAILURES",
    "appliance/features/doors/known_types.py::_kept": "while self.bytes > self._most",
    "appliance/features/doors/known_types.py::_read": "while len(self._read) > _MAX_READ",
    "appliance/features/doors/message_reader.py::_made": TEXT,
    "appliance/features/doors/message_writer.py::made": TEXT,
    "appliance/features/doors/rosbridge.py::_advertised": "_check_room(self._advertised, ",
    "appliance/features/fleet/connection.py::_known": OURS_ONLY,
    "appliance/features/fleet/bundle_gate.py::_lost": TEXT,
    "appliance/features/recorder/recording.py::_numbers": ANSWER,
    "appliance/features/recorder/recording_plan.py::_begun": "if len(self._begun) > _MAX_HOSTS",
    "appliance/features/recorder/recording_plan.py::_open": "if own != ROBOT and len(others) >= _MAX_AT_ONCE",
    "appliance/features/standby/witness/serving.py::_connected": OURS_ONLY,
    "appliance/features/standby/witness/request_gate.py::_last": OURS_ONLY,
    "appliance/features/topics/control_part.py::_shown": "if moment - since >= ONE_LOOK",
    "appliance/features/tunnels/refusals.py::_packets": OURS_ONLY,
    "appliance/features/tunnels/refusals.py::_passed": "self._passed.total() < REFUSALS_PER_SECOND",
    "appliance/formats/interventions.py::_states": ANSWER,
    "appliance/hosts/hosts_file.py::found": TEXT,
    "appliance/master/endpoints/delivery.py::_lists": OPEN,
    "appliance/master/endpoints/delivery.py::_queues": OPEN,
    "appliance/master/endpoints/delivery.py::_used": "if len(self._used) + len(self._unused) >= _MAX_KEPT",
    "appliance/master/endpoints/node_ports.py::_routes": "if len(self._routes) > _MAX_ROUTES",
    "appliance/master/endpoints/delivery.py::_nodes": OPEN,
    "appliance/policy/groups.py::_kept": TEXT,
    "appliance/policy/host_sets.py::_networks": TEXT,
    "appliance/policy/policy.py::standings": "if len(self.standings) >= _KEPT_HOSTS",
    "appliance/quotas/peers.py::_first": "if len(self._rows) >= self._most",
    "appliance/quotas/peers.py::_rows": "if len(self._rows) >= self._most",
    "appliance/relay/data_plane.py::topics": OPEN,
    "appliance/relay/loop.py::_payers": "if len(self._payers) >= _PAYERS",
    "appliance/relay/monitors/interceptor.py::_known": "if len(self._known) >= _MAX_KNOWN",
    "appliance/relay/monitors/observation_points.py::_numbers": "if len(self._points) > _SENDERS",
    "appliance/relay/monitors/observations.py::_told": "self._distinct.get((kind, monitor), 0) >= _DISTINCT",
    "appliance/relay/monitors/observer.py::_counters": TEXT,
    "appliance/relay/monitors/state_memory.py::_memory": NO_CACHE,
    "appliance/relay/monitors/time_budget.py::_own": OPEN,
    "appliance/relay/transport/frames.py::area": NO_CACHE,
    "appliance/relay/transport/rate_limit.py::_shares": OPEN,
    "appliance/rpc/connection_table.py::_stages": OPEN,
    "appliance/rpc/fair_queue.py::_taken": OPEN,
    "appliance/rpc/fair_queue.py::_taken_as": OPEN,
    "appliance/specifications/records.py::_going": TEXT,  # monitors and topics in force
    "appliance/specifications/records.py::_known": "known < 2 * _MAX else",
    "fleet/src/rosrv_fleet/bundles/repository.py::_signers": OURS_ONLY,
    "fleet/src/rosrv_fleet/connections.py::_owners": OPEN,
    "fleet/src/rosrv_fleet/indexer.py::_killed": OURS_ONLY,
    "fleet/src/rosrv_fleet/search.py::_running": OPEN,
    "fleet/src/rosrv_fleet/segment_store.py::_locks": LOCKS,
    "rosmop/logics/ltl.py::_after": TEXT,
    "rosmop/logics/ltl.py::_chosen": TEXT,
    "rosmop/logics/ltl.py::_moves": TEXT,
    "rosmop/logics/ltl.py::_steps": TEXT,
    "rosmop/logics/ere.py::_derived": TEXT,
    "rosmop/logics/ere.py::_letters": TEXT,
    "rosmop/logics/ere.py::_numbers": TEXT,
    "rosmop/logics/ltl.py::propositions": TEXT,
    "rosmop/logics/ltl.py::_known": TEXT,
    "rosmop/logics/ltl.py::_numbers": TEXT,
    "rosmop/logics/parsing.py::_shapes": "if len(self._shapes) >= KEPT_ENTRIES",
    "rosmop/logics/past_monitors.py::_numbers": TEXT,
    "rosmop/run/engine.py::_silent": TEXT,
    "rosmop/run/outcomes.py::_known": ANSWER,
    "rosmop/run/outcomes.py::_plain": ANSWER,
    "rosmop/runtime/action_context.py::throttled": TEXT,
    "rosmop/runtime/values.py::_made": TEXT,
    "rosmop/runtime/wire.py::buffer": NO_CACHE,
    "roswire/definitions.py::_depths": TEXT,
    "roswire/definitions.py::_layouts": TEXT,
    "roswire/definitions.py::_md5sums": TEXT,
    "roswire/message_view.py::_sizes": ANSWER,
    "roswire/node/ros_node.py::_locks": LOCKS,
    "roswire/node/ros_node.py::parameters": OPEN,
    "roswire/node/ros_node.py::publishers": OPEN,
    "roswire/node/ros_node.py::services": OPEN,
    "roswire/node/ros_node.py::subscribers": OPEN,
}
"""The rule of each dictionary, or the text of its module that bounds it: then others make room, or it is refused."""
WHOLE = "its key has everything that its value depends on"
HOST = "its value is of the host, address or policy that is the key, and no content"
CLIENT = "it is of one connection, which chooses its own keys"
COUNTED = "its value counts or shortens reports; each is decided without it"
KEYED = {
    "appliance/audit/log/folding.py::_due": COUNTED,
    "appliance/audit/log/folding.py::_kinds": COUNTED,
    "appliance/control/rest/rest_proof.py::_taken": WHOLE,  # a challenge, which control makes and signs
    "appliance/features/doors/door_parameters.py::_reads": CLIENT,
    "appliance/features/doors/door_processes.py::_host_numbers": HOST,
    "appliance/features/doors/foxglove.py::_channels": CLIENT,
    "appliance/features/doors/foxglove.py::_parameters": CLIENT,
    "appliance/features/doors/heard_topic.py::told": COUNTED,
    "appliance/features/doors/known_types.py::_failed": WHOLE,  # the name, the md5sum and the whole definition
    "appliance/features/doors/known_types.py::_kept": WHOLE,  # as `_failed`, or the message itself
    "appliance/features/doors/known_types.py::_read": WHOLE,  # as `_failed`
    "appliance/features/doors/rosbridge.py::_advertised": CLIENT,
    "appliance/features/recorder/recording_plan.py::_begun": HOST,
    "appliance/features/recorder/recording_plan.py::_open": HOST,
    "appliance/features/topics/control_part.py::_shown": COUNTED,
    "appliance/features/tunnels/refusals.py::_passed": COUNTED,
    "appliance/master/endpoints/delivery.py::_used": WHOLE,  # the address that is called
    "appliance/master/endpoints/node_ports.py::_routes": HOST,
    "appliance/policy/policy.py::standings": HOST,
    "appliance/quotas/peers.py::_first": COUNTED,
    "appliance/quotas/peers.py::_rows": COUNTED,
    "appliance/relay/loop.py::_payers": HOST,
    "appliance/relay/monitors/interceptor.py::_known": WHOLE,
    "appliance/relay/monitors/observation_points.py::_numbers": WHOLE,
    "appliance/relay/monitors/observations.py::_told": COUNTED,
    "appliance/specifications/records.py::_known": COUNTED,
    "rosmop/logics/parsing.py::_shapes": WHOLE,
}
"""Why no peer can make the key of a bounded dictionary for another content, which would then be taken for the first."""
RULES_BY_HAND = {OPEN, LOCKS, TEXT, ANSWER, ONE_EACH, OURS_ONLY, NO_CACHE}
OF_OPERATORS = re.compile(
    r"appliance/(api/console|cli|configuration)/|rosmop/(batch|certify|check|fast|form|learn|recordings|tool|types)/"
)
"""Folders that work for one command of an operator, or compile one text."""


_FILLED = re.compile(r"self\.\w+\[[^\n]+\][^\n=]*= |self\.\w+\.setdefault\(")


def kept_by_hand(path: Path) -> set[str]:
    """Return the attributes that a function looks into by a key and also fills by it, to save work later."""
    text = path.read_text(encoding="utf-8")
    return {
        attribute
        for node in ast.walk(ast.parse(text if _FILLED.search(text) else ""))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for attribute in _looked_up_and_filled(node)
    }


def _looked_up_and_filled(function: ast.AST) -> set[str]:
    nodes = [*ast.walk(function)]
    filled = {place for node in nodes for place in _places(node, filled=True)}

    def looked_up(within: ast.AST) -> set[str]:
        return {
            place[0] for node in ast.walk(within) for place in _places(node, filled=False) if place in filled
        }

    names: dict[str, set[str]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign | ast.AnnAssign | ast.NamedExpr) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                if isinstance(target, ast.Name):
                    names.setdefault(target.id, set()).update(looked_up(node.value))
    results = [node.value for node in nodes if isinstance(node, ast.Return) and node.value is not None]
    tests = [
        node.test
        for node in nodes
        if isinstance(node, ast.If) and isinstance(node.body[-1], ast.Return | ast.Raise | ast.Continue)
    ]
    decides = {name.id for test in tests for name in ast.walk(test) if isinstance(name, ast.Name)}
    decides |= {
        name.id
        for value in results
        for name in (value.elts if isinstance(value, ast.Tuple) else [value])
        if isinstance(name, ast.Name)
    }
    return {one for name in decides for one in names.get(name, ())}.union(
        *(looked_up(one) for one in [*results, *tests])
    )


def _places(node: ast.AST, *, filled: bool) -> Iterator[tuple[str, str]]:
    match node:
        case ast.Subscript(value=ast.Attribute(value=ast.Name(id="self"), attr=name), slice=key, ctx=use):
            if isinstance(use, ast.Store) is filled:
                yield name, ast.unparse(key)
        case ast.Call(
            func=ast.Attribute(value=ast.Attribute(value=ast.Name(id="self"), attr=name), attr=method),
            args=[key, *_],
        ):
            if method == "setdefault" or (method == "get" and not filled):
                yield name, ast.unparse(key)
        case ast.Compare(
            left=key, ops=[ast.In()], comparators=[ast.Attribute(value=ast.Name(id="self"), attr=name)]
        ) if not filled:
            yield name, ast.unparse(key)


def test_each_dictionary_that_is_asked_and_filled_has_its_rule() -> None:
    files = [
        file
        for folder in FOLDERS
        for file in (ROOT / folder).rglob("*.py")
        if LANGUAGE_TESTS not in file.parents and not OF_OPERATORS.match(str(file.relative_to(ROOT)))
    ]
    kept = facts_of_files(set[str], kept_by_hand, files, code=(__file__,))
    found = {
        f"{name}::{attribute}": (ROOT / name).read_text(encoding="utf-8")
        for name, attributes in kept.items()
        for attribute in attributes
    }
    assert found.keys() == BY_HAND.keys()
    lacking = [
        one for one, rule in BY_HAND.items() if rule not in RULES_BY_HAND and found[one].count(rule) == 0
    ]
    assert lacking == [], "the module has not this bound any longer"


def test_each_bounded_dictionary_says_why_no_content_is_taken_for_another() -> None:
    """Functions with a cache need no row: their key has all their arguments."""
    bounded = {one for one, rule in BY_HAND.items() if rule not in RULES_BY_HAND}
    require_rows(bounded, KEYED, "KEYED in tests/unit/test_caches.py")


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("if key not in self.x: self.x[key] = make(key)\n return self.x[key]", True),
        ("known = self.x.get(key)\n if known is None: self.x[key] = make()\n return known", True),
        ("if key in self.x: return True\n self.x[key] = make()", True),
        ("if (old := self.x.get(key)) is not None: raise old\n self.x[key] = make()", True),
        ("return self.x.setdefault(key, make())", True),
        ("self.x[key] = make()", False),
        ("return self.x[key]", False),
    ],
)
def test_each_form_of_a_dictionary_that_saves_work_is_found(body: str, found: bool, tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(f"def one(self, key):\n {body}")
    assert kept_by_hand(tmp_path / "module.py") == ({"x"} if found else set())
