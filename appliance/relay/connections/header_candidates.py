"""Choose the header with which the relay introduces itself to a publisher: any type first, then the likely ones.

rospy and roscpp accept `type=*`, `md5sum=*`. rosgo, roslibrust up to 0.9 and many nodes written by hand accept only
their own type and md5sum, some demand a `message_definition`, and some refuse by just closing the connection.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import zip_longest

from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.context import RelayContext

_ANY = "*"
_Key = tuple[str, str, bool]
_MAX = 8  # claims to try in a row on one publisher, because subscribers can make up any number


class HeaderCandidates:
    """The header fields for the next connection to one publisher; accepted fields are used for all later ones.

    `claims` returns known fields, the most likely ones first; the `registered` type replaces an unknown one. After
    `_MAX` of them the next ones follow in the next row, and the first ones again after all.
    """

    def __init__(
        self, claims: Callable[[], Iterable[Mapping[str, str]]], registered: Callable[[], str]
    ) -> None:
        self._claims = claims
        self._registered = registered
        self._refused: set[_Key] = set()
        self._earlier: set[_Key] = set()  # refused in earlier rows
        self.fields: Mapping[str, str] = {"type": _ANY, "md5sum": _ANY}

    @classmethod
    def of(cls, context: RelayContext, topic: RelayedTopic) -> "HeaderCandidates":
        """Return candidates with the previous header, the type in specifications, and those of subscribers.

        The hosts of subscribers take turns, so that none hides the others.
        """

        def claims() -> Iterator[Mapping[str, str]]:
            if topic.header is not None:
                yield topic.header
            yield context.interceptor.claim_of(topic.topic)
            hosts: dict[str, list[Mapping[str, str]]] = {}
            for member in topic.members:
                hosts.setdefault(member.host, []).append(member.fields)
            for turn in zip_longest(*hosts.values(), fillvalue={}):
                yield from turn

        def registered_type() -> str:
            publication = context.table.publication(topic.key, topic.topic)
            return "" if publication is None else publication.type

        return cls(claims, registered_type)

    def advance(self) -> bool:
        """Choose the next fields; return False at the end of a row."""
        self._refused.add(_key(self.fields))
        named: dict[_Key, Mapping[str, str]] = {}
        for claim in self._claims():
            if _named(claim, "md5sum"):
                typed = self._with_type(claim)
                named.setdefault(_key(typed), typed)
        self._earlier &= named.keys()
        if not named.keys() - self._earlier:
            self._earlier.clear()
        row = [fields for key, fields in named.items() if key not in self._earlier][:_MAX]
        for fields in (*row, self._with_type({})):
            if _key(fields) not in self._refused:
                self.fields = fields
                return True
        self._earlier |= self._refused
        self._refused.clear()
        self.fields = {"type": _ANY, "md5sum": _ANY}
        return False

    def _with_type(self, claim: Mapping[str, str]) -> dict[str, str]:
        return {
            "type": _named(claim, "type") or self._registered() or _ANY,
            "md5sum": _named(claim, "md5sum") or _ANY,
            "message_definition": claim.get("message_definition", ""),
        }

    def accepted(self) -> None:
        self._refused.clear()
        self._earlier.clear()


def _named(claim: Mapping[str, str], field: str) -> str:
    return claim.get(field, "").replace(_ANY, "")


def _key(fields: Mapping[str, str]) -> _Key:
    return fields["type"], fields["md5sum"], "message_definition" in fields
