"""Write the age of a time."""

from appliance.base import clock


def age(since: float, now: float | None = None) -> str:
    seconds = max(0, int((clock.wall() if now is None else now) - since))
    days, rest = divmod(seconds, 86_400)
    hours, rest = divmod(rest, 3_600)
    minutes, left = divmod(rest, 60)
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {left} s" if minutes else f"{left} s"
