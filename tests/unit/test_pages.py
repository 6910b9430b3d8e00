import re
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from rosrv_fleet.cli import app as fleet_app

from appliance.channel.operations import OPERATIONS
from appliance.configuration.settings import Settings
from appliance.policy.policy_compiler import compile_policy
from appliance.supervisor.role import Facts
from appliance.supervisor.roles import ROLES
from appliance.supervisor.sandbox.sandbox_plan import NETWORK, ROUTES, UNIX
from distribution import command_line_page, generated_pages
from rosmop.tool.command import app as rosmop_app
from tests.support.command import commands
from tests.support.page_steps import steps
from tests.support.sources import files_of_tests

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
WITH_LINKS = [
    *PAGES,
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")),
]
_CODE = re.compile(r"```.*?```|`[^`\n]+`|^ {4,}\S.*$", re.DOTALL | re.MULTILINE)
_CALL = re.compile(r"(?:^|[`(]|\$ |sudo |bin/|appliance |&& )rosrv ([a-z][^\n`|…]*)", re.MULTILINE)

_VARIABLE = re.compile(r"\bROSRV_[A-Z]+(?:_+[A-Z]+)*")
_ADVICE = re.compile(r"\brosrv ([a-z][a-z-]*(?: [^\n`|…\"'<;()]*)?)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_page_is_in_the_list_for_readers(page: Path) -> None:
    assert "(docs/README.md)" in (ROOT / "README.md").read_text()
    link = f"({page.relative_to(ROOT / 'docs')})"
    assert page.name == "README.md" or link in (ROOT / "docs" / "README.md").read_text()


@pytest.mark.parametrize("page", WITH_LINKS, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text()
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)
    linked = [page.parent / link for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", prose)]
    named = [ROOT / name for name in re.findall(r"\bdocs/[\w/-]+\.md", text)]
    assert [place for place in linked + named if not place.exists()] == []


@pytest.mark.parametrize("page", WITH_LINKS, ids=lambda page: page.name)
def test_each_policy_of_a_page_loads(page: Path) -> None:
    for block in re.findall(r"^```ini\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        assert compile_policy(block, file=page.name).text == block  # raises PolicyError for a mistake


@pytest.mark.parametrize("page", WITH_LINKS, ids=lambda page: page.name)
def test_links_lead_to_headings(page: Path) -> None:
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(), flags=re.DOTALL)
    links = re.findall(r"\]\((?!https?:)([^)#]*)#([^)]+)\)", prose)
    assert [
        link for link in links if link[1] not in headings(page.parent / link[0] if link[0] else page)
    ] == []


def headings(page: Path) -> set[str]:
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", ["docs/dev/architecture.md", "docs/reference/limits.md", "CONTRIBUTING.md"])
def test_modules_that_are_named_are_there(page: str) -> None:
    names = re.findall(r"\b(?:[a-z_]+/)+[a-z_]+\.(?:py|sh|js|rv|toml|yaml)\b", (ROOT / page).read_text())
    folders = (ROOT, ROOT / "appliance", ROOT / "appliance" / "api" / "console")
    assert [name for name in names if not any((folder / name).exists() for folder in folders)] == []


def test_the_sandbox_of_each_process_is_in_the_architecture() -> None:
    page = (ROOT / "docs/dev/architecture.md").read_text().split("\n## Sandbox", 1)[1]
    rows = re.findall(
        r"^\| (\w+) \| `([\w-]+)` \| (\w+) \| ([^|]+) \| ([^|]+), ([^|]+) \|", page, re.MULTILINE
    )
    sockets = {UNIX: "Unix", NETWORK: "Unix, IP", ROUTES: "Unix, IP, netlink"}
    expected = []
    for role in ROLES:
        plan = role.sandbox(Facts(ROOT, ROOT / "config.json", 12311, "http://127.0.0.1:5"))
        calls = "allowlisted" if plan.allowlist else "usual"
        expected.append((role.name, role.user, calls, sockets[plan.families], plan.binds is None))
    assert sorted((*row[:4], row[4] == "any") for row in rows) == sorted(expected)


def test_the_state_directory_is_described() -> None:
    page = (ROOT / "docs/reference/processes.md").read_text()
    table = page.split("\n## The state directory", 1)[1].split("\n## ", 1)[0]
    folders = {
        name.partition("/")[0]
        for row in re.findall(r"^\| (`[^|]*) \|", table, re.MULTILINE)
        for name in re.findall(r"`([^`]+)`", row)
    }
    assert {role.part for role in ROLES} - folders == set()


def test_settings_that_pages_name_exist() -> None:
    sections = {name: kind for name, kind in get_type_hints(Settings).items() if is_dataclass(kind)}
    files = {"audit.pub", "firewall.translations"}  # of the state directory, and of the status
    pages = [page for page in WITH_LINKS[:-1] if "fleet" not in page.name]
    named = {name for page in pages for name in re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)[`:]", page.read_text())}
    named = {name for name in named - files if name.partition(".")[0] in sections}
    assert [name for name in named if not _is_setting(f"ROSRV_{name.replace('.', '__').upper()}")] == []
    assert len(named) > 30


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tests_that_pages_name_are_there(page: Path) -> None:
    named = set(re.findall(r"`(test_\w+)(?:\[[^`]*\])?`", page.read_text()))
    assert named <= names_of_tests()


@cache
def names_of_tests() -> frozenset[str]:
    texts = (file.read_text(encoding="utf-8") for file in files_of_tests())
    return frozenset(name for text in texts for name in re.findall(r"def (test_\w+)\(", text))


def test_tests_that_the_assurance_names_are_there() -> None:
    named = re.findall(r"([\w/]+\.py)::(test_\w+)", (ROOT / "docs/dev/assurance.md").read_text())
    texts = {file: [one.read_text() for one in (ROOT / "tests").rglob(Path(file).name)] for file, _ in named}
    assert named
    assert [name for file, name in named if not any(f"def {name}(" in text for text in texts[file])] == []


def test_every_operation_of_rest_is_on_its_page() -> None:
    text = (ROOT / "docs" / "reference" / "rest.md").read_text()
    paths = {re.sub(r"{\w+}", r"[^/\\s?\"]+", operation.path) for operation in OPERATIONS if operation.path}
    missing = [path for path in paths if not re.search(rf"{path}(?![\w/])", text)]
    assert not missing, f"describe in docs/reference/rest.md: {', '.join(missing)}"


@cache
def options_of_verbs() -> dict[str, set[str]]:
    """Return the options in the help of each verb: a former name is not one for a page."""
    return {
        name: {
            "--help",
            *(one for each in verb.params if not getattr(each, "hidden", False) for one in each.opts),
        }
        for name, verb in commands()
    }


@pytest.mark.parametrize("page", WITH_LINKS[:-1], ids=lambda page: page.name)
def test_commands_of_pages_exist(page: Path) -> None:
    options = options_of_verbs()
    groups = {name.split()[0] for name in options}
    calls = [call.strip() for code in _CODE.findall(page.read_text()) for call in _CALL.findall(code)]
    assert [call for call in calls if call not in groups and not _exists(call, options)] == []


def test_options_that_the_product_names_exist() -> None:
    options = {
        name: {one for each in verb.params for one in (*each.opts, *each.secondary_opts, "--help")}
        for name, verb in commands()
    }
    files = [*(ROOT / "appliance").rglob("*.py"), *(ROOT / "appliance").glob("**/console/**/*.js")]
    files += [
        *(ROOT / "examples").rglob("*.y*ml"),
        *(ROOT / "examples").rglob("*.sh"),
        *ROOT.glob("compose*.yaml"),
    ]
    gone, seen = [], 0
    for file in files:
        for call in _ADVICE.findall(file.read_text()):
            name = max((one for one in options if f"{call} ".startswith(f"{one} ")), key=len, default=None)
            given = set(re.findall(r"(?<=[ \[])--[a-z-]+", call)) if name is not None else set()
            seen += len(given)
            gone += [f"{file.name}: {call}"] if name is not None and given - options[name] else []
    assert gone == []
    assert seen > 50


OTHERS = {
    "--device": "docker run", "--global": "pipx", "--pip-args": "pipx",
    "--runtime-env-agent-port": "ray", "--wait": "roslaunch",
}  # fmt: skip


def test_options_that_pages_name_alone_exist() -> None:
    options = set().union(*options_of_verbs().values())
    for program in (fleet_app, rosmop_app):
        for _, command, context in command_line_page.commands(("",), program):
            options |= {
                one
                for each in command.get_params(context)
                if not getattr(each, "hidden", False)
                for one in (*each.opts, *each.secondary_opts)
            }
    named = {name for page in WITH_LINKS[:-1] for name in re.findall(r"`(--[a-z][a-z-]*)", page.read_text())}
    folders = ("appliance/features/standby", "benchmarks", "tests/support", "tests/world")
    scripts = "".join(file.read_text() for folder in folders for file in (ROOT / folder).rglob("*.py"))
    missing = {name for name in named - options if f'"{name}"' not in scripts}
    assert missing == OTHERS.keys()


def test_commands_of_the_collector_on_pages_exist() -> None:
    options = {
        " ".join(words): {one for each in command.get_params(context) for one in (*each.opts, "--help")}
        for name, program in (("rosrv-fleet", fleet_app), ("rosmop", rosmop_app))
        for words, command, context in command_line_page.commands((name,), program)
    }
    calls = [
        call
        for page in WITH_LINKS[:-1]
        for code in _CODE.findall(page.read_text())
        for call in re.findall(r"\b((?:rosrv-fleet|rosmop) [a-z][^\n`|…]*)", code)
    ]
    assert [call for call in calls if not _exists(call, options)] == []
    assert len(calls) > 50


def test_variables_that_the_product_names_exist() -> None:
    folders = ("appliance", "fleet/src", "rosmop", "scripts")
    sources = [file for one in folders for kind in ("py", "sh") for file in (ROOT / one).rglob(f"*.{kind}")]
    compose = [*ROOT.glob("compose*.yaml"), *(ROOT / "fleet").glob("*.y*ml")]
    read = set(_VARIABLE.findall("".join(file.read_text() for file in (*sources, *compose))))
    naming = [*WITH_LINKS[:-1], *compose, *(ROOT / "appliance").glob("**/console/**/*.js")]
    naming += (ROOT / "examples").rglob("*.y*ml")
    named = set(_VARIABLE.findall("".join(file.read_text() for file in naming)))
    assert {name for name in named - read if not _is_setting(name)} == set()
    assert len(named) > 15


def _is_setting(variable: str) -> bool:
    section: Any = Settings
    for part in variable.removeprefix("ROSRV_").lower().split("__"):
        if not is_dataclass(section) or part not in get_type_hints(section):
            return False
        section = get_type_hints(section)[part]
    return True


def _exists(call: str, options: dict[str, set[str]]) -> bool:
    name = max((option for option in options if f"{call} ".startswith(f"{option} ")), key=len, default=None)
    given = re.findall(r"(?<=[ \[])--[a-z-]+", re.sub(" #.*", "", call))
    return name is not None and options[name].issuperset(given)


def test_the_quickstart_is_quick() -> None:
    text = (ROOT / "docs/quickstart.md").read_text()
    words = re.sub(r"<!--.*?-->|^```.*$", "", text, flags=re.MULTILINE).split()
    denied = [step for step in steps("quickstart.md") if step.how == "fails"]
    assert (text.count("\n## "), len(denied), len(words) <= 250) == (5, 1, True), len(words)


@pytest.mark.parametrize("page", ["quickstart.md", "try-for-an-hour.md", "audit.md"])
def test_a_reader_types_no_id_of_another_run(page: str) -> None:
    """Numbers are short, and the output above the step shows where the reader's own one is."""
    shown, typed = "", list[str]()
    for step in steps(page):
        numbers = re.findall(r"#\d+", step.script)
        assert [number for number in numbers if f"'{number}'" not in step.script or number not in shown] == []
        typed += re.findall(r"\b[0-9a-f]{20}\b", step.script)
        shown += "\n".join(step.shown)
    assert typed == []


STEPS = ("quickstart.md", "close-the-ports.md", "policy.md", "guards.md", "driving.md", "operating.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_step_has_its_number_and_leads_to_the_next(page: Path) -> None:
    """The way of a newcomer to a protected robot. A running robot has another first step."""
    text = page.read_text()
    name = page.name if page.parent.name == "docs" else ""
    number = STEPS.index(name) + 1 if name in STEPS else 1 if name == "try-for-an-hour.md" else 0
    numbers = re.findall(r"^Step (\d) of (\d)\b", text, re.MULTILINE)
    assert numbers == ([(str(number), str(len(STEPS)))] if number else [])
    following = re.findall(r"^\*\*Next\*\*.*?\]\(([^)#]+)", text, re.MULTILINE)
    assert not number or following == [*STEPS[number : number + 1]]


@pytest.mark.parametrize("page", ["README.md", "docs/README.md"])
def test_the_steps_are_listed_in_their_order(page: str) -> None:
    named = re.findall(
        r"^(?:\d\. |\| )\[[^]]+\]\((?:docs/)?([\w-]+\.md)\)", (ROOT / page).read_text(), re.MULTILINE
    )
    assert tuple(one for one in named if one in STEPS) == STEPS


def test_the_first_steps_need_eight_verbs() -> None:
    parts = {
        "quickstart.md": ("# Quickstart", "**Next**"),
        "guards.md": ("## Three minutes", "\n## "),
        "close-the-ports.md": ("# Close the ports", "\n## "),
    }
    options = options_of_verbs()
    texts = [
        (ROOT / "docs" / page).read_text().partition(begin)[2].partition(end)[0]
        for page, (begin, end) in parts.items()
    ]
    calls = re.findall(r"(?:^|\$ |sudo )rosrv ([a-z][^\n`|]*)", "\n".join(texts), re.MULTILINE)
    verbs = {max((one for one in options if f"{call} ".startswith(f"{one} ")), key=len) for call in calls}
    assert verbs == {
        "status", "audit search", "policy grant", "guard suggest", "guard new", "guard enforce", "monitor confirm",
        "protect",
    }  # fmt: skip


def test_the_changelog_has_no_fact_twice() -> None:
    """Two bullets with mostly the same words are one fact, as after a merge."""
    release = (ROOT / "CHANGELOG.md").read_text().partition("## [Unreleased]")[2].partition("\n## [")[0]
    bullets = [" ".join(one.split()) for one in re.findall(r"^- (.*(?:\n  .*)*)", release, re.MULTILINE)]
    words = [frozenset(re.findall(r"[\w.-]+", re.sub(r"\]\([^)]*\)", "]", one.lower()))) for one in bullets]
    twice = [
        (bullets[first], bullets[second])
        for first in range(len(words))
        for second in range(first)
        if len(words[first] & words[second]) > 0.6 * len(words[first] | words[second])
    ]
    assert twice == []


def test_the_example_of_the_audit_log_does_not_use_the_state_of_the_service() -> None:
    """It starts with a new log, and its monitor is gone with it."""
    scripts = "".join(step.script for step in steps("audit.md"))
    assert set(re.findall(r"(?:--state |STATE=)(\S+)", scripts)) == {"/var/lib/rosrv-audit"}


def test_the_changelog_begins_with_what_an_upgrade_asks_for() -> None:
    section = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1]
    notes = section.split("### Security")[0]
    assert "### Upgrade from" in notes
    assert notes.count("\n|") <= 20


_EXAMPLES = [
    path for path in sorted((ROOT / "examples").rglob("*")) if path.suffix in {".yaml", ".yml", ".sh", ".md"}
]


@pytest.mark.parametrize("page", [*WITH_LINKS[:-1], *_EXAMPLES], ids=lambda page: page.name)
def test_file_names_of_pages_and_examples_have_no_version(page: Path) -> None:
    assert re.findall(r"rosrv[\w-]*[_-]\d+\.\d+\.\d+[\w.-]*", page.read_text()) == []


def test_sizes_have_one_bound_on_the_settings_page() -> None:
    assert "size above 0" in generated_pages.settings_markdown()
    assert "size with a unit or integer" not in generated_pages.settings_markdown()


def test_the_architecture_lists_each_folder_once() -> None:
    rows = re.findall(
        r"^\| `(appliance/[\w/]+)` \|", (ROOT / "docs/dev/architecture.md").read_text(), re.MULTILINE
    )
    assert len(rows) > 20
    assert len(rows) == len(set(rows))


def test_the_guides_stay_short_and_the_index_begins_with_twelve_pages() -> None:
    """Further text is a row of the reference, or replaces words of a guide."""
    words = sum(len(page.read_text().split()) for page in (ROOT / "docs").glob("*.md"))
    first = (ROOT / "docs/README.md").read_text().split("\n## ")[1]
    assert (words <= 40_000, first.count("\n| [")) == (True, 12)
