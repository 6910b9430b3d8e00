import subprocess
import sys
from pathlib import Path

import pytest

from rosmop.tests.batch.test_many_recordings import make_bag

pytestmark = pytest.mark.nightly

PROGRAM = """
import sys
from pathlib import Path
from rosmop.recordings.recording import definitions_of, open_recording
from rosmop.recordings.replay import replay
from rosmop.batch.replay_job import Specifications
reader = open_recording(Path(sys.argv[1]))
text = "m() { event e(int n) /n std_msgs/Int32 '{data:n}' { if (n > 100) return; } }"
monitors = Specifications({"m.rv": text}, {}).monitors(definitions_of(reader))
count = sum(1 for _ in replay(monitors, reader, None))
# ru_maxrss would include the memory of the process that started this one.
(most,) = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line]
print(count, most)
"""


def memory(path: Path, count: int) -> int:
    command = [sys.executable, "-P", "-c", PROGRAM, str(path)]
    read, most = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert int(read) == count
    return int(most)


def test_the_index_is_not_kept(tmp_path: Path) -> None:
    """Two hundred thousand messages take at most 12 MiB more than ten thousand; 140 bytes for each would be 26 MiB."""
    short = memory(make_bag(tmp_path / "short.bag", 1, 10_000), 10_000)
    long = memory(make_bag(tmp_path / "long.bag", 1, 200_000), 200_000)
    assert long - short < 12 * 1024
