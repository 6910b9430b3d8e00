import re
import tokenize
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "dev" / "architecture.md").read_text()
SECTION = PAGE.split("\n## The kernel", 1)[1].split("\n## ", 1)[0]
SIZES = {path: int(lines) for path, lines in re.findall(r"`([\w/]+\.pyx?)` (\d+)", SECTION)}
BUDGET = 11_216  # lines of code: lower this number with the kernel, and never raise it

# The modules outside the kernel that the kernel may import.
OUTSIDE = frozenset(
    """
    audit.log.disk_space audit.log.events audit.log.ids audit.log.lock_holders audit.proof.copies
    audit.proof.signer_memory
    base.atomic_files base.clock base.counted base.engine_thread base.input_files base.validation_messages
    channel.channel channel.link channel.messages channel.messages.relay_link channel.rosout_address
    configuration.settings master.calls.monitor_calls
    master.calls.request_peek master.endpoints.delivery
    master.endpoints.node_ports master.endpoints.topic_taps_control master.endpoints.traffic
    master.calls.arrivals master.parameter_charges
    master.reconcile.liveness master.rosmaster policy.policy_lint quotas.descriptors quotas.pool
    quotas.table relay.connections.introductions relay.connections.latched_message
    relay.connections.message_sink relay.connections.monitor_calls
    relay.connections.named_subscribers relay.context relay.loop relay.monitors.fast_path_counts
    relay.monitors.holds relay.monitors.monitor_sets relay.monitors.observation_points
    relay.monitors.observations relay.monitors.observer relay.monitors.shadow
    relay.monitors.state_keeper relay.monitors.state_memory relay.monitors.time_budget
    relay.relay_limits relay.report relay.topic_taps relay.transport.loop_channel
    relay.transport.memory relay.transport.sockets rpc.acceptor rpc.connection_table rpc.fair_queue
    rpc.front rpc.processor_time rpc.server rpc.xmlrpc_client
    specifications.allocation
    specifications.specification_manager store.state_file telemetry.metrics
    """.split()  # noqa: SIM905  a list would need a line for each
)

_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
}  # fmt: skip


def _lines(path: str) -> int:
    lines: set[int] = set()
    statement: list[tokenize.TokenInfo] = []
    with (ROOT / "appliance" / path).open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type not in _NO_CODE and token.type != tokenize.ENCODING:
                statement.append(token)
            elif token.type == tokenize.NEWLINE:
                if [one.type for one in statement] != [tokenize.STRING]:
                    for one in statement:
                        lines.update(range(one.start[0], one.end[0] + 1))
                statement = []
    return len(lines)


def _number(text: str) -> int:
    return int(text.replace(",", ""))


@pytest.mark.parametrize("path", SIZES)
def test_a_listed_module_exists_with_its_printed_size(path: str) -> None:
    assert abs(_lines(path) - SIZES[path]) <= SIZES[path] / 10, f"{path} has {_lines(path)} lines"


def test_the_sums_on_the_page_are_those_of_its_rows() -> None:
    rows = re.findall(r"^\| [^|*]+ \|(.+)\| ([\d,]+) \|$", SECTION, flags=re.MULTILINE)
    for modules, total in rows:
        assert sum(map(int, re.findall(r"` (\d+)", modules))) == _number(total), modules
    [whole] = re.findall(r"\*\*([\d,]+)\*\* \|$", SECTION, flags=re.MULTILINE)
    assert sum(_number(total) for _modules, total in rows) == sum(SIZES.values()) == _number(whole)


def test_the_kernel_stays_within_its_budget() -> None:
    assert f"The budget is {BUDGET:,} lines" in SECTION
    assert sum(map(_lines, SIZES)) <= BUDGET


def test_the_kernel_imports_only_the_modules_on_the_list() -> None:
    graph = grimp.build_graph("appliance", cache_dir=None)
    kernel = {
        "appliance." + path.removesuffix(".py").replace("/", ".") for path in SIZES if path.endswith(".py")
    }
    imported = {
        one.removeprefix("appliance.")
        for module in kernel
        for one in graph.find_modules_directly_imported_by(module)
        if one not in kernel
    }
    assert sorted(imported ^ OUTSIDE) == []
