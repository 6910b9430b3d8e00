import threading
from collections.abc import Callable, Iterator
from socketserver import ThreadingMixIn
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

import pytest
from playwright.sync_api import expect

from tests.system.console.reader import LIMIT, Reader

NODES, TOPICS = 100, 1000


class _Quiet(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True


@pytest.fixture(scope="module")
def node_api() -> Iterator[str]:
    server = _Quiet(("127.0.0.1", 0), logRequests=False, allow_none=True)

    class Agree:
        def _dispatch(self, method: str, parameters: tuple[Any, ...]) -> list[Any]:
            return [1, "", 4711 if method == "getPid" else 0]

    server.register_instance(Agree())
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_refused_attempt_is_red_and_leads_to_its_rule(
    opened: Callable[..., Reader], attempt: Callable[..., Any], node_api: str
) -> None:
    assert attempt("registerPublisher", "/talker", "/chatter", "std_msgs/String", node_api)[0] == 1
    assert attempt("registerSubscriber", "/listener", "/chatter", "std_msgs/String", node_api)[0] == 1
    reader = opened()
    page = reader.go("graph")
    expect(page.locator('[data-key="n/talker"]')).to_be_visible()
    expect(page.locator('[data-key="t/chatter"]')).to_have_class("box topic mediated")
    before = page.locator('[data-key="t/chatter"]').get_attribute("transform")
    attempt("registerPublisher", "/talker", "/guarded", "std_msgs/String", node_api)
    line = page.locator("g.attempt").first
    expect(line).to_be_attached()
    assert page.locator('[data-key="t/chatter"]').get_attribute("transform") == before
    line.focus()
    page.keyboard.press("Enter")
    details = page.get_by_role("region", name="Denied")
    expect(details).to_contain_text("[Publishers] /guarded")
    details.get_by_role("link", name="line 7").click()
    expect(page.locator(".cm-lineNumbers .cm-activeLineGutter")).to_have_text("7")


def test_the_self_test_is_not_an_attempt(opened: Callable[..., Reader]) -> None:
    page = opened().go("graph")
    attempts = """async (denials) => {
      const { attempts } = await import("/console/static/js/graph/model.js");
      return attempts(denials).map((one) => one.records[0].resource);
    }"""
    caller = {"host": "10.0.0.9", "caller_id": "/rosrv_selftest_publisher", "category": "publish"}
    denials = [{**caller, "resource": "/rosrv_selftest"}, {**caller, "resource": "/cmd_vel"}]
    assert page.evaluate(attempts, denials) == ["/cmd_vel"]


def test_a_host_that_uses_names_of_another_host_is_shown_as_that(opened: Callable[..., Reader]) -> None:
    page = opened().go("graph")
    drawn = """async ({ graph, denials }) => {
      const { modelOf } = await import("/console/static/js/graph/model.js");
      const { items, lines } = modelOf(graph, denials, { services: false, quiet: true, denied: true });
      const found = [...items.values()].filter((one) => one.kind !== "topic");
      const ends = [...lines.values()].map((one) => [one.from, one.to]);
      return { items: found.map((one) => [one.key, one.name, one.sub]), lines: ends };
    }"""
    nodes = [
        {"name": name, "host": host, "state": "live", "publishes": [], "subscribes": [], "offers": []}
        for name, host in (("/arm", "10.0.0.1"), ("/eye", "10.0.0.2"), ("/ear", "10.0.0.9"))
    ]
    denied = {
        "host": "10.0.0.9",
        "category": "publish",
        "decision": "deny",
        "rule": None,
        "equality": {"times": 3},
    }
    denials = [
        {**denied, "caller_id": caller, "resource": resource}
        for caller, resource in (("/arm", "/new"), ("/eye", "/new"), ("/ear", "/new"), ("/other", "/new"))
    ]
    found = page.evaluate(
        drawn, {"graph": {"nodes": nodes, "topics": [], "services": []}, "denials": denials}
    )
    assert found["items"] == [
        ["n/arm", "/arm", "10.0.0.1"],
        ["n/eye", "/eye", "10.0.0.2"],
        ["n/ear", "/ear", "10.0.0.9"],
        ["x@10.0.0.9", "10.0.0.9", "uses names of 2 hosts"],
        ["t/new", "/new", "denied publish"],
    ]
    assert found["lines"] == [
        ["x@10.0.0.9", "n/arm"],
        ["x@10.0.0.9", "n/eye"],
        ["n/ear", "t/new"],
        ["x@10.0.0.9", "t/new"],
    ]


def test_a_long_chain_fills_the_frame(opened: Callable[..., Reader]) -> None:
    page = opened(width=1600, height=1000).go("graph")
    shape = """async ({ chain, alone }) => {
      const { afresh, extent, loadLayout } = await import("/console/static/js/graph/arrange.js");
      await loadLayout();
      const numbers = (count) => [...Array(Math.max(0, count)).keys()];
      const line = (at) => ({ key: `${at}`, from: `n${at}`, to: `n${at + 1}`, kind: "flow" });
      const items = new Map(numbers(chain + alone).map((at) => [`n${at}`, { key: `n${at}`, kind: "node" }]));
      const lines = new Map(numbers(chain - 1).map((at) => [`${at}`, line(at)]));
      const { w, h } = extent(afresh(items, lines, { narrow: false, w: 1300, h: 760 }).values());
      return Math.min(1300 / w, 760 / h);
    }"""
    assert page.evaluate(shape, {"chain": 40, "alone": 0}) > 0.3  # 0.13 in one row
    assert page.evaluate(shape, {"chain": 0, "alone": 50}) > 0.7  # 0.23 in one column
    assert page.evaluate(shape, {"chain": 6, "alone": 40}) > 0.6


def test_names_lose_their_first_namespaces_first(opened: Callable[..., Reader]) -> None:
    page = opened().go("graph")
    shown = """async (cases) => {
      const { label } = await import("/console/static/js/graph/drawing.js");
      return cases.map(([name, most]) => label(name, most));
    }"""
    cases = {
        ("/arm/planner", 12): "/arm/planner",
        ("/left/arm/planner", 12): "arm/planner",
        ("/left/arm/planner", 8): "planner",
        ("/navigation_planner", 12): "navigation_…",
        ("/arm … safety", 20): "/arm … safety",
    }
    assert page.evaluate(shown, [list(case) for case in cases]) == list(cases.values())


def test_a_thousand_topics(opened: Callable[..., Reader], attempt: Callable[..., Any], node_api: str) -> None:
    for number in range(TOPICS):
        node = f"/fleet/robot_{number % NODES:03}"
        topic = f"/fleet/robot_{number % NODES:03}/sensor_{number // NODES}"
        assert attempt("registerPublisher", node, topic, "std_msgs/String", node_api)[0] == 1
    reader = opened()
    page = reader.go("graph")
    expect(page.locator(".head-sub")).to_contain_text("1,0")
    drawn = page.locator(".drawing")
    expect(drawn).to_be_visible()
    assert 2 <= int(drawn.get_attribute("data-items") or 0) <= 150
    page.locator(".box.many").first.focus()
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Open the group").click()
    expect(page.get_by_role("button", name="Close groups")).to_be_visible()
    assert int(drawn.get_attribute("data-items") or 0) <= 200
    page.get_by_label("Search the graph").fill("robot_042/sensor_7")
    expect(page.locator('[data-key="t/fleet/robot_042/sensor_7"]')).to_be_visible(timeout=LIMIT)
    expect(page.locator('[data-key="n/fleet/robot_042"]')).to_be_visible()
    page.get_by_label("Search the graph").fill("")
    page.get_by_role("button", name="Table").click()
    expect(page.get_by_text(" of 1,0")).to_be_visible()
    page.get_by_role("button", name="More").click()
    expect(page.get_by_text("101 to 200")).to_be_visible()
