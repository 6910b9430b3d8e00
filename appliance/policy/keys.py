"""The left side of a rule: a resolved ROS name, or a pattern.

    /arm/*        one level below /arm
    /arm/**       any depth below /arm, and /arm itself; /** is everything
    /arm*         names of one level that begin with /arm: /arm, /arm2, but not /arm/joint
    /*/state      a star at the end of any level stands for the rest of that level

Only the most specific matching key decides. An exact name beats a pattern. A longer literal beginning (the text up to
the first star) beats a shorter beginning. If these are equally long, a pattern without `**` beats a pattern with `**`.
Two keys tie if they are equally specific and match the same name. A tie is an error when the policy is loaded.
"""

from dataclasses import dataclass

from roswire.errors import InvalidNameError
from roswire.names import is_global_name, resolve_parameter

Step = tuple[str, bool]
"""The text of one level, and whether a star follows it."""


class BadKeyError(ValueError):
    """The message gives the reason and the correct form."""


@dataclass(frozen=True, slots=True)
class Key:
    """`subtree`: the key includes everything below the last level (`/**`)."""

    text: str
    steps: tuple[Step, ...]
    subtree: bool

    @property
    def literal(self) -> str:
        return self.text.partition("*")[0]

    @property
    def exact(self) -> bool:
        return "*" not in self.text

    @property
    def specificity(self) -> tuple[bool, int, bool]:
        """If two keys match a name, the one with the greater specificity decides."""
        return (self.exact, len(self.literal), not self.subtree)

    @property
    def inner_star(self) -> bool:
        """A star before the end (`/*/state`, `/arm*/**`): only such keys can tie."""
        return any(star for _, star in (self.steps if self.subtree else self.steps[:-1]))

    def matches(self, name: str) -> bool:
        if self.exact:
            return name == self.text
        parts = levels(name)
        if len(parts) < len(self.steps) or (len(parts) > len(self.steps) and not self.subtree):
            return False
        return all(
            part.startswith(text) if star else part == text
            for (text, star), part in zip(self.steps, parts, strict=False)
        )

    def ties_with(self, other: "Key") -> bool:
        """The keys are equally specific and some name matches both."""
        if self.specificity != other.specificity:
            return False
        if len(self.steps) != len(other.steps) and not self.subtree:
            return False
        return all(map(_compatible, self.steps, other.steps))


def _compatible(one: Step, other: Step) -> bool:
    (text, star), (other_text, other_star) = one, other
    fits = star and other_text.startswith(text)
    return fits or (other_star and text.startswith(other_text)) or text == other_text


def levels(name: str) -> list[str]:
    """The name `/` has no levels."""
    return name[1:].split("/") if name != "/" else []


def parse_key(text: str, *, parameter: bool = False) -> Key:
    """Names of parameters have a wider grammar than those of topics. Raises `BadKeyError`."""
    if not text.startswith("/"):
        raise BadKeyError(f"names here are resolved and begin with a slash: /{text.lstrip('~')}")
    if "//" in text:
        raise BadKeyError(f"can never match: resolved names have single slashes: {_single_slashes(text)}")
    if text.endswith("/"):
        meant = f"{text[:-1]} or {text[:-1]}/**" if text != "/" else "/**"
        raise BadKeyError(f"can never match: no resolved name ends with a slash; write {meant}")
    parts = text[1:].split("/")
    subtree = parts[-1] == "**"
    steps = tuple((part.removesuffix("*"), part.endswith("*")) for part in parts[: -1 if subtree else None])
    if any("*" in step for step, _ in steps):
        raise BadKeyError("a star may only be at the end of a level, and ** only as the whole last level")
    # Check the key as a name. A level that is only a star matches any name, so replace it by x.
    name = "".join(f"/{step or 'x'}" for step, _ in steps) or "/x"
    if not (is_parameter_key(name) if parameter else is_global_name(name)):
        raise BadKeyError("is not a ROS name: letters, digits and _ between single slashes")
    return Key(text, steps, subtree)


def command_key(name: str) -> Key:
    """The name of a call is not a ROS name."""
    return Key(name, (), subtree=False)


def is_parameter_key(text: str) -> bool:
    """`/` is one; the spelling must be canonical."""
    try:
        return text.startswith("/") and resolve_parameter(text, "") == text
    except InvalidNameError:
        return False


def _single_slashes(text: str) -> str:
    while "//" in text:
        text = text.replace("//", "/")
    return text
