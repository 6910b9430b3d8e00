"""Tests of the position that outlives the forwarder."""

from pathlib import Path

import pytest

from appliance.forwarding.position import Position, load_position, save_position


def test_there_and_back(tmp_path: Path) -> None:
    """What was kept is what is loaded, and replaces what was kept before."""
    file = tmp_path / "position.json"
    assert load_position(file) is None
    for position in (Position("a" * 32, 7, 1), Position("a" * 32, 9, 2)):
        save_position(file, position)
        assert load_position(file) == position
    assert [one.name for one in tmp_path.iterdir()] == ["position.json"]


@pytest.mark.parametrize("text", ["", "{}", "rubbish", '{"log":1,"sequence":2}'])
def test_one_that_cannot_be_read(tmp_path: Path, text: str) -> None:
    """A damaged position is told with the file and what to do; it is no reason to send nothing, or all, in silence."""
    file = tmp_path / "position.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"position\.json.*remove it"):
        load_position(file)
