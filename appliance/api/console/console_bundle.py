"""Join the console's modules into one script and one more for each part that is loaded late, and its style sheets.

The sources stay plain modules without a build tool. Imports have the form `import { a, b as c } from "./x.js";`,
in a feature also from `"#console/x.js"`; an absolute address stays a separate file. Exports have the forms
`export function`, `export async function`, `export class`, `export const NAME` and `export { a, b } from "…";`.

`import("./x.js")` makes a script of the module and of those that only it needs: a page is loaded when it is opened.
Every module becomes one function scope, so private names do not collide, and its exports are kept in one table, `$m`:
a module in several scripts runs once. Everything else raises `ModuleError`, at the start of the API.
"""

import posixpath
import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple, Self

_TOKEN = re.compile(
    r"""(?P<space>\s+|//[^\n\r\u2028\u2029]*|/\*.*?\*/)|(?P<text>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')"""
    r"""|(?P<word>[\w$]+)|(?P<mark>[^"'\s])""",
    re.DOTALL,
)
_TEMPLATE = re.compile(r"(?:\\.|\$(?!\{)|[^`\\$])*(?:`|\$\{)", re.DOTALL)
_REGULAR_EXPRESSION = re.compile(r"/(?:\\.|\[(?:\\.|[^\]\\\n])*+\]|[^/\\\n\[])++/\w*")
_BEFORE_A_VALUE = frozenset({
    "return", "typeof", "case", "of", "in", "await", "yield", "void", "delete", "throw", "else", "do", "instanceof",
})  # fmt: skip
_LINE_BREAK = re.compile(r"[\n\r\u2028\u2029]")
_CONSOLE = "#console/"
_WITHIN = tuple(
    quote + start for quote in "\"'`" for start in ("./", "../", _CONSOLE)
)  # of the console itself
_PAGE_HEAD = "const $m=[],$late=async(from)=>(await import(from)).load($m,$late);\n"
_LATE_HEAD = "export const load=($m,$late)=>{\n"
_OPENING = {")": "(", "]": "[", "}": "{"}
_AMBIGUOUS = re.compile(r"/(?![/*=\s])")
_NO_BREAK_AFTER = frozenset("{([,;")  # a statement never ends here by a line break, or it has ended already
_SEPARATING = frozenset("{}()[],;:?=<>&|!*")
_FROM = re.compile(r'(?:import|export)\s*\{([\w$,\s]+)\}\s*from\s*"([^"]+)"\s*;')
_NAME = re.compile(r"([\w$]+)(?:\s+as\s+([\w$]+))?")
_STYLE_IMPORT = re.compile(r'@import "([^"]+)";')
_STYLE_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)


class ModuleError(Exception):
    """The modules cannot be joined; the message names the file and, where known, the line."""


class _Token(NamedTuple):
    kind: str  # space, text, template, word or mark
    text: str
    line: int
    outermost: bool  # outside of all brackets


def join_modules(sources: Mapping[str, str], entry: str, root: str = "/") -> dict[str, str]:
    """Return the scripts by the path of their entry; the first one is the page's. Raises `ModuleError`.

    `sources` maps paths, such as `js/main.js`, to texts. A script is loaded late from `root` and its path.
    """
    numbers: dict[str, int] = {}
    page = _Joining(sources, root, numbers)
    page.include(entry)
    scripts = {entry: page.page_script()}
    waiting = page.late
    while waiting:
        path = waiting.pop(0)
        if page.includes(path):
            raise ModuleError(f"{path} is loaded with the page, and cannot be loaded late")
        if path not in scripts:
            later = _Joining(sources, root, numbers, page)
            later.include(path)
            scripts[path] = later.late_script(path)
            waiting += later.late
    return scripts


def join_styles(sources: Mapping[str, str], entry: str, within: tuple[str, ...] = ()) -> str:
    """Return a style sheet with its imports; `within` are the files that led to the entry. Raises `ModuleError`."""
    if entry not in sources:
        raise ModuleError(f"there is no file {entry}")
    way = (*within, entry)
    if entry in within:
        raise ModuleError(f"style sheets import each other: {', '.join(way)}")
    joined = _STYLE_IMPORT.sub(
        lambda found: join_styles(sources, _path(entry, found[1]), way),
        _STYLE_COMMENT.sub("", sources[entry]),
    )
    if "@import" in joined:
        raise ModuleError(f'{entry}: unsupported import; write @import "./FILE.css";')
    return re.sub(r"\s*\n\s*", "\n", joined).lstrip()


class _Joining:
    def __init__(
        self, sources: Mapping[str, str], root: str, numbers: dict[str, int], page: Self | None = None
    ) -> None:
        self.late: list[str] = []  # the modules that are loaded when they are asked for
        self._sources = sources
        self._root = root
        self._numbers = numbers  # the place of each module's exports in the table of all scripts
        self._exports: dict[str, set[str]] = dict(page._exports) if page else {}  # of each included module
        self._open: list[str] = []
        self._separate: dict[tuple[str, str], str] = {}  # the alias of each name of a separate file
        self._scopes: list[str] = []

    def includes(self, path: str) -> bool:
        return path in self._exports

    def page_script(self) -> str:
        return f"{self._imports()}{_PAGE_HEAD}{''.join(self._scopes)}"

    def late_script(self, path: str) -> str:
        return f"{self._imports()}{_LATE_HEAD}{''.join(self._scopes)}return {self._constant(path)};}};\n"

    def _imports(self) -> str:
        heads: dict[str, list[str]] = {}
        for (address, name), alias in self._separate.items():
            heads.setdefault(address, []).append(f"{name} as {alias}")
        return "".join(
            f'import {{{",".join(names)}}} from "{address}";\n' for address, names in heads.items()
        )

    def _constant(self, path: str) -> str:
        return f"$m[{self._numbers.setdefault(path, len(self._numbers))}]"

    def include(self, path: str) -> None:
        if path in self._open:
            raise ModuleError(f"modules import each other: {', '.join([*self._open, path])}")
        if path in self._exports:
            return
        if path not in self._sources:
            raise ModuleError(
                f"there is no file {path}{f', imported by {self._open[-1]}' if self._open else ''}"
            )
        self._open.append(path)
        head: list[str] = []
        body: list[_Token] = []
        exports: dict[str, str] = {}
        tokens = list(_tokens(path, self._sources[path]))
        at = 0
        while at < len(tokens):
            token = tokens[at]
            at += 1
            following = [one for one in tokens[at : at + 8] if one.kind != "space"]
            if token.text == "import" and token.kind == "word":
                token = self._dynamic(path, token, following, tokens, at)
            if not token.outermost or token.kind != "word" or token.text not in ("import", "export", "await"):
                body.append(token)
                continue
            if token.text == "export" and (name := _declared(following)):
                exports[name] = name
                continue
            end = next(
                (i for i in range(at, len(tokens)) if tokens[i].text == ";" and tokens[i].outermost), at
            )
            statement = "".join(one.text for one in tokens[at - 1 : end + 1])
            match = _FROM.fullmatch(statement)
            if match is None:
                raise ModuleError(
                    f"{path}:{token.line}: unsupported in a module of the console: {statement[:80]}"
                )
            for name, renamed in self._names(path, match[1], token.line):
                value = self._value(path, match[2], name, token.line)
                if token.text == "export":
                    exports[renamed] = value
                else:
                    head.append(f"{renamed}={value}")
            at = end + 1
        self._exports[path] = set(exports)
        bound = f"const {','.join(head)};\n" if head else ""
        given = ",".join(f"{name}:{value}" for name, value in exports.items())
        text = _tighten(body).strip()
        self._scopes.append(f"{self._constant(path)}??=(()=>{{{bound}{text}\nreturn {{{given}}};}})();\n")
        self._open.pop()

    def _names(self, path: str, text: str, line: int) -> Iterator[tuple[str, str]]:
        for part in text.strip().rstrip(",").split(","):
            match = _NAME.fullmatch(part.strip())
            if match is None:
                raise ModuleError(f"{path}:{line}: unsupported list of names: {text.strip()}")
            yield match[1], match[2] or match[1]

    def _value(self, path: str, address: str, name: str, line: int) -> str:
        if address.startswith("/"):
            return self._separate.setdefault((address, name), f"$v{len(self._separate)}")
        imported = _path(path, address)
        self.include(imported)
        if name not in self._exports[imported]:
            raise ModuleError(f"{path}:{line}: {imported} does not export {name}")
        return f"{self._constant(imported)}.{name}"

    def _dynamic(
        self, path: str, token: _Token, following: list[_Token], tokens: list[_Token], at: int
    ) -> _Token:
        """Return what stands for the word `import`, and name the script of a module of the console."""
        words = [one.text for one in following]
        if words[:1] == ["."]:
            raise ModuleError(
                f"{path}:{token.line}: unsupported in a module of the console: import.{words[1]}"
            )
        if words[:1] != ["("] or not words[1:] or not words[1].startswith(_WITHIN):
            return token
        if following[1].kind != "text" or words[2:3] != [")"]:
            raise ModuleError(
                f"{path}:{token.line}: unsupported in a module of the console: import({words[1]}"
            )
        named = _path(path, words[1][1:-1])
        if named not in self._sources:
            raise ModuleError(f"there is no file {named}, imported by {path}")
        self.late.append(named)
        place = tokens.index(following[1], at)
        tokens[place] = following[1]._replace(text=f'"{self._root}{named}"')
        return token._replace(text="$late")


def _tighten(pieces: list[_Token]) -> str:
    kept: list[_Token] = []
    gap = ""
    for piece in pieces:
        if piece.kind == "space":
            gap = "\n" if "\n" in (gap, piece.text) else gap or piece.text
            continue
        before = kept[-1].text if kept else ";"
        if before not in _NO_BREAK_AFTER and (gap == "\n" or (gap and not _apart(before, piece.text))):
            kept.append(_Token("space", gap, piece.line, piece.outermost))
        gap = ""
        kept.append(piece)
    return "".join(one.text for one in kept)


def _apart(before: str, after: str) -> bool:
    return before in _SEPARATING or after in _SEPARATING


def _declared(tokens: list[_Token]) -> str | None:
    words = [token.text for token in tokens]
    if words[:1] == ["async"]:
        words = words[1:] if words[1:2] == ["function"] else []
    if len(words) > 1 and words[0] in ("const", "class", "function") and re.fullmatch(r"[\w$]+", words[1]):
        return words[1]
    return None


def _path(of: str, address: str) -> str:
    if address.startswith(_CONSOLE):
        return f"js/{address.removeprefix(_CONSOLE)}"
    return posixpath.normpath(posixpath.join(posixpath.dirname(of), address))


def _tokens(path: str, text: str) -> Iterator[_Token]:
    brackets: list[str] = []
    at, line, before = 0, 1, _Token("mark", ";", 1, outermost=True)
    while at < len(text):
        value_follows = before.text in _BEFORE_A_VALUE or _awaits_value(before)
        if before.text in _OPENING and _AMBIGUOUS.match(text, at):
            raise ModuleError(
                f"{path}:{line}: put a regular expression in brackets, or a space after a division"
            )
        outermost = not brackets
        in_template = text[at] == "}" and brackets[-1:] == ["`"]
        found = _next(text, at, in_template=in_template, value_follows=value_follows)
        if found is None:
            raise ModuleError(f"{path}:{line}: unclosed string, template, comment or regular expression")
        kind, piece = found
        if in_template or (kind == "mark" and piece in _OPENING):
            if brackets[-1:] != ["`" if in_template else _OPENING[piece]]:
                raise ModuleError(f"{path}:{line}: unexpected {piece}")
            brackets.pop()
            outermost = not brackets
        if kind == "template" and piece.endswith("${"):
            brackets.append("`")
        elif kind == "mark" and piece in _OPENING.values():
            brackets.append(piece)
        shown = piece
        if kind == "space":
            shown = "\n" if _LINE_BREAK.search(piece) else "" if piece.startswith("//") else " "
        token = _Token(kind, shown, line, outermost)
        yield token
        if kind != "space":
            before = token
        at += len(piece)
        line += piece.count("\n")
    if brackets:
        raise ModuleError(f"{path}:{line}: unclosed {brackets[-1]}")


def _awaits_value(before: _Token) -> bool:
    if before.kind == "template":
        return before.text.endswith("${")
    return before.kind == "mark" and before.text not in _OPENING


def _next(text: str, at: int, *, in_template: bool, value_follows: bool) -> tuple[str, str] | None:
    if text[at] == "`" or in_template:
        match = _TEMPLATE.match(text, at + 1)
        return match and ("template", text[at : match.end()])
    if text[at] == "/" and value_follows and text[at + 1 : at + 2] not in ("/", "*"):
        match = _REGULAR_EXPRESSION.match(text, at)
        return match and ("text", match[0])
    match = _TOKEN.match(text, at)
    if match is None or (text.startswith("/*", at) and match.lastgroup != "space"):
        return None
    return str(match.lastgroup), match[0]
