"""Generate the end of docs/reference/metrics.md: the table of all metrics."""

from appliance.features.metrics.metric_table import METRICS


def markdown() -> str:
    lines = ["| metric | kind | labels | meaning |", "|---|---|---|---|"]
    lines += [
        f"| `{row.name}` | {row.kind} | {', '.join(f'`{label}`' for label in row.labels) or '-'} | {row.help} |"
        for row in METRICS
    ]
    return "\n".join([*lines, ""])
