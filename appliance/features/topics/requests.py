"""The request for the next messages of a topic, and its answer."""

from typing import Annotated, Any

import msgspec

from appliance.channel.admin import WaitingRequest
from appliance.channel.answers.field_docs import Name, NanoMoment, RosType, doc
from appliance.channel.rest_operation import parameter, rest


class TopicMessage(msgspec.Struct, frozen=True):
    """A message of a topic as subscribers get it, after the monitors."""

    time: Annotated[NanoMoment, doc("when the relay sent it, nanoseconds since the epoch")]
    node: Annotated[str, doc("the node that published it")]
    size: Annotated[int, doc("bytes, without the length prefix")]
    fields: Annotated[
        dict[str, Any],
        doc(
            "by name; long values are cut and the rest is counted (`… 344 more`), bytes are hexadecimal, NaN and"
            " infinity are strings"
        ),
    ]
    why: Annotated[str, doc("why only the first bytes are shown instead of the fields; else empty")]


class TopicMessages(msgspec.Struct, frozen=True):
    """The next messages of a topic, fewer than requested if no more came in time."""

    topic: Name
    type: RosType
    publishers: Annotated[list[str], doc("nodes that publish it")]
    subscribers: Annotated[list[str], doc("nodes that subscribe to it")]
    messages: Annotated[list[TopicMessage], doc("messages as subscribers got them")]


@rest(
    "operator", "GET", "/v1/messages", ("topic", "messages", "seconds", "latched"), name="topic_messages",
    problems={404: "No node publishes or subscribes to it."}, tag="graph",
)  # fmt: skip
class TopicLook(WaitingRequest[TopicMessages], frozen=True, tag="topic look"):
    """The next messages of a topic as subscribers get them, with their fields. The query is recorded."""

    topic: Annotated[str, parameter("name of the topic", max_length=500, examples=["/scan"])]
    messages: Annotated[int, parameter("maximum number of messages", ge=1, le=20)] = 1
    seconds: Annotated[float, parameter("how long to wait for messages, in seconds", gt=0, le=10)] = 2.0
    latched: Annotated[
        bool, parameter("send a latched message first; false if the client already has it")
    ] = True


REQUESTS = (TopicLook,)
