from pathlib import Path

from appliance.features.survey.draft import draft
from appliance.features.survey.verb import page, report
from appliance.rpc.graph_inventory import NodeConnection, SurveyedService, SurveyedTopic, problems
from tests.unit.features.survey.surveyed import BASE, NODES, TABLET, inventory, node

EVIL = "/<script>alert(1)</script>\x1b[2J"


def test_the_page_has_no_script_and_loads_nothing() -> None:
    topics = (SurveyedTopic(EVIL, EVIL, (EVIL,), ("/base",)),)
    found = inventory(nodes=(*NODES, node(EVIL, BASE, problem=EVIL)), topics=topics)
    text = page(found, draft(found, {}))
    assert "<script" not in text
    assert "\x1b" not in text
    assert "default-src 'none'" in text
    assert "http://" not in text.partition("<style>")[0]


def test_the_report_says_in_numbers_what_any_host_may_do() -> None:
    lines = list(report(inventory()))
    assert lines[0].startswith("7 nodes on 3 hosts, 6 topics, 3 services, 2 parameters; read with 40 calls")
    assert "  nodes that it can end: 7" in lines
    assert "  of these, commands that move something: 2" in lines
    assert "moves: /cmd_vel (geometry_msgs/Twist) from /navigation (10.0.0.1), /teleop (10.0.0.7)" in lines
    assert "acts: /arm/enable of /arm/driver (10.0.0.2)" in lines
    assert "named like a secret: /wifi/password" in lines


def test_behind_an_appliance_no_host_is_reported_as_free() -> None:
    found = inventory(protected=True, listeners=())
    for text in ("\n".join(report(found)), page(found, None)):
        assert "its policy decides for each host: rosrv policy who-may" in text
        assert not any(said in text for said in ("any host", "Any host", "nodes that it can end"))


def test_the_report_on_the_page_is_this_one() -> None:
    text = (Path(__file__).parents[4] / "docs" / "try-for-an-hour.md").read_text()
    shown = text.partition("--policy draft.ini\n")[2].partition("    …")[0]
    lines = "".join(f"    {line}\n" for line in report(inventory()))
    assert shown.count("\n") > 8
    assert lines.startswith(shown)


def test_problems_are_named() -> None:
    nodes = (
        node("/a", BASE, problem="no answer"),
        node("/b", "127.0.0.1"),
        node("/c", TABLET, connections=(NodeConnection("/scan", "/a", "i", "UDPROS"),)),
    )
    topics = (SurveyedTopic("/cmd_vel", "geometry_msgs/Twist", ("/a", "/c"), ()),)
    services = (SurveyedService("/reset", ("/a", "/c")),)
    found = list(problems(inventory(nodes=nodes, topics=topics, services=services)))
    assert [line.split()[0] for line in found] == ["/a", "/b", "/cmd_vel", "/reset", "/c"]
    assert "set ROS_IP" in found[1]
