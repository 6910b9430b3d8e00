"""The grammar of ``.rv`` files, for lark's LALR(1) parser with its contextual lexer.

The lexer knows which tokens may follow, so `/landshark/scan` is a topic where a topic is allowed and two divisions
elsewhere. A C++ parser needs the declared types to distinguish a declaration from an expression; here two names in a
row are a declaration.
"""

from rosmop.logics.catalogue import LOGICS

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
GIVEN_KIND.5: /(corners|joints|hosts|time)(?!\w)/
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
TOPIC.2: /[~\/]?[A-Za-z_][\w]*(\/\w+)*\/?/
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
