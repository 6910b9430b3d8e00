import os
import re
import subprocess
import sys

import pytest

from distribution.checkout import ROOT
from tests.support.examples import examples
from tests.support.pump_fuzzer import OUTCOMES

pytestmark = pytest.mark.nightly


@pytest.mark.timeout(600)
def test_no_bytes_and_no_order_of_calls_harm_memory() -> None:
    seed = int.from_bytes(os.urandom(4))
    command = [sys.executable, "-m", "tests.support.pump_fuzzer", str(seed), f"{examples(6)}e6"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}:\n{done.stderr[-5000:]}"
    counts = {name: int(number) for number, name in re.findall(r"^ *(\d+)  (.+)$", done.stdout, re.MULTILINE)}
    assert counts.keys() >= OUTCOMES
    assert counts["bytes at subscribers"] > 10_000
