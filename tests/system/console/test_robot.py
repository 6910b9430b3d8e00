from collections.abc import Callable, Iterator
from itertools import combinations
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.support.appliance import Appliance
from tests.support.robot import Robot, nodes
from tests.system.console.reader import Reader, wait_until

WIDE, NARROW = (1280, 800), (390, 844)
SMALLEST_NAME = 11  # pixels on the screen
_Box = tuple[float, float, float, float]  # left, top, right, bottom
_ALL_IN_FRAME = """() => {
  const frame = document.querySelector(".drawing").getBoundingClientRect();
  return [...document.querySelectorAll(".box .shape")].map((one) => one.getBoundingClientRect()).every((box) =>
    frame.left <= box.left && box.right <= frame.right && frame.top <= box.top && box.bottom <= frame.bottom);
}"""

# For each line of a denied attempt: the boxes that hide a part of it; at its ends it touches their edges.
_BEHIND = """() => {
  const boxes = [...document.querySelectorAll(".box")].map((one) => [one.dataset.key, one.querySelector(".shape")]);
  return [...document.querySelectorAll("g.attempt path.line")].map((line) => {
    const found = new Set();
    for (let step = 0; step <= 200; step += 1) {
      const at = line.getPointAtLength((line.getTotalLength() * step) / 200).matrixTransform(line.getScreenCTM());
      for (const [key, shape] of boxes) {
        const { left, right, top, bottom } = shape.getBoundingClientRect();
        if (at.x > left + 1 && at.x < right - 1 && at.y > top + 1 && at.y < bottom - 1) found.add(key);
      }
    }
    return [...found];
  });
}"""


@pytest.fixture(scope="module")
def robot(appliance: Appliance) -> Iterator[Robot]:
    with Robot(appliance.master_uri) as robot:
        refused = robot.call(
            "/operator/bridge",
            "registerPublisher",
            "/guarded",
            "std_msgs/Float64",
            robot.api("/operator/bridge"),
        )
        assert refused[0] != 1
        yield robot


@pytest.mark.usefixtures("robot")
@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_all_of_it_is_in_the_picture(opened: Callable[..., Reader], size: tuple[int, int]) -> None:
    page = _graph(opened(width=size[0], height=size[1]))
    expect(page.locator('[data-key="gnode:/arm/*"]')).to_contain_text("/arm")
    wait_until(page, _ALL_IN_FRAME)  # it is fitted once it is drawn
    boxes = _boxes(page)
    assert not [pair for pair in combinations(boxes, 2) if _overlap(*pair)]
    assert _smallest_name(page) >= SMALLEST_NAME
    names = page.locator(".box.many .box-name").all_text_contents()
    assert sorted(names) == sorted({f"/{node.split('/')[1]}" for node, _machine in nodes()})
    for _step in range(6):
        page.get_by_role("button", name="Farther").click()
    assert _smallest_name(page) >= SMALLEST_NAME


@pytest.mark.usefixtures("robot")
def test_nodes_on_the_appliances_own_machine_are_not_denied(opened: Callable[..., Reader]) -> None:
    page = opened().go("hosts")
    expect(page.locator(".head-sub")).to_contain_text("0 other machines without a tunnel")
    expect(page.get_by_text("No other machine runs nodes without a tunnel")).to_be_visible()


@pytest.mark.usefixtures("robot")
def test_a_group_opens_where_it_stands(opened: Callable[..., Reader]) -> None:
    page = _graph(opened(width=WIDE[0], height=WIDE[1]))
    group = page.locator('[data-key="gnode:/arm/*"]')
    at = _corner(group)
    before = {key: spot for key, spot in _corners(page).items() if spot[0] <= at[0] and spot[1] < at[1]}
    assert before
    group.focus()
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Open the group").click()
    expect(page.locator('[data-key="n/arm/planner"]')).to_be_visible()
    after = _corners(page)
    assert {key: after[key] for key in before} == before
    assert at in after.values()
    boxes = _boxes(page)
    assert not [pair for pair in combinations(boxes, 2) if _overlap(*pair)]
    page.get_by_role("button", name="Close groups").click()
    expect(page.locator(".box.many")).to_have_count(10)


@pytest.mark.usefixtures("robot")
def test_groups_by_host(opened: Callable[..., Reader]) -> None:
    page = opened(width=WIDE[0], height=WIDE[1]).go("graph")
    page.get_by_label("Groups", exact=True).select_option("host")
    expect(page.locator(".box.many")).to_have_count(4)
    expect(page.locator(".box.many").first).to_contain_text("127.0.0.1")


@pytest.mark.usefixtures("robot")
def test_publishers_and_subscribers_of_the_arm(opened: Callable[..., Reader]) -> None:
    page = opened(width=WIDE[0], height=WIDE[1]).go("graph")
    search = page.get_by_label("Search the graph")
    search.fill("/arm/command")
    search.press("Enter")
    details = page.get_by_role("region", name="Topic")
    for node in ("/arm/planner", "/arm/controller", "/safety/watchdog"):
        expect(details.get_by_role("button", name=node)).to_be_visible()
    search.fill("/guarded")
    expect(page.locator('[data-key="n/operator/bridge"]')).to_be_visible()
    expect(page.locator("g.attempt")).to_have_count(1)


@pytest.mark.usefixtures("robot")
def test_numbers_agree(opened: Callable[..., Reader], appliance: Appliance) -> None:
    reader = opened()
    expect(reader.go("graph").locator(".head-sub")).to_have_text("100 nodes, 200 topics, 0 services")
    card = reader.go("now").get_by_role("link", name="Nodes 1")
    expect(card).to_contain_text("100")
    expect(card).to_contain_text("200 topics, 0 services")
    status: dict[str, Any] = appliance.status()
    assert (status["nodes"], status["topics"], status["services"]) == (100, 200, 0)


def test_a_refusal_runs_behind_no_box(
    appliance: Appliance, robot: Robot, opened: Callable[..., Reader]
) -> None:
    policy = appliance.policy_file.read_text()
    appliance.reload(policy.replace("[Publishers]\n", "[Publishers]\n/arm/command = 127.0.0.11\n"))
    for node in ("/operator/bridge", "/camera/bridge"):
        assert (
            robot.call(node, "registerPublisher", "/arm/command", "std_msgs/Float64", robot.api(node))[0] != 1
        )
        appliance.recorded("--deny", caller_id=node, resource="/arm/command")
    page = opened(width=WIDE[0], height=WIDE[1]).go("graph")
    expect(page.locator("g.attempt")).to_have_count(3)
    wait_until(page, _ALL_IN_FRAME)
    assert not [keys for keys in page.evaluate(_BEHIND) if keys]
    appliance.reload(policy)


def _graph(reader: Reader) -> Page:
    page = reader.go("graph")
    expect(page.locator(".box.many")).to_have_count(10)
    expect(page.locator("g.attempt")).to_have_count(1)
    return page


def _corners(page: Page) -> dict[str, tuple[float, float]]:
    return {str(one.get_attribute("data-key")): _corner(one) for one in page.locator(".box").all()}


def _corner(box: Locator) -> tuple[float, float]:
    words = str(box.get_attribute("transform")).removeprefix("translate(").removesuffix(")").split()
    return float(words[0]), float(words[1])


def _boxes(page: Page) -> list[_Box]:
    """Return the boxes in one evaluation, because the drawing may move between two."""
    boxes: list[_Box] = page.eval_on_selector_all(
        ".box .shape",
        """all => all.map(one => {
             const { left, top, right, bottom } = one.getBoundingClientRect();
             return [left, top, right, bottom];
           })""",
    )
    assert boxes
    return boxes


def _overlap(one: _Box, other: _Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _smallest_name(page: Page) -> float:
    return float(
        page.evaluate(
            "Math.min(...[...document.querySelectorAll('.box-name')].map((one) =>"
            " one.getAttribute('font-size') * one.getScreenCTM().a))"
        )
    )


# Draws the pad beside the page, and returns its words after each button was pressed, and its orders.
PAD = """async ([group, guard]) => {
    const { h, html, render } = await import("/console/static/vendor/preact.js");
    const { Pad } = await import("/console/static/features/doors/teleop/pad.js");
    const orders = [];
    const shown = ({ value, title, children }) => html`<span>${value} ${title} ${children}</span>`;
    const Button = ({ onClick, children }) => html`<button onClick=${onClick}>${children}</button>`;
    const answers = { "/v1/drive": { groups: [group] }, "/v1/guards": { guards: [guard] } };
    const parts = {
        Field: () => null, Given: shown, Notice: shown, Failure: shown, Button,
        optional: async (path) => answers[path],
        ask: async (_method, path, { json }) => orders.push([path, json]),
    };
    const place = document.createElement("div");
    const topics = [{ name: "/cmd_vel", type: "geometry_msgs/Twist" }];
    const given = { parts, door: {}, topics, freshness: { age: () => 0 }, name: "first", address: "10.0.0.1" };
    render(html`<${Pad} ...${given} />`, place);
    await new Promise((done) => setTimeout(done, 500));
    for (const button of place.querySelectorAll("button")) button.click();
    const text = place.textContent;
    render(null, place);
    return [text, orders];
}"""
GUARD = {"preset": "deadman", "topics": {"command": "/cmd_vel"}, "state": "free"}


GROUP = {"group": "base", "names": ["/cmd_vel"], "ranks": [], "holder": "10.0.0.1"}


def test_the_pad_hands_over_only_what_it_shows(opened: Callable[..., Reader]) -> None:
    """Another operator may have handed the group on since: the order names the holder that the person saw."""
    page = opened().go("robot")
    for holder in ("", "10.0.0.1", "10.0.0.2"):
        [[_path, order]] = page.evaluate(PAD, [GROUP | {"holder": holder}, GUARD])[1]
        assert order["holder"] == holder


def test_the_pad_lists_the_guards_that_act(opened: Callable[..., Reader]) -> None:
    page = opened().go("robot")
    listed = {
        state: "Guards: deadman" in text
        for state in ("free", "stopping", "withholding", "holding", "shadow", "off", "broken")
        if ("No deadman guards" in (text := page.evaluate(PAD, [GROUP, GUARD | {"state": state}])[0]))
        != ("Guards: deadman" in text)
    }
    acting = dict.fromkeys(("free", "stopping", "withholding", "holding"), True)
    assert listed == acting | dict.fromkeys(("shadow", "off", "broken"), False)
