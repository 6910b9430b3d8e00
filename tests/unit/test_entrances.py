"""No way into the appliance without its row, and no cell without a test or a reason."""

import ast
import inspect
import re
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import pytest

from appliance.api.front.request_gate import PUBLIC
from appliance.control.assembly.hosts import SiteHosts
from appliance.control.core import Core
from appliance.supervisor.roles import ROLES as PROCESSES
from tests.support import entrances
from tests.support.entrances import CELLS, RULES

ROOT = Path(__file__).parents[2]
_LISTENS = re.compile(
    r"\blisten\(|start_server\(|create_server\(|start_unix_server\(|create_datagram_endpoint\(|\.bind\("
)
_SECRET = re.compile(r"secrets\.(token|randbelow)|make_token\(|new_ticket\(|new_secret\(|SecretForm\(")
_COMPARED = re.compile(r"compare_digest\(")
_ROUTES = re.compile(r"APIRouter\(|Routes\(\)|Route\(")
_NO_WAY_IN = frozenset(
    {
        "links.start",
        "links.kill",
        "links.before_end",
        "links.after_removal",
        "policy.provide",
        "policy.on_change",
        "policy.on_first",
        "limits.provide",
        "relay.publish_only",
    }
)


def files(pattern: re.Pattern[str], *folders: str) -> set[str]:
    return {
        str(path.relative_to(ROOT))
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        if pattern.search(path.read_text(encoding="utf-8"))
    }


def named(rows: Mapping[str, str]) -> Iterator[str]:
    for text in rows.values():
        if not text.startswith("- "):
            yield from (one.strip() for one in text.split(","))


def _named_tests(cell: str) -> list[str]:
    return [] if cell.startswith("- ") else cell.split()


def test_every_cell_is_filled() -> None:
    for entrance, row in CELLS.items():
        assert row.keys() == RULES.keys(), entrance


def test_every_process_is_the_row_of_an_entrance() -> None:
    assert {role.name for role in PROCESSES} == entrances.ROLES.keys()


def test_every_file_that_listens_is_the_row_of_an_entrance() -> None:
    found = files(_LISTENS, "appliance", "roswire", "fleet/src/rosrv_fleet")
    assert found == entrances.LISTENERS.keys()


def test_every_secret_is_the_row_of_an_entrance() -> None:
    assert files(_SECRET, "appliance", "fleet/src/rosrv_fleet") == entrances.SECRETS.keys()


def test_shown_secrets_are_compared_in_one_module() -> None:
    """All other comparisons have their reason here."""
    assert files(_COMPARED, "appliance", "fleet/src/rosrv_fleet") == {
        "appliance/signing/bearer_secrets.py",
        "appliance/store/access_tokens.py",  # a salted, slow hash, for tokens without keys
        "appliance/control/rest/rest_proof.py",  # the code of a challenge, which is not stored
        "appliance/features/standby/witness/protocol.py",  # the code of a datagram
        "fleet/src/rosrv_fleet/tokens.py",  # the hash in hexadecimal, in a file
    }


def test_every_path_without_a_token_is_the_row_of_an_entrance() -> None:
    assert entrances.WITHOUT_TOKEN.keys() == PUBLIC


def test_every_route_of_the_collector_is_known() -> None:
    found = {file.removeprefix("fleet/src/rosrv_fleet/") for file in files(_ROUTES, "fleet/src/rosrv_fleet")}
    assert found == {*entrances.COLLECTOR_ROUTES}


def test_every_service_of_a_feature_is_an_entrance_or_none() -> None:
    """A method of the core without a result takes what a feature provides."""
    services = {
        f"{field}.{name}"
        for field, kind in typing.get_type_hints(Core).items()
        if kind.__module__ in (Core.__module__, SiteHosts.__module__)
        for name, method in inspect.getmembers(kind, inspect.isfunction)
        if not name.startswith("_") and typing.get_type_hints(method).get("return") is type(None)
    }
    assert services == entrances.HOOKS.keys() | _NO_WAY_IN


def test_the_rows_name_entrances_of_the_table() -> None:
    rows: Iterable[Mapping[str, str]] = (
        entrances.ROLES,
        entrances.LISTENERS,
        entrances.SECRETS,
        entrances.WITHOUT_TOKEN,
        entrances.HOOKS,
    )
    assert {name for row in rows for name in named(row)} | {"collector"} <= CELLS.keys()
    used = {name for row in rows for name in named(row)}
    assert CELLS.keys() == used, "a row of the table is no entrance any longer"


@pytest.mark.parametrize("entrance", CELLS)
def test_the_tests_of_the_cells_exist(entrance: str) -> None:
    for rule, cell in CELLS[entrance].items():
        assert cell.startswith("- ") or _named_tests(cell), f"{entrance}, {rule}: no test and no reason"
        for test in _named_tests(cell):
            file, _colons, name = test.partition("::")
            path = ROOT / "tests" / file
            assert path.exists(), f"{entrance}, {rule}: {file} does not exist"
            tree = ast.parse(path.read_text(encoding="utf-8"))
            functions = (
                one.name for one in ast.walk(tree) if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
            )
            assert name in functions, f"{entrance}, {rule}: {file} has no {name}"


def test_each_rule_of_each_entrance_is_taken_out_once() -> None:
    changes = [*entrances.taken_out()]
    assert sorted((change.entrance, change.rule) for change in changes) == sorted(
        (entrance, rule)
        for entrance, row in CELLS.items()
        for rule, cell in row.items()
        if _named_tests(cell)
    )
    for one in changes:
        count = (ROOT / one.file).read_text(encoding="utf-8").count(one.old)
        assert count == 1, f"{one.entrance}, {one.rule}: {one.file} has {count} times {one.old!r}"
