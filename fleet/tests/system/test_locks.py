"""Searches of all days need a lock for each day: the collector reports it before they begin to fail."""

import threading
from contextlib import closing
from datetime import date, timedelta

import psycopg
import pytest
from rosrv_fleet.database import IndexDatabase, migrate, too_few_locks
from rosrv_fleet.index_commands import fleet_report
from rosrv_fleet.indexer import make_partition
from rosrv_fleet.search import search_fleet
from rosrv_fleet.search_sql import FleetFilter

from appliance.audit.search.query import Filter
from fleet.tests.support.postgres import postgres

_CONNECTIONS, _DAYS, _SEARCHES = 12, 150, 4
_FEWEST = _SEARCHES * 12 * _DAYS // _CONNECTIONS


def _search(database: IndexDatabase, record: Filter | None = None) -> None:
    search_fleet(database, FleetFilter(None, record or Filter()), None, 10, 0)


def test_searches_fail_only_where_the_collector_reports_too_few_locks() -> None:
    with postgres() as cluster:
        info = cluster.create("fleet")
        with psycopg.connect(info) as connection:
            migrate(connection)
        with closing(IndexDatabase(info, connections=_SEARCHES, statement_seconds=60)) as index:
            index.open()
            for number in range(_DAYS):
                make_partition(index, date(2026, 1, 1) + timedelta(number))
        cluster.stop()
        cluster.start(max_connections=_CONNECTIONS, max_locks_per_transaction=_FEWEST)
        with closing(IndexDatabase(info, connections=_SEARCHES, statement_seconds=60)) as index:
            index.open()
            _all_searches_work(index)
        with psycopg.connect(info) as connection:
            assert too_few_locks(connection, _SEARCHES) == ""
            assert "set max_locks_per_transaction" in too_few_locks(connection, _SEARCHES + 1)
            connection.execute("TRUNCATE segment, record, complete")
        cluster.stop()
        cluster.start(max_connections=_CONNECTIONS, max_locks_per_transaction=10)
        with closing(IndexDatabase(info, connections=1, statement_seconds=60)) as index:
            index.open()
            _search(index, Filter(since=1, until=2))  # an hour without segments needs none of them
        with psycopg.connect(info) as connection:
            assert f"searches of all {_DAYS} days" in too_few_locks(connection, 1)
            with pytest.raises(psycopg.errors.OutOfMemory):
                connection.execute("TRUNCATE segment, record")


def _all_searches_work(index: IndexDatabase) -> None:
    begin, failures = threading.Barrier(_SEARCHES), list[BaseException]()

    def search() -> None:
        begin.wait(60)
        try:
            for _time in range(5):
                _search(index)
        except Exception as error:  # noqa: BLE001  the test shows it
            failures.append(error)

    running = [threading.Thread(target=search) for _search in range(_SEARCHES)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join(60)
    assert not failures
    fleet_report(index, None, None, 10**18, waiting=0, version="1")
