import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer

from roswire.standard import standard_definitions

pytestmark = pytest.mark.nightly

SPECIFICATION = """near() { event scan(std::vector<float> r) /scan sensor_msgs/LaserScan '{ranges:r}' {
    if (r.size() > 3 && r[0] < 0.5) { ROS_WARN("near %g", r[0]); return; } } }"""
PROGRAM = """
import json, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("numpy", "apsw"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
from appliance.cli.main import main
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["rosrv", *arguments]
    try:
        main()
    except SystemExit as end:
        assert not end.code, arguments
"""


def scan(number: int) -> bytes:
    ranges = [0.25 if number % 10 == 9 else 1.0 + number / 100, 2.0, 3.0, float("inf"), *[4.0] * 8]
    header = struct.pack("<3I", number, number, 0) + struct.pack("<I5s", 5, b"laser")
    return (
        header
        + struct.pack("<7f", -1, 1, 0.1, 0, 0.1, 0.1, 30)
        + struct.pack(f"<I{len(ranges)}f", len(ranges), *ranges)
        + struct.pack("<I", 0)
    )


@pytest.mark.parametrize("compression", [None, *Writer.CompressionFormat])
def test_recordings_are_read_and_written(
    compression: Writer.CompressionFormat | None, tmp_path: Path
) -> None:
    bag, kind, definitions = tmp_path / "a.bag", "sensor_msgs/LaserScan", standard_definitions()
    writer = Writer(bag)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connection = writer.add_connection(
            "/scan",
            "sensor_msgs/msg/LaserScan",
            msgdef=definitions.full_text(kind),
            md5sum=definitions.md5sum(kind),
        )
        for number in range(100):
            writer.write(connection, number * 10**9, scan(number))
    (tmp_path / "near.rv").write_text(SPECIFICATION)
    commands = [
        ["monitor", "learn", "--bag", "a.bag", "--output", "learnt.rv"],
        ["monitor", "check", "near.rv", "learnt.rv"],
        ["monitor", "run", "near.rv", "--bag", "a.bag", "--output", "passed.bag"],
        ["monitor", "run", "near.rv", "--bag", "passed.bag"],
        ["monitor", "replay", "near.rv", "--bag", "a.bag", "--margins"],
        ["monitor", "coverage", "near.rv", "--bag", "a.bag"],
    ]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(commands)],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if not name.startswith("ROS")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "100 messages: 90 passed, 0 changed, 10 dropped" in done.stdout
    assert "90 messages: 90 passed, 0 changed, 0 dropped" in done.stdout
    assert "/scan" in (tmp_path / "learnt.rv").read_text()
