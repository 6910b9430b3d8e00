"""The text frames of Foxglove's protocol: the operations of clients as structs, and announcements."""

from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from appliance.features.doors.surroundings import SeenService, SeenTopic

_Number = Annotated[int, Meta(ge=0, le=(1 << 32) - 1)]
_Name = Annotated[str, Meta(max_length=1024)]
_Id = Annotated[str, Meta(max_length=1024)] | None


class _Operation(Struct, tag_field="op"):
    pass


class _Subscription(Struct):
    id: _Number
    channelId: _Number  # noqa: N815  the protocol's name


class FoxgloveSubscribe(_Operation, tag="subscribe"):
    """Subscribe to channels."""

    subscriptions: list[_Subscription]


class FoxgloveUnsubscribe(_Operation, tag="unsubscribe"):
    """End subscriptions."""

    subscriptionIds: list[_Number]  # noqa: N815  the protocol's name


class FoxgloveChannel(Struct):
    """A channel of the client."""

    id: _Number
    topic: _Name
    encoding: _Name
    schemaName: _Name  # noqa: N815  the protocol's name


class FoxgloveAdvertise(_Operation, tag="advertise"):
    """Advertise channels of the client."""

    channels: list[FoxgloveChannel]


class FoxgloveUnadvertise(_Operation, tag="unadvertise"):
    """Withdraw channels of the client."""

    channelIds: list[_Number]  # noqa: N815  the protocol's name


class FoxgloveGetParameters(_Operation, tag="getParameters"):
    """Read parameters; without names, all of them."""

    parameterNames: list[_Name]  # noqa: N815  the protocol's name
    id: _Id = None


class _Parameter(Struct):
    name: _Name
    value: Raw | UnsetType = UNSET


class FoxgloveSetParameters(_Operation, tag="setParameters"):
    """Set or delete parameters."""

    parameters: list[_Parameter]
    id: _Id = None


class FoxgloveSubscribeParameters(_Operation, tag="subscribeParameterUpdates"):
    """Follow parameters; without names, all of them."""

    parameterNames: list[_Name]  # noqa: N815  the protocol's name


class FoxgloveUnsubscribeParameters(_Operation, tag="unsubscribeParameterUpdates"):
    """Stop following parameters; without names, all of them."""

    parameterNames: list[_Name]  # noqa: N815  the protocol's name


class FoxgloveSubscribeGraph(_Operation, tag="subscribeConnectionGraph"):
    """Follow the graph."""


class FoxgloveUnsubscribeGraph(_Operation, tag="unsubscribeConnectionGraph"):
    """Stop following the graph."""


class FoxgloveFetchAsset(_Operation, tag="fetchAsset"):
    """Fetch a file."""

    requestId: _Number  # noqa: N815  the protocol's name
    uri: str = ""


_Operations = (
    FoxgloveSubscribe
    | FoxgloveUnsubscribe
    | FoxgloveAdvertise
    | FoxgloveUnadvertise
    | FoxgloveGetParameters
    | FoxgloveSetParameters
    | FoxgloveSubscribeParameters
    | FoxgloveUnsubscribeParameters
    | FoxgloveSubscribeGraph
    | FoxgloveUnsubscribeGraph
    | FoxgloveFetchAsset
)
FOXGLOVE_OPERATION: msgspec.json.Decoder[_Operations] = msgspec.json.Decoder(_Operations)


def channel_fields(number: int, seen: SeenTopic) -> dict[str, object]:
    return {
        "id": number,
        "topic": seen.topic,
        "encoding": "ros1",
        "schemaName": seen.type,
        "schema": seen.definition,
        "schemaEncoding": "ros1msg",
    }


def service_fields(number: int, seen: SeenService) -> dict[str, object]:
    return {
        "id": number,
        "name": seen.service,
        "type": seen.type,
        "request": _part(f"{seen.type}Request", seen.request),
        "response": _part(f"{seen.type}Response", seen.response),
    }


def _part(name: str, schema: str) -> dict[str, str]:
    return {"encoding": "ros1", "schemaName": name, "schemaEncoding": "ros1msg", "schema": schema}
