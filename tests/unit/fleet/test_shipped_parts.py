import re
import subprocess
import sys

import pytest

from tests.support.sources import ROOT

SHIPPED = set(re.findall(r'"appliance/(\w+)"', (ROOT / "fleet/pyproject.toml").read_text()))


@pytest.mark.nightly
def test_the_collector_imports_only_what_is_shipped_with_it() -> None:
    program = "import rosrv_fleet.cli, sys; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT / "fleet" / "src"
    )
    loaded = {name.split(".")[1] for name in done.stdout.split() if name.startswith("appliance.")}
    assert loaded <= SHIPPED
    assert loaded >= {"audit", "signing"}
    assert not {"rosmop", "roswire"} & set(done.stdout.split())


def test_the_image_has_the_folders_of_the_wheel() -> None:
    copied = set(re.findall(r"^COPY appliance/(\w+) ", (ROOT / "fleet/Dockerfile").read_text(), re.MULTILINE))
    assert copied == SHIPPED
