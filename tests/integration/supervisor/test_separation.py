import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.supervisor.users import account_of
from tests.support.appliance import Appliance
from tests.support.requirements import need_root

LOG = {"control/audit.db", "control/audit.db-wal", "control/audit.db-shm"}
NO_SECRET = {"run/config.json", "control/audit.pub"}
READS = {  # besides the role's own part
    "api": LOG,
    "syslog": LOG,
    "relay": set(),
    "rosmaster": set(),
    "rosout": set(),
    "signer": set(),
    "ipsec": set(),
    "control": set(),
    "nobody": set(),
}
USERS = {"control": "rosrv", "rosmaster": "rosmaster"}


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    need_root()
    with Appliance(options=("--api", "127.0.0.1:0")) as running:
        assert running.rest().get("/v1/audit").status == 200
        yield running


@pytest.mark.parametrize("role", READS)
def test_a_process_reads_only_its_own_files(appliance: Appliance, role: str) -> None:
    user, group = 65534, 65534
    if role != "nobody":
        name = USERS.get(role, f"rosrv-{role}")
        account = account_of(name, "rosrv-api" if role == "syslog" else None)
        user, group = account.uid, account.gid

    def found(flag: str) -> set[str]:
        files = [path for path in appliance.state.rglob("*") if path.is_file()]
        program = 'for one; do [ "$FLAG" "$one" ] && echo "$one"; done; true'
        command = ["/bin/sh", "-c", program.replace("$FLAG", flag), "sh", *map(str, files)]
        done = subprocess.run(
            command, user=user, group=group, extra_groups=[], capture_output=True, text=True, check=True
        )
        names = {str(Path(line).relative_to(appliance.state)) for line in done.stdout.splitlines()}
        return {name for name in names if not name.startswith(f"{role}/")}

    assert found("-w") == set()
    assert found("-r") - NO_SECRET == READS[role]


def test_the_hidden_files_exist(appliance: Appliance) -> None:
    for name in ("signer/ca.key", "signer/audit.key", "api/key.pem", "control/state.db", *LOG):
        assert (appliance.state / name).is_file(), name


def test_the_order_of_oom_kills(appliance: Appliance) -> None:
    scores = {
        role: int(Path(f"/proc/{row['pid']}/oom_score_adj").read_text())
        for role, row in appliance.processes().items()
    }
    own = scores["supervisor"]
    assert scores["api"] > scores["relay"] > scores["control"] > own
    assert scores["rosmaster"] == scores["signer"] == own


def test_the_weights_of_processes(appliance: Appliance) -> None:
    pids = {role: int(row["pid"]) for role, row in appliance.processes().items()}
    nice = {role: os.getpriority(os.PRIO_PROCESS, pid) for role, pid in pids.items()}
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert nice["relay"] == own - 10 and nice["api"] == own + 5
    assert nice["control"] == own - 5 and nice["rosmaster"] == own
    for role in ("relay", "control", "api"):
        group = Path(f"/proc/{pids[role]}/autogroup")
        if group.exists() and (text := group.read_text()):
            assert text.endswith(f" nice {min(0, nice[role])}\n")


def test_a_relay_has_short_turns_only_without_its_priority(appliance: Appliance) -> None:
    slices = {}
    for role in ("relay", "control"):
        attributes = (ctypes.c_uint32 * 12)()
        [pid] = appliance.pids(role)
        call = {"x86_64": 315, "aarch64": 275}[os.uname().machine]  # sched_getattr
        assert ctypes.CDLL(None).syscall(call, pid, attributes, ctypes.sizeof(attributes), 0) == 0
        slices[role] = ctypes.c_uint64.from_buffer(attributes, 24).value
    if slices["control"] == 0:
        pytest.skip("this kernel has no slices")
    [relay] = appliance.pids("relay")
    has_priority = os.getpriority(os.PRIO_PROCESS, relay) < os.getpriority(os.PRIO_PROCESS, 0)
    assert slices["relay"] == (slices["control"] if has_priority else 100_000)


def test_planted_code_is_not_loaded_at_the_next_start(appliance: Appliance) -> None:
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    parts = [path for path in appliance.state.iterdir() if path.is_dir() and path.name != "run"]
    assert {path.name for path in parts} >= {"rosmaster", "control", "signer", "relay", "api"}
    assert appliance.stop() == 0
    for part in parts:
        packages = part / ".local" / "lib" / version / "site-packages"
        packages.mkdir(parents=True)
        (packages / "planted.pth").write_text(
            f"import os; os.close(os.open({str(part / 'ran')!r}, os.O_CREAT))\n"
        )
        for path in (*packages.parents, packages, packages / "planted.pth"):
            if part in path.parents:
                os.chown(path, part.stat().st_uid, part.stat().st_gid)
    appliance.start()
    assert [path.name for path in parts if (path / "ran").exists()] == []
    for part in parts:
        shutil.rmtree(part / ".local")
