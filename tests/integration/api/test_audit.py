"""The audit log over REST: searched, followed live, verified, exported; it contains REST's own calls."""

import json
import threading
import time
import xmlrpc.client
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance
from tests.support.rest import Rest
from tests.support.waiting import eventually

POLICY = "[Nodes]\ndefault = *\n[Publishers]\n/allowed = *\n[Commands]\ndefault = *\n"


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """Run an appliance that denies every publisher except those of /allowed, with some decisions in its log."""
    config = tmp_path_factory.mktemp("config") / "appliance.yaml"
    config.write_text("audit: {durability: strict, checkpoint_seconds: 2}\napi: 127.0.0.1:0\napi_tls: off\n")
    with Appliance(policy=POLICY, options=("--config", str(config))) as running:
        yield running


@pytest.fixture(scope="module")
def rest(appliance: Appliance) -> Rest:
    """Return a REST client of an admin."""
    return appliance.rest()


def publish(appliance: Appliance, topic: str) -> Any:
    """Register a publisher at RVMaster."""
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        return master.registerPublisher("/tester", topic, "std_msgs/String", "http://127.0.0.1:1/")


def test_followers_get_a_denial_live(appliance: Appliance, rest: Rest) -> None:
    """A client that follows denials gets each one at once, with rule and reason, and nothing else."""
    events = rest.events("/v1/audit/stream?decision=deny&category=publish")
    next(events)
    publish(appliance, "/allowed")
    publish(appliance, "/cmd_vel")
    event = next(events)
    record = json.loads(event["data"])
    assert (event["event"], event["id"]) == ("record", str(record["sequence"]))
    assert (record["decision"], record["resource"], record["caller_id"]) == ("deny", "/cmd_vel", "/tester")
    assert record["host"] == "127.0.0.1"


def test_a_reconnecting_client_misses_no_record(appliance: Appliance, rest: Rest) -> None:
    """With Last-Event-ID (as a browser sends it) or `after`, the stream continues after that record."""
    publish(appliance, "/first")
    first = rest.get("/v1/audit?resource=/first&event=decision").json["records"][0]
    publish(appliance, "/second")
    mine = "category=publish&event=decision&caller_id=/tester"
    for events in (
        rest.events(f"/v1/audit/stream?{mine}", Last_Event_ID=str(first["sequence"])),
        rest.events(f"/v1/audit/stream?{mine}&after={first['sequence']}"),
    ):
        next(events)
        assert json.loads(next(events)["data"])["resource"] == "/second"


@pytest.mark.real
def test_search_returns_the_same_as_the_command(appliance: Appliance, rest: Rest) -> None:
    """The same filters return the same records as the command, field by field."""
    publish(appliance, "/sought")
    found = rest.get("/v1/audit?resource=/sou*&decision=deny&since=1h").json["records"]
    assert found == appliance.audit("--topic", "/sou*", "--deny", "--since", "1h")
    assert found[0]["rule"] is None or found[0]["rule"]["section"] == "Publishers"
    assert rest.get("/v1/audit?resource=/nothing").json == {"records": [], "cursor": None}


def test_pages_join_without_gap_or_repetition(appliance: Appliance, rest: Rest) -> None:
    """Following the cursor returns every matching record once, in both orders."""
    for number in range(7):
        publish(appliance, f"/page/{number}")
    for order in ("newest", "oldest"):
        seen: list[str] = []
        cursor = ""
        while True:
            page = rest.get(f"/v1/audit?resource=/page/*&event=decision&limit=3&order={order}{cursor}").json
            assert len(page["records"]) <= 3
            seen += [one["resource"] for one in page["records"]]
            if page["cursor"] is None:
                break
            cursor = f"&cursor={page['cursor']}"
        wanted = [f"/page/{number}" for number in range(7)]
        assert seen == (wanted if order == "oldest" else wanted[::-1])


def test_one_record_and_its_neighbours(appliance: Appliance, rest: Rest) -> None:
    """The id and the sequence return the same record; its neighbours have the same host or caller."""
    publish(appliance, "/middle")
    record = rest.get("/v1/audit?resource=/middle&event=decision").json["records"][0]
    shown = rest.get(f"/v1/audit/{record['id']}").json
    assert shown["record"] == record
    assert shown == rest.get(f"/v1/audit/{record['sequence']}").json | {"after": shown["after"]}
    assert all(one["host"] == "127.0.0.1" for one in shown["before"] + shown["after"] if one["host"])
    assert rest.get(f"/v1/audit/{record['id']}?neighbours=1000").status == 200
    assert rest.get(f"/v1/audit/{record['id']}?neighbours=1001").status == 422
    assert rest.get("/v1/audit/ffffffffffffffffffff").status == 404
    assert rest.get("/v1/audit/99999999").status == 404


@pytest.mark.real
def test_the_log_is_proven(rest: Rest) -> None:
    """Verification reports that the chain is complete, and how many records a signature covers."""
    verified = rest.get("/v1/audit/verify").json
    assert verified["ok"] is True
    assert verified["records"] > 0
    assert verified["findings"] == []


def test_export_is_ndjson_oldest_first(appliance: Appliance, rest: Rest) -> None:
    """Export has one record per line, in order, as `rosrv audit export` writes them."""
    publish(appliance, "/exported")
    answer = rest.get("/v1/audit/export?event=decision")
    assert answer.headers["content-type"].startswith("application/x-ndjson")
    lines = answer.body.decode("ascii").splitlines()
    sequences = [json.loads(line)["sequence"] for line in lines]
    assert sequences == sorted(sequences)
    here = appliance.rosrv("audit", "export", "--event", "decision").stdout.splitlines()
    assert list(map(_record, lines)) == list(map(_record, here))


def test_an_export_over_rest_is_verifiable(appliance: Appliance, rest: Rest, tmp_path: Path) -> None:
    """A partial export over REST is proven by the appliance's public key, without the log."""
    publish(appliance, "/evidence")
    file, public = tmp_path / "evidence.ndjson", appliance.state / "control" / "audit.pub"
    proven, deadline = 0, time.monotonic() + 60
    while not proven:  # until the signer has sealed it
        assert time.monotonic() < deadline
        threading.Event().wait(0.5)
        if not public.exists():
            continue
        file.write_bytes(rest.get("/v1/audit/export?resource=/evidence").body)
        verified = appliance.row("audit", "verify", "--export", str(file), "--excerpt", "--key", str(public))
        proven = verified["proven"]
    assert verified["ok"] is True
    file.write_text(file.read_text().replace("/evidence", "/innocent", 1))
    assert (
        appliance.row("audit", "verify", "--export", str(file), "--excerpt", "--key", str(public))["ok"]
        is False
    )


def _record(line: str) -> dict[str, Any]:
    """Return a line of an export without its position in the chain, which each new checkpoint extends."""
    return {name: value for name, value in json.loads(line).items() if name != "chain"}


def test_calls_of_rest_are_recorded(rest: Rest) -> None:
    """Each call is recorded with caller, method, path and status.

    The first of five equal reads is recorded in full, the others as sums.
    """
    events = rest.events("/v1/audit/stream?event=rest%20call&resource=/v1/graph")
    next(events)
    for _ in range(5):
        rest.get("/v1/graph")
    told = [json.loads(next(events)["data"])]
    first = told[0]
    assert first["detail"] | {"took_us": 0} == {
        "count": 1, "method": "GET", "status": 200, "took_us": 0, "who": "first",
    }  # fmt: skip
    assert (first["host"], first["category"], first["decision"]) == ("127.0.0.1", "rest", "allow")
    while sum(one["detail"]["count"] for one in told) < 5:
        told.append(json.loads(next(events)["data"]))
    assert sum(one["detail"]["count"] for one in told) == 5
    assert len(told) <= 4  # two, or two for each half if a sum was due between the reads
    events.close()


def test_changes_over_rest_are_never_folded(rest: Rest) -> None:
    """Equal changes and dry runs get a record each, at any rate."""
    events = rest.events("/v1/audit/stream?event=rest%20call&resource=/v1/policy*")
    next(events)
    for _ in range(3):
        assert rest.post("/v1/policy/reload", match="*").status == 200
        assert rest.post("/v1/policy?dry_run=1", POLICY).status == 200
    told = [json.loads(next(events)["data"]) for _ in range(6)]
    assert [one["resource"] for one in told] == ["/v1/policy/reload", "/v1/policy"] * 3
    assert {(one["detail"]["method"], one["detail"]["count"], one["decision"]) for one in told} == {
        ("POST", 1, "allow")
    }
    assert [one["detail"].get("dry_run") for one in told] == [None, True] * 3
    events.close()


def test_an_error_in_a_draft_is_not_a_denial(rest: Rest) -> None:
    """The console's checks of a draft are not recorded as denials, because a dry run or a question changes nothing."""
    events = rest.events("/v1/audit/stream?event=rest%20call&resource=/v1/policy*")
    next(events)
    draft = {"text": "[Nodes]\nbogus\n"}
    for path in ("/v1/policy/test", "/v1/policy?dry_run=1"):
        assert rest.post(path, draft).status == 422
        told = json.loads(next(events)["data"])
        assert (told["decision"], told["detail"]["dry_run"], told["detail"]["status"]) == ("allow", True, 422)
    events.close()


def test_refused_callers_are_recorded(rest: Rest) -> None:
    """A call without a valid token is a denial, and names no user."""
    rest.with_token(None).get("/v1/graph?from=unknown")
    events = rest.events("/v1/audit/stream?event=rest%20call&decision=deny&after=0")
    next(events)
    refused = json.loads(next(events)["data"])
    assert (refused["decision"], refused["detail"]["status"], refused["detail"]["who"]) == ("deny", 401, None)
    assert refused["severity"] == "warning"


@pytest.mark.parametrize(
    "query", ["since=tomorrow", "limit=0", "limit=100000", "cursor=-1", "decision=maybe", "severity=loud",
              "host=" + "*" * 9, "since=9999999999999999999999w"],
)  # fmt: skip
def test_an_invalid_filter_is_reported(rest: Rest, query: str) -> None:
    """The problem names the parameter or the possible values; search, stream and export behave alike."""
    for path in ("/v1/audit", "/v1/audit/export"):
        if path.endswith("export") and query.startswith(("limit", "cursor")):
            continue
        answer = rest.get(f"{path}?{query}")
        assert answer.status == 422, query
        assert answer.json["detail"]


@pytest.mark.parametrize(
    "path", ["/v1/audit", "/v1/audit/export", "/v1/audit/stream", "/v1/graph", "/v1/policy"]
)
def test_an_unknown_parameter_is_reported(rest: Rest, path: str) -> None:
    """A misspelt filter is refused instead of matching all records; the answer suggests the correct name."""
    answer = rest.get(f"{path}?resourse=/cmd_*")
    assert answer.status == 422
    assert answer.json["errors"][0]["where"] == "query.resourse"
    if path == "/v1/audit":
        assert "did you mean resource?" in answer.json["detail"]


def test_search_takes_the_filters_of_the_command(rest: Rest) -> None:
    """`deny` and `topic` are parameters as in `rosrv audit search`; `topic` and `resource` exclude each other."""
    rest.with_token(None).get("/v1/graph")

    def denials() -> Any:
        return rest.get("/v1/audit?deny=1&since=1h&topic=/v1/gra*").json["records"]

    eventually(denials, "the denial is recorded")
    found = denials()
    assert {(one["decision"], one["resource"]) for one in found} == {("deny", "/v1/graph")}
    assert rest.get("/v1/audit?deny=1&topic=/none*").json["records"] == []
    assert rest.get("/v1/audit?resource=/a&topic=/a").status == 422


def test_followers_have_a_quota_of_streams(appliance: Appliance, rest: Rest) -> None:
    """A viewer's token gets six of sixteen streams, then an error.

    An admin can still follow, and closed streams free their slots.
    """
    made = appliance.rosrv("token", "add", "greedy", "--role", "viewer", "--json").stdout
    admin, rest = rest, rest.with_token(json.loads(made)["token"])
    eventually(lambda: rest.get("/v1/whoami").status == 200, "the api knows the token")
    open_ones: list[Generator[dict[str, str], None, None]] = []
    with pytest.raises(AssertionError, match="too many clients"):
        while len(open_ones) <= 16:
            one = rest.events("/v1/audit/stream?event=nothing")
            next(one)
            open_ones.append(one)
    assert len(open_ones) == 6
    follows = admin.events("/v1/audit/stream?event=nothing")
    next(follows)
    follows.close()
    refused = rest.get("/v1/audit/stream?event=nothing")
    assert refused.status == 503
    assert int(refused.headers["retry-after"]) > 0
    for one in open_ones:
        one.close()
    for _ in range(100):
        try:
            next(rest.events("/v1/audit/stream?event=nothing"))
            break
        except AssertionError:
            rest.get("/healthz")  # the api notices that a client left when the kernel reports it
    else:
        raise AssertionError("no stream was freed")
