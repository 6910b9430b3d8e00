"""`searchParam`: a parameter is found by whoever may read it.

ROSMaster looks for a relative key in the caller's namespace and then upwards. The `caller_id` is a claim, so anybody
can look anywhere: whether a parameter is there that the host may not read must make no difference to the answer. So a
global key is decided before it is looked for, and of a search upwards only those places count that may be read. What
is told when nothing is found depends on the policy alone.
"""

from dataclasses import dataclass

from appliance.master.caller import Answer, Caller
from appliance.master.calls.parameter_rights import ParameterRights
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.rosmaster import RosMaster
from appliance.policy.model import Decision
from appliance.ros.names import resolve_parameter
from appliance.ros.parameter_tree import standing_at

_CALL = "searchParam"


@dataclass(frozen=True, slots=True)
class ParameterSearch:
    """Finds parameters."""

    rosmaster: RosMaster
    mirror: ParameterMirror
    rights: ParameterRights

    async def search_param(self, caller: Caller, key: str) -> Answer:
        """`searchParam(caller_id, key)`: the name that is found is one the host may read."""
        if caller.own or not caller.caller_id:
            return await self.rosmaster.call(_CALL, caller.caller_id, key)
        places = {name: self.rights.to_find(caller, name) for name in _places(key, caller.caller_id)}
        hidden = [name for name, decision in places.items() if not decision.allowed]
        if key.startswith("/") and hidden:
            return [0, self.rights.recorded(caller, _CALL, hidden[0], places[hidden[0]]), ""]
        answer = await self.rosmaster.call(_CALL, caller.caller_id, key)
        found = _found(answer)
        if found in hidden:
            found = self._next_readable(key, places, found)
            answer = [1, f"Found [{found}]", found] if found is not None else [-1, "", ""]
        if found is not None and places[found].would_deny:
            self.rights.recorded(caller, _CALL, found, places[found])
        if answer[0] != 1 and hidden:
            why = self.rights.recorded(caller, _CALL, hidden[0], places[hidden[0]])
            return [-1, f"Cannot find parameter [{key}] in an upwards search of what may be read: {why}", ""]
        return answer

    def _next_readable(self, key: str, places: dict[str, Decision], hidden: str) -> str | None:
        """The name that would have been found if nothing were at those that may not be read."""
        levels = len([part for part in key.split("/") if part])
        names = list(places)
        for name in names[names.index(hidden) + 1 :]:
            # It is enough that the key's first part is there.
            first = "/".join(name.split("/")[: -levels + 1 or None])
            if places[name].allowed and standing_at(self.mirror.tree, first)[0] is not None:
                return name
        return None


def _places(key: str, caller_id: str) -> list[str]:
    """The names that ROSMaster may answer with, in its order."""
    if key.startswith("/"):
        return [resolve_parameter(key, caller_id)]
    namespace = [part for part in caller_id.split("/") if part]
    rest = [part for part in key.split("/") if part]
    return ["/" + "/".join(namespace[:depth] + rest) for depth in range(len(namespace), -1, -1)]


def _found(answer: Answer) -> str | None:
    if answer[0] != 1 or not isinstance(answer[2], str):
        return None
    return "/" + "/".join(part for part in answer[2].split("/") if part)
