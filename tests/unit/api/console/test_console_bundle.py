import pytest

from appliance.api.console.console_bundle import ModuleError, join_modules, join_styles

HEAD = "const $m=[],$late=async(from)=>(await import(from)).load($m,$late);\n"


def test_only_comments_and_indentation_are_removed() -> None:
    kept = "[\"// {\",'/* ( */',/[/`]\\/\\/{/g,`//\n   ${`}${1 / 2} /* b */`} `]"
    text = f"const a = {kept};  // c\n  let b  /* d */ = 1\n  /* e\n */ a / a / 2 + +b;\n\n"
    assert join_modules({"a.js": text}, "a.js")["a.js"] == (
        f"{HEAD}$m[0]??=(()=>{{const a={kept};let b=1\na / a / 2 + +b;\nreturn {{}};}})();\n"
    )


@pytest.mark.parametrize(
    "kept",
    [
        "t=`${/a  \"/.test(x)}`;", "if(a)b;else /a  \"/.test(x);", "const f=()=>/a  \"/;", "a=(b)/ 2 / c;",
        "function f(){import(SOURCE);}", "f(a.import);",
    ],
)  # fmt: skip
def test_a_slash_is_read_as_its_place_demands(kept: str) -> None:
    joined = join_modules({"a.js": kept}, "a.js")["a.js"]
    assert joined == f"{HEAD}$m[0]??=(()=>{{{kept}\nreturn {{}};}})();\n"


@pytest.mark.parametrize("end", ["\n", "\r", "\u2028", "\u2029"])
def test_a_comment_ends_with_its_line(end: str) -> None:
    assert "{a\nb;" in join_modules({"a.js": f"a // c{end}b;"}, "a.js")["a.js"]


@pytest.mark.parametrize(
    ("sources", "error"),
    [
        ({"a.js": 'import x from "./b.js";'}, "a.js:1: unsupported in a module"),
        ({"a.js": '\nimport * as x from "./b.js";'}, "a.js:2: unsupported in a module"),
        ({"a.js": 'import "./b.js";'}, "a.js:1: unsupported in a module"),
        ({"a.js": 'import { b } from "./b.js"'}, "a.js:1: unsupported in a module"),
        ({"a.js": 'import { default } as x } from "./b.js";'}, "a.js:1: unexpected }"),
        ({"a.js": 'import { b } from "./b.js";'}, "there is no file b.js, imported by a.js"),
        ({"a.js": 'import { b } from "./b.js";', "b.js": ""}, "a.js:1: b.js does not export b"),
        (
            {"a.js": 'import { b } from "./b.js";', "b.js": 'import { a } from "./a.js";'},
            "modules import each other: a.js, b.js, a.js",
        ),
        ({"a.js": "export default 1;"}, "a.js:1: unsupported in a module"),
        ({"a.js": "export let a = 1;"}, "a.js:1: unsupported in a module"),
        ({"a.js": "export const { a } = b;"}, "a.js:1: unsupported in a module"),
        ({"a.js": "await a;"}, "a.js:1: unsupported in a module"),
        ({"a.js": "\n'open"}, "a.js:2: unclosed string"),
        ({"a.js": "\n`open ${1}"}, "a.js:2: unclosed string"),
        ({"a.js": "/* open"}, "a.js:1: unclosed string"),
        ({"a.js": "a = /open"}, "a.js:1: unclosed string"),
        ({"a.js": "f(() => {"}, "a.js:1: unclosed {"),
        ({"a.js": "f(]"}, "a.js:1: unexpected ]"),
        ({"a.js": "\nif (a) /b  c/.test(d);"}, "a.js:2: put a regular expression in brackets"),
        ({"a.js": "function f() { }\n/b  c/.test(d);"}, "a.js:2: put a regular expression in brackets"),
        ({"a.js": 'const f = () => import("./b.js");'}, "there is no file b.js, imported by a.js"),
        (
            {"a.js": "function f() { return import(`../${b}.js`); }"},
            "a.js:1: unsupported in a module of the console: import(`../${",
        ),
        (
            {
                "a.js": 'import { b } from "./b.js";\nconst f = () => import("./b.js");',
                "b.js": "export const b = 1;",
            },
            "b.js is loaded with the page, and cannot be loaded late",
        ),
        ({"a.js": "function f() { return import.meta.url; }"}, "a.js:1: unsupported in a module"),
    ],
)
def test_unsupported_modules_are_an_error(sources: dict[str, str], error: str) -> None:
    with pytest.raises(ModuleError) as raised:
        join_modules(sources, "a.js")
    assert str(raised.value).startswith(error)


def test_styles_are_joined_in_the_order_of_their_imports() -> None:
    sources = {"c/a.css": '/* a */\n@import "./b.css";\na {\n  top: 0;\n}\n', "c/b.css": "b { top: 1px; }\n"}
    assert join_styles(sources, "c/a.css") == "b { top: 1px; }\na {\ntop: 0;\n}\n"
    with pytest.raises(ModuleError, match=r"there is no file c/b\.css"):
        join_styles({"c/a.css": sources["c/a.css"]}, "c/a.css")
    with pytest.raises(ModuleError, match=r"c/a\.css: unsupported import"):
        join_styles({"c/a.css": "@import url(./b.css);"}, "c/a.css")
    with pytest.raises(ModuleError, match=r"import each other: c/a\.css, c/b\.css, c/a\.css"):
        join_styles(sources | {"c/b.css": '@import "./a.css";'}, "c/a.css")


def test_a_late_module_shares_the_state_of_the_page() -> None:
    """A module of the page is used there, and one that two late scripts need is run by the first of them."""
    sources = {
        "js/main.js": (
            'import { state } from "./state.js";\nopen = () => import("#console/x.js") || import("../y.js");\n'
        ),
        "js/state.js": "export const state = {};\n",
        "js/x.js": (
            'import { state } from "./state.js";\nimport { a } from "../a.js";\nexport const x = [state, a];\n'
        ),
        "y.js": 'import { a } from "./a.js";\nexport const y = a;\n',
        "a.js": 'export const a = () => import("./y.js");\n',
    }
    scripts = join_modules(sources, "js/main.js", "/files/")
    assert next(iter(scripts)) == "js/main.js"
    assert 'open=()=>$late("/files/js/x.js")||$late("/files/y.js");' in scripts["js/main.js"]
    assert scripts["js/x.js"].count("??=") == scripts["y.js"].count("??=") == 2
    assert "state=$m[0].state,a=$m[2].a;" in scripts["js/x.js"]
    assert "$m[2]??=" in scripts["y.js"]
    assert scripts["y.js"].startswith("export const load=($m,$late)=>{\n")
    assert scripts["y.js"].endswith("return $m[4];};\n")
