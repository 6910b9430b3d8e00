import os
import termios
from pathlib import Path

import pytest

from appliance.supervisor.heartbeat_wiring import HeartbeatWiring


def test_the_serial_line_is_opened_raw() -> None:
    ours, theirs = os.openpty()
    wiring = HeartbeatWiring(1, os.ttyname(theirs))
    line = wiring.open_line()
    os.write(line, b"\x55\xaa\x0a")
    assert os.read(ours, 8) == b"\x55\xaa\x0a"
    assert not os.get_blocking(line)
    assert termios.tcgetattr(line)[4:6] == [termios.B9600, termios.B9600]
    for descriptor in (line, ours, theirs):
        os.close(descriptor)
    wiring.close()


@pytest.mark.parametrize(
    ("name", "reason"),
    [("missing", "No such file"), ("file", "is not a serial line"), ("", "no serial line")],
)
def test_a_path_of_another_kind_is_an_error(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "file").touch()
    wiring = HeartbeatWiring(1, str(tmp_path / name) if name else "")
    with pytest.raises(OSError, match=reason):
        wiring.open_line()
    wiring.close()


def test_only_relays_share_the_memory_and_none_can_shrink_it() -> None:
    wiring = HeartbeatWiring(3, "")
    assert [*wiring.messages_for("api")] == []
    [(_message, descriptor)] = wiring.messages_for("relay")
    assert os.fstat(descriptor).st_size == 48
    with pytest.raises(PermissionError):
        os.ftruncate(descriptor, 8)
    wiring.close()
