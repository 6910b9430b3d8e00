"""Find names in an audit search that this version never records: misspelt names, or names of another version."""

from appliance.audit.log.events import EVENTS
from appliance.audit.search.query import Filter
from appliance.base.validation_messages import meant
from appliance.policy.model import Category

CATEGORIES = (*Category, "monitor", "parameter", "publication", "rest", "service", "subscription", "topic")
"""The categories of records, including some that the policy does not decide."""


def unknown_names(wanted: Filter) -> list[str]:
    """Return a sentence for each unknown name, with the nearest known one. Globs are not checked."""
    return [
        f"this version records no {what} {name!r}{meant(name, known)}"
        for what, name, known in (("event", wanted.event, EVENTS), ("category", wanted.category, CATEGORIES))
        if name is not None and not set(name) & set("*?[") and name not in known
    ]
