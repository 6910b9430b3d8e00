"""Define the verbs of a command as data. The module of a verb is imported when the verb runs (`cli/lazy.py`)."""

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

_ROOT = Path(__file__).parents[2]
_CLI = "appliance.cli."


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb's function (`module:function`, from `appliance.cli` unless the module begins with `appliance.`).

    In the help, `first` precedes its docstring.
    """

    place: str
    first: str = ""
    hidden: bool = False

    @property
    def module(self) -> str:
        """Return the full name of the module."""
        module = self.place.partition(":")[0]
        return module if module.startswith("appliance.") else _CLI + module

    @property
    def function(self) -> str:
        """Return the name of the function in the module."""
        return self.place.partition(":")[2]

    @property
    def help(self) -> str:
        """Return the first sentence of the help, read without importing the module."""
        file = _ROOT.joinpath(*self.module.split(".")).with_suffix(".py")
        return self.first or _first_sentence(file, self.function)


@dataclass(frozen=True, slots=True)
class Group:
    """A command with its own verbs, such as `rosrv audit`."""

    help: str
    verbs: "Verbs"


Verbs = Mapping[str, Verb | Group]


@functools.cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def _first_sentence(file: Path, function: str) -> str:
    found = re.search(rf'(?ms)^def {function}\(.*?"""(.+?)(?:"""|\n\n)', _text(file))
    assert found is not None, function  # noqa: S101  every verb has a docstring
    return " ".join(found[1].split())
