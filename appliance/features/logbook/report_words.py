"""Put a report into words: lines for a terminal, and one page for paper. No I/O."""

from collections.abc import Callable, Iterable, Iterator, Sequence

from appliance.base.counted import counted
from appliance.features.logbook.interventions import SUBJECTS, Intervention
from appliance.features.logbook.machine_report import LastingState, MachineReport
from appliance.formats.html_page import Cells, head, lines, section, text

_TITLE = "Interventions in the safety settings of a machine"
_NO_VERIFICATION = "no result of `rosrv audit verify` is stored here: run it, on the machine, as root"
_TAMPERING = (
    "Each record has the hash of the one before it, and checkpoints of this chain are signed. A changed, removed or"
    " inserted record is found by `rosrv audit verify`; a log that root replaced as a whole, or cut at its end, by"
    " comparison with checkpoints that were kept on another machine (`--checkpoints`), by the signer's memory, or by"
    " the collector. This report is not signed: make it again from the log."
)
_SPAN = ("what", "state", "from (UTC)", "to (UTC)", "by", "ended by", "reason")
_ROW = ("time (UTC)", "record", "event", "what", "who", "from", "before", "after", "reason")


def page(report: MachineReport, in_words: Callable[[str], str] = str) -> str:
    """Return a self-contained HTML page without scripts. `in_words` names hosts."""
    parts = [head(_TITLE), f"<h1>{_TITLE}</h1>\n"]
    parts += section("About this report", (), _facts(report))
    for subject in SUBJECTS:
        rows = [row for row in report.interventions if row.subject == subject]
        parts += section(
            subject[0].upper() + subject[1:], _ROW, [_cells(row, in_words) for row in rows], "No record."
        )
        for row in rows:
            if row.diff:
                parts.append(f"<p>{text(row.time_utc)}: changed lines of record {text(row.id)}:</p>\n")
                parts.append(f"<pre>{lines(chr(10).join(row.diff))}</pre>\n")
    for title, spans, empty in _spans(report):
        parts += section(title, _SPAN, [_span(span, in_words) for span in spans], empty)
    parts += section(
        "Interfaces now, and what protects each", ("interface", "where", "commands", "protection"),
        [(row.name, row.where, row.commands, row.protection) for row in report.interfaces], report.live_reason,
    )  # fmt: skip
    parts += section("Rights on the machine now", (), [(row,) for row in report.rights], report.live_reason)
    parts += section(
        "Completeness of the log", ("time (UTC)", "event", "reason"),
        [(row.time_utc, row.event, row.reason) for row in report.gaps],
        "The log has no record of a gap in this period.",
    )  # fmt: skip
    parts += section("Verification", (), [(_verification(report),), (_TAMPERING,)])
    return "".join(parts)


def report_lines(report: MachineReport, in_words: Callable[[str], str] = str) -> Iterator[str]:
    """Yield the lines for a terminal, in the order of the page."""
    yield from (f"{name}: {value}" for name, value in _facts(report))
    for subject in SUBJECTS:
        rows = [row for row in report.interventions if row.subject == subject]
        if rows:
            yield f"{subject}:"
        for row in rows:
            who = " ".join(filter(None, (row.who, row.origin and f"from {in_words(row.origin)}")))
            change = f" ({row.before or 'unknown'} -> {row.after})" if row.after else ""
            what = f" {in_words(row.what)}" if row.what else ""
            yield f"  {row.time_utc}  {row.event}{what}{change} by {who or 'the appliance'}: {row.reason}"
            yield from (f"      {line}" for line in row.diff)
    for title, spans, empty in _spans(report):
        yield f"{title}:" if spans else f"{title}: {empty}"
        for span in spans:
            until = span.until_utc or "now"
            by = f" by {span.by}" if span.by else ""
            yield f"  {span.since_utc} to {until}  {in_words(span.what)}: {in_words(span.state)}{by}"
    if report.live_reason:
        yield f"interfaces and rights: {report.live_reason}"
    yield from (
        f"interface {row.name} at {row.where}: {row.commands}; {row.protection}" for row in report.interfaces
    )
    yield from report.rights
    yield from (f"gap {row.time_utc}  {row.event}: {row.reason}" for row in report.gaps)
    yield _verification(report)


def _facts(report: MachineReport) -> Iterator[tuple[str, str]]:
    yield "machine", report.robot or "(no name in appliance.yaml)"
    yield "period", f"{report.since_utc} to {report.until_utc}"
    yield "made", f"{report.made_utc}, by ROSRV {report.version}"
    yield (
        "audit log",
        f"{', '.join(report.logs)}; its first record is of {report.log_begins_utc or 'no time: it is empty'}",
    )
    if report.log_begins_utc > report.since_utc:
        yield "not covered", f"{report.since_utc} to {report.log_begins_utc}: the log begins later"
    yield "interventions", str(len(report.interventions))


def _spans(report: MachineReport) -> Iterable[tuple[str, Sequence[LastingState], str]]:
    return (
        (
            "Guards and monitors that an order switched off",
            report.switched_off,
            "none in this period; one that was loaded and never enabled is not listed here",
        ),
        ("Hosts that were blocked", report.blocks, "none in this period"),
        ("Drivers", report.drivers, "no record that a host held a group of [Authority] in this period"),
        ("Software that ran", report.software, "no start in the log"),
    )


def _cells(row: Intervention, in_words: Callable[[str], str]) -> Cells:
    before = row.before or (row.sha256_before and f"SHA-256 {row.sha256_before}")
    after = row.after or (row.sha256_after and f"SHA-256 {row.sha256_after}")
    origin = in_words(row.origin) if row.origin else ""
    return (
        row.time_utc,
        row.id,
        row.event,
        in_words(row.what),
        row.who or "the appliance",
        origin,
        before,
        after,
        row.reason,
    )


def _span(span: LastingState, in_words: Callable[[str], str]) -> Cells:
    until = span.until_utc or "lasts"
    return (
        in_words(span.what),
        in_words(span.state),
        span.since_utc,
        until,
        span.by,
        span.ended_by,
        span.reason,
    )


def _verification(report: MachineReport) -> str:
    result = report.verification
    if result is None:
        return f"last verification: {_NO_VERIFICATION}"
    verdict = "complete and unchanged" if result.complete else "NOT complete or changed"
    return (
        f"last verification: {result.time_utc}, {counted(result.records, 'record')}: {verdict}: {result.text}"
    )
