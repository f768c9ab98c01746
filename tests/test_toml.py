from __future__ import annotations

import pytest

from gz_onboard.errors import InputError
from gz_onboard.toml import Table

TEXT = """\
name = "x"
list = [
  [1.0, 2.0],
  [3.0, 4.0],
]
number = 3
# value = 7

[a]
value = 1
unit = "V"

[a.inner]
unit = "A"

[b]
inline = { value = 2, unit = "m" }
dotted.value = 3
"quoted key" = 4

[c.d]
value = "text"

[many]
numbers = [1, 2.5]
bad = [1, "2"]
infinite = [1.0, inf]
empty = []
grid = [[1, 2], [3]]
grid2 = [[1, 2], [3, 4]]
half = 0.5
"""
TEXT += f"huge = 1{'0' * 400}\nhexadecimal = 0x{'f' * 5000}\n"


@pytest.fixture
def table(tmp_path):
    file = tmp_path / "t.toml"
    file.write_text(TEXT, encoding="utf-8")
    return Table.read(file)


def line_of(error: InputError) -> int | None:
    part = str(error).split(".toml")[1]
    return int(part[1:].split(":")[0]) if part[1:2].isdigit() else None


@pytest.mark.parametrize(
    ("path", "key", "line"),
    [
        ("", "name", 1),
        ("", "list", 2),
        ("", "number", 6),
        ("", "absent", None),
        ("", "value", None),  # stands in other tables only
        ("", "a", 9),
        ("a", "", 9),
        ("a", "value", 10),
        ("a", "absent", 9),
        ("a", "inner", 13),
        ("a.inner", "unit", 14),
        ("a.inner", "value", 13),  # not the value of [a]
        ("b", "inline", 17),
        ("b.inline", "value", 17),
        ("b.inline", "", 17),
        ("b.dotted", "value", 18),
        ("b", "quoted key", 19),
        ("c", "d", 21),
        ("c", "", 21),
        ("c.d", "value", 22),
        ("none.at.all", "value", None),
    ],
)
def test_a_complaint_names_the_line(table, path, key, line):
    for part in filter(None, path.split(".")):
        table = table.table(part)
    error = table.error("is wrong", key)
    assert line_of(error) == line
    assert str(error).endswith(f": {'.'.join(filter(None, [path, key]))}: is wrong".replace(": : ", ": "))


@pytest.mark.parametrize(
    ("ask", "parts"),
    [
        (lambda t: t.text("number"), [":6:", "number", "must be a string", "3"]),
        (lambda t: t.text("absent"), ["absent", "is missing"]),
        (lambda t: t.text("name", choices=["xx", "abc"]), [":1:", "'x'", "xx, abc", "did you mean 'xx'"]),
        (lambda t: t.number("name"), [":1:", "name", "must be a number", "'x'"]),
        (lambda t: t.number("absent"), ["absent", "is missing"]),
        (lambda t: t.number("number", low=4, high=9), [":6:", "3 is outside 4 to 9"]),
        (lambda t: t.table("name"), [":1:", "must be a table", "'x'"]),
        (lambda t: t.numbers("name"), [":1:", "list of numbers"]),
        (lambda t: t.numbers("absent"), ["absent", "is missing"]),
        (lambda t: t.table("many").numbers("bad"), [":26:", "many.bad", "must be a number", "'2'"]),
        (lambda t: t.table("many").numbers("infinite"), [":27:", "many.infinite", "must be a finite number", "inf"]),
        (lambda t: t.table("many").numbers("empty"), [":28:", "many.empty", "list of numbers"]),
        (lambda t: t.table("many").integer("half", 0, 9), ["half", "whole number", "0.5"]),
        (lambda t: t.table("many").number("huge"), ["huge", "must be a finite number"]),
        (lambda t: t.table("many").number("hexadecimal"), ["hexadecimal", "thousands of digits"]),
        (lambda t: t.texts("name", "words"), [":1:", "name", "must be a list of words", "'x'"]),
        (lambda t: t.texts("absent", "words"), ["absent", "is missing"]),
        (lambda t: t.rows("absent", 2, "x and y", 0, 9), ["absent", "is missing"]),
        (lambda t: t.table("many").rows("grid", 2, "x and y", 0, 9), ["many.grid", "2 numbers (x and y), not [3]"]),
        (lambda t: t.table("many").rows("grid2", 2, "x and y", 0, 3), ["many.grid2", "4 is outside 0 to 3"]),
        (lambda t: t.table("a").only(["value", "units"]), [":11:", "a.unit", "unknown key", "did you mean 'units'"]),
    ],
)
def test_what_is_wrong_is_said(table, ask, parts):
    with pytest.raises(InputError) as caught:
        ask(table)
    assert str(table.file) in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


def test_what_is_right_is_given(table):
    assert table.text("name") == "x"
    assert table.text("absent", "default") == "default"
    assert table.number("number") == 3.0
    assert table.number("absent", 4.0) == 4.0
    assert table.table("many").numbers("numbers") == (1.0, 2.5)
    assert table.table("absent").values == {}
    table.table("a").only(["value", "unit", "inner", "more"])


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b"a = 1\nb = \n", ["not valid TOML", "line 2"]),
        (b"a = 1\na = 2\n", ["not valid TOML", "line 2"]),
        (b"a = '\xff'\n", ["not text in utf-8"]),
        (b"a = " + b"[" * 5000, ["not valid TOML", "brackets"]),
        (b"a = " + b"9" * 5000, ["not valid TOML"]),
        (b"# " + b"x" * 1_000_000, ["larger than 1 MB"]),
    ],
)
def test_a_file_that_is_not_toml(tmp_path, content, parts):
    (tmp_path / "t.toml").write_bytes(content)
    with pytest.raises(InputError) as caught:
        Table.read(tmp_path / "t.toml")
    for part in ["t.toml", *parts]:
        assert part in str(caught.value)
