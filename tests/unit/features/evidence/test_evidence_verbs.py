import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.features.evidence import verbs
from appliance.features.evidence.bundle import BundleError
from tests.support.command import rosrv


@pytest.mark.parametrize("breaks", [False, True])
def test_a_bundle_gets_its_name_when_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, breaks: bool
) -> None:
    place = tmp_path / "incident.zip"

    def export(*_asked: Any) -> Iterator[bytes]:
        yield b"half"
        [making] = tmp_path.iterdir()
        assert re.fullmatch(r"incident\.zip\.[0-9a-f]{8}\.new", making.name)
        if breaks:
            raise BundleError("a text was changed while it was exported", "failed")
        yield b"whole"

    monkeypatch.setattr(verbs, "export", export)
    order = ("evidence", "export", "--since", "1h", "-o", str(place), "--state", "nowhere")
    done = rosrv(*order)
    assert done.returncode == breaks, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ([] if breaks else ["incident.zip"])
    if not breaks:
        assert (place.read_bytes(), stat.S_IMODE(place.stat().st_mode)) == (b"halfwhole", 0o600)
        again = rosrv(*order)
        assert (again.returncode, again.stderr) == (2, f"rosrv: {place}: File exists; name a new file\n")
