"""The rows of the tables of verbs, without importing a verb."""

import functools
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Verb:
    """A row of the table; `place` is `module:function`, and in the help, `first` precedes its docstring.

    A feature's verb is listed `after` another one.
    """

    place: str
    first: str = ""
    hidden: bool = False
    after: str = ""

    @property
    def path(self) -> str:
        return self.place if self.place.startswith("appliance.") else f"appliance.cli.{self.place}"

    @property
    def help(self) -> str:
        module, _colon, function = self.path.partition(":")
        file = _PACKAGES.joinpath(*module.split(".")).with_suffix(".py")
        return self.first or _first_sentence(file, function)


@dataclass(frozen=True, slots=True)
class Group:
    """A command with its own verbs, such as `rosrv audit`. A feature adds verbs to a group with the same name."""

    help: str
    verbs: "Verbs"
    after: str = ""


Verbs = Mapping[str, Verb | Group]
FIRST = "(first)"
"""The value of `after` for a verb before all others."""
CONFIRM = "Keep a change loaded with --confirm-within. Exit status 1 if there is nothing to confirm."
"""The help of `rosrv policy confirm` and `rosrv monitor confirm`."""
_PACKAGES = Path(__file__).parents[2]


def merge(core: Verbs, *features: Verbs) -> Verbs:
    table = list(core.items())
    for name, added in itertools.chain.from_iterable(verbs.items() for verbs in features):
        names = [known for known, _verb in table]
        if name in names:
            table[names.index(name)] = (name, _extend(name, dict(table)[name], added))
        else:
            table.insert(_place(names, added.after), (name, added))
    return dict(table)


def _extend(name: str, known: Verb | Group, added: Verb | Group) -> Group:
    if isinstance(known, Group) and isinstance(added, Group):
        return Group(known.help or added.help, merge(known.verbs, added.verbs), known.after or added.after)
    raise ValueError(f"the verb {name} of a feature is already defined")


def _place(names: list[str], after: str) -> int:
    return 0 if after == FIRST else names.index(after) + 1 if after in names else len(names)


@functools.cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def _first_sentence(file: Path, function: str) -> str:
    text = _text(file)
    docstring = text[text.index(f"\ndef {function}(") :].split('"""', 2)[1]  # every verb has one
    return " ".join(docstring.partition("\n\n")[0].split())
