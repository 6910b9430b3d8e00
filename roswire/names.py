"""ROS graph names: return the name that `rosmaster` acts on, or raise.

Access is decided by name, so a name must mean the same here and in `rosmaster`, which checks almost no characters.
Invariants:

1. `resolve` returns the same as `resolve_name` of `rosmaster`, or raises.
2. A returned name is canonical: it starts with `/`, has no empty segment, and resolves to itself.
3. Two different returned names mean different things to `rosmaster` and look different: they are ASCII without
   control characters. Only slashes are normalised.
4. `rosmaster` never resolves a `caller_id`. rospy and roscpp fold its slashes before they send it, but rosgo sends
   `//name`. So this module folds them, and only the result is passed on.
"""

import re

from roswire.errors import InvalidNameError, quote

MAX_NAME_LENGTH = 1024
"""A generous limit: names on robots are shorter than a quarter of it."""
ROSOUT = "/rosout"
"""The node that collects the log, and the topic of the log."""

_NAME = re.compile(r"[A-Za-z/~][A-Za-z0-9_/]*+\Z")
_CANONICAL = re.compile(r"(?:/[A-Za-z0-9_]++){1,512}\Z")  # a name of MAX_NAME_LENGTH has at most 512 segments
_TOOL = re.compile(r"(?:/[A-Za-z0-9_-]++){1,512}\Z")
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*+/[A-Za-z][A-Za-z0-9_]*+\Z")
# Parameters come from YAML files, where `/arm/joint-1.left/gains` and `/analyzers/Base Driver` are common.
_IN_KEYS = r"[A-Za-z0-9_/.:@#%+,=()\[\]<>&$!;'-]"
_PARAMETER = re.compile(rf"[A-Za-z0-9_/~]{_IN_KEYS}*+(?:(?<![/~]) (?!/){_IN_KEYS}++){{0,512}}\Z")
_SLASHES = re.compile("/{2,}+")


def resolve(name: str, caller_id: str) -> str:
    """Return the canonical form of a name. An empty `caller_id` is the global namespace, as for `rosmaster`.

    Raise `InvalidNameError` for a name outside the ROS grammar, for the global namespace, and for a relative name of
    a caller whose own name is invalid.
    """
    resolved = _resolve(name, caller_id, _NAME)
    if resolved == "/":
        raise InvalidNameError(f"{quote(name)} is the global namespace: give the name of something in it")
    return resolved


def resolve_namespace(name: str, caller_id: str) -> str:
    """Like `resolve`, but `/` is allowed."""
    return _resolve(name, caller_id, _NAME)


def resolve_parameter(name: str, caller_id: str) -> str:
    """Like `resolve_namespace`, but segments may have any printable ASCII character, as in YAML keys.

    Exceptions are `~` (except as the first character), `*`, `?`, quotes, backslashes, and spaces at the ends of a
    segment.
    """
    return _resolve(name, caller_id, _PARAMETER)


def canonical_caller_id(caller_id: str) -> str:
    """Return the canonical form of a node's name: `//a//b/` becomes `/a/b`, as with rospy and roscpp.

    Raise `InvalidNameError` for any name that is not global.
    """
    return _canonical_id(caller_id, _CANONICAL)


def canonical_tool_id(caller_id: str) -> str:
    """Like `canonical_caller_id`, for a caller that may be a tool, such as `/rosparam-4711`."""
    return _canonical_id(caller_id, _TOOL)


def is_global_name(name: str) -> bool:
    """Return whether a name is canonical and global: `/a/b`, not `/`, `//a` or `a`."""
    return len(name) <= MAX_NAME_LENGTH and _CANONICAL.match(name) is not None


def is_relative_member(name: str) -> bool:
    """Return whether a name is relative (not `/a` or `~a`) and has no empty segment."""
    return not name.startswith("~") and all(name.split("/"))


def is_valid_type_name(name: str) -> bool:
    return name == "*" or (len(name) <= MAX_NAME_LENGTH and _TYPE_NAME.match(name) is not None)


def namespace(name: str) -> str:
    return name[: name.rstrip("/").rfind("/") + 1] or "/"


def candidate_keys(key: str, caller_id: str) -> list[str]:
    """Return the keys that `searchParam` tries, from the caller's namespace upwards."""
    if key.startswith("/"):
        return [resolve_parameter(key, caller_id)]
    levels = [part for part in caller_id.split("/") if part]
    rest = [part for part in key.split("/") if part]
    return ["/" + "/".join(levels[:depth] + rest) for depth in range(len(levels), -1, -1)]


def join(namespace: str, name: str) -> str:
    """Return a name in a namespace. A global or private name is returned unchanged."""
    if name.startswith(("/", "~")) or not namespace:
        return name
    return f"{namespace}{name}" if namespace.endswith("/") else f"{namespace}/{name}"


def _resolve(name: str, caller_id: str, grammar: re.Pattern[str]) -> str:
    if len(name) > MAX_NAME_LENGTH or grammar.match(name) is None:
        raise InvalidNameError(_refusal(name, grammar))
    first = name[0]
    if first == "/":
        resolved = name
    else:
        if caller_id:
            caller_id = canonical_tool_id(caller_id)
        resolved = f"{caller_id}/{name[1:]}" if first == "~" else namespace(caller_id) + name
        if len(resolved) > MAX_NAME_LENGTH or grammar.match(resolved) is None:
            raise InvalidNameError(f"name {quote(name)} of {quote(caller_id)}: {_refusal(resolved, grammar)}")
    if "//" in resolved:
        resolved = _SLASHES.sub("/", resolved)
    return resolved.rstrip("/") or "/"


def _canonical_id(caller_id: str, grammar: re.Pattern[str]) -> str:
    if len(caller_id) <= MAX_NAME_LENGTH:
        if grammar.match(caller_id) is not None:
            return caller_id
        folded = _SLASHES.sub("/", caller_id).removesuffix("/")
        if grammar.match(folded) is not None:
            return folded
    raise InvalidNameError(
        f"caller_id {quote(caller_id)} is not a global ROS name: write it as /name or /namespace/name, "
        f"with letters, digits and '_', at most {MAX_NAME_LENGTH} characters"
    )


def _refusal(name: str, grammar: re.Pattern[str]) -> str:
    if not name:
        return "empty name: a ROS name has at least one character"
    if len(name) > MAX_NAME_LENGTH:
        return f"name {quote(name)} has {len(name)} characters; at most {MAX_NAME_LENGTH} are allowed"
    for position, character in enumerate(name):
        if character != "~" and grammar.match(f"/a{character}a") is None:
            allowed = (
                "printable ASCII without quotes, '*', '?' and '\\'; such a member is read and set with its namespace"
                if grammar is _PARAMETER
                else "letters, digits, '_', '/'"
            )
            return f"name {quote(name)}: character {position + 1} is {character!a}; allowed are {allowed}"
    if grammar is _PARAMETER:
        return (
            f"name {quote(name)}: '~' is only allowed first, and no part of a key starts or ends with a space"
        )
    return f"name {quote(name)}: a ROS name starts with a letter, '/' or '~', and '~' is allowed only there"
