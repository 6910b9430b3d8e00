"""A trace of the running appliance is an execution of the model (`lab/proofs/insertion.pml`); a tampered one is not.

A monitor that stamps its revision on its messages is replaced and removed, the relay is killed, and the policy
revokes the subscription and grants it again. After the answer to each change, one more message is sent.
"""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from lab.proofs.spin import Bounds, Step, accepts
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Event
from tests.support.waiting import eventually

NO_EARS = OPEN_POLICY.replace("[Commands]", "/chatter =\n[Commands]", 1)
STAMP = """
stamp() {
    event said(std::string text) /chatter std_msgs/String '{data:text}' { text = "REVISION " + text; }
}
"""
STEPS = {
    ("registered", "publication"): "publication",
    ("registered", "subscription"): "subscription",
    ("decision", "requestTopic"): "decided_call",
    ("connection opened", "topic"): "opened",
    ("connection closed", "topic"): "closed",
    ("revoked", "registerSubscriber"): "revoked",
}
Trace = list[Step]


def steps(appliance: Appliance) -> Trace:
    found: Trace = []
    for record in appliance.audit("--limit", "10000", "--oldest-first"):
        event, detail = record["event"], record["detail"]
        if event == "specifications loaded" and detail["revision_of_specifications"] > 1:
            found.append(("loaded", detail["revision_of_specifications"], int(bool(detail["monitors"]))))
        elif record.get("resource") == "/chatter" and record.get("decision") in (None, "allow", "deny"):
            step = STEPS.get((event, detail.get("call") or record["category"]))
            denied = event == "decision" and record["decision"] != "allow"
            found += [(step, 0, 0)] if step and not denied else []
    return found


def number(event: Event) -> int:
    return int(event["data"].split()[-1]) if event["event"] == "received" else 0


@pytest.fixture(scope="module")
def trace() -> Trace:
    need_ros()
    with tempfile.TemporaryDirectory(prefix="rosrv-stamp-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "stamp.rv").write_text(STAMP.replace("REVISION", "1"))
        with (
            Appliance(options=("--monitors", name, "--api", "off")) as appliance,
            RosSession(appliance.master_uri, folder) as ros,
        ):
            return followed(appliance, ros, folder)


def followed(appliance: Appliance, ros: RosSession, folder: Path) -> Trace:
    trace: Trace = []
    listener = ros.listener("rospy", "/chatter")
    talker = ros.talker("rospy", "/chatter", "--rate", "20")

    def hear(revision: int, opened: int) -> None:
        last = max((one["number"] for one in talker.seen(event="sent")), default=0)
        heard = listener.wait_for(lambda event: number(event) >= last + 2)

        def recorded() -> Trace | None:
            known = steps(appliance)
            there = [what for what, _, _ in known]
            last_end = next(
                what for what in reversed(["closed", *there]) if what in ("opened", "closed", "revoked")
            )
            # More are opened where a listener that has already connected again is reminded to connect.
            ready = there.count("opened") >= opened and last_end == "opened"
            return known if ready and there.count("loaded") == revision - 1 else None

        known = eventually(recorded, appliance.story)
        trace.extend(known[sum(what != "heard" for what, _, _ in trace) :])
        stamp = re.match(r"\d+", heard["data"])
        trace.append(("heard", int(stamp[0]) if stamp else revision, revision))

    hear(1, 1)
    changed = folder / "changed" / "stamp.rv"
    changed.parent.mkdir()
    changed.write_text(STAMP.replace("REVISION", "2"))
    appliance.rosrv("monitor", "load", str(changed))
    hear(2, 1)
    appliance.kill("relay")
    hear(2, 2)
    appliance.reload(NO_EARS)
    appliance.reload(OPEN_POLICY)
    hear(2, 3)
    appliance.rosrv("monitor", "remove", "stamp")
    hear(3, 3)
    return trace


def bounds(trace: Trace) -> Bounds:
    happened = [what for what, _, _ in trace]
    again = max(0, happened.count("subscription") - 1)
    return Bounds(loads=happened.count("loaded"), policies=happened.count("revoked") + again, crashes=1)


def test_a_run_is_an_execution_of_the_model(trace: Trace, tmp_path: Path) -> None:
    happened = [what for what, _, _ in trace]
    assert [step for step in trace if step[0] in ("loaded", "heard")] == [
        ("heard", 1, 1), ("loaded", 2, 1), ("heard", 2, 2), ("heard", 2, 2), ("heard", 2, 2), ("loaded", 3, 0),
        ("heard", 3, 3),
    ]  # fmt: skip
    assert happened.count("opened") >= 3
    assert happened.count("revoked") == 1
    assert accepts(tmp_path, bounds(trace), trace), trace


def past_its_monitor(trace: Trace) -> Trace:
    place = trace.index(("heard", 2, 2))
    return [*trace[:place], ("heard", 1, 2)]


def undecided(trace: Trace) -> Trace:
    place = trace.index(("decided_call", 0, 0))
    return [*trace[:place], *trace[place + 1 : trace.index(("opened", 0, 0)) + 1]]


def after_the_end(trace: Trace) -> Trace:
    return [*trace[: trace.index(("closed", 0, 0)) + 1], ("heard", 2, 2)]


def twice(trace: Trace) -> Trace:
    return [*trace[: trace.index(("opened", 0, 0)) + 1], ("opened", 0, 0)]


@pytest.mark.parametrize("tampered", [past_its_monitor, undecided, after_the_end, twice])
def test_a_tampered_run_is_not_an_execution_of_the_model(
    tampered: Callable[[Trace], Trace], trace: Trace, tmp_path: Path
) -> None:
    wrong = tampered(trace)
    assert not accepts(tmp_path, bounds(wrong), wrong), wrong
