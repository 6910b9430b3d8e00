"""Search over REST. The parameters are `robot` and the options of `rosrv audit search`."""

import functools
from typing import Annotated, Any

import msgspec
from fastapi import APIRouter, Depends, HTTPException, Query, Response

from appliance.audit.search.filter_options import filter_given, in_utc
from appliance.audit.search.query import Filter, FilterError
from appliance.base.timestamps import TimestampError
from rosrv_fleet.access import holder_of
from rosrv_fleet.collector import Collector
from rosrv_fleet.search import (
    LARGEST_FLEET_PAGE,
    IndexDownError,
    SearchTooLongError,
    TooManySearchesError,
    search_fleet,
)
from rosrv_fleet.search_sql import FleetFilter
from rosrv_fleet.tokens import FleetRole, OperatorToken


@functools.wraps(filter_given)
def filter_asked(**words: Any) -> Filter:
    try:
        return filter_given(**words | {name: in_utc(words.get(name)) for name in ("since", "until")})
    except TimestampError as error:
        raise HTTPException(422, str(error)) from error


def search_router(collector: Collector) -> APIRouter:
    router = APIRouter()
    Viewer = Annotated[OperatorToken, Depends(holder_of(collector.tokens, FleetRole.VIEWER))]  # noqa: N806  a type

    @router.get("/v1/search")
    def search(
        viewer: Viewer,
        wanted: Annotated[Filter, Depends(filter_asked)],
        robot: Annotated[str | None, Query(description="name of the robot; a glob")] = None,
        cursor: Annotated[str | None, Query(max_length=1024)] = None,
        limit: Annotated[int, Query(ge=1, le=LARGEST_FLEET_PAGE)] = 100,
    ) -> Response:
        """Return the records of all robots that match, newest first."""
        try:
            with collector.searches.turn(viewer.name) as database:
                waiting = collector.store.waiting()
                page = search_fleet(database, FleetFilter(robot, wanted), cursor, limit, waiting)
        except TooManySearchesError as error:
            raise HTTPException(429, str(error), {"Retry-After": "2"}) from error
        except FilterError as error:
            raise HTTPException(422, str(error)) from error
        except SearchTooLongError as error:
            raise HTTPException(422, str(error)) from error
        except IndexDownError as error:
            raise HTTPException(503, str(error), {"Retry-After": "5"}) from error
        return Response(msgspec.json.encode(page), media_type="application/json")

    return router
