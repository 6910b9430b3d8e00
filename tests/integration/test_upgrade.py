"""The appliance is upgraded in place: it starts on the state of version 0.2.0.

`state-0.2.0.sql` has a publisher, a subscriber, a service and its client, a policy and a specification that an
operator loaded, and two tokens, one of them revoked.
"""

import hashlib
import re
import secrets
import sqlite3
import xmlrpc.client
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from appliance.signing.request_signing import keys_of
from tests.integration.conformance.fake_nodes import FakeNodes
from tests.support.appliance import Appliance

DUMP = Path(__file__).with_name("state-0.2.0.sql")
NODES = ("asker", "ears", "negator", "voice")
NOBODY = "[Nodes]\n[Publishers]\n[Subscribers]\n[Commands]\n[Services]\n[Clients]\n"


class Upgraded(NamedTuple):
    appliance: Appliance
    nodes: FakeNodes
    token: str
    revoked: str


def old_state(directory: Path, nodes: FakeNodes) -> tuple[str, str]:
    directory.mkdir(parents=True)
    sql = DUMP.read_text()
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
            token, revoked = old_state(appliance.state / "control", nodes)
            appliance.start()
            yield Upgraded(appliance, nodes, token, revoked)
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
