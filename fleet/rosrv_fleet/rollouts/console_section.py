"""The section of the console with the rollouts: one row for each ring of each group's last rollout."""

from html import escape

from rosrv_fleet.rollouts.operator_routes import group_state
from rosrv_fleet.rollouts.service import BundleService


def rollouts_section(service: BundleService) -> str:
    """Return the section as HTML; every text is escaped."""
    rows = "".join(
        _rows(group_state(service, group)) for group in sorted({*service.rollouts, *service.robots})
    )
    trouble = f'<p class="bad">{escape(service.trouble)}</p>' if service.trouble else ""
    return (
        f"{trouble}<table><caption>Rollouts</caption><thead><tr>"
        + "".join(
            f'<th scope="col">{name}</th>'
            for name in ("Group", "Bundle", "State", "Ring", "In force", "Refused", "Unhealthy")
        )
        + f"</tr></thead><tbody>{rows}</tbody></table>"
    )


def _rows(group: dict[str, object]) -> str:
    place, rollout = f"{group['site']}/{group['group']}", group["rollout"]
    if not isinstance(rollout, dict):
        return f'<tr><td>{escape(place)}</td><td colspan="6">{group["robots_known"]} robots, no rollout</td></tr>'
    bad = ' class="bad"' if rollout["state"] == "stopped" else ""
    state = f"{rollout['state']}: {rollout['why']}"
    return "".join(
        f"<tr><td>{escape(place)}</td><td>{escape(str(rollout['bundle']))}</td><td{bad}>{escape(state)}</td>"
        f"<td>{escape(str(ring['name']))} ({'open' if ring['open'] else 'not open'})</td>"
        f"<td>{ring['in_force']} of {ring['robots']}</td><td>{ring['refused']}</td><td>{ring['unhealthy']}</td></tr>"
        for ring in rollout["rings"]
    )
