"""Compare lists with their members, so that a failure names the line to add."""

from collections.abc import Iterable


def require_rows(members: Iterable[str], rows: Iterable[str], where: str) -> None:
    """Fail with a line for each member that has no row in the list at `where`, and each row without a member."""
    __tracebackhide__ = True
    known, listed = set(members), set(rows)
    wrong = [f"{name}: add it to {where}" for name in sorted(known - listed)]
    wrong += [f"{name}: remove it from {where}, it does not exist" for name in sorted(listed - known)]
    assert not wrong, "\n".join(["", *wrong])
