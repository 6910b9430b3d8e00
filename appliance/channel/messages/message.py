"""The base of all messages."""

from typing import ClassVar

import msgspec


class Message(msgspec.Struct, frozen=True, tag=True, tag_field="message", forbid_unknown_fields=True):
    """A message between two processes of the appliance."""

    descriptors: ClassVar[int] = 0
