import asyncio
import errno
import socket
import threading
from collections.abc import Callable, Iterator

import pytest
from structlog.testing import capture_logs

from appliance.base import clock
from appliance.channel.answers.status import FirewallState
from appliance.channel.messages import (
    EndpointFound,
    FirewallReported,
    MachineAddresses,
    Message,
    ProbeFailed,
    ProbePassed,
    RulesRestored,
)
from appliance.network.esp import Esp
from appliance.network.firewall.rule_watch import RuleWatch
from appliance.network.namespaces import NetworkError
from appliance.supervisor import isolation_watchdog
from appliance.supervisor.isolation_lifecycle import NoIsolation, RestoredRules
from appliance.supervisor.isolation_watchdog import IsolationWatchdog
from tests.support.determinism import may_depend_on_chance
from tests.support.nftables_reports import CHAIN_REMOVED, generation, report

pytestmark = pytest.mark.anyio


class Surroundings(NoIsolation):
    kind = "container"
    probes = True

    def __init__(self) -> None:
        self.found: list[str | Exception | None] = []
        self.closed: list[int] = []

    def report(self) -> FirewallState:
        return FirewallState(backend="nft")

    def probe(self) -> str | None:
        finding = self.found.pop(0)
        if isinstance(finding, Exception):
            raise finding
        return finding

    def control_ready(self, inner_port: int, own_port: int) -> None:
        if inner_port == 0:
            raise NetworkError("the kernel says no")
        if inner_port == 1:
            raise OSError(errno.EAGAIN, "no process can be made")
        self.closed.append(inner_port)

    def open_tunnels(self, pool: str, address: str) -> Esp:
        raise OSError(errno.EAGAIN, "no process can be made")


@pytest.fixture
def surroundings(request: pytest.FixtureRequest) -> Iterator[Surroundings]:
    if not may_depend_on_chance(request.node):
        request.getfixturevalue("guard_in_loop")
    with capture_logs():  # a shown traceback takes a tenth of a second
        yield Surroundings()


async def test_control_learns_of_each_opening_and_closing(surroundings: Surroundings) -> None:
    told: list[Message] = []
    surroundings.found = ["reached", None]
    watchdog = IsolationWatchdog(surroundings, told.append)
    assert await watchdog.look() == "reached"
    assert await watchdog.look() is None
    report = FirewallReported("container", FirewallState(backend="nft"))
    assert told == [report, ProbeFailed("reached"), report, ProbePassed()]


async def test_a_probe_that_cannot_be_made_counts_as_open(surroundings: Surroundings) -> None:
    told: list[Message] = []
    surroundings.found = [NetworkError("no child")]
    assert "no child" in str(await IsolationWatchdog(surroundings, told.append).look())
    assert isinstance(told[-1], ProbeFailed)


async def test_a_new_control_receives_the_last_finding(surroundings: Surroundings) -> None:
    surroundings.found = ["reached"]
    watchdog = IsolationWatchdog(surroundings, lambda _message: None)
    assert watchdog.news() == [FirewallReported("container", FirewallState())]
    await watchdog.look()
    assert watchdog.news()[-1] == ProbeFailed("reached")


async def test_the_master_side_port_is_closed_and_then_probed(surroundings: Surroundings) -> None:
    surroundings.found = [None]
    watchdog = IsolationWatchdog(surroundings, lambda _message: None)
    assert await watchdog.control_ready(4711, 4712) is None
    assert "the kernel says no" in str(await watchdog.control_ready(0, 4712))
    assert surroundings.closed == [4711]
    assert surroundings.found == []


@pytest.mark.parametrize("port", [0, 1])
async def test_a_master_side_port_that_cannot_be_closed_is_reported(
    surroundings: Surroundings, port: int
) -> None:
    told: list[Message] = []
    watchdog = IsolationWatchdog(surroundings, told.append)
    assert "cannot be closed to others" in str(await watchdog.control_ready(port, 4712))
    news = watchdog.news()
    assert isinstance(told[-1], ProbeFailed)
    assert news[-1] == told[-1]


@pytest.mark.parametrize(
    "broken", [OSError(errno.EMFILE, "too many open files"), ValueError("no JSON"), KeyError("chain")]
)
async def test_a_failing_probe_is_a_finding_and_is_soon_repeated(
    surroundings: Surroundings, broken: Exception
) -> None:
    told: list[Message] = []
    surroundings.found = [broken, broken, None]
    running = asyncio.create_task(IsolationWatchdog(surroundings, told.append, every=60.0).run())
    await asyncio.sleep(60 + 1 + 2 + 1)  # nodes are refused until one passes
    running.cancel()
    assert [type(one) for one in told[1::2]] == [ProbeFailed, ProbeFailed, ProbePassed]
    assert all(str(broken) in one.reason for one in told if isinstance(one, ProbeFailed))


async def test_tunnels_that_cannot_be_opened_are_answered(surroundings: Surroundings) -> None:
    watchdog = IsolationWatchdog(surroundings, lambda _message: None)
    answer = await watchdog.open_tunnels("10.9.0.0/24", "10.9.0.1")
    assert answer.esp is None
    assert "no process can be made" in str(answer.reason)


async def test_probes_are_repeated(surroundings: Surroundings) -> None:
    told: list[Message] = []
    surroundings.found = [None, "reached", None]
    running = asyncio.create_task(IsolationWatchdog(surroundings, told.append, every=60.0).run())
    await asyncio.sleep(60 + 60 + 1 + 1)
    running.cancel()
    assert [type(one) for one in told[1::2]] == [ProbePassed, ProbeFailed, ProbePassed]


@pytest.mark.usefixtures("guard_in_loop")
async def test_without_isolation_nothing_is_probed() -> None:
    told: list[Message] = []
    assert await IsolationWatchdog(NoIsolation(), told.append).look() is None
    assert told == [FirewallReported("none", FirewallState())]


async def test_without_isolation_there_is_no_address_for_hosts(surroundings: Surroundings) -> None:
    assert await IsolationWatchdog(surroundings, lambda _message: None).endpoint() == EndpointFound(
        None, "isolation container has no tunnels: use isolation netns or container"
    )


@pytest.mark.nightly
async def test_a_crowd_of_new_hosts_costs_a_few_threads(
    surroundings: Surroundings, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, entered, most = threading.Lock(), [0], [0]
    release = threading.Event()

    def route_to(host: str) -> str:
        with lock:
            entered[0] += 1
            most[0] = max(most[0], entered[0])
        assert release.wait(30)
        with lock:
            entered[0] -= 1
        return f"way to {host}"

    monkeypatch.setattr(surroundings, "route_to", route_to)
    watchdog = IsolationWatchdog(surroundings, lambda _message: None)
    asked = [asyncio.create_task(watchdog.route_to(str(number))) for number in range(200)]
    async with asyncio.timeout(30):
        while most[0] == 0:
            await asyncio.sleep(0)
    for _ in range(200):
        await asyncio.sleep(0)
    release.set()
    assert (await asyncio.gather(*asked)) == [f"way to {number}" for number in range(200)]
    assert most[0] <= 8


async def test_a_former_address_of_the_machine_stays_closed_until_control_has_forgotten_it(
    surroundings: Surroundings, monkeypatch: pytest.MonkeyPatch
) -> None:
    trusted: list[tuple[str, ...]] = []
    monkeypatch.setattr(surroundings, "trust_machine", trusted.append)
    told: list[Message] = []
    watchdog = IsolationWatchdog(surroundings, told.append)
    for addresses in (("10.0.0.1",), ("10.0.0.2",)):
        monkeypatch.setattr(surroundings, "machine_addresses", lambda found=addresses: found)
        assert watchdog.machine_has_changed()
        await watchdog.take_machine()
        assert not watchdog.machine_has_changed()
    assert [message for message in told if isinstance(message, MachineAddresses)] == [
        MachineAddresses(["10.0.0.1"]), MachineAddresses(["10.0.0.2"]),
    ]  # fmt: skip
    surroundings.found = [None, None]
    await watchdog.look()
    assert trusted == [("10.0.0.1",), ("10.0.0.1", "10.0.0.2")]
    await asyncio.sleep(isolation_watchdog.FORMER_SECONDS)
    await watchdog.look()
    assert trusted[-1] == ("10.0.0.2",)


class Flushed(NoIsolation):
    """Rules that another program removes; `heard` is the kernel's report."""

    kind = "netns"

    def __init__(self, heard: socket.socket) -> None:
        self.heard = heard
        self.missing: list[list[str]] = []
        self.broken: list[Exception] = []
        self.open_since: list[
            float
        ] = []  # the restorations at which the closed ports of the machine were open
        self.open_ports = ""
        self.ended_at: list[float] = []
        self.remembered = 0

    def watch_rules(self) -> list[RuleWatch]:
        return [RuleWatch(self.heard, frozenset({"rosrv"}))]

    @property
    def unprotected(self) -> str:
        return self.open_ports

    def restore(self) -> RestoredRules:
        if self.broken:
            raise self.broken.pop()
        if self.open_ports:
            self.open_since.append(round(clock.now(), 1))
        return RestoredRules(self.missing.pop() if self.missing else [], clock.now())

    def remember_connections(self) -> None:
        self.remembered += 1

    def end_connections(self) -> int:
        self.ended_at.append(round(clock.now(), 1))
        return 2


@pytest.fixture
def kernel(sockets: None) -> Iterator[tuple[Flushed, Callable[[str], None]]]:
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    here.setblocking(False)
    flushed = Flushed(here)

    def change(table: str) -> None:
        flushed.missing.append(["forwarded ports"])
        there.send(report(CHAIN_REMOVED, table) + generation("nft"))

    with capture_logs(), here, there:
        yield flushed, change


@pytest.mark.usefixtures("guard_in_loop")
async def test_rules_are_restored_as_soon_as_the_kernel_reports_their_removal(
    kernel: tuple[Flushed, Callable[[str], None]],
) -> None:
    """Connections that come late are also ended."""
    isolation, change = kernel
    told: list[Message] = []
    recorded: list[RulesRestored] = []
    watchdog = IsolationWatchdog(isolation, told.append, recorded.append)
    watching = asyncio.create_task(watchdog.watch())
    await asyncio.sleep(3.5)
    assert isolation.remembered == 3
    began = clock.now()
    for _ in range(2):
        change("rosrv")
        await asyncio.sleep(0.01)
    change("other")
    await asyncio.sleep(5)
    watching.cancel()
    assert [(one.rules, one.by, one.connections) for one in recorded] == 2 * [(["forwarded ports"], "nft", 2)]
    assert max(one.seconds for one in recorded) < 0.1
    assert sorted(isolation.ended_at) == pytest.approx(sorted(2 * [began, began + 0.5, began + 2.5]), abs=0.2)
    shown = [one.report.removed for one in told if isinstance(one, FirewallReported)]
    moment = clock.utc_now().isoformat(timespec="hours")
    assert f"nft removed 1 rule of the firewall until {moment.partition('+')[0]}:" in str(shown[-1])


async def test_no_restoration_waits_for_the_end_of_connections(
    kernel: tuple[Flushed, Callable[[str], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation, change = kernel
    recorded: list[Message] = []

    async def in_thread(function: Callable[[], object]) -> object:
        if function == isolation.end_connections:
            await asyncio.sleep(1)
        return function()

    monkeypatch.setattr(isolation_watchdog, "in_thread", in_thread)
    watching = asyncio.create_task(IsolationWatchdog(isolation, recorded.append, recorded.append).watch())
    for _ in range(3):
        await asyncio.sleep(0.1)
        change("rosrv")
    await asyncio.sleep(5)
    watching.cancel()
    seconds = [one.seconds for one in recorded if isinstance(one, RulesRestored)]
    assert seconds == pytest.approx(3 * [0], abs=0.05)


@pytest.mark.usefixtures("guard_in_loop")
async def test_a_restoration_that_fails_is_a_finding_and_is_repeated(
    kernel: tuple[Flushed, Callable[[str], None]],
) -> None:
    isolation, change = kernel
    isolation.broken = [NetworkError("nft hangs")]
    told: list[Message] = []
    watchdog = IsolationWatchdog(isolation, told.append)
    watching = asyncio.create_task(watchdog.watch())
    await asyncio.sleep(0.5)
    change("rosrv")
    await asyncio.sleep(3)
    watching.cancel()
    (failed,) = [one for one in told if isinstance(one, ProbeFailed)]
    assert "nft hangs" in failed.reason
    (restored,) = [one for one in told if isinstance(one, RulesRestored)]
    assert restored.seconds == pytest.approx(1.0, abs=0.2)


@pytest.mark.usefixtures("guard_in_loop")
@pytest.mark.parametrize("failures", [1, 3])
async def test_nodes_are_refused_only_until_a_restoration_succeeds(
    failures: int, kernel: tuple[Flushed, Callable[[str], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation, change = kernel
    monkeypatch.setattr(isolation, "probes", True)
    isolation.broken = [NetworkError("nft hangs") for _second in range(failures)]
    told: list[tuple[float, type[Message]]] = []
    watching = asyncio.create_task(
        IsolationWatchdog(isolation, lambda one: told.append((clock.now(), type(one)))).watch()
    )
    await asyncio.sleep(0.5)
    change("rosrv")
    began = clock.now()
    await asyncio.sleep(failures + 3)
    watching.cancel()
    probed = [(when - began, kind) for when, kind in told if kind in (ProbeFailed, ProbePassed)]
    assert [kind for _, kind in probed] == [*failures * [ProbeFailed], ProbePassed]
    assert probed[-1][0] == pytest.approx(failures, abs=0.3)


@pytest.mark.usefixtures("guard_in_loop")
async def test_a_regular_check_restores_what_the_kernel_does_not_report(
    kernel: tuple[Flushed, Callable[[str], None]],
) -> None:
    isolation, _change = kernel
    told: list[Message] = []
    running = asyncio.create_task(IsolationWatchdog(isolation, told.append, every=60.0).run())
    await asyncio.sleep(90)
    isolation.missing.append(["forwarded ports"])
    await asyncio.sleep(60)
    running.cancel()
    (restored,) = [one for one in told if isinstance(one, RulesRestored)]
    assert not restored.reported
    assert restored.seconds == pytest.approx(60, abs=0.2)


@pytest.mark.usefixtures("guard_in_loop")
async def test_open_ports_of_the_machine_are_an_alarm_until_they_are_closed_again(
    kernel: tuple[Flushed, Callable[[str], None]],
) -> None:
    """The appliance goes on serving; it tries again soon, and then with each regular check."""
    isolation, change = kernel
    told: list[Message] = []
    watchdog = IsolationWatchdog(isolation, told.append)
    watching = asyncio.create_task(watchdog.watch())
    await asyncio.sleep(0.5)
    isolation.open_ports, began = "apply them again", clock.now()
    change("rosrv")
    await asyncio.sleep(3)
    watching.cancel()
    assert isolation.open_since == pytest.approx([began, began + 1], abs=0.2)

    def alarm() -> str:
        (report,) = [message.report for message in watchdog.news() if isinstance(message, FirewallReported)]
        return str(report.removed)

    assert alarm().startswith("apply them again; nft removed 1 rule")
    for _minute in range(3):
        await watchdog.look()
        assert alarm().startswith("apply them again; nft removed 1 rule")
    assert len(isolation.open_since) == 5
    isolation.open_ports = ""
    await watchdog.look()
    assert alarm().startswith("nft removed 1 rule")
    assert not any(isinstance(one, ProbeFailed) for one in told)
