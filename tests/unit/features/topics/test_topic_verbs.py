import pytest
import typer

from appliance.features.topics.verbs import part_of
from roswire.definitions import Definitions
from roswire.message_view import CUT, read_fields

DEFINITIONS = Definitions.from_files(
    {"a/Scan.msg": "float32[] ranges\nuint8[] data\nPose pose\nuint8 last\n", "a/Pose.msg": "float32 x\n"}
)


def scan(length: int) -> dict[str, object]:
    whole = (720).to_bytes(4, "little") + b"\0" * 2880 + (921_600).to_bytes(4, "little") + b"\1" * 921_600
    fields = read_fields(DEFINITIONS, "a/Scan", (whole + b"\0" * 4 + b"\7")[:length])
    assert fields is not None
    return fields


def test_omitted_parts_are_marked() -> None:
    whole, cut = scan(1_000_000), scan(3000)
    assert part_of(whole, "ranges.3") == 0
    assert part_of(whole, "ranges.300") == f"{CUT} 704 more"
    assert part_of(whole, "data").endswith(f"{CUT} 921568 more")
    assert part_of(whole, "data.5000") == f"{CUT} 921568 more"
    assert part_of(whole, "last") == 7
    assert part_of(cut, "pose.x") == part_of(cut, "last") == CUT


@pytest.mark.parametrize("path", ["nothing", "ranges.x", "pose.y", "last.x", "data.x"])
def test_a_missing_field_is_an_error(path: str) -> None:
    with pytest.raises(typer.Exit):
        part_of(scan(1_000_000), path)
