import pkgutil
import subprocess
from pathlib import Path

import pytest

from appliance.supervisor.errors import StartError
from appliance.supervisor.role import Facts
from appliance.supervisor.roles import ROLES, SYSTEM_PYTHON, require_programs, roles_of
from appliance.supervisor.users import NUMERIC_IDS

FACTS = Facts(Path("/s"), Path("/s/run/config.json"), 12311, "http://127.0.0.1:5")
HERE = Path("/bin/true")
BY_NAME = {role.name: role for role in ROLES}


def test_rosmaster_binds_loopback_only() -> None:
    role = BY_NAME["rosmaster"]
    assert role.program is not None
    program = role.program(FACTS)
    assert program.environment["ROS_IP"] == "127.0.0.1"
    assert program.argv[-2:] == ("-p", "12311")


def test_rosmaster_runs_no_code_of_its_home() -> None:
    role = BY_NAME["rosmaster"]
    assert role.program is not None
    assert role.program(FACTS).argv[:2] == ("/usr/bin/python3", "-s")


@pytest.mark.nightly
def test_rosmaster_logs_warnings_and_no_calls(tmp_path: Path) -> None:
    """Logging each call would cost rosmaster half of its time."""
    role = BY_NAME["rosmaster"]
    assert role.program is not None
    says = (
        "import logging; from rosgraph.roslogging import configure_logging;"
        "configure_logging('rosmaster', filename='master.log');"
        "log = logging.getLogger('rosmaster.master');"
        "log.info('+PARAM [/a] by /b'); log.warning('subscriber data stale')"
    )
    environment = {**role.program(FACTS).environment, "ROS_LOG_DIR": str(tmp_path), "HOME": str(tmp_path)}
    done = subprocess.run(
        [str(SYSTEM_PYTHON), "-s", "-c", says], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    [line] = (tmp_path / "master.log").read_text().splitlines()
    assert "WARNING" in line
    assert "subscriber data stale" in line


def test_rosout_writes_no_files() -> None:
    role = BY_NAME["rosout"]
    assert role.program is not None
    assert role.program(FACTS).environment["ROSOUT_DISABLE_FILE_LOGGING"] == "1"


def test_a_missing_rosmaster_is_an_error_that_says_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="apt install python3-rosmaster"):
        require_programs({HERE: "coreutils", tmp_path / "rosmaster": "python3-rosmaster"})
    require_programs({HERE: "coreutils"})


def test_links_are_between_roles_and_go_both_ways() -> None:
    for role in ROLES:
        for other in role.links:
            assert role.name in BY_NAME[other].links


def test_the_compiler_has_only_its_link() -> None:
    compiler = BY_NAME["compiler"]
    assert compiler in roles_of()
    assert compiler.user not in {role.user for role in ROLES if role is not compiler}
    assert (compiler.path, compiler.network, compiler.capabilities) == (None, False, ())
    assert (compiler.dispensable, compiler.on_demand, compiler.links) == (True, True, ("control",))
    assert compiler.sandbox(FACTS).reads == compiler.sandbox(FACTS).writes == ()


def test_rows_are_consistent() -> None:
    assert all(role.user in NUMERIC_IDS for role in ROLES)
    assert all((role.entry is None) != (role.program is None) for role in ROLES)
    assert all(callable(pkgutil.resolve_name(role.entry)) for role in ROLES if role.entry is not None)
    parts = [role.part for role in ROLES if role.entry]
    assert len(parts) == len(set(parts))


def test_rest_can_be_left_out() -> None:
    api, control = BY_NAME["api"], BY_NAME["control"]
    assert [role for role in roles_of() if role not in roles_of(api=False)] == [api]
    assert api.dispensable
    assert not control.dispensable
    assert control.readable_by == api.user
