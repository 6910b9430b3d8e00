"""Define a row of the table of methods."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Generic

from appliance.channel.admin import A_co, AdminRequest


@dataclass(frozen=True, slots=True)
class RequestMethod(Generic[A_co]):
    """The method that answers a request. `who`: it also takes the client's name.

    `order`: the answer waits until the records of the request are in the audit log. `full_disk`: the request is also
    accepted if the store cannot be written.
    """

    request: type[AdminRequest[A_co]]
    answer: Callable[..., Awaitable[A_co]]
    who: bool = False
    order: bool = True
    full_disk: bool = False
