import json
from collections.abc import Iterator

import pytest

from appliance.base.clock import using
from tests.support.audit import decision
from tests.support.engines import open_log
from tests.support.rest_world import RestWorld
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.nightly  # FastAPI computes the filter in a thread


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RestWorld]:
    state = tmp_path_factory.mktemp("state")
    (state / "control").mkdir()
    with using(VirtualClock(wall=1_700_000_000.0)):
        log = open_log(state / "control" / "audit.db")
        log.record(decision(log, resource="/allowed"))
        for number in range(7):
            log.record(
                decision(log, decision="deny", host="10.0.0.9", caller_id="/n", resource=f"/page/{number}")
            )
        log.close()
    world = RestWorld(state)
    yield world
    world.close()


@pytest.mark.parametrize("order", ["newest", "oldest"])
def test_pages_join_without_gap_or_repetition(world: RestWorld, order: str) -> None:
    seen: list[str] = []
    cursor = ""
    for _page in range(4):
        page = world.asked("GET", f"/v1/audit?resource=/page/*&limit=2&order={order}{cursor}").json()
        assert len(page["records"]) <= 2
        seen += [record["resource"] for record in page["records"]]
        cursor = f"&cursor={page['cursor']}"
    assert page["cursor"] is None
    assert seen[:: -1 if order == "newest" else 1] == [f"/page/{number}" for number in range(7)]


@pytest.mark.parametrize(
    ("query", "count"),
    [("deny=1&topic=/page/*", 7), ("decision=allow&event=decision", 1), ("deny=1&topic=/none*", 0),
     ("host=10.0.0.9", 7)],
)  # fmt: skip
def test_a_search_takes_the_filters_of_the_command(world: RestWorld, query: str, count: int) -> None:
    assert len(world.asked("GET", f"/v1/audit?{query}").json()["records"]) == count


@pytest.mark.parametrize("path", ["/v1/audit", "/v1/audit/export", "/v1/audit/stream"])
@pytest.mark.parametrize(
    ("query", "told"),
    [
        ("since=tomorrow", "2026-03-01"), ("since=9999999999999999999999w", ""), ("decision=maybe", "allow"),
        ("severity=loud", "warning"), ("host=" + "*" * 9, "more than 8"), ("text=" + "*" * 9, "more than 8"),
        ("resource=/a&topic=/a", "give one"),
        ("resourse=/cmd_*", "did you mean resource?"),
    ],
)  # fmt: skip
def test_an_invalid_filter_is_reported(world: RestWorld, path: str, query: str, told: str) -> None:
    answer = world.asked("GET", f"{path}?{query}")
    assert answer.status_code == 422
    assert told in answer.json()["detail"]


@pytest.mark.parametrize("query", ["limit=0", "limit=100000", "cursor=-1", "cursor=x"])
def test_an_invalid_page_is_reported(world: RestWorld, query: str) -> None:
    assert world.asked("GET", f"/v1/audit?{query}").status_code == 422


def test_each_path_reports_an_unknown_parameter(world: RestWorld) -> None:
    paths = world.asked("GET", "/v1/openapi.json").json()["paths"]
    read = [path for path, operations in paths.items() if "get" in operations and "{" not in path]
    assert len(read) > 20
    for path in read:
        answer = world.asked("GET", f"{path}?resourse=/cmd_*")
        errors = answer.json().get("errors") if answer.status_code == 422 else None
        about = path, answer.status_code, answer.text[:200]
        assert errors and errors[0]["where"] == "query.resourse", about


def test_one_record_has_its_neighbours(world: RestWorld) -> None:
    [record] = world.asked("GET", "/v1/audit?resource=/page/3").json()["records"]
    shown = world.asked("GET", f"/v1/audit/{record['id']}?neighbours=1").json()
    assert shown["record"] == record
    assert [one["resource"] for one in shown["before"] + shown["after"]] == ["/page/2", "/page/4"]
    assert world.asked("GET", f"/v1/audit/{record['sequence']}?neighbours=1").json() == shown
    statuses = [
        world.asked("GET", f"/v1/audit/{target}").status_code
        for target in (f"{record['id']}?neighbours=1001", "f" * 20, "99999999", "nonsense")
    ]
    assert statuses == [422, 404, 404, 422]


@pytest.mark.parametrize(
    "path", ["monitors/{}", "monitors/{}/picture", "monitors/{}/history", "audit/{}", "hosts/{}"]
)
@pytest.mark.parametrize(
    "name",
    ["..%2f..%2fetc%2fpasswd", "%00", "a" * 300, "%3Cscript%3E", "'%20OR%201=1%20--", "%ff%fe", "{}", "%0d%0aX:%20y"],
)  # fmt: skip
def test_an_invalid_name_in_a_path_finds_nothing(world: RestWorld, path: str, name: str) -> None:
    answer = world.asked("GET", f"/v1/{path.format(name)}")
    assert answer.status_code in (404, 422) or answer.json()["happened"] == []
    assert "html" not in answer.headers["content-type"]
    assert "x" not in answer.headers


def test_an_export_has_one_record_a_line_oldest_first(world: RestWorld) -> None:
    answer = world.asked("GET", "/v1/audit/export?event=decision")
    assert answer.headers["content-type"].startswith("application/x-ndjson")
    sequences = [json.loads(line)["sequence"] for line in answer.text.splitlines()]
    assert (len(sequences), sequences) == (8, sorted(sequences))


def test_a_summary_counts_the_denials_of_each_host(world: RestWorld) -> None:
    [row] = world.asked("GET", "/v1/audit/summary").json()["hosts"]
    assert (row["host"], row["count"]) == ("10.0.0.9", 7)
    assert world.asked("GET", "/v1/audit/summary?since=never").status_code == 422


def test_a_verification_proves_the_log(world: RestWorld) -> None:
    verified = world.asked("GET", "/v1/audit/verify").json()
    assert (verified["ok"], verified["findings"]) == (True, [])
    assert world.asked("GET", "/v1/audit/verify", role="viewer").status_code == 403
