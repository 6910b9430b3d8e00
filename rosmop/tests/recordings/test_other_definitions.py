import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from struct import pack

import pytest
from rosbags.rosbag1 import Writer

from rosmop.batch.jobs import to_bytes, unpack, work
from rosmop.batch.recording_list import recordings_of
from rosmop.batch.replay_job import Replayed, ReplayJob, Specifications
from rosmop.recordings.replay import EVER
from rosmop.tests.batch.test_many_recordings import rosmop
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

RULE = "=" * 80
OWN = f"pkg/N n\n{RULE}\nMSG: pkg/N\nfloat64 x\nfloat64 y\n"
Sent = tuple[str, str, str, bytes]  # topic, type, text, message

OTHERS: dict[str, Sent] = {
    "same topic, equal size": ("/a", "pkg/A", OWN.replace("x", "z").replace("y", "x"), bytes(16)),
    "same topic, other size": ("/a", "pkg/A", OWN + "float64 z\n", bytes(24)),
    "same topic, other type": ("/a", "std_msgs/Int8", "int8 data", b"\1"),
    "nested type, equal size": (
        "/b",
        "pkg/B",
        OWN.replace("64 x", "64 z").replace("64 y", "64 x"),
        bytes(16),
    ),
    "nested type, other size": ("/b", "pkg/B", OWN + "float64 z\n", bytes(24)),
    "other topic, equal size": ("/b", "pkg/N", "float64 y\nfloat64 x\n", bytes(16)),
    "other topic, other size": ("/b", "pkg/N", "float64 z\n", bytes(8)),
}
SPECIFICATION = """
m() { event e(double x) /a pkg/A '{n.x:x}' { if (x > 100.9) { ROS_WARN("high"); return; } } }
"""


def record(path: Path, others: Sequence[Sent], *, first: bool, caller: str = "/other") -> None:
    sent = [*others, ("/a", "pkg/A", OWN, b"")] if first else [("/a", "pkg/A", OWN, b""), *others]
    with Writer(path) as writer:
        rows = []
        for topic, kind, text, data in sent:
            digest = Definitions.from_full_text(kind, text).md5sum(kind)
            name = caller if data else "/node"
            row = writer.add_connection(
                topic, kind.replace("/", "/msg/"), msgdef=text, md5sum=digest, callerid=name
            )
            rows.append((row, data))
        for tick in range(400):
            own = pack("<dd", 100 + math.sin(tick), math.sin(tick))
            for row, data in rows:
                if not data or tick in (50, 51):
                    writer.write(row, 10**12 + tick * 10**8, data or own)


def strictly_replayed(path: Path) -> object:
    (recording,) = recordings_of([path], [])
    specifications = Specifications({"m.rv": Path("m.rv").read_text()}, {})
    return unpack(
        work(to_bytes(ReplayJob(recording, specifications, ["*"], EVER, 1, margins=False, strict=True)))
    )


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("other", OTHERS)
def test_a_connection_that_does_not_fit_changes_nothing_and_is_named(
    other: str, first: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.rv").write_text(SPECIFICATION)
    Path("alone").mkdir()
    Path("beside").mkdir()
    record(Path("alone/x.bag"), [], first=first)
    record(Path("beside/x.bag"), [OTHERS[other]], first=first)
    for command in ("run m.rv --json", "coverage m.rv", "learn"):
        results = []
        for folder in ("alone", "beside"):
            status, out, err = rosmop(f"{command} --bags {folder}")
            assert status == 0, err
            if folder == "beside" and (OTHERS[other][0] == "/a" or command == "learn"):
                assert "/a" in err + out if OTHERS[other][0] == "/a" else "/b" in err
                assert re.search("carries|different definition|another definition|instead of", err + out)
            rows = [json.loads(line) for line in out.splitlines()] if "--json" in command else []
            counts = [
                (row["effect"], row["count"], row["first"])
                for row in rows
                if row.get("monitor") == "m" and "effect" in row
            ]
            results.append(counts or out)
        assert results[0] == results[1]
    result = strictly_replayed(Path("beside/x.bag"))
    assert isinstance(result, Replayed) and bool(result.notes) == (OTHERS[other][0] == "/a")


TWIST = "geometry_msgs/Twist"
TYPES = {
    "own type": ("pkg/A", OWN, "n.x", 2),
    "type of ROS": (TWIST, standard_definitions().full_text(TWIST), "linear.x", 6),
}
USELESS = {"none": "\n", "of another md5sum": "float64 x\n", "no definition": "= float64 =\n"}


@pytest.mark.parametrize("senders", [("/few", "/many"), ("/many", "/few"), ("/many", "/many")])
@pytest.mark.parametrize("useless", USELESS)
@pytest.mark.parametrize("kind", TYPES)
def test_a_useless_text_of_a_connection_changes_nothing(
    kind: str, useless: str, senders: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The messages of all connections with the right md5sum are judged, and none is named."""
    monkeypatch.chdir(tmp_path)
    name, text, field, numbers = TYPES[kind]
    useless_sender, other_sender = senders
    if useless_sender == other_sender and name != TWIST:
        return  # without any text, only a type of ROS is known
    digest = Definitions.from_full_text(name, text).md5sum(name)
    Path("m.rv").write_text(SPECIFICATION.replace("pkg/A", name).replace("n.x", field))
    results = []
    for sent in (text, USELESS[useless]):
        with Writer(Path("x.bag")) as writer:
            rows = {
                caller: writer.add_connection(
                    "/a", name.replace("/", "/msg/"), msgdef=each, md5sum=digest, callerid=caller
                )
                for caller, each in {other_sender: text, useless_sender: sent}.items()
            }
            for tick in range(400):
                row = rows.get("/few" if tick % 3 == 0 else "/many", rows["/many"])
                data = pack(f"<{numbers}d", 100 + math.sin(tick), *[math.sin(tick)] * (numbers - 1))
                writer.write(row, 10**12 + tick * 10**8, data)
        outputs = [rosmop(f"{verb} --bag x.bag") for verb in ("run m.rv --json", "coverage m.rv", "learn")]
        results.append((outputs, strictly_replayed(Path("x.bag"))))
        Path("x.bag").unlink()
    assert results[0] == results[1]
    assert [(status, err) for status, _out, err in results[0][0]] == [(0, "")] * 3
    assert isinstance(results[0][1], Replayed) and results[0][1].effects


@pytest.mark.parametrize("other", [("/a", "pkg/A", OWN, pack("<dd", 500, 0)), *OTHERS.values()])
def test_messages_that_monitors_published_change_nothing(
    other: Sent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.rv").write_text(SPECIFICATION)
    outputs: dict[bool, list[object]] = {}
    for beside in (False, True):
        others = [other] if beside else []
        record(Path("x.bag"), others, first=False, caller="/rosrv")
        commands = (f"{verb} --bag x.bag" for verb in ("run m.rv", "coverage m.rv", "learn"))
        outputs[beside] = [re.sub(r"#\d+", "", str(rosmop(command))) for command in commands]
        Path("x.bag").unlink()
        record(Path("x.bag"), others, first=False, caller="/guardian")
        (recording,) = recordings_of([Path("x.bag")], [])
        specifications = Specifications({"m.rv": SPECIFICATION}, {})
        job = ReplayJob(
            recording, specifications, ["*"], EVER, 0, margins=False, strict=True, own="/guardian"
        )
        outputs[beside].append(unpack(work(to_bytes(job))))
        Path("x.bag").unlink()
    assert outputs[False] == outputs[True]
