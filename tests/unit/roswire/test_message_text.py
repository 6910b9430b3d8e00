import pytest
from hypothesis import given
from hypothesis import strategies as st

from roswire.errors import DefinitionError
from roswire.message_text import Constant, Field, parse_message, parse_service, split_full_text
from tests.unit.roswire.tables import rows

RULE = "=" * 80


def test_fields_and_constants_of_every_form() -> None:
    message = parse_message(
        "my_msgs/All",
        "# comment\r\n"
        "Header header # where\n"
        "  \tfloat64[36]  covariance\r\n"
        "time[] stamps\n"
        "Other other\n"
        "geometry_msgs/Point[3] corners\n"
        "string[] names\n"
        "uint8 DEBUG=1#one\n"
        "int8 LOW = -128\n"
        "bool ON=True\n"
        "float32 RATE=0.50\n"
        "string TITLE=  a # b = c  \n",
        "All.msg",
    )
    assert message.fields == (
        Field("std_msgs/Header", "header"),
        Field("float64", "covariance", True, 36),
        Field("time", "stamps", True),
        Field("my_msgs/Other", "other"),
        Field("geometry_msgs/Point", "corners", True, 3),
        Field("string", "names", True),
    )
    assert [field.notation for field in message.fields[1:3]] == ["float64[36]", "time[]"]
    assert message.constants == (
        Constant("uint8", "DEBUG", 1, "1"),
        Constant("int8", "LOW", -128, "-128"),
        Constant("bool", "ON", True, "True"),
        Constant("float32", "RATE", 0.5, "0.50"),
        Constant("string", "TITLE", "a # b = c", "a # b = c"),
    )


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        *rows("lines of message definitions that are refused"),
        ("float64 A=" + "1" * 500, "is not of type float64"),
    ],
)
def test_bad_lines_are_refused_with_their_place(line: str, complaint: str) -> None:
    with pytest.raises(DefinitionError, match=complaint) as refused:
        parse_message("a/B", f"int32 first\n\n{line}", "B.msg")
    assert refused.value.source == "B.msg"
    assert refused.value.line == 3 + line.count("\n")
    assert str(refused.value).startswith(f"B.msg:{refused.value.line}: ")


def test_services_are_split_at_the_rule() -> None:
    service = parse_service("a/Add", "int32 x\n--- sum\nint32 y\n", "Add.srv")
    assert (service.request.name, service.response.name) == ("a/AddRequest", "a/AddResponse")
    assert service.request.fields == (Field("int32", "x"),)
    assert service.response.fields == (Field("int32", "y"),)
    with pytest.raises(DefinitionError, match=r"Add\.srv:3: .*is not a field"):
        parse_service("a/Add", "int32 x\n---\nint32\n", "Add.srv")
    for text in ("int32 x\n", "---\n---\n"):
        with pytest.raises(DefinitionError, match="write one between"):
            parse_service("a/Add", text, "Add.srv")


def test_full_texts_are_split_at_their_rules() -> None:
    text = f"B b\n{RULE}\nMSG: a/B\nint32 x\n{RULE}\r\nMSG: c/D\r\nint32 y"
    assert split_full_text("a/A", text) == [("a/A", "B b", 1), ("a/B", "int32 x", 4), ("c/D", "int32 y", 7)]
    assert split_full_text("a/A", "") == [("a/A", "", 1)]
    with pytest.raises(DefinitionError, match="expected 'MSG: package/Type'") as refused:
        split_full_text("a/A", f"int32 x\n{RULE}\nint32 y")
    assert refused.value.line == 3
    with pytest.raises(DefinitionError, match="expected"):
        split_full_text("a/A", RULE)


def test_the_number_of_fields_is_bounded() -> None:
    with pytest.raises(DefinitionError, match="more than 10000 fields"):
        parse_message("a/B", "\n".join(f"int8 f{number}" for number in range(10_001)), "B.msg")


@given(text=st.text(st.sampled_from("int32 string[]=#/\n-abX1\t\u00e9\udce9"), max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    for parse in (
        lambda: parse_message("a/B", text, "B.msg"),
        lambda: parse_service("a/B", text, "B.srv"),
        lambda: split_full_text("a/B", f"{text}\n{RULE}\n{text}"),
    ):
        try:
            parse()
        except DefinitionError as error:
            assert str(error).isprintable()
