import random
from pathlib import Path

from rosmop.recordings.recording import RecordedFile, RecordingError
from tests.support.bags import make_bag, number


def test_a_damaged_bag_ends_with_the_reason(tmp_path: Path) -> None:
    rows = [(f"/t{at % 2}", "std_msgs/Int32", 1000.0 + at, number(at)) for at in range(20)]
    whole = make_bag(tmp_path / "whole.bag", rows).read_bytes()
    place, chance, ended = tmp_path / "damaged.bag", random.Random(5), 0  # noqa: S311  the same each time
    for _turn in range(300):
        data = bytearray(whole)
        for _byte in range(3):
            data[chance.randrange(4100, len(data))] = chance.randrange(256)
        place.write_bytes(data)
        try:
            list(RecordedFile(place, ["*"]).messages())
        except RecordingError:
            ended += 1
    assert ended > 50
