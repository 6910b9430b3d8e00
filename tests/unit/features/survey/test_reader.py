import asyncio
from typing import Any

import pytest

from appliance.rpc import graph_reader as reader
from appliance.rpc.graph_inventory import GraphInventory
from appliance.rpc.graph_reader import SurveyError, SurveyLimits, survey
from appliance.rpc.xmlrpc_client import UnansweredError
from roswire.uris import NodeUri
from tests.support import autojump

MASTER: dict[str, Any] = {
    "getSystemState": [[["/scan", ["/laser"]]], [["/scan", ["/base"]]], [["/reset", ["/base"]]]],
    "getTopicTypes": [["/scan", "sensor_msgs/LaserScan"]],
    "getParamNames": ["/speed"],
    "lookupService": "rosrpc://127.0.0.1:5001",
    "lookupNode": "http://127.0.0.1:4000/",
}
NODE: dict[str, Any] = {
    "getPid": 12,
    "getBusInfo": [[1, "/base", "o", "TCPROS", "/scan", True, "text"]],
    "getBusStats": [[["/scan", 100, [[1, 100, 10, True]]]], []],
}


class FakeClient:
    """Answers for the master at port 11311, and for each node at another port."""

    answers: dict[str, Any]
    asked: list[str]

    def __init__(self, uri: NodeUri, **_options: object) -> None:
        self.is_master, self.host = uri.port == 11311, uri.host

    async def call(self, method: str, *_parameters: object) -> Any:
        self.asked.append(method)
        await asyncio.sleep(0)
        answer = self.answers.get(method, (MASTER if self.is_master else NODE).get(method))
        if isinstance(answer, Exception):
            raise answer
        return list(answer) if isinstance(answer, tuple) else [1, "", answer]

    def close(self) -> None:
        pass


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(reader, "XmlRpcClient", FakeClient)
    FakeClient.asked = []

    async def refused(_host: str, _port: int) -> None:
        raise ConnectionRefusedError

    monkeypatch.setattr(asyncio, "open_connection", refused)

    def surveyed(limits: SurveyLimits | None = None, **answers: Any) -> GraphInventory:
        FakeClient.answers = answers
        return autojump.run(survey("http://127.0.0.1:11311", limits or SurveyLimits(sample=0.001)))

    return surveyed


def test_all_that_the_master_and_the_nodes_say_is_read(run: Any) -> None:
    found = run()
    assert [node.name for node in found.nodes] == ["/base", "/laser"]
    assert found.topics[0].type == "sensor_msgs/LaserScan"
    assert found.services[0].uri == "rosrpc://127.0.0.1:5001"
    assert found.nodes[1].connections[0].peer == "/base"
    assert found.calls == len(FakeClient.asked)


@pytest.mark.parametrize(
    "row", [["/scan", 100, [[1, 100, 10, True]]], ["/scan", [[1, 100, 90, 10, 0]]]], ids=["rospy", "roscpp"]
)
def test_messages_are_counted_by_both_clients(run: Any, row: list[object]) -> None:
    assert run(getBusStats=[[row], []]).topics[0].rate == 0.0
    assert run(getBusStats=[[["/scan", 0, []]], []]).topics[0].rate is None


def test_only_calls_that_read_are_made(run: Any) -> None:
    run()
    assert set(FakeClient.asked) == {"getRVState", *MASTER, *NODE}
    assert not any(
        method.startswith(("register", "unregister", "set", "delete", "shutdown"))
        for method in FakeClient.asked
    )


@pytest.mark.parametrize("method", [*NODE, "lookupNode", "lookupService"])
@pytest.mark.parametrize(
    "answer",
    [
        None,
        3,
        "x",
        [],
        [[]],
        [[[[]]]],
        {"a": 1},
        [[["/scan", 1, [["x"]]]]],
        "\x00" * 999,
        UnansweredError("late"),
    ],
)
def test_a_node_that_answers_nonsense_costs_its_own_row_only(run: Any, method: str, answer: object) -> None:
    found = run(**{method: answer})
    assert [topic.name for topic in found.topics] == ["/scan"]
    assert len(found.nodes) == 2


@pytest.mark.parametrize("method", ["getSystemState", "getTopicTypes", "getParamNames"])
@pytest.mark.parametrize("answer", [None, 3, "x", {"a": 1}, [1], [[], []], UnansweredError("late")])
def test_a_master_that_answers_nonsense_is_an_error_or_an_empty_list(
    run: Any, method: str, answer: object
) -> None:
    try:
        found = run(**{method: answer})
    except SurveyError as error:
        assert "ROS_MASTER_URI" in str(error)
    else:
        assert method != "getSystemState"
        assert len(found.nodes) == 2


DENIED: tuple[int, str, list[str]] = (0, f"{'a' * 300} is not granted [18e9aa02efc40abb0e51]", [])


@pytest.mark.parametrize(
    ("answer", "protected"),
    [(DENIED, True), ((1, "", [11312, 11311, []]), True), ((0, "not supported", 0), False), ((1, "", 0), False),
     ((-1, "unknown [12]", 0), False), (UnansweredError("no such method"), False)],
)  # fmt: skip
def test_an_appliance_at_the_master_is_recognised(run: Any, answer: object, protected: bool) -> None:
    found = run(getRVState=answer)
    assert found.protected is protected
    assert [port.what for port in found.listeners] == ["a ROSRV appliance" if protected else "a ROS master"]


def test_a_denied_visitor_gets_the_record_and_is_not_sent_elsewhere(run: Any) -> None:
    with pytest.raises(SurveyError, match=r"\[18e9aa02efc40abb0e51\]") as error:
        run(getSystemState=DENIED)
    assert "ROS_MASTER_URI" not in str(error.value)


def test_a_limit_is_named_in_the_inventory(run: Any) -> None:
    many = [[f"/topic{number}", ["/laser"]] for number in range(30)]
    found = run(SurveyLimits(rows=10, sample=0.001), getSystemState=[many, [], []])
    assert len(found.topics) == 10
    assert "20 of 30 topics" in found.left_out


def test_an_address_that_is_not_a_uri_is_an_error_with_an_example() -> None:
    with pytest.raises(SurveyError, match="--master http://robot:11311"):
        autojump.run(survey("robot:11311", SurveyLimits()))


@pytest.mark.parametrize(("here", "own"), [(True, ("10.0.0.1",)), (False, ())])
def test_the_addresses_of_the_machine_of_the_master_are_known_only_on_that_machine(
    run: Any, monkeypatch: pytest.MonkeyPatch, here: bool, own: tuple[str, ...]
) -> None:
    mine = {"10.0.0.1", "127.0.0.1"} if here else {"10.0.0.1"}  # by chance, a node has an own address
    monkeypatch.setattr(reader, "is_here", mine.__contains__)
    assert run(lookupNode="http://10.0.0.1:4000/").own == own


@pytest.mark.real
@pytest.mark.parametrize(("address", "here"), [("127.0.1.1", True), ("::1", True), ("192.0.2.99", False)])
def test_an_address_of_another_machine_is_not_an_own_one(address: str, here: bool) -> None:
    assert reader.is_here(address) is here


async def answer_of_a_crowd(client: FakeClient, method: str, *parameters: object) -> Any:
    """Answer for a master with 500 names of a host that never answers, before two nodes that do."""
    if client.host == "10.0.0.66":
        await asyncio.sleep(3.0)
        raise UnansweredError("late")
    if method == "lookupNode":
        name = str(parameters[1])
        host = {"/base": "127.0.0.1", "/nuc": "192.168.50.2"}.get(name, "10.0.0.66")
        return [1, "", f"http://{host}:{4000 + len(name)}/{name.strip('/')}"]
    return [1, "", client.answers.get(method, (MASTER if client.is_master else NODE).get(method))]


def test_names_of_a_silent_host_keep_no_other_out_and_make_no_host_a_target(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeClient, "call", answer_of_a_crowd)
    scanned: list[str] = []

    async def refused(host: str, _port: int) -> None:
        scanned.append(host)
        raise ConnectionRefusedError

    monkeypatch.setattr(asyncio, "open_connection", refused)
    monkeypatch.setattr(reader, "is_here", {"127.0.0.1"}.__contains__)
    names = [f"/a{number}" for number in range(500)]
    state = [[["/scan", [*names, "/nuc", "/base"]]], [], []]
    found = run(SurveyLimits(whole=20.0, sample=0.001), getSystemState=state)
    assert [node.name for node in found.nodes if not node.problem] == ["/base", "/nuc"]
    assert found.seconds < 20
    assert {*scanned} == {"127.0.0.1", "192.168.50.2"}, "a registered URI alone makes no host a target"
    assert "the time of their hosts was over" in " ".join(found.left_out)
