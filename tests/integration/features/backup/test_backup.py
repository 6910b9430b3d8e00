import contextlib
import json
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import ROSRV
from tests.support.processes import LIMIT
from tests.support.rosmaster import master_at
from tests.support.waiting import eventually

LOADED = OPEN_POLICY + "[Services]\ndefault = *\n"


@contextlib.contextmanager
def busy(uri: str) -> Iterator[None]:
    started, ending = threading.Event(), threading.Event()

    def work() -> None:
        with master_at(uri) as master:
            number = 0
            while not ending.is_set():
                number += 1
                assert master.setParam("/busy", "/counter", number)[0] == 1
                started.set()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        assert started.wait(LIMIT)
        yield
    finally:
        ending.set()
        thread.join()


def test_backed_up_while_running_and_restored_elsewhere(tmp_path: Path) -> None:
    settings = "audit: {checkpoint_records: 20, checkpoint_seconds: 1}\n"
    file = tmp_path / "backup.tar.gz"
    with Appliance(settings=settings) as old:
        with master_at(old.master_uri) as master:
            assert master.setParam("/robot", "/arm", {"joints": [1.5, -2.0], "name": "left"})[0] == 1
        old.reload(LOADED)
        token = old.ready["token"]
        old.rosrv("host", "block", "10.9.9.9", "--for", "1h", "--note", "odd")
        with busy(old.master_uri):
            eventually(lambda: old.audit(event="checkpoint"), "a checkpoint is recorded")
            old.rosrv("backup", str(file))
        assert "The log is " in old.rosrv("audit", "verify").stdout

    new = Appliance(policy=LOADED, settings=settings)
    try:
        new.rosrv("restore", str(file))
        before = json.loads(new.rosrv("audit", "verify", "--json").stdout)
        assert before["ok"], before
        new.start()
        with master_at(new.master_uri) as master:
            assert master.getParam("/robot", "/arm")[2] == {"joints": [1.5, -2.0], "name": "left"}
            assert master.getParam("/robot", "/counter")[2] > 0
        assert new.status()["policy"]["revision"] == 2
        block = json.loads(new.rosrv("host", "blocks", "--json").stdout)
        assert (block["address"], block["note"]) == ("10.9.9.9", "odd")
        assert 0 < block["until"] - block["since"] <= 3600.5
        assert new.rest(token).get("/v1/status").status == 200
        eventually(
            lambda: (
                json.loads(new.rosrv("audit", "verify", "--json").stdout)["signed_through"] > before["last"]
            ),
            "later records are signed",
        )
        assert new.audit(event="signature refused") == []
    finally:
        new.close()


def test_a_half_restored_state_is_not_started() -> None:
    appliance = Appliance()
    try:
        appliance.state.mkdir(mode=0o711)
        (appliance.state / "restoring").touch()
        command = [ROSRV, "up", "--isolation", "none", "--state", str(appliance.state)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=2 * LIMIT, check=False)
        assert done.returncode == 1
        assert "a restore did not finish: remove this folder, and run `rosrv restore` again" in done.stderr
        assert [one.name for one in appliance.state.iterdir()] == ["restoring"]
    finally:
        appliance.close()
