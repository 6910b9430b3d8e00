"""Tests of `appliance.supervisor.isolation_watchdog`, with surroundings that do what a test says."""

import asyncio
import errno
import threading

import pytest

from appliance.channel.answers.status import FirewallState
from appliance.channel.messages import EndpointFound, FirewallReported, Message, ProbeFailed, ProbePassed
from appliance.network.esp import Esp
from appliance.network.namespaces import NetworkError
from appliance.supervisor.isolation_lifecycle import Enclosure
from appliance.supervisor.isolation_watchdog import Guard


class Surroundings(Enclosure):
    """An enclosure of which a test decides what a probe finds."""

    kind = "container"
    probes = True

    def __init__(self) -> None:
        self.found: list[str | Exception | None] = []
        self.closed: list[int] = []
        self.looked = threading.Event()

    def report(self) -> FirewallState:
        """A report that can be recognised."""
        return FirewallState(backend="nft")

    def probe(self) -> str | None:
        """The next finding."""
        self.looked.set()
        finding = self.found.pop(0)
        if isinstance(finding, Exception):
            raise finding
        return finding

    def control_ready(self, inner_port: int, own_port: int) -> None:
        """Fails for port 0 and 1."""
        if inner_port == 0:
            raise NetworkError("the kernel says no")
        if inner_port == 1:
            raise OSError(errno.EAGAIN, "no process can be made")
        self.closed.append(inner_port)

    def open_tunnels(self, pool: str, address: str) -> Esp:
        """Fails as a machine does that has no process left."""
        raise OSError(errno.EAGAIN, "no process can be made")


@pytest.fixture
def surroundings() -> Surroundings:
    """Surroundings without a finding yet."""
    return Surroundings()


def test_control_is_told_when_something_opens_and_closes(surroundings: Surroundings) -> None:
    """A finding is told with its reason, its end as well; the report goes with both."""
    told: list[Message] = []
    surroundings.found = ["reached", None]

    async def scene() -> None:
        guard = Guard(surroundings, told.append)
        assert await guard.look() == "reached"
        assert await guard.look() is None

    asyncio.run(scene())
    report = FirewallReported("container", FirewallState(backend="nft"))
    assert told == [report, ProbeFailed("reached"), report, ProbePassed()]


def test_a_probe_that_cannot_be_made_counts_as_open(surroundings: Surroundings) -> None:
    """What cannot be told is not assumed to be right."""
    told: list[Message] = []
    surroundings.found = [NetworkError("no child")]

    async def scene() -> None:
        assert "no child" in str(await Guard(surroundings, told.append).look())

    asyncio.run(scene())
    assert isinstance(told[-1], ProbeFailed)


def test_a_new_control_learns_how_things_stand(surroundings: Surroundings) -> None:
    """The last finding is repeated to a control that was not there when it was made."""
    surroundings.found = ["reached"]

    async def scene() -> list[Message]:
        guard = Guard(surroundings, lambda _message: None)
        assert guard.news() == [FirewallReported("container", FirewallState())]
        await guard.look()
        return guard.news()

    assert asyncio.run(scene())[-1] == ProbeFailed("reached")


def test_the_inner_face_is_closed_and_then_probed(surroundings: Surroundings) -> None:
    """The port is closed to others before it is probed; a failure to close it is a finding."""
    surroundings.found = [None]

    async def scene() -> None:
        guard = Guard(surroundings, lambda _message: None)
        assert await guard.control_ready(4711, 4712) is None
        assert "the kernel says no" in str(await guard.control_ready(0, 4712))

    asyncio.run(scene())
    assert surroundings.closed == [4711]
    assert surroundings.found == []


@pytest.mark.parametrize("port", [0, 1])
def test_an_inner_face_that_cannot_be_closed_is_told_to_control(
    surroundings: Surroundings, port: int
) -> None:
    """Whatever stood in the way: control hears that it must not serve, and so does the next one."""
    told: list[Message] = []

    async def scene() -> list[Message]:
        guard = Guard(surroundings, told.append)
        assert "cannot be closed to others" in str(await guard.control_ready(port, 4712))
        return guard.news()

    news = asyncio.run(scene())
    assert isinstance(told[-1], ProbeFailed)
    assert news[-1] == told[-1]


@pytest.mark.parametrize(
    "broken", [OSError(errno.EMFILE, "too many open files"), ValueError("no JSON"), KeyError("chain")]
)
def test_whatever_breaks_a_probe_is_a_finding_and_the_next_one_is_made(
    surroundings: Surroundings, broken: Exception
) -> None:
    """A machine without files or processes for a moment: told as a fault, then looked at again and told as over."""
    told: list[Message] = []
    surroundings.found = [broken, *[None] * 100_000]

    async def scene() -> None:
        running = asyncio.create_task(Guard(surroundings, told.append, every=0.001).run())
        async with asyncio.timeout(20):
            while len(told) < 4 and not running.done():
                await asyncio.sleep(0)
        running.cancel()

    asyncio.run(scene())
    assert [type(one) for one in told[1:4:2]] == [ProbeFailed, ProbePassed]
    (failed,) = [one for one in told if isinstance(one, ProbeFailed)]
    assert str(broken) in failed.reason


def test_tunnels_that_cannot_be_opened_are_answered(surroundings: Surroundings) -> None:
    """Control waits for the answer: also an error that nobody thought of is one."""
    answer = asyncio.run(Guard(surroundings, lambda _message: None).open_tunnels("10.9.0.0/24", "10.9.0.1"))
    assert answer.esp is None
    assert "no process can be made" in str(answer.reason)


def test_it_looks_again_and_again(surroundings: Surroundings) -> None:
    """While the appliance runs the surroundings are looked at in turn, also after a finding."""
    told: list[Message] = []
    surroundings.found = [None, "reached", None]

    async def scene() -> None:
        running = asyncio.create_task(Guard(surroundings, told.append, every=0.001).run())
        async with asyncio.timeout(20):
            while len(told) < 6:
                await asyncio.sleep(0)
        running.cancel()

    surroundings.found += [None] * 100_000
    asyncio.run(scene())
    assert [type(one) for one in told[1:6:2]] == [ProbePassed, ProbeFailed, ProbePassed]


def test_without_isolation_nothing_is_probed() -> None:
    """Isolation `none` has nothing to prove, and does not claim to have proven it."""
    told: list[Message] = []

    async def scene() -> None:
        assert await Guard(Enclosure(), told.append).look() is None

    asyncio.run(scene())
    assert told == [FirewallReported("none", FirewallState())]


def test_without_isolation_there_is_no_address_for_hosts(surroundings: Surroundings) -> None:
    """Why is handed on instead; nothing is raised in the supervisor."""
    assert asyncio.run(Guard(surroundings, lambda _message: None).endpoint()) == EndpointFound(
        None, "isolation container has no tunnels: use isolation netns or container"
    )


def test_a_crowd_of_new_hosts_costs_a_few_threads(
    surroundings: Surroundings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many routes are asked for at once, a bounded number is looked up at a time, and all are answered."""
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

    async def scene() -> list[str | None]:
        guard = Guard(surroundings, lambda _message: None)
        asked = [asyncio.create_task(guard.route_to(str(number))) for number in range(200)]
        async with asyncio.timeout(30):
            while most[0] == 0:
                await asyncio.sleep(0)
        for _ in range(200):
            await asyncio.sleep(0)
        release.set()
        return await asyncio.gather(*asked)

    assert asyncio.run(scene()) == [f"way to {number}" for number in range(200)]
    assert most[0] <= 8
