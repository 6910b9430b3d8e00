"""What an audit search asks for that this version never records: a slip of the pen, or a log of another version."""

from appliance.audit.events import EVENTS
from appliance.audit.query import Filter
from appliance.base.validation_messages import meant
from appliance.policy.model import Category

CATEGORIES = (*Category, "monitor", "parameter", "publication", "rest", "service", "subscription", "topic")
"""What a record may be about: what the policy decides, and what else there is."""


def unrecorded(wanted: Filter) -> list[str]:
    """A sentence for each name that no record has, with the nearest known one; a glob has none."""
    return [
        f"this version records no {what} {name!r}{meant(name, known)}"
        for what, name, known in (("event", wanted.event, EVENTS), ("category", wanted.category, CATEGORIES))
        if name is not None and not set(name) & set("*?[") and name not in known
    ]
