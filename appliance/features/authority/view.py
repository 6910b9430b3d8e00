"""Show in the status the command groups that no host commands, although some publish to them."""

from collections.abc import Iterator
from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import doc
from appliance.features.view import AlarmKind, FeatureView, StateView, Trouble

_MAX_NAMED = 3


class NotCarried(msgspec.Struct, frozen=True):
    """A host whose nodes publish a topic of a group, and none of whose messages is carried."""

    host: Annotated[str, doc("its address")]
    topic: Annotated[str, doc("the topic")]
    nodes: Annotated[list[str], doc("names of the nodes")]
    order: Annotated[str, doc("the command that lets it drive, or empty if another host holds the group")] = (
        ""
    )


class UnheardGroup(msgspec.Struct, frozen=True):
    """A group that no host commands, although some publish to it."""

    group: Annotated[str, doc("its name")]
    why: Annotated[str, doc("why nothing is carried")]
    hosts: Annotated[list[NotCarried], doc("the hosts, at most 20, by topic")]


class AuthorityState(msgspec.Struct, frozen=True):
    """The groups of `[Authority]` that need an order before anything drives."""

    unheard: Annotated[list[UnheardGroup], doc("by name")]


def _publishers(group: UnheardGroup) -> str:
    named = [f"{host.host} ({host.nodes[0]}) to {host.topic}" for host in group.hosts[:_MAX_NAMED]]
    more = len(group.hosts) - _MAX_NAMED
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")


def _alarms(state: AuthorityState) -> Iterator[Trouble]:
    for group in state.unheard:
        text = (
            f"messages of {_publishers(group)} are not carried, because {group.why}: {group.hosts[0].order}"
        )
        yield Trouble(f"not-carried:{group.group}", text)


def _line(state: AuthorityState) -> tuple[str, str]:
    free = ", ".join(group.group for group in state.unheard)
    return "drive", f"not carried: {free}: rosrv drive status" if free else "rosrv drive status"


AUTHORITY_VIEW = FeatureView(
    (
        StateView(
            "authority",
            AuthorityState,
            "the command groups that no host commands, or null without [Authority]",
            kinds={"not-carried": AlarmKind("notice", "assign the group, if the host should drive")},
            alarms=_alarms,
            line=_line,
        ),
    ),
)
