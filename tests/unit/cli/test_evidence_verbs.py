"""`rosrv evidence export`: a bundle has its name when it is whole."""

import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.cli import evidence_verbs
from appliance.evidence.bundle import BundleError
from tests.support.command import rosrv


@pytest.mark.parametrize("breaks", [False, True])
def test_a_bundle_has_its_name_when_it_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, breaks: bool
) -> None:
    """Who is killed meanwhile leaves nothing that looks like one; what breaks off leaves nothing."""
    place = tmp_path / "incident.zip"

    def export(*_asked: Any) -> Iterator[bytes]:
        yield b"half"
        [making] = tmp_path.iterdir()
        assert re.fullmatch(r"incident\.zip\.[0-9a-f]{8}\.new", making.name)
        if breaks:
            raise BundleError("a text was changed while it was exported", "failed")
        yield b"whole"

    monkeypatch.setattr(evidence_verbs, "export", export)
    order = ("evidence", "export", "--since", "1h", "-o", str(place), "--state", str(tmp_path))
    done = rosrv(*order)
    assert done.returncode == breaks, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ([] if breaks else ["incident.zip"])
    if not breaks:
        assert (place.read_bytes(), stat.S_IMODE(place.stat().st_mode)) == (b"halfwhole", 0o600)
        again = rosrv(*order)
        assert (again.returncode, again.stderr) == (2, f"rosrv: {place}: File exists\n")
