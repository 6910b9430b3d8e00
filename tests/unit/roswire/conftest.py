import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from roswire.definitions import Definitions
from roswire.standard import standard_definitions

PACKAGES = (
    "actionlib_msgs", "geometry_msgs", "move_base_msgs", "nav_msgs", "rosgraph_msgs", "roscpp", "sensor_msgs",
    "std_msgs", "std_srvs",
)  # fmt: skip


@pytest.fixture(scope="session")
def genpy_types() -> dict[str, dict[str, Any]]:
    script = Path(__file__).with_name("genpy_messages.py")
    ran = subprocess.run(["/usr/bin/python3", str(script), *PACKAGES], check=True, capture_output=True)
    types: dict[str, dict[str, Any]] = json.loads(ran.stdout)
    assert len(types) > 100
    return types


@pytest.fixture(scope="session")
def standard() -> Definitions:
    return standard_definitions()
