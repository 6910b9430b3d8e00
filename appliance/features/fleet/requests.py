"""Define the request of `rosrv fleet take`, an order on the machine only: no row of `@rest`."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest
from appliance.channel.answers.field_docs import doc


class OrderedBundle(msgspec.Struct, frozen=True):
    """A bundle that is tried now."""

    path: Annotated[str, doc("SITE/GROUP/VERSION.tar")]
    confirm_seconds: Annotated[float, doc("for which it must stay healthy")]


class BundleTake(AdminRequest[OrderedBundle], frozen=True, tag="bundle take"):
    """Try the bundle that waits for an order; another one than `path` is not taken."""

    path: str


REQUESTS = (BundleTake,)
