"""URScript out of a stream of bytes."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_twin.wire.ur.moves import Move
from sim_twin.wire.ur.program import ScriptError
from sim_twin.wire.ur.script import PoseValue, Script, ScriptReader, parse_statement
from tests.sim_twin.wire.ur.control_script import control_script

PROGRAM = b"def job():\n  movej([0,-1,1,0,0,0], a=1.4, v=0.5)\n\tset_digital_out(1, True)\n  # done\nend\n"
SECONDARY = b'sec note():\n  textmsg("hello")\nend\n'
LINE = b"stopl(2.0)\n"


def names(scripts: list[Script]) -> list[str]:
    return [script.name for script in scripts]


def test_programs_secondary_programs_and_lines_are_told_apart() -> None:
    scripts = ScriptReader().feed(PROGRAM + b"\n# between\n" + SECONDARY + LINE)
    assert names(scripts) == ["job", "note", "unnamed"]
    assert [script.secondary for script in scripts] == [False, True, False]
    assert [statement.name for statement in scripts[0].statements()] == ["movej", "set_digital_out"]
    assert scripts[0].statements()[0].keywords == {"a": 1.4, "v": 0.5}
    assert [statement.name for statement in scripts[2].statements()] == ["stopl"]


def test_a_program_is_complete_with_its_end_only() -> None:
    reader = ScriptReader()
    assert reader.feed(PROGRAM[:-4]) == []
    assert reader.feed(b"end") == []
    assert names(reader.feed(b"\n")) == ["job"]


@given(st.lists(st.sampled_from([PROGRAM, SECONDARY, LINE, b"\r\n"]), max_size=5), st.lists(st.integers(0, 400)))
def test_it_does_not_matter_how_the_stream_is_cut(parts: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(parts)
    whole = ScriptReader().feed(stream)
    reader = ScriptReader()
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert [script for a, b in itertools.pairwise(edges) for script in reader.feed(stream[a:b])] == whole


@given(st.binary(max_size=400))
def test_any_bytes_give_programs_or_a_script_error(data: bytes) -> None:
    for script in ScriptReader().feed(data + b"\n"):
        try:
            script.statements()
            script.path()
        except ScriptError as error:
            assert str(error)


def test_a_program_without_an_end_is_given_up() -> None:
    reader = ScriptReader()
    reader.feed(b"def endless():\n" + b"  sync()\n" * 100_000)
    with pytest.raises(ScriptError, match="more than"):
        reader.feed(b"  sync()\n" * 100_000)
    assert names(reader.feed(LINE)) == ["unnamed"]


@pytest.mark.parametrize(
    ("text", "arguments"),
    [
        ("f(1, -2.5, True)", (1, -2.5, True)),
        ("f(p[0.1,0,-0.2,0,3.14,0])", (PoseValue((0.1, 0, -0.2, 0, 3.14, 0)),)),
        ("f([1,2], [p[1,2,3,4,5,6]])", ([1, 2], [PoseValue((1, 2, 3, 4, 5, 6))])),
        ("f(0 +24, 1/4, 2*3-1)", (24, 0.25, 5)),
        ('f("a, b)")', ("a, b)",)),
    ],
)
def test_plain_values_are_understood(text: str, arguments: tuple[object, ...]) -> None:
    statement = parse_statement(text, 1)
    assert statement is not None
    assert statement.arguments == arguments


@pytest.mark.parametrize(
    "text", ["if x:", "a = 1", "f(x)", "f(g(1))", "f(1/0)", "movej(", "while True:", "f(1)(2)", "p[1,2](3)", "f(*[1])"]
)
def test_what_is_not_plain_is_refused_with_its_line(text: str) -> None:
    with pytest.raises(ScriptError, match="line 7"):
        parse_statement(text, 7)


def test_the_control_script_tells_its_offset_and_its_path() -> None:
    path = (
        "\tsignal_async_progress(0)\n\tmovej([0,1,2,3,4,5],a=1.4,v=1,r=0.02)\n"
        "\tsignal_async_progress(1)\n\tmovel(p[0.1,0.2,0.3,0,0,1],a=1.2,v=0.25,r=0)\n"
    )
    [script] = ScriptReader().feed(control_script(path, offset=24))
    assert script.is_control_loop
    assert script.register_offset == 24
    assert script.path() == [
        Move((0, 1, 2, 3, 4, 5), is_pose=False, straight=False, speed=1, acceleration=1.4, blend_m=0.02, number=0),
        Move((0.1, 0.2, 0.3, 0, 0, 1), is_pose=True, straight=True, speed=0.25, acceleration=1.2, number=1),
    ]
    [plain] = ScriptReader().feed(control_script())
    assert plain.path() == []


def test_the_script_that_ur_rtde_uploads_is_recognised() -> None:
    script_client = pytest.importorskip("script_client")
    text = "def rtde_control():\n" + script_client.ScriptClient("unused", 5, 12).getScript() + "end\n"
    [script] = ScriptReader().feed(text.encode())
    assert script.is_control_loop
    assert script.path() == []
