"""Put a report into words: lines for a terminal, and one page for paper. No I/O."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from appliance.audit.proof.chain_findings import VerificationResult
from appliance.base.counted import counted
from appliance.formats.html_page import Cells, Unbroken, head, lines, section, text
from appliance.formats.interventions import SUBJECTS, Intervention
from appliance.formats.machine_report import Gap, LastingState, MachineReport, ReportedLog

_TITLE = "Interventions in the safety settings of a machine"
_TAMPERING = (
    "Each record has the hash of the one before it, and checkpoints of this chain are signed. A changed, removed or"
    " inserted record is found by `{verify}`; a log that root replaced as a whole, or cut at its end, by"
    " comparison with checkpoints that were kept on another machine (`--checkpoints`), by the signer's memory, or by"
    " the collector. The last result is stored beside the log and is not signed, and neither is this report: verify the"
    " log, and make the report again from it."
)
_SPAN = ("what", "state", "from (UTC)", "to (UTC)", "by", "ended by", "reason")
_ROW = ("time (UTC)", "event", "what", "before", "after", "who", "reason", "record")
_MAX_NAMED = 6
_LONGEST_UNBROKEN = 24
InWords = Callable[[str], str]


class _Section(NamedTuple):
    title: str
    columns: Sequence[str]
    rows: Sequence[Cells]
    empty: str
    below: str = ""


class ReportPage:
    """A self-contained HTML page without scripts. `in_words` names hosts by the policy of now."""

    def __init__(self, report: MachineReport, in_words: InWords = str) -> None:
        self._report = report
        self._in_words = in_words
        self._named = any(log.name for log in report.logs)  # a column for the appliances or robots

    def text(self) -> str:
        sections = list(self._sections())
        numbers = {one.title: number for number, one in enumerate(sections, start=1)}
        answers = [(*row, numbers.get(title, "none")) for *row, title in self._answers()]
        parts = [head(_TITLE), f"<h1>{_TITLE}</h1>\n"]
        facts = [(Unbroken(name), value) for name, value in _facts(self._report, _time)]
        parts += section("About this report", (), facts)
        parts += section("Answers", ("question", "answer", "section"), answers)
        for one in sections:
            parts += section(f"{numbers[one.title]}. {one.title}", one.columns, one.rows, one.empty)
            parts.append(one.below)
        return "".join(parts)

    def _sections(self) -> Iterator[_Section]:
        report, without = self._report, []
        for subject in SUBJECTS:
            rows = [row for row in report.interventions if row.subject == subject]
            if not rows:
                without.append(subject)
                continue
            below = "".join(map(self._diff, rows))
            yield _Section(_title(subject), self._columns(_ROW), [self._row(row) for row in rows], "", below)
        if without:
            yield _Section("No record in this period", (), [(", ".join(without),)], "")
        for title, spans, empty in _spans(report):
            yield _Section(title, self._columns(_SPAN), [self._span(span) for span in spans], empty)
        ways = [(row.name, row.where, row.commands, row.protection) for row in report.interfaces]
        yield _Section(
            _INTERFACES, ("interface", "where", "commands", "protection"), ways, report.live_reason
        )
        rights = [(row.what, row.who, row.by) for row in report.rights]
        yield _Section(_RIGHTS, ("right", "who", "by"), rights, report.live_reason)
        gaps = [
            (*self._name(row.appliance), _time(row.time_utc), row.event, row.reason) for row in report.gaps
        ]
        yield _Section(_GAPS, self._columns(("time (UTC)", "event", "reason")), gaps, _NO_GAP)
        verified = [(*self._name(log.name), _verification(log, report.verify)) for log in report.logs]
        below = f"<p>{text(_TAMPERING.format(verify=report.verify))}</p>\n"
        yield _Section(_VERIFICATION, (), verified, "no log", below)

    def _answers(self) -> Iterator[tuple[str, str, str]]:
        """Yield questions, short answers, and the title of the section with the whole answer."""
        report = self._report
        rows = report.interventions
        values = [row for row in rows if row.event == "monitor set"]
        loads = [row for row in rows if row.event == "policy loaded"]
        live = report.live_reason
        yield "Who may stop the robot remotely?", live or _who(report, "stop the robot"), _RIGHTS
        yield (
            "Who can change policies, monitors and guards?",
            live or _who(report, "change policies"),
            _RIGHTS,
        )
        yield (
            "Which interfaces take commands, and what protects each?",
            live or ", ".join(row.name for row in report.interfaces if row.commands),
            _INTERFACES,
        )
        yield "Who changed a guard's value, from what to what?", _last(values), _title("guards and monitors")
        yield "Who changed the policy?", _last(loads), _title("policy")
        yield "Was a guard off, when, by whose order?", _states(report.switched_off, self._in_words), _OFF
        drove = _states(report.drivers, self._in_words) if report.drivers else _NO_HOLDER
        yield "Who drove, and when?", drove, _DRIVERS
        yield "Which hosts were blocked?", _states(report.blocks, self._in_words), _BLOCKED
        yield (
            "Who approved calls of agents?",
            _last([row for row in rows if row.event == "approval given"]),
            _title("approvals"),
        )
        yield "Which software ran?", ", ".join(dict.fromkeys(one.state for one in report.software)), _SOFTWARE
        yield "Does the log have gaps, and why?", _gap_words(report.gaps), _GAPS
        yield (
            "Was the log changed, and how would one know?",
            "; ".join(_verdict(log) for log in report.logs),
            _VERIFICATION,
        )

    # --- rows ---

    def _columns(self, columns: Sequence[str]) -> Sequence[str]:
        return ("machine", *columns) if self._named else columns

    def _name(self, name: str) -> Cells:
        return (name,) if self._named else ()

    def _row(self, row: Intervention) -> Cells:
        before, after = (_value(row, which, self._in_words) for which in ("before", "after"))
        return (
            *self._name(row.appliance), _cell(row.time_utc), _short(row.event),
            _short(_host(row.what, row.names, self._in_words)),
            before, after, _short(_author(row, self._in_words)), row.reason, f"{row.sequence}",
        )  # fmt: skip

    def _diff(self, row: Intervention) -> str:
        """Return the hashes and the changed lines of a text, which do not fit into a cell."""
        if not (row.diff or row.sha256_after):
            return ""
        name = f"{row.appliance}, " if row.appliance else ""
        hashes = (
            f" SHA-256 before: {row.sha256_before or 'none known'}; after: {row.sha256_after}."
            if row.sha256_after
            else ""
        )
        title = f"Record {name}{row.sequence} ({row.event}, {_time(row.time_utc)}).{hashes}"
        changed = f"<pre>{lines(chr(10).join(row.diff))}</pre>\n" if row.diff else ""
        return f"<p>{text(title)}</p>\n{changed}"

    def _span(self, span: LastingState) -> Cells:
        return (
            *self._name(span.appliance), _host(span.what, span.names, self._in_words),
            _host(span.state, span.names, self._in_words), _cell(span.since_utc),
            _cell(span.until_utc) if span.until_utc else "lasts", span.by, span.ended_by, span.reason,
        )  # fmt: skip


_OFF, _BLOCKED, _DRIVERS, _SOFTWARE = (
    "Guards and monitors that were off", "Hosts that were blocked", "Drivers", "Software that ran",
)  # fmt: skip
_INTERFACES, _RIGHTS = "Interfaces now, and what protects each", "Rights on the machine now"
_GAPS, _VERIFICATION = "Completeness of the log", "Verification"
_NO_GAP = "The log has no record of a gap in this period."
_NO_HOLDER = "no record that a host held a group of [Authority] in this period"


def page(report: MachineReport, in_words: InWords = str) -> str:
    return ReportPage(report, in_words).text()


def report_lines(report: MachineReport, in_words: InWords = str) -> Iterator[str]:
    """Yield the lines for a terminal, in the order of the page."""
    yield from (f"{name}: {value}" for name, value in _facts(report))
    for subject in SUBJECTS:
        rows = [row for row in report.interventions if row.subject == subject]
        if rows:
            yield f"{subject}:"
        for row in rows:
            what = f" {_host(row.what, row.names, in_words)}" if row.what else ""
            name = f"{row.appliance}  " if row.appliance else ""
            yield f"  {row.time_utc}  {name}{row.event}{what}{_change(row, in_words)}: {row.reason}"
            yield from (f"      {line}" for line in row.diff)
    for title, spans, empty in _spans(report):
        yield f"{title}:" if spans else f"{title}: {empty}"
        for span in spans:
            until = span.until_utc or "now"
            by = f" by {span.by}" if span.by else ""
            what, state = (_host(one, span.names, in_words) for one in (span.what, span.state))
            yield f"  {span.since_utc} to {until}  {what}: {state}{by}"
    if report.live_reason:
        yield f"interfaces and rights: {report.live_reason}"
    yield from (
        f"interface {row.name} at {row.where}: {row.commands}; {row.protection}" for row in report.interfaces
    )
    yield from (f"right: {row.what}: {row.who} ({row.by})" for row in report.rights)
    for gap in report.gaps:
        name = f"{gap.appliance}  " if gap.appliance else ""
        yield f"gap {gap.time_utc}  {name}{gap.event}: {gap.reason}"
    for log in report.logs:
        yield (
            f"{log.name}: {_verification(log, report.verify)}"
            if log.name
            else _verification(log, report.verify)
        )


def host_words(address: str, names: Mapping[str, str], in_words: InWords = str) -> str:
    """Return a host by the name that the records give it, or by its address and its name in the policy of now."""
    if address in names:
        return f"{names[address]} ({address})"
    label = in_words(address).removesuffix(f" ({address})")
    return address if label == address else f"{address} (now {label})"


_host = host_words


def _facts(report: MachineReport, time: Callable[[str], str] = str) -> Iterator[tuple[str, str]]:
    yield "machine", report.robot or "(no name in appliance.yaml)"
    yield "period (UTC)", f"{time(report.since_utc)} to {time(report.until_utc)}"
    yield "made (UTC)", f"{time(report.made_utc)}, by ROSRV {report.version}"
    for log in report.logs:
        name = f"audit log of {log.name}" if log.name else "audit log"
        begins = time(log.begins_utc) if log.begins_utc else "no time: it is empty"
        yield (
            name,
            f"{log.id or '(read over REST)'}, up to record {log.last}; its first record is of {begins}",
        )
        if log.begins_utc > report.since_utc:
            yield "not covered", f"{time(report.since_utc)} to {begins}: the {name} begins later"
    if len(report.logs) > 1:
        yield "order", "by the time of each record, which is that of its own machine's clock"
    yield "interventions", str(len(report.interventions))


def _spans(report: MachineReport) -> Iterable[tuple[str, Sequence[LastingState], str]]:
    return (
        (_OFF, report.switched_off, "none in this period"),
        (_BLOCKED, report.blocks, "none in this period"),
        (_DRIVERS, report.drivers, _NO_HOLDER),
        (_SOFTWARE, report.software, "no start in the log"),
    )


def _title(subject: str) -> str:
    return subject[0].upper() + subject[1:]


def _time(utc: str) -> str:
    """Return a time (UTC) to the second for paper; a terminal and JSON have nanoseconds."""
    return f"{utc[:10]} {utc[11:19]}" if utc[10:11] == "T" else utc


def _cell(utc: str) -> Unbroken:
    return Unbroken(_time(utc))


def _short(words: str) -> str:
    return Unbroken(words) if len(words) <= _LONGEST_UNBROKEN else words


def _value(row: Intervention, which: str, in_words: InWords) -> str:
    words, digest = (row.before, row.sha256_before) if which == "before" else (row.after, row.sha256_after)
    parts = (_host(words, row.names, in_words) if words else "", digest and f"SHA-256 {digest[:12]}…")
    return ", ".join(filter(None, parts))


def _author(row: Intervention, in_words: InWords) -> str:
    origin = f"from {_host(row.origin, row.names, in_words)}" if row.origin else ""
    return " ".join(filter(None, (row.who or "the appliance", origin)))


def _change(row: Intervention, in_words: InWords) -> str:
    author = f" by {_author(row, in_words)}"
    if not row.after:
        return author
    before, after = (_host(words, row.names, in_words) for words in (row.before or "unknown", row.after))
    return f" ({before} -> {after}){author}"


def _who(report: MachineReport, what: str) -> str:
    return "; ".join(f"{row.who} ({row.by})" for row in report.rights if what in row.what) or "no one"


def _last(rows: Sequence[Intervention]) -> str:
    if not rows:
        return "no record in this period"
    row = rows[-1]
    change = (
        f": {row.what} {row.before} → {row.after}"
        if row.before and row.after
        else row.reason and f": {row.reason}"
    )
    times = f"{counted(len(rows), 'record')}, the last at" if len(rows) > 1 else "at"
    return f"{times} {_time(row.time_utc)} by {row.who or 'the appliance'}{change}"


def _states(spans: Sequence[LastingState], in_words: InWords) -> str:
    if not spans:
        return "none in this period"
    words = [" ".join(_host(one, span.names, in_words) for one in (span.what, span.state)) for span in spans]
    lasting = [name for name, span in zip(words, spans, strict=True) if not span.until_utc]
    last = f"lasting: {_few(lasting)}" if lasting else "none lasts"
    return f"{counted(len(spans), 'time')}: {_few(words)}; {last}"


def _few(words: Iterable[str]) -> str:
    """Return different words, and the number of those that are too many for an answer."""
    found = list(dict.fromkeys(words))
    more = f" and {len(found) - _MAX_NAMED} more" if len(found) > _MAX_NAMED else ""
    return f"{', '.join(found[:_MAX_NAMED])}{more}"


def _gap_words(gaps: Sequence[Gap]) -> str:
    if not gaps:
        return "no record of a gap in this period"
    return ", ".join(
        f"{event}: {sum(gap.event == event for gap in gaps)}" for event in sorted({gap.event for gap in gaps})
    )


def _verdict(log: ReportedLog) -> str:
    name, found = f"{log.name}: " if log.name else "", log.verification
    if found is None:
        return f"{name}not verified, as far as this machine knows"
    return f"{name}{_outcome(found)}, at {_time(found.time_utc)}, up to record {found.through}"


def _outcome(result: VerificationResult) -> str:
    if not result.complete:
        return "NOT complete or changed"
    return result.verdict or "without a finding"


def _verification(log: ReportedLog, verify: str) -> str:
    result = log.verification
    if result is None:
        return f"last verification: none is stored here: run `{verify}`"
    read = counted(result.records, "record")
    text = f"last verification: {result.time_utc}, {read}: {_outcome(result)}: {result.text}"
    if result.log and log.id and result.log != log.id:
        return f"{text}. It is of another log ({result.log}), and says nothing of this one: run `{verify}`"
    if result.through and log.last > result.through:
        later = counted(log.last - result.through, "later record is", "later records are")
        return f"{text}. {later} not verified: run `{verify}`"
    return text
