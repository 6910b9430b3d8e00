"""Every verb over REST (`--api`) says what it says over the state directory (`--state`), with the same exit status."""

import json
import os
import subprocess
import threading
import xmlrpc.client
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import ROSRV, commands, rosrv
from tests.support.processes import LIMIT

SPEED = "speed() { event said() /chatter std_msgs/String '{}' { } }\n"
COUNT = "hold count() { event said() /chatter std_msgs/String '{}' { } }\n"
WRONG = "wrong() {\n    event said() /chatter std_msgs/Strong '{}' { }\n}\n"
WITHOUT_PUBLISHERS = OPEN_POLICY.replace("[Publishers]\ndefault = *\n", "")
Done = subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    """An appliance with TLS and a monitor, which has refused something."""
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
        # Whatever is exported of this has the same checkpoint each time: it is sealed now.
        running.rosrv("evidence", "export", "--since", "1h", "-o", str(running.directory / "sealed.zip"))
        yield running


def run(appliance: Appliance, way: str, *arguments: str, env: dict[str, str] | None = None) -> Done:
    """A verb, one way or the other."""
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
    ("audit", "why", "1"), ("audit", "why", "ffff"), ("policy", "grant", "1"), ("policy", "grant", "ffff"),
    ("policy", "grant", "nonsense"),
    ("monitor", "margins"), ("monitor", "revisions"), ("monitor", "revisions", "--json"),
    ("monitor", "show", "1"), ("monitor", "show", "777"), ("monitor", "rvstate"),
    ("topic", "info", "/nowhere"), ("topic", "echo", "/nowhere"), ("topic", "echo", "/nowhere", "--json"),
    ("host", "list"), ("host", "revoke", "nobody"), ("host", "reload"),
    ("record", "list"), ("record", "list", "--json"), ("record", "show", "a" * 20), ("record", "now"),
    ("record", "remove", "a" * 20), ("record", "timeline", "a" * 20), ("monitor", "rollback", "777"),
    ("monitor", "confirm"), ("monitor", "promote", "nobody"),
]  # fmt: skip
# What is tried over REST elsewhere, with what it needs (a recording, a host's key, a policy), and three verbs whose
# options of these names do not say which appliance is asked.
ELSEWHERE = {
    "monitor replay", "record messages", "record fetch", "host add", "host kit", "policy check", "monitor diff", "up",
    "selftest", "protect",
}  # fmt: skip


def test_no_verb_that_asks_an_appliance_is_missing() -> None:
    """Each that takes --state and --api is asked both ways here, or is known to be elsewhere."""
    options = {
        name: {one for parameter in verb.params for one in parameter.opts} for name, verb in commands()
    }
    both = {name for name, known in options.items() if {"--state", "--api"} <= known}
    here = Path(__file__).read_text()
    missing = {name for name in both if ", ".join(f'"{word}"' for word in name.split()) not in here}
    assert (missing - ELSEWHERE, ELSEWHERE - both) == (set(), set())


@pytest.mark.parametrize("verb", LOOKING, ids=" ".join)
def test_where_nothing_answers_it_is_said(verb: tuple[str, ...]) -> None:
    """An appliance that cannot be reached over REST is no defect of the command."""
    token = "rosrv_0123456789ab_" + "A" * 43
    done = rosrv(*verb, "--api", "https://127.0.0.1:1", ROSRV_TOKEN=token)
    assert done.returncode == 2 or "cannot be reached" not in done.stderr
    assert done.returncode in {0, 1, 2}, done.stderr


def comparable(done: Done) -> list[object]:
    """What was said, without what a moment changes: how long `status` says that something runs, and its layout."""
    lines = [
        " ".join(line.split())
        for line in takewhile(lambda one: not one.startswith("process "), done.stdout.splitlines())
    ]
    still = [line for line in lines if not line.startswith(("appliance ", "audit log "))]
    return [
        done.returncode,
        [json.loads(line) if line.startswith("{") else line for line in still],
        done.stderr,
    ]


@pytest.mark.parametrize("verb", LOOKING, ids=" ".join)
def test_looking_is_the_same(appliance: Appliance, verb: tuple[str, ...]) -> None:
    """Output, errors and exit status of what only looks are equal."""
    over_socket, over_rest = (comparable(run(appliance, way, *verb)) for way in ("state", "api"))
    assert over_socket == over_rest
    assert over_socket[1] or over_socket[2] or "/nowhere" in verb


def test_checkpoints_are_the_same(appliance: Appliance) -> None:
    """What is written over REST begins with what was in the file before, and the beginning of what is there then."""
    before, over_rest, after = (
        run(appliance, way, "audit", "checkpoints").stdout for way in ("state", "api", "state")
    )
    assert over_rest.startswith(before)
    assert after.startswith(over_rest)


def test_status_has_the_same_fields(appliance: Appliance) -> None:
    """`status --json`: every field, and whatever stands still has the same value."""
    over_socket, over_rest = (
        json.loads(run(appliance, way, "status", "--json").stdout) for way in ("state", "api")
    )
    assert over_socket.keys() == over_rest.keys()
    for name in ("version", "since", "policy", "monitors", "nodes", "topics", "isolation", "ipsec"):
        assert over_socket[name] == over_rest[name], name


def test_the_log_is_proven_both_ways(appliance: Appliance, tmp_path: Path) -> None:
    """`audit verify` finds it whole; a key or copies of one's own are held against the file only, which is said."""
    for way in ("state", "api"):
        done = run(appliance, way, "audit", "verify", "--json")
        assert (done.returncode, done.stderr) == (0, ""), done.stdout
        assert json.loads(done.stdout)["ok"] is True
        assert "complete and unchanged" in run(appliance, way, "audit", "verify").stdout
    key = tmp_path / "audit.pub"
    public = Ed25519PrivateKey.generate().public_key()
    key.write_bytes(public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    done = run(appliance, "api", "audit", "verify", "--key", str(key))
    assert done.returncode == 2
    assert "--state" in done.stderr


@pytest.mark.parametrize("way", ["state", "api"])
def test_changing_is_the_same(appliance: Appliance, way: str, tmp_path: Path) -> None:
    """Policy and monitors: what a change says, refusals with their places, and exit statuses, one way and the other."""
    files = {name: tmp_path / name for name in ("count.rv", "wrong.rv")}
    files["count.rv"].write_text(COUNT)
    files["wrong.rv"].write_text(WRONG)

    def said(*arguments: str) -> tuple[int, str, str]:
        done = run(appliance, way, *arguments)
        return done.returncode, done.stdout.strip(), done.stderr.strip()

    assert said("monitor", "disable", "speed") == (0, "disabled: speed", "")
    assert said("monitor", "disable", "speed") == (0, "disabled: nothing, it was so already", "")
    assert said("monitor", "enable", "speed", "nobody")[0] == 1
    assert "no monitor is named nobody; there are: speed" in said("monitor", "enable", "speed", "nobody")[2]
    assert said("monitor", "enable", "speed") == (0, "enabled: speed", "")
    status, shown, error = said("monitor", "load", str(files["count.rv"]), "--note", "trial")
    assert (status, shown.endswith("added count.rv"), error) == (0, True, "")
    status, shown, error = said("monitor", "load", str(files["wrong.rv"]))
    assert (status, shown) == (1, "")
    assert error.startswith("wrong.rv:2:") and "error: " in error.splitlines()[0]
    assert error.splitlines()[-1].startswith("rosrv: refused; revision ")
    told = json.loads(said("monitor", "load", str(files["wrong.rv"]), "--json")[1])
    assert told["findings"][0].startswith("wrong.rv:2:")
    assert said("monitor", "resume", "count") == (0, "resumed: none was held", "")
    assert said("monitor", "remove", "count")[1].endswith("removed count.rv")
    assert said("monitor", "reload")[1].endswith("nothing is different")

    assert said("policy", "confirm")[0] == 1
    status, shown, _ = said("policy", "reload", "--confirm-within", "1h")
    assert status == 0
    assert "is in force (was " in shown and "rosrv policy confirm" in shown
    assert said("policy", "confirm")[1].endswith("stays in force")
    assert said("policy", "rollback")[0] == 0
    assert said("policy", "rollback", "7777")[0] == 1
    good = appliance.policy_file.read_text()
    appliance.policy_file.write_text("[Nodes]\nnonsense\n")
    try:
        status, shown, error = said("policy", "reload")
    finally:
        appliance.policy_file.write_text(good)
    assert (status, shown) == (1, "")
    assert error.startswith(f"{appliance.policy_file}:2:1")
    assert said("policy", "reload")[0] == 0


def test_a_policy_is_compared_and_learnt_both_ways(appliance: Appliance, tmp_path: Path) -> None:
    """`policy diff` and `policy learn` take the audit log (and what is registered) from either place."""
    open_policy = tmp_path / "open.ini"
    open_policy.write_text(OPEN_POLICY)
    for verb in (
        ("policy", "diff", str(appliance.policy_file), str(open_policy)),
        ("policy", "diff", str(appliance.policy_file), str(open_policy), "--json"),
        ("policy", "learn"),
    ):
        over_socket, over_rest = (comparable(run(appliance, way, *verb)) for way in ("state", "api"))
        assert over_socket == over_rest
        assert over_socket[1]


def test_tokens_end_over_rest_and_are_made_on_the_machine(appliance: Appliance) -> None:
    """`token revoke` works both ways, and at once; `token add` over REST says where it can be done."""
    refused = run(appliance, "api", "token", "add", "bob")
    assert refused.returncode == 2
    assert "on the appliance's machine" in refused.stderr
    made = json.loads(run(appliance, "state", "token", "add", "bob", "--json").stdout)
    bob = {"ROSRV_TOKEN": made["token"]}
    assert run(appliance, "api", "policy", "revisions", env=bob).returncode == 0
    assert "for admins" in run(appliance, "api", "token", "list", env=bob).stderr
    gone = run(appliance, "api", "token", "revoke", "bob")
    assert (gone.returncode, gone.stdout) == (0, "token bob (viewer) is revoked\n")
    late = run(appliance, "api", "policy", "revisions", env=bob)
    assert late.returncode == 2
    assert "is not taken" in late.stderr
    unknown = [run(appliance, way, "token", "revoke", "bob") for way in ("state", "api")]
    assert unknown[0].stderr == unknown[1].stderr
    assert [one.returncode for one in unknown] == [1, 1]


def test_following_goes_on_over_a_restart_of_the_api(appliance: Appliance) -> None:
    """`audit tail --api` shows what is recorded after the api was killed, once, and ends with its token."""
    made = json.loads(run(appliance, "state", "token", "add", "tail", "--json").stdout)
    certificate = str(appliance.state / "api" / "certificate.pem")
    place = ["--api", str(appliance.ready["api"]), "--api-ca", certificate]
    env = {key: value for key, value in os.environ.items() if not key.startswith("ROSRV_")}
    follower = subprocess.Popen(
        [ROSRV, "audit", "tail", "--event", "monitor *abled", "--lines", "0", "--json", *place],
        env=env | {"ROSRV_TOKEN": made["token"]}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    stop = threading.Event()

    def switch() -> None:
        words = ("disable", "enable")
        for number in range(200):
            run(appliance, "state", "monitor", words[number % 2], "speed")
            if stop.wait(0.1):
                return

    switching = threading.Thread(target=switch)
    try:
        switching.start()
        assert follower.stdout is not None
        first = [json.loads(follower.stdout.readline())["sequence"] for _ in range(3)]
        appliance.kill("api")
        then = [json.loads(follower.stdout.readline())["sequence"] for _ in range(3)]
        stop.set()
        switching.join()
        assert [*first, *then] == sorted(set(first + then))
        wanted = appliance.audit("--event", "monitor *abled", "--oldest-first")
        known = [one["sequence"] for one in wanted if first[0] <= one["sequence"] <= then[-1]]
        assert known == [*first, *then]
        run(appliance, "state", "token", "revoke", "tail")
        _rest, said = follower.communicate(timeout=LIMIT)
        assert follower.returncode == 2, said
        assert "token" in said
    finally:
        stop.set()
        switching.join()
        if follower.poll() is None:
            follower.kill()
            follower.communicate()
    run(appliance, "state", "monitor", "enable", "speed")
