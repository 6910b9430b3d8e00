"""The signed terms of a bundle: its place, version and rings. No I/O, no clock.

A ring is a set of robots that may not take the bundle earlier than `after` seconds after the signature. Robots
compute their own ring, so a collector can only delay a bundle further.
"""

import hashlib
import itertools
import re
from typing import NamedTuple, Self

import msgspec

_WORD = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")
_PATH = re.compile(r"([a-z0-9][a-z0-9-]{0,62}+)/([a-z0-9][a-z0-9-]{0,62}+)/([1-9][0-9]{0,8}+)\.tar")
ROBOT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_MAX_RINGS = 20
_MAX_ROBOTS = 1000
_LONGEST_WAIT = 30 * 86_400
CUSTOM = "rosrv"


class TermsError(ValueError):
    """A name, path or term of a bundle is invalid."""


class BundlePath(NamedTuple):
    """The name of a bundle: its site, group and version."""

    site: str
    group: str
    version: int

    def __str__(self) -> str:
        return f"{self.site}/{self.group}/{self.version}.tar"

    @property
    def role(self) -> str:
        return role_of(self.site, self.group)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the path that a text names. Raises `TermsError`."""
        match = _PATH.fullmatch(text)
        if match is None:
            raise TermsError(f"{text[:200]!r} is not SITE/GROUP/VERSION.tar")
        return cls(match[1], match[2], int(match[3]))


def role_of(site: str, group: str) -> str:
    """Return the role that signs the bundles of a group. Raises `TermsError` for an invalid name."""
    for word in (site, group):
        if _WORD.fullmatch(word) is None:
            raise TermsError(
                f"{word[:80]!r} is not a valid name: lower-case letters, digits and -, at most 63"
            )
    return f"{site}.{group}"


class Ring(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Robots by name, or up to a percentage of all; `after` is in seconds after the signature."""

    name: str
    robots: list[str] = []
    percent: int = 0
    after: int = 0


class Terms(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The time of the signature (seconds since the epoch), the rings in order, and a note."""

    signed: int
    rings: list[Ring]
    note: str = ""

    def ring_of(self, robot: str, path: BundlePath) -> int:
        position = _position(robot, path)
        for index, ring in enumerate(self.rings):
            if robot in ring.robots or position < ring.percent:
                return index
        raise TermsError("the last ring does not have 100 percent: write it as --ring rest=100%")

    def earliest(self, robot: str, path: BundlePath) -> float:
        """Return when the robot may take the bundle, in seconds since the epoch."""
        return self.signed + self.rings[self.ring_of(robot, path)].after


def _position(robot: str, path: BundlePath) -> int:
    """Return a number from 0 to 99, which is fixed for a robot and a bundle, and even among robots."""
    return int.from_bytes(hashlib.sha256(f"{path}\0{robot}".encode()).digest()[:8]) % 100


def checked_terms(terms: Terms) -> Terms:
    """Return the terms. Raises `TermsError` if the rings are not in order or do not cover all robots."""
    rings = terms.rings
    if not 1 <= len(rings) <= _MAX_RINGS:
        raise TermsError(f"a bundle has 1 to {_MAX_RINGS} rings, not {len(rings)}")
    if len({ring.name for ring in rings}) < len(rings):
        raise TermsError("two rings have the same name: give each --ring its own")
    for ring in rings:
        if _WORD.fullmatch(ring.name) is None:
            raise TermsError(f"{ring.name[:80]!r} is not a valid name of a ring, for example canary")
        if not (ring.robots or ring.percent):
            raise TermsError(f"ring {ring.name} has no robots: give names or a percentage")
        if len(ring.robots) > _MAX_ROBOTS or not all(map(ROBOT_NAME.fullmatch, ring.robots)):
            raise TermsError(
                f"ring {ring.name}: give at most {_MAX_ROBOTS} robots, each by its valid name, or a percentage"
            )
        if not (0 <= ring.percent <= 100 and 0 <= ring.after <= _LONGEST_WAIT):
            raise TermsError(f"ring {ring.name}: a percentage is 0 to 100, a wait at most 30 days")
    for former, ring in itertools.pairwise(rings):
        if ring.after < former.after or ring.percent < former.percent:
            raise TermsError(
                f"ring {ring.name} has a shorter wait or a smaller percentage than {former.name}, which comes before"
                " it: change their order"
            )
    if rings[-1].percent != 100:
        raise TermsError(f"the last ring, {rings[-1].name}, must have 100 percent")
    return terms


def terms_of(custom: object) -> Terms:
    """Return the terms in a bundle's metadata. Raises `TermsError`."""
    found = custom.get(CUSTOM) if isinstance(custom, dict) else None
    try:
        return checked_terms(msgspec.convert(found, Terms))
    except msgspec.ValidationError as error:
        raise TermsError(f"the signed terms of the bundle are invalid: {error}") from error


def custom_of(terms: Terms) -> dict[str, object]:
    """Return the metadata for the terms. Raises `TermsError`."""
    return {CUSTOM: msgspec.to_builtins(checked_terms(terms))}
