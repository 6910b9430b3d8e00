"""Parse the text of an ``.rv`` file into a tree, in time and memory linear in its length."""

import re
from collections.abc import Mapping
from functools import lru_cache

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from rosmop.form.findings import Position, SpecificationError
from rosmop.logics.catalogue import LOGICS
from rosmop.text import tree
from rosmop.text.builder import TreeBuilder, check
from rosmop.text.complaints import FORBIDDEN, RESERVED, describe, explain_misplaced
from rosmop.text.typed import make_specifications
from rosmop.types.roles import ROLES

# The grammar of ``.rv`` files, for lark's LALR(1) parser with its contextual lexer.
#
# The lexer knows which tokens may follow, so `/landshark/scan` is a topic where a topic is allowed and two divisions
# elsewhere. A C++ parser needs the declared types to distinguish a declaration from an expression; here two names in a
# row are a declaration.

_GAP = r"(?:\s|\/\/[^\n]*\n|\/\*(?:[^*]|\*(?!\/))*\*\/)"
"""White space and comments; it can match in only one way, so the lexer never backtracks."""

_WORD = "(?:creation|static|unsynchronized|decentralized|perthread|suffix)"

_AT = r"@(?=(?:bc?|c)(?!\w))(?!\w+<GAP>*\{)"

_CONDITION = r"\{[^{}@]*@[A-Za-z_]\w*\.[^{}]*\}"

_GRAMMAR = r"""
file: (specification | using | order | preset | role | ";")*
using: "using" "namespace" NAME ";"
order: ORDER NAME ("<" NAME)* ";"
preset: _PRESET NAME NUMBER ["as" NAME [ON_OR_OFF] "{" setting* "}"]
setting: NAME "=" GIVEN_VALUE ";"
role: _ROLE NAME "(" [parameters] ")" [":" NAME] "{" row* "}"
row: (ROW_TYPE | DEFAULT) ["(" [parameters] ")"] pattern [CANCEL] (block | ";")

specification: NAME+ ["(" [parameters] ")" [phase] [given]] "{" item* "}"
phase: "in" NAME
given: GIVEN "{" (given_value | given_topic | given_list)* "}"
given_value: BUILTIN+ NAME "=" GIVEN_VALUE ";"
given_topic: TOPIC_WORD NAME [":" NAME] "=" TOPIC ";"
given_list: GIVEN_KIND NAME "=" GIVEN_VALUE ";"
?item: shared ";" | function | prototype | init | event | property | safe | withhold | ";" -> nothing

function: type NAME "(" [parameters] ")" block
        | NAME "(" [parameters] ")" block         -> procedure
prototype: type NAME "(" [parameters] ")" ";"
init: "init" "(" [parameters] ")" block
parameters: parameter ("," parameter)*
         | BUILTIN+                               -> unnamed_parameters
parameter: type NAME
         | type "&" NAME                          -> reference_parameter
         | type "[" "]" NAME                      -> array_parameter
         | type "[" "]" "&" NAME                  -> array_reference_parameter
         | type NAME "[" "]"                      -> array_parameter_behind

event: MODIFIER* "event" NAME "(" [parameters] ")" trigger action
     | MODIFIER* "event" NAME "(" [names] ")" TOPIC ["when" "(" expression ")"] action -> typed_event
names: NAME ("," NAME)*
?action: block | "<<" statement* ">>"              -> block
trigger: TOPIC MESSAGE_TYPE pattern ["when" "(" expression ")"]
       | SERVICE TOPIC MESSAGE_TYPE SERVICE_PART pattern ["when" "(" expression ")"] -> service_trigger
       | EVERY DURATION                         -> timer
pattern: QUOTE "{" [fields] "}" QUOTE
fields: field ("," field)* [","]
field: path ":" NAME                              -> bind
     | path ":" constant                          -> constrain
     | path ":" "{" [fields] "}"                  -> nest
path: path_step ("." path_step)*
path_step: NAME ["[" NUMBER "]"]
?constant: NUMBER -> number
         | "-" NUMBER -> negative
         | "+" NUMBER -> number
         | string | character
         | NAME ("::" NAME)+                      -> name

safe: SAFE MESSAGE_TYPE "{" [fields] "}" ON TOPIC EVERY DURATION ";"
    | SAFE "{" "}" ON TOPIC EVERY DURATION ";"      -> typed_safe
withhold: WITHHOLD TOPIC FROM (string ("," string)* | NAME) WHILE NAME ";"

property: NAME ":" FORMULA handler*
handler: AT CATEGORY block

// Types
type: qualifier* core qualifier*
core: BUILTIN+
    | BUILTIN+ "*"                                -> pointer
    | scoped                                      -> named
    | MESSAGE_TYPE                                -> message
    | vector
    | "auto"                                      -> automatic
vector: VECTOR "<" type ">"
    | VECTOR "<" VECTOR "<" type ">>"             -> vector_of_vectors
!qualifier: "const" | "constexpr" | "static" | "volatile" | "inline"
scoped: ["::"] NAME ("::" NAME)*

// Statements
block: "{" statement* "}"
?statement: block
    | declaration ";"
    | expression ";"                              -> evaluate
    | ";"                                         -> nothing
    | IF "(" expression ")" statement ["else" statement]          -> if_
    | WHILE "(" expression ")" statement                          -> while_
    | DO statement "while" "(" expression ")" ";"                 -> do_
    | FOR "(" for_start [expression] ";" [expression] ")" statement -> for_
    | FOR "(" type NAME ":" expression ")" statement              -> range_for
    | RANGE_FOR "(" type "&" NAME ":" expression ")" statement    -> range_for_reference
    | SWITCH "(" expression ")" "{" case* "}"                     -> switch
    | BREAK ";"                                   -> break_
    | CONTINUE ";"                                -> continue_
    | RETURN [expression] ";"                     -> return_
    | DROP ";"                                    -> drop
    | STOP ";"                                    -> stop
    | RESET ";"                                   -> reset
    | DELETE ["[" "]"] expression ";"             -> delete
    | PUBLISH "(" (TOPIC | STRING) "," (MESSAGE_TYPE | STRING) "," assignment ")" ";" -> publish
    | CALL "(" (TOPIC | STRING) "," (MESSAGE_TYPE | STRING) "," assignment ")" ";" -> call_service
?for_start: declaration ";" | expression ";" -> evaluate | ";" -> nothing
case: CASE conditional ":" statement*
    | DEFAULT ":" statement*                      -> default
declaration: type declarator ("," declarator)*
shared: type plain_declarator ("," declarator)*   -> declaration
      | type made ("," declarator)*               -> declaration
made: NAME "(" literals ")"                       -> constructed
literals: literal ("," literal)*                  -> arguments
?literal: NUMBER -> number
        | MINUS number                            -> prefix
        | string | character
        | scoped -> name
number: NUMBER
?declarator: plain_declarator
    | NAME "(" arguments ")"                      -> constructed
plain_declarator: NAME
    | NAME "=" initializer                        -> initialized
    | NAME "{" [elements] "}"                     -> braced
    | NAME "[" [expression] "]"                   -> sized
    | NAME "[" [expression] "]" "=" "{" [elements] "}"            -> sized_initialized
    | NAME "[" [expression] "]" "=" assignment    -> sized_assigned
?initializer: assignment | elements_in_braces
elements_in_braces: LBRACE [elements] "}"
elements: initializer ("," initializer)* [","]

// Expressions, loosest first
?expression: assignment | assignment ("," assignment)+ -> sequence
?assignment: conditional
    | unary ASSIGN assignment                     -> assign
    | unary "=" initializer                       -> set
?conditional: or | or "?" expression ":" assignment
?or: and | or OR and                              -> binary
?and: bit_or | and AND bit_or                     -> binary
?bit_or: bit_xor | bit_or "|" bit_xor             -> bit_or_
?bit_xor: bit_and | bit_xor "^" bit_and           -> bit_xor_
?bit_and: equality | bit_and "&" equality         -> bit_and_
?equality: relation | equality EQUALITY relation  -> binary
?relation: shift | relation RELATION shift        -> binary
    | relation "<" shift                          -> less
    | relation ">" shift                          -> greater
?shift: sum | shift "<<" sum                      -> shift_left
    | shift ">>" sum                              -> shift_right
?sum: product | sum "+" product                   -> add
    | sum "-" product                             -> subtract
?product: unary | product "*" unary               -> multiply
    | product "/" unary                           -> divide
    | product "%" unary                           -> remainder
?unary: postfix
    | NOT unary                                   -> prefix
    | MINUS unary                                 -> prefix
    | PLUS unary                                  -> prefix
    | INCREMENT unary                             -> step_before
    | LPAR BUILTIN+ ")" unary                     -> cast
    | LPAR FIXED ")" unary                        -> cast
?postfix: primary
    | postfix "[" expression "]"                  -> index
    | postfix "." NAME                            -> member
    | postfix "(" [arguments] ")"                 -> call
    | postfix INCREMENT                           -> step_after
?primary: NUMBER -> number
    | string | character
    | scoped -> name
    | LPAR expression ")"                         -> parenthesis
    | BUILTIN+ "(" [arguments] ")"                -> convert
    | vector "(" [arguments] ")"                  -> construct_vector
    | vector "{" [elements] "}"                   -> construct_elements
    | CAST "<" type ">" "(" expression ")"        -> static_cast
    | NEW BUILTIN+ "[" expression "]"             -> new
    | LIMITS "<" type ">" "::" NAME "(" ")"       -> limit
arguments: argument ("," argument)*
?argument: assignment | elements_in_braces
string: STRING+
character: CHARACTER

// Tokens
NAME: /[A-Za-z_][A-Za-z_0-9]*/
MODIFIER.5: /<WORD>(?=<GAP>+(<WORD><GAP>+)*event<GAP>+[A-Za-z_])/
CATEGORY: /[A-Za-z_][A-Za-z_0-9]*/
BUILTIN.3: /(void|bool|char|short|int|long|float|double|signed|unsigned)(?!\w)/
FIXED.4: /(std\s*::\s*)?(u?int(8|16|32|64)_t|size_t)(?=\s*\))/
VECTOR.3: /(std\s*::\s*)?vector(?=\s*<)/
LIMITS.3: /(std\s*::\s*)?numeric_limits(?=\s*<)/
CAST: "static_cast"
NEW: "new"
DELETE: "delete"
IF: "if"
WHILE: "while"
DO: "do"
FOR: "for"
RANGE_FOR.4: /for(?=<GAP>*\([^;()?=]*&<GAP>*[A-Za-z_]\w*<GAP>*:(?!:))/
SWITCH: "switch"
CASE: "case"
DEFAULT: "default"
BREAK: "break"
CONTINUE: "continue"
RETURN: "return"
DROP: "DROP"
STOP.5: /STOP(?=<GAP>*;)/
RESET: "__RESET"
PUBLISH: "PUBLISH"
ORDER.5: /order(?=<GAP>+[A-Za-z_]\w*<GAP>*[<;])/
_PRESET.5: /preset(?=<GAP>+[A-Za-z_]\w*<GAP>+\d)/
ON_OR_OFF.5: /(on|shadow|off)(?=<GAP>*\{)/
_ROLE.5: /role(?=<GAP>+[A-Za-z_]\w*<GAP>*\()/
ROW_TYPE.5: /[A-Za-z]\w*\/[A-Za-z]\w*(?=<GAP>*['(])/
CANCEL: "cancel"
GIVEN_KIND.5: /(corners|joints|entries|hosts|time)(?!\w)/
GIVEN.5: /given(?!\w)/
TOPIC_WORD.5: /topic(?!\w)/
GIVEN_VALUE.9: /[^;={}]+/
SAFE.5: /safe(?=<GAP>+[A-Za-z]\w*(\/|::)[A-Za-z]\w*<GAP>*\{|<GAP>*\{<GAP>*\}<GAP>*on(?!\w))/
ON.5: /on(?!\w)/
WITHHOLD.5: /withhold(?=<GAP>+[~\/A-Za-z_][\w\/]*<GAP>+from(<GAP>*"|<GAP>+[A-Za-z_]\w*<GAP>+while(?!\w)))/
FROM.5: /from(?=<GAP>*")|from(?=<GAP>+[A-Za-z_]\w*<GAP>+while(?!\w))/
CALL.3: /CALL(?=<GAP>*\(<GAP>*["\/~])/
SERVICE.5: /service(?!\w)/
EVERY.5: /every(?!\w)/
SERVICE_PART.5: /(request|response)(?!\w)/
TOPIC.2: /\/\w+(\/\w+)*\/?|~?[A-Za-z_]\w*(\/\w+)*\/?/
MESSAGE_TYPE.4: /[A-Za-z]\w*\/[A-Za-z]\w*(?=<GAP>*['\u2018\u2019\u00b4`{>\],&]|<GAP>+[A-Za-z_])/
    | /[A-Za-z]\w*::[A-Za-z]\w*(?=<GAP>*['\u2018\u2019\u00b4`,{]|<GAP>+(request|response)(?!\w))/
DURATION: /(\d+(\.\d*)?|\.\d+)\s*[A-Za-z]*/
QUOTE: /['\u2018\u2019\u00b4`]/
FORMULA.9: /(?:(?!<NEXT>)[^@{}\/]|<AT>|<CONDITION>|\/(?![\/*])|\/\/[^\n]*|\/\*(?:[^*]|\*(?!\/))*\*\/)+/
AT: "@"
NUMBER: /(0[xX][0-9A-Fa-f]+|(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)[uUlLfF]*/
STRING: /"(\\.|[^"\\\n])*"|“(\\.|[^”\\\n])*”/
CHARACTER: /'(\\[0-7]{1,3}|\\x[0-9A-Fa-f]{1,2}|\\[^\n]|[^'\\\n])'/
ASSIGN: /([+\-*\/%&|^]|<<|>>)=/
OR: "||"
AND: "&&"
EQUALITY: /[=!]=/
RELATION: /[<>]=/
NOT: /[!~]/
MINUS: "-"
PLUS: "+"
INCREMENT.3: /\+\+|--/
LPAR: "("
LBRACE: "{"
COMMENT.10: /\/\/[^\n]*|\/\*(?:[^*]|\*(?!\/))*\*\//
PREAMBLE.10: /#(\\\r?\n|[^\n])*/
%ignore /[ \t\r\n\f\v\ufeff]+/
%ignore COMMENT
%ignore PREAMBLE
"""

_NEXT = rf"(?<!\w)(?:(?i:{'|'.join(LOGICS)}|dl)\s*:(?!:)|(?:{_WORD}\s+)*event\s+[A-Za-z_]\w*\s*\()"

GRAMMAR = (
    _GRAMMAR.replace("<CONDITION>", _CONDITION)
    .replace("<NEXT>", _NEXT)
    .replace("<AT>", _AT)
    .replace("<GAP>", _GAP)
    .replace("<WORD>", _WORD)
)


MAX_CHARACTERS = 128 * 1024
MAX_DEPTH = 100

_NO_TEXT = re.compile("[\ud800-\udfff]")
"""Surrogates, which replace bytes that are not UTF-8."""

# Lines of the C++ preprocessor are ignored where the meaning stays the same.
_PREPROCESSED = re.compile(
    r"""(?P<comment>//[^\n]*|/\*(?:[^*]|\*(?!/))*(?:\*/|\Z))
    |\#[ \t]*(?P<word>if|ifn?def|el(?:se|if)|endif|define|undef|include|pragma|error|warning|line)\b
        [ \t]*(?P<macro>\w+)?(?:\\\r?\n|[^\n])*
    |(?P<name>[A-Za-z_]\w*)
    |"(?:\\[^\n]|[^"\\\n])*"?|'(?:\\[^\n]|[^'\\\n])'|\d[\w.]*|[^\s\ufeff]""",
    re.VERBOSE,
)
_CONDITIONS = ("if", "ifdef", "ifndef")


class _ForbiddenWordError(Exception):
    def __init__(self, token: Token) -> None:
        super().__init__(str(token))
        self.token = token


def parse(text: str, file: str) -> tree.SpecificationFile:
    """Return the tree of a file; `file` is its name in positions. Raises `SpecificationError`."""
    start = Position(file, 1, 1)
    if len(text) > MAX_CHARACTERS:
        raise SpecificationError.at(
            start, f"the file has more than {MAX_CHARACTERS // 1024} Ki characters; split it into several"
        )
    broken = _NO_TEXT.search(text)
    if broken is not None:
        raise SpecificationError.at(
            start.within(text, broken.start()), "these bytes are not UTF-8; save the file as UTF-8"
        )
    _check_directives(text, file)
    result = make_specifications(_build(text, file), roles)
    if not result.specifications and not result.orders:
        raise SpecificationError.at(
            start, "there is no specification in this file; write `name() { event … }`"
        )
    return result


def _build(text: str, file: str) -> tree.TypedFile:
    parsed = _parse(text, file)
    _check_depth(parsed, file)
    builder = TreeBuilder(file, text)
    result: tree.TypedFile = builder.transform(parsed)
    check(builder)
    return result


@lru_cache(maxsize=1)
def roles() -> Mapping[str, tree.RoleDeclaration]:
    """Return the roles that every file has."""
    return {role.name: role for role in _build(ROLES, "the roles").roles}


def _parse(text: str, file: str) -> Tree[Token]:
    try:
        return _parser().parse(text)
    except _ForbiddenWordError as error:
        begin, message = explain_misplaced(text, error.token.start_pos or 0, str(error.token))
        raise SpecificationError.at(start_of(file, text, begin), message) from None
    except UnexpectedInput as error:
        at_end = isinstance(error, UnexpectedToken) and error.token.type == "$END"
        offset = len(text) if at_end or error.pos_in_stream is None else error.pos_in_stream
        if text[offset - 1 : offset + 1] == "->":
            offset -= 1
        early = _ended_early(text, offset)
        if early is not None:
            advice = (
                "a comment ends at the first `*/`: here in `/*/`; write a space before its `/`, or use `//`"
            )
            raise SpecificationError.at(start_of(file, text, early), advice) from None
        begin, message = describe(text, offset, _accepted_tokens(error))
        raise SpecificationError.at(start_of(file, text, begin), message) from None


def _ended_early(text: str, offset: int) -> int | None:
    comments = [piece for piece in _PREPROCESSED.finditer(text, 0, offset) if piece["comment"]]
    last = comments[-1] if comments else None
    if last is None or not last[0].startswith("/*") or not last[0][2:].endswith("/*/"):
        return None
    return last.end() - 3 if text[last.end() : offset].count("\n") <= 1 else None


def start_of(file: str, text: str, offset: int) -> Position:
    if offset >= len(text):
        offset = len(text.rstrip())
    return Position(file, 1, 1).within(text, offset)


def _accepted_tokens(error: UnexpectedInput) -> set[str]:
    if isinstance(error, UnexpectedToken):
        return set(error.accepts)
    return set(error.allowed or ()) if isinstance(error, UnexpectedCharacters) else set()


def _check_depth(parsed: Tree[Token], file: str) -> None:
    waiting: list[tuple[Tree[Token], int]] = [(parsed, 0)]
    while waiting:
        node, depth = waiting.pop()
        if depth > MAX_DEPTH:
            position = Position(file, node.meta.line, node.meta.column)
            raise SpecificationError.at(
                position,
                f"nested more than {MAX_DEPTH} deep; use variables for parts of it, or helper functions",
            )
        waiting += [(child, depth + 1) for child in node.children if isinstance(child, Tree)]


def _allow(token: Token) -> Token:
    if token in FORBIDDEN or token in RESERVED:
        raise _ForbiddenWordError(token)
    return token


@lru_cache(maxsize=1)
def _parser() -> Lark:
    return Lark(
        GRAMMAR,
        start="file",
        parser="lalr",
        propagate_positions=True,
        maybe_placeholders=True,
        lexer_callbacks={"NAME": _allow},
    )


def _check_directives(text: str, file: str) -> None:
    macros: dict[str, int] = {}
    used: set[str] = set()
    conditions: list[tuple[str, int]] = []
    for piece in _PREPROCESSED.finditer(text):
        word, place = piece["word"], piece.start()
        if word in _CONDITIONS:
            conditions.append((word, place))
        elif word == "include" and (included := re.search(r'"([^"\n]*\.rv)"', piece[0])):
            instead = f"load {included[1]} with this file: its variables are seen here, but not its functions"
            raise _directive_error(text, file, place, f'#include "{included[1]}"', instead)
        elif word == "endif":
            del conditions[-1:]
        elif word == "define":
            macros.setdefault(piece["macro"] or "", place)
        elif not word and not piece["comment"]:
            if conditions:
                word, place = conditions[0]
                raise _directive_error(
                    text, file, place, f"#{word}", "keep the lines that you want, without conditions"
                )
            if piece["name"]:
                used.add(piece["name"])
    for macro, place in macros.items():
        if macro in used:
            advice = f"write `const double {macro} = …;`, or a function, into the specification"
            raise _directive_error(text, file, place, f"#define {macro}", advice)


def _directive_error(text: str, file: str, place: int, what: str, instead: str) -> SpecificationError:
    position = Position(file, 1, 1).within(text, place)
    return SpecificationError.at(position, f"`{what}`: there is no preprocessor; {instead}")
