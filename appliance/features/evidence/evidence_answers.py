"""Evidence: what was sealed for it."""

import msgspec


class Sealed(msgspec.Struct, frozen=True):
    """A signed checkpoint seals all that was recorded; `record` is the id of what was recorded for it, if anything."""

    record: str = ""
