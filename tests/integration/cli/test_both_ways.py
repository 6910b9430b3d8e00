"""Every command has the same output and exit status over REST (`--api`) and over the state directory (`--state`)."""

import json
import re
import subprocess
import xmlrpc.client
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import rosrv
from tests.support.fake_appliance import FakeAppliance
from tests.support.transcript import Section, Transcript, sections

SPEED = "speed() { event said() /chatter std_msgs/String '{}' { } }\n"
TRANSCRIPT = Path(__file__).with_name("both_ways.txt")
_USE = re.compile(r' (?:never|last) used.*|, "last_used(?:_utc)?": [^,}]*')
WITHOUT_PUBLISHERS = OPEN_POLICY.replace("[Publishers]\ndefault = *\n", "")
Done = subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    appliance = Appliance(policy=WITHOUT_PUBLISHERS)
    folder = appliance.directory / "monitors"
    folder.mkdir()
    (folder / "speed.rv").write_text(SPEED)
    appliance.options = ("--api", "127.0.0.1:0", "--monitors", str(folder))
    with appliance as running:
        running.rest()
        with xmlrpc.client.ServerProxy(running.master_uri) as master:
            for name in ("/a", "/b", "/c"):
                master.registerPublisher(f"/node{name}", name, "std_msgs/String", "http://127.0.0.1:9/")
            master.getSystemState("/looker")
        # Seal the log now, so that every export has the same checkpoint.
        running.rosrv("evidence", "export", "--since", "1h", "-o", str(running.directory / "sealed.zip"))
        yield running


def run(appliance: Appliance, way: str, *arguments: str, env: dict[str, str] | None = None) -> Done:
    if way == "state":
        return rosrv(*arguments, "--state", str(appliance.state))
    certificate = appliance.state / "api" / "certificate.pem"
    place = ("--api", str(appliance.ready["api"]), "--api-ca", str(certificate))
    return rosrv(*arguments, *place, **({"ROSRV_TOKEN": appliance.token} | (env or {})))


LOOKING = [
    ("status",), ("policy", "revisions"), ("policy", "revisions", "--json"), ("monitor", "list"),
    ("monitor", "list", "--json"), ("token", "list"), ("token", "list", "--json"),
    ("version",), ("version", "--json"),
    ("audit", "search", "--deny", "--category", "publish"), ("audit", "search", "--deny", "--json", "--limit", "2"),
    ("audit", "search", "--event", "policy loaded", "--oldest-first"), ("audit", "search", "--topic", "/nowhere"),
    ("audit", "search", "--since", "never"), ("audit", "search", "--cursor", "nonsense"),
    ("audit", "search", "--text", "publish /a", "--json"), ("audit", "show", "1"), ("audit", "show", "1", "--json"),
    ("audit", "show", "999999"), ("audit", "show", "../x"),
    ("audit", "tail", "--no-follow", "--deny", "--lines", "2"), ("audit", "export", "--category", "publish"),
    ("audit", "summary", "--until", "2026-01-01"), ("audit", "summary", "--since", "never"),
    ("audit", "why", "1"), ("audit", "why", "ffff"), ("policy", "grant", "1"), ("policy", "grant", "ffff"),
    ("policy", "grant", "nonsense"),
    ("monitor", "revisions"), ("monitor", "revisions", "--json"),
    ("monitor", "show", "1"), ("monitor", "show", "777"), ("monitor", "rvstate"),
    ("topic", "list"), ("node", "list"),
    ("policy", "show"), ("policy", "show", "1", "--json"), ("policy", "show", "777"),
    ("policy", "who-may", "command", "getPid"), ("policy", "who-may", "command", "getPid", "--json"),
    ("policy", "explain", "--host", "127.0.0.1", "--command", "getPid"),
    ("host", "show", "127.0.0.1"),
    ("policy", "diff", "1", "1", "--json"), ("policy", "diff", "777"), ("policy", "diff", "1", "777", "--json"),
    ("topic", "publishers", "/nowhere", "--at", "2026-01-01"),
    ("topic", "info", "/nowhere"), ("topic", "echo", "/nowhere"), ("topic", "echo", "/nowhere", "--json"),
    ("host", "list"), ("host", "revoke", "nobody"), ("host", "reload"),
    ("host", "blocks"), ("host", "unblock", "10.9.9.9"), ("host", "block", "nobody"),
    ("record", "list"), ("record", "list", "--json"), ("record", "show", "a" * 20), ("record", "now"),
    ("record", "remove", "a" * 20), ("record", "timeline", "a" * 20), ("monitor", "rollback", "777"),
    ("monitor", "confirm"), ("monitor", "enforce", "nobody"), ("monitor", "set", "nobody", "vMax=1"),
    ("alarm", "list"), ("alarm", "acknowledge", "nothing", "--note", "seen"),
    ("alarm", "silence", "nothing", "--for", "1h"),
    ("guard", "list"), ("guard", "show", "nobody"), ("guard", "suggest"), ("guard", "manual"),
    ("guard", "new", "nothing", "/cmd_vel"),
    ("door", "list"), ("door", "ticket", "nobody"), ("door", "remove", "nobody"), ("drive", "status"),
    ("drive", "assign", "base", "--host", "robot"), ("drive", "free", "base"), ("approval", "refuse", "48213"),
    ("policy", "unused", "--json"), ("policy", "enforce", "Publishers", "--dry-run"), ("who-drove", "--at", "0s"),
    ("drive", "ask", "base", "--host", "robot"), ("approve",),
    ("approve", "48213"), ("sso", "list"), ("sso", "end", "nobody"),
    ("guard", "set", "nobody", "vMax=1"), ("guard", "enforce", "nobody"), ("guard", "upgrade", "nobody"),
    ("guard", "remove", "nobody"), ("guard", "test"), ("guard", "test", "nobody"),
    ("guard", "check-driver", "/nothing", "--by", "/odom", "--yes"),
]  # fmt: skip


def comparable(done: Done) -> list[object]:
    lines = [
        " ".join(line.split())
        for line in takewhile(lambda one: not one.startswith("process "), done.stdout.splitlines())
    ]
    still = [_USE.sub("", line) for line in lines if not line.startswith(("appliance ", "audit log "))]
    return [
        done.returncode,
        [json.loads(line) if line.startswith("{") else line for line in still],
        done.stderr,
    ]


@pytest.mark.parametrize("verb", LOOKING, ids=" ".join)
def test_reading_verbs_print_the_same(appliance: Appliance, verb: tuple[str, ...]) -> None:
    over_socket, over_rest = (comparable(run(appliance, way, *verb)) for way in ("state", "api"))
    assert over_socket == over_rest
    assert over_socket[1] or over_socket[2] or "/nowhere" in verb


def test_checkpoints_are_the_same(appliance: Appliance) -> None:
    before, over_rest, after = (
        run(appliance, way, "audit", "checkpoints").stdout for way in ("state", "api", "state")
    )
    assert over_rest.startswith(before)
    assert after.startswith(over_rest)


def test_status_has_the_same_fields(appliance: Appliance) -> None:
    over_socket, over_rest = (
        json.loads(run(appliance, way, "status", "--json").stdout) for way in ("state", "api")
    )
    assert over_socket.keys() == over_rest.keys()
    for name in ("version", "since", "policy", "monitors", "nodes", "topics", "isolation", "ipsec"):
        assert over_socket[name] == over_rest[name], name


def test_the_log_is_proven_both_ways(appliance: Appliance, tmp_path: Path) -> None:
    for way in ("state", "api"):
        done = run(appliance, way, "audit", "verify", "--json")
        assert (done.returncode, done.stderr) == (0, ""), done.stdout
        assert json.loads(done.stdout)["ok"] is True
        assert "The log is " in run(appliance, way, "audit", "verify").stdout
    key = tmp_path / "audit.pub"
    public = Ed25519PrivateKey.generate().public_key()
    key.write_bytes(public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    done = run(appliance, "api", "audit", "verify", "--key", str(key))
    assert done.returncode == 2
    assert "--state" in done.stderr


@pytest.mark.parametrize("way", ["state", "api"])
@pytest.mark.parametrize("section", sections(TRANSCRIPT))
def test_changing_verbs_print_the_same(
    appliance: Appliance, way: str, section: Section, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("POLICY", str(appliance.policy_file))
    transcript = Transcript(FakeAppliance(), lambda *arguments, **_: run(appliance, way, *arguments))
    assert section.played(transcript) == section.text


def test_a_policy_is_compared_and_learnt_both_ways(appliance: Appliance, tmp_path: Path) -> None:
    open_policy = tmp_path / "open.ini"
    open_policy.write_text(OPEN_POLICY)
    for verb in (
        ("policy", "diff", str(appliance.policy_file), str(open_policy), "--decisions"),
        ("policy", "diff", str(appliance.policy_file), str(open_policy), "--decisions", "--json"),
        ("policy", "learn"),
    ):
        over_socket, over_rest = (comparable(run(appliance, way, *verb)) for way in ("state", "api"))
        assert over_socket == over_rest
        assert over_socket[1]


def test_tokens_are_revoked_over_rest_and_made_on_the_machine(appliance: Appliance) -> None:
    for verb in ("add", "rotate"):
        refused = run(appliance, "api", "token", verb, "bob")
        assert refused.returncode == 2
        assert "on the appliance's machine" in refused.stderr
    run(appliance, "state", "token", "add", "bob", "--json")
    made = json.loads(run(appliance, "state", "token", "rotate", "bob", "--json").stdout)
    bob = {"ROSRV_TOKEN": made["token"]}
    assert run(appliance, "api", "policy", "revisions", env=bob).returncode == 0
    assert "for admins" in run(appliance, "api", "token", "list", env=bob).stderr
    gone = run(appliance, "api", "token", "revoke", "bob")
    assert (gone.returncode, gone.stdout) == (0, "token bob (viewer) is revoked\n")
    late = run(appliance, "api", "policy", "revisions", env=bob)
    assert late.returncode == 2
    assert "is not accepted" in late.stderr
    unknown = [run(appliance, way, "token", "revoke", "bob") for way in ("state", "api")]
    assert unknown[0].stderr == unknown[1].stderr
    assert [one.returncode for one in unknown] == [1, 1]
