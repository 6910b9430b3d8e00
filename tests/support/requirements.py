"""Check what a test needs of the machine. A missing requirement skips the test on a laptop and fails it in CI.

`needs(condition, text)` is called at the head of a test or fixture; with `CI=true` in the environment a
missing thing is a failure, so a test cannot quietly stop running.
"""

import os
import shutil

import pytest

from appliance.network.namespaces import has_privileges


def needs(condition: object, text: str) -> None:
    """Continue if `condition` holds; else skip the test, or fail it in CI, with `text` as the reason."""
    if condition:
        return
    if os.environ.get("CI", "").lower() in ("1", "true", "yes"):
        pytest.fail(f"needs {text}, which this CI machine lacks", pytrace=False)
    pytest.skip(f"needs {text}")


def need_root() -> None:
    needs(has_privileges(), "root (CAP_SYS_ADMIN and CAP_NET_ADMIN): run the tests with sudo")


def need_program(name: str, package: str) -> str:
    """Return the path of a program of the machine; `package` is the Debian package that has it."""
    path = shutil.which(name)
    needs(path, f"`{name}` (Debian: sudo apt install {package})")
    return path or ""
