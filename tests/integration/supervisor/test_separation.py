import ctypes
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.supervisor.priority import ProcessorPressure, may_raise_priority, waited_seconds
from appliance.supervisor.users import account_of
from benchmarks.published_stop import busy_programs
from tests.support.appliance import Appliance
from tests.support.processes import LIMIT
from tests.support.requirements import need_root
from tests.support.waiting import eventually

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


def niceness_of_threads(pid: int) -> set[int]:
    threads = [int(path.name) for path in Path(f"/proc/{pid}/task").iterdir()]
    return {os.getpriority(os.PRIO_PROCESS, thread) for thread in threads}


def autogroups_follow(pids: dict[str, int]) -> None:
    for role in ("relay", "control", "api"):
        group = Path(f"/proc/{pids[role]}/autogroup")
        if group.exists() and (text := group.read_text()):
            assert text.endswith(f" nice {min(0, os.getpriority(os.PRIO_PROCESS, pids[role]))}\n")


def test_the_weights_of_processes(appliance: Appliance) -> None:
    pids = {role: int(row["pid"]) for role, row in appliance.processes().items()}
    own = os.getpriority(os.PRIO_PROCESS, 0)
    with busy_programs(2 * (os.cpu_count() or 1)):
        eventually(lambda: niceness_of_threads(pids["relay"]) == {own - 10}, "the relay has its priority")
        autogroups_follow(pids)
    nice = {role: os.getpriority(os.PRIO_PROCESS, pid) for role, pid in pids.items()}
    assert nice["control"] == own - 5 and nice["rosmaster"] == own and nice["api"] == own + 5


@pytest.mark.skipif(
    waited_seconds() is None, reason="this kernel does not count the time in which tasks wait"
)
def test_a_relay_gives_its_priority_up_while_no_task_waits(appliance: Appliance) -> None:
    pids = {role: int(row["pid"]) for role, row in appliance.processes().items()}
    own = os.getpriority(os.PRIO_PROCESS, 0)
    pressure = ProcessorPressure()
    began = time.monotonic()
    quiet_samples = 0

    def is_given_up_or_needed() -> bool:
        nonlocal quiet_samples
        busy = pressure.is_busy(waited_seconds(), time.monotonic())
        quiet_samples = 0 if busy else quiet_samples + 1
        assert quiet_samples < 40, "the machine has been quiet for seconds"
        other_programs_wait = time.monotonic() - began > LIMIT
        return niceness_of_threads(pids["relay"]) == {own} or other_programs_wait

    eventually(is_given_up_or_needed, "the relay has given its priority up")
    autogroups_follow(pids)


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
    has_priority = may_raise_priority()
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
