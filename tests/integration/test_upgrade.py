"""The appliance is upgraded in place: it starts on the state of 0.4, and refuses that of earlier versions.

`state-0.4.1.sql` has a publisher, a subscriber, a service and its client, a policy and a specification that an operator
loaded, and three tokens, one of them revoked. It has rows in every table.
"""

import hashlib
import re
import secrets
import shutil
import sqlite3
import subprocess
import xmlrpc.client
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from appliance.signing.request_signing import keys_of
from tests.integration.conformance.fake_nodes import FakeNodes
from tests.support.appliance import Appliance
from tests.support.command import rosrv
from tests.support.requirements import needs
from tests.support.sources import ROOT

STATE = Path(__file__).with_name("state-0.4.1.sql")
NODES = ("asker", "ears", "negator", "voice")
NOBODY = "[Nodes]\n[Publishers]\n[Subscribers]\n[Commands]\n[Services]\n[Clients]\n"


UNCHANGED = (
    "authority", "door", "door_ticket", "enrolment_token", "host", "host_block", "host_certificate",
    "host_ports", "parameter_owner", "policy_revision", "policy_signature", "revocation",
    "revoked_certificate", "token", "token_keys",
)  # fmt: skip
"""The tables in which a start changes no row. It adds the warnings of its specifications to their revision."""


class Upgraded(NamedTuple):
    before: dict[str, set[tuple[Any, ...]]]
    """The rows of each table."""
    appliance: Appliance
    nodes: FakeNodes
    token: str
    revoked: str


def rows_of_tables(database: sqlite3.Connection) -> dict[str, set[tuple[Any, ...]]]:
    tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    return {name: set(database.execute(f"SELECT * FROM {name}")) for (name,) in tables}  # noqa: S608  a table's name


def old_state(directory: Path, nodes: FakeNodes) -> tuple[str, str]:
    directory.mkdir(parents=True)
    sql = STATE.read_text()
    for name in NODES:
        sql = re.sub(rf"('/{name}','127.0.0.1',)'http://[^']*'", rf"\g<1>'{nodes.uri(name)}'", sql)
    with closing(sqlite3.connect(directory / "state.db")) as database:
        database.executescript(sql)
        tokens = [make_secret(database, name) for name in ("first", "gone")]
        database.commit()
    (directory / "state.db").chmod(0o666)  # control runs as its own user
    return tokens[0], tokens[1]


def make_secret(database: sqlite3.Connection, name: str) -> str:
    [token_id, salt] = database.execute("SELECT id, salt FROM token WHERE name = ?", (name,)).fetchone()
    secret = secrets.token_urlsafe(32)
    kept = hashlib.scrypt(secret.encode(), salt=salt, n=1 << 14, r=8, p=1, dklen=32, maxmem=64 << 20)
    text = f"rosrv_{token_id}_{secret}"
    database.execute("UPDATE token SET hash = ? WHERE id = ?", (kept, token_id))
    database.execute("REPLACE INTO token_keys VALUES (?, ?, ?)", (token_id, *keys_of(text)))
    return text


@pytest.fixture(scope="module")
def upgraded() -> Iterator[Upgraded]:
    with FakeNodes() as nodes:
        appliance = Appliance(options=("--api", "127.0.0.1:0"), relays=2)
        try:
            folder = appliance.state / "control"
            token, revoked = old_state(folder, nodes)
            with closing(sqlite3.connect(folder / "state.db")) as database:
                before = rows_of_tables(database)
            appliance.start()
            yield Upgraded(before, appliance, nodes, token, revoked)
        finally:
            appliance.close()


def call(appliance: Appliance, method: str, *parameters: str) -> Any:
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        return getattr(master, method)("/tester", *parameters)


def test_the_policy_in_force_survives(upgraded: Upgraded) -> None:
    status = upgraded.appliance.status()["policy"]
    assert (status["revision"], status["who"], status["differs_from_file"]) == (2, "first", True)
    rest = upgraded.appliance.rest(upgraded.token)
    assert b"/secret =" in rest.get("/v1/policy").body
    code, reason, _value = call(
        upgraded.appliance, "registerSubscriber", "/secret", "*", upgraded.nodes.uri("tester")
    )
    assert (code, "revision 2:9" in reason) == (0, True), reason


def test_tokens_survive(upgraded: Upgraded) -> None:
    appliance = upgraded.appliance
    assert appliance.rest(upgraded.token).get("/v1/tokens").status == 200
    assert appliance.rest(upgraded.revoked).get("/v1/policy").status == 401
    rows = appliance.rest(upgraded.token).get("/v1/tokens").json["tokens"]
    assert {row["name"]: (row["role"], row["revoked"] is None) for row in rows} == {
        "first": ("admin", True), "reader": ("viewer", True), "gone": ("viewer", False),
    }  # fmt: skip
    assert appliance.token == "", "no second first token is made"


def test_specifications_in_force_survive(upgraded: Upgraded) -> None:
    status = upgraded.appliance.status()["monitors"]
    assert (status["revision"], status["loaded"], status["enabled"], status["who"]) == (1, 1, 1, "operator")
    [row] = upgraded.appliance.rest(upgraded.token).get("/v1/monitors").json["monitors"]
    assert (row["name"], row["topics"], row["failing"]) == ("diary", ["/chatter"], False)


def test_registrations_and_parameters_survive(upgraded: Upgraded) -> None:
    publishers, subscribers, services = call(upgraded.appliance, "getSystemState")[2]
    assert ["/chatter", ["/voice"]] in publishers
    assert ["/chatter", ["/ears"]] in subscribers
    assert ["/negate", ["/negator"]] in services
    assert call(upgraded.appliance, "getParam", "/kept")[2] == 42
    assert upgraded.nodes.wait_until(
        lambda: any(
            topic == "/chatter" and uris for topic, uris in upgraded.nodes.calls("ears", "publisherUpdate")
        )
    ), "the listener gets the talker's new address"


def test_grants_survive(upgraded: Upgraded) -> None:
    ends = upgraded.appliance.rest(upgraded.token).post("/v1/policy?dry_run=1", NOBODY).json["ends"]
    live = {(end["caller_id"], end["what"], end["resource"]) for end in ends}
    assert {
        ("/voice", "publication", "/chatter"),
        ("/ears", "subscription", "/chatter"),
        ("/negator", "service", "/negate"),
        ("/asker", "call", "/negate"),
    } <= live
    with closing(sqlite3.connect(upgraded.appliance.state / "control" / "state.db")) as database:
        rows = set(database.execute("SELECT resource, caller_id FROM permission WHERE resource != '/rosout'"))
    assert rows == {("/negate", "/asker")}


def test_rows_survive(upgraded: Upgraded) -> None:
    with closing(sqlite3.connect(upgraded.appliance.state / "control" / "state.db")) as database:
        after = rows_of_tables(database)
    lost = {name: upgraded.before.get(name, set()) - after[name] for name in UNCHANGED}
    assert {name: rows for name, rows in lost.items() if rows} == {}
    empty = {name for name, rows in upgraded.before.items() if not rows}
    assert empty == {"token_left"}, (
        "a table without a row tests nothing; this one was for versions before 0.4"
    )


def test_doors_hosts_and_blocks_survive(upgraded: Upgraded) -> None:
    rest = upgraded.appliance.rest(upgraded.token)
    doors = rest.get("/v1/doors").json["doors"]
    assert {door["name"]: (door["address"], door["port"], door["source"], len(door["tickets"])) for door in doors} == {
        "alice": ("198.19.240.2", None, "", 1), "agent-1": ("198.19.240.3", 9091, "10.0.0.7/32", 0),
    }  # fmt: skip
    hosts = {host["name"]: host for host in rest.get("/v1/hosts").json["hosts"]}
    assert {name: (host["address"], host["revoked"] is None) for name, host in hosts.items()} == {
        "robot2": ("10.78.0.2", True), "away": ("10.78.0.3", False), "robot3": ("10.78.0.4", True),
    }  # fmt: skip
    assert hosts["robot2"]["renewing"] and hosts["robot2"]["ports"]["open"] == [11_311, 40_001]
    assert hosts["robot3"]["token_by"] == "first"  # noqa: S105  a name
    [block] = rest.get("/v1/blocks").json["blocks"]
    assert (block["address"], block["note"], block["until"]) == ("10.9.9.9", "lost", None)


@pytest.mark.parametrize("serves", [False, True])
def test_a_state_of_0_3_is_refused_and_stays_as_it_is(tmp_path: Path, serves: bool) -> None:
    """Also while the old version serves, which then goes on with it."""
    folder = tmp_path / "control"
    folder.mkdir()
    (tmp_path / "policy.ini").write_text(NOBODY)
    with closing(sqlite3.connect(folder / "state.db", isolation_level=None)) as old:
        old.execute("PRAGMA journal_mode=WAL")
        old.executescript(STATE.read_text())
        old.executescript("DROP TABLE ends; DELETE FROM setting WHERE name = 'ends';")
        old.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        if serves:
            old.execute("INSERT INTO setting VALUES ('newer', '1')")
        else:
            old.close()
        before = contents(tmp_path)
        given = ("--policy", str(tmp_path / "policy.ini"), "--state", str(tmp_path), "--isolation", "none")
        done = rosrv("up", *given)
        assert (done.returncode, "install 0.4.1, start it once" in done.stderr) == (1, True)
        (tmp_path / "appliance.yaml").write_text(f"state: {tmp_path}\npolicy: {tmp_path}/policy.ini\n")
        done = rosrv("config", "check", str(tmp_path / "appliance.yaml"))
        assert (done.returncode, "made by a version before 0.4" in done.stderr) == (1, True)
        (tmp_path / "appliance.yaml").unlink()
        assert contents(tmp_path) == before
        if serves:
            old.execute("UPDATE setting SET value = '2' WHERE name = 'newer'")


def contents(folder: Path) -> dict[str, bytes]:
    """Return the content of each file, except SQLite's index in shared memory, which readers lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith("-shm"))
    return {str(path): path.read_bytes() for path in files}


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        ("upgrade 0.3.0", 1),
        ("install 0.2.0", 1),
        ("upgrade 0.4.0", 0),
        ("upgrade 0.5.0~dev0", 0),
        ("install", 0),
    ],
)
def test_the_package_refuses_an_upgrade_from_below_0_4_before_it_is_unpacked(
    arguments: str, status: int
) -> None:
    needs(shutil.which("dpkg") is not None, "dpkg, of Debian")
    script = ROOT / "distribution" / "debian" / "rosrv.preinst"
    done = subprocess.run(
        ["sh", str(script), *arguments.split()], check=False, capture_output=True, text=True
    )
    assert (done.returncode, "install 0.4.1 first, start it once" in done.stderr) == (status, bool(status))


@pytest.mark.parametrize(("moved", "closed"), [(False, False), (True, True)], ids=["", "moved, closed"])
@pytest.mark.parametrize("booted", [True, False], ids=["systemd", ""])
@pytest.mark.parametrize(
    ("adopted", "statuses", "asked"),
    [
        (False, [], []),
        (True, [0], ["--dead"]),
        (True, [1, 0], ["--dead", "--force"]),
        (True, [1, 1, 0], ["--dead", "--force", "--dead"]),
        (True, [1, 1, 1], ["--dead", "--force", "--dead"]),
    ],
    ids=["never adopted", "given back", "by hand", "another master", "not given back"],
)
def test_the_removal_stops_the_service_before_it_gives_back_what_is_left(
    tmp_path: Path,
    *,
    adopted: bool,
    statuses: list[int],
    asked: list[str],
    booted: bool,
    moved: bool,
    closed: bool,
) -> None:
    """`rosrv release --force` of a service that waits for a port is refused, and `--dead` beside a service."""
    places = {"/var/lib/rosrv": "default", "/usr/lib/rosrv": "program", "/run/systemd/system": "booted"}
    text = (ROOT / "distribution" / "debian" / "rosrv.prerm").read_text()
    for path, name in places.items():
        text = text.replace(path, str(tmp_path / name))
    state = tmp_path / ("moved" if moved and booted else "default")
    for folder in (state, tmp_path / "program", tmp_path / "bin", *([tmp_path / "booted"] if booted else [])):
        folder.mkdir()
    if adopted:
        (state / "adopt.json").touch()
    (tmp_path / "statuses").write_text("".join(f"{status}\n" for status in statuses))
    environment = f"LANG=C ROSRV_STATE={state} X=1" if moved else "LANG=C"
    programs = {
        "systemctl": f'case "$*" in *=Environment\\ *) echo "{environment}" ;; esac',
        "nft": f"exit {int(not closed)}",
        "deb-systemd-invoke": 'echo "$*" >>calls',
        "rosrv": 'echo "$*" >>calls\nstatus=$(head -n 1 statuses)\nsed -i 1d statuses\nexit "$status"',
    }
    for name, lines in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{lines}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    done = subprocess.run(
        ["sh", "-c", text, "rosrv.prerm", "remove"], cwd=tmp_path, check=False, capture_output=True, text=True,
        env={"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin"},
    )  # fmt: skip
    calls = (tmp_path / "calls").read_text().splitlines() if (tmp_path / "calls").exists() else []
    assert calls == [
        *(["stop rosrv.service rosrv-hold.service"] if booted else []),
        *(f"release {option} --state {state}" for option in asked),
    ], done.stderr
    assert done.returncode == (statuses or [0])[-1]
    assert ("nft delete table inet rosrv_protect" in done.stderr) is (closed and done.returncode == 0)


@pytest.mark.parametrize("place", ["Environment", "EnvironmentFiles", "MainPID", "ExecStart"])
def test_the_removal_finds_the_state_wherever_the_service_has_it(tmp_path: Path, place: str) -> None:
    state = tmp_path / "moved state" if place in ("EnvironmentFiles", "MainPID") else tmp_path / "moved"
    for folder in (state, tmp_path / "bin", tmp_path / "booted", tmp_path / "program" / "bin"):
        folder.mkdir(parents=True)
    (state / "adopt.json").touch()
    (tmp_path / "given").write_text(f'LANG=C\nROSRV_STATE="{state}"\n')
    programs = {
        "bin/systemctl": f'case "$*" in *={place}\\ *) cat answer ;; esac',
        "bin/nft": "exit 1",
        "bin/deb-systemd-invoke": "",
        "bin/rosrv": 'echo "$*" >>calls',
        "program/bin/python": f'case "$*" in *"/srv/a.yaml") echo "{state}" ;; *) echo /nothing ;; esac',
    }
    for name, lines in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{lines}\n")
        (tmp_path / name).chmod(0o755)
    text = (ROOT / "distribution" / "debian" / "rosrv.prerm").read_text()
    for path, name in {"/usr/lib/rosrv": "program", "/run/systemd/system": "booted"}.items():
        text = text.replace(path, str(tmp_path / name))
    with subprocess.Popen(["/bin/sleep", "60"], env={"ROSRV_STATE": str(state)}) as service:
        answers = {
            "Environment": f"LANG=C ROSRV_STATE={state} X=1",
            "EnvironmentFiles": f"{tmp_path}/given (ignore_errors=yes)",
            "MainPID": f"{service.pid}",
            "ExecStart": "{ path=/usr/bin/rosrv ; argv[]=/usr/bin/rosrv up --config /srv/a.yaml ; pid=0 }",
        }
        (tmp_path / "answer").write_text(answers[place] + "\n")
        done = subprocess.run(
            ["sh", "-c", text, "rosrv.prerm", "remove"], cwd=tmp_path, check=False, capture_output=True, text=True,
            env={"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin"},
        )  # fmt: skip
        service.kill()
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "calls").read_text() == f"release --dead --state {state}\n"
