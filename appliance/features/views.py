"""List the views of the features. To remove a feature, also remove its import and its row here."""

import functools
import pkgutil

from appliance.features.standby.view import STANDBY_VIEW
from appliance.features.view import FeatureView, PairView

VIEWS: tuple[FeatureView, ...] = (STANDBY_VIEW,)


@functools.cache
def pair_view() -> PairView:
    """Return the views of two appliances."""
    found: PairView = next((pkgutil.resolve_name(view.pair)() for view in VIEWS), PairView())
    return found
