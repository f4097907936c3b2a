"""URScript out of a stream of bytes."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_twin.wire.ur.moves import Move
from sim_twin.wire.ur.program import ScriptError
from sim_twin.wire.ur.script import PoseValue, parse_statement
from sim_twin.wire.ur.script_reader import (
    MAX_LINE_BYTES,
    MAX_PROGRAM_BYTES,
    MAX_PROGRAM_LINES,
    Command,
    ControlScript,
    Received,
    Refused,
    Script,
    ScriptReader,
)
from tests.sim_twin.wire.ur.control_script import control_script
from tests.sim_twin.wire.ur.stepped_controller import received

MOVE = b"  movej([0,-1,1,0,0,0], a=1.4, v=0.5)\n"
PROGRAM = b"def job():\n" + MOVE + b"\tset_digital_out(1, True)\n  # done\nend\n"
SECONDARY = b'sec note():\n  textmsg("hello")\nend\n'
LINE = b"stopl(2.0)\n"


def shown(found: list[Received]) -> list[tuple[str, list[str]] | tuple[int, str] | str]:
    """Programs by name and statements, refusals by line and words, and what else there is."""
    result: list[tuple[str, list[str]] | tuple[int, str] | str] = []
    for one in found:
        match one:
            case Script(name):
                result.append((name, [statement.name for statement in one.statements()]))
            case Refused(error):
                result.append((error.line, error.words))
            case Command(words):
                result.append(words)
            case ControlScript():
                result.append("control script")
    return result


def test_programs_secondary_programs_and_lines_are_told_apart() -> None:
    scripts = received(PROGRAM + b"\n# between\n" + SECONDARY + LINE)
    assert shown(scripts) == [("job", ["movej", "set_digital_out"]), ("note", ["textmsg"]), ("unnamed", ["stopl"])]
    assert [script.secondary for script in scripts if isinstance(script, Script)] == [False, True, False]
    assert isinstance(scripts[0], Script)
    first, second = scripts[0].statements()
    assert first.keywords == {"a": 1.4, "v": 0.5}
    assert (first.line, second.line) == (2, 3)


def test_a_program_is_complete_with_its_end_only() -> None:
    reader = ScriptReader()
    assert received(PROGRAM[:-4], reader) == []
    assert received(b"end", reader) == []
    assert shown(received(b"\n", reader)) == [("job", ["movej", "set_digital_out"])]


@pytest.mark.parametrize(
    "text",
    [
        b"def job(): # a comment\n  stopj(2) # another, with 'quotes\nend # and here\n",
        b"def job():\r\n  stopj(2)   \r\n\r\n\tend\t \r\n",
        b"   def job ( ) :\n stopj(2)\n   end\n",
        b"\n\n# before\ndef job():\nstopj(2)\nend\n# after\n",
    ],
)
def test_comments_blanks_and_indents_mean_nothing(text: bytes) -> None:
    assert shown(received(text + LINE)) == [("job", ["stopj"]), ("unnamed", ["stopl"])]


def test_a_sign_in_a_string_begins_no_comment() -> None:
    [script] = received(b'textmsg("end # of: ", 1) # and here\n')
    assert isinstance(script, Script)
    [statement] = script.statements()
    assert statement.arguments == ("end # of: ", 1)


def test_halt_is_a_keyword() -> None:
    assert shown(received(b"def p():\n  halt\n  stopj(2)\nend\nhalt # now\n")) == [
        ("p", ["halt", "stopj"]),
        ("unnamed", ["halt"]),
    ]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (b"def p():\n  def inner():\n    stopj(2)\n  end\n  stopj(3)\nend\n", 2),
        (b"def p(x):\n  stopj(2)\nend\n", 1),
        (b"def p(x=1):\n  if x > 0:\n    stopj(2)\n  end\nend\n", 1),
        (b"thread t():\n  while True:\n    stopj(2)\n  end\nend\n", 1),
        (b"while True:\n  stopj(2)\nend\n", 1),
        (b"if True:\n  stopj(2)\nelse:\n  stopj(3)\nend\n", 1),
        (b"switch 3:\n  stopj(2)\nend\n", 1),
        (b"def p():\n  stopj(1)\nwhile True:\nstopj(2)\nend\nend\n", 3),
        (b"def p():\n  stopj(1)\n  if True: stopj(2) end\n  stopj(3)\nend\n", 3),
        (b"def p(): stopj(2) end\n", 1),
        (b"def p():\n  stopj(2) end\n", 2),
        (b"def p():\n  stopj(2)\n  x = 1\nend\n", 3),
        (b"sec s(x):\n  stopj(2)\nend\n", 1),
        (b"end\n", 1),
        (b"global x = 1\n", 1),
    ],
)
def test_a_program_that_is_not_understood_is_refused_whole(text: bytes, line: int) -> None:
    refused, after = shown(received(text + LINE))
    assert refused == (line, f"syntax_error_on_line:{line}:{text.decode().splitlines()[line - 1].strip()}:")
    assert after == ("unnamed", ["stopl"])


def test_an_unknown_name_is_refused_before_anything_runs() -> None:
    assert shown(received(b"def p():\n  stopj(2)\n  fly_away(1)\nend\n")) == [
        (3, "compile_error_name_not_found:fly_away:")
    ]


def test_what_a_move_cannot_be_is_refused_before_anything_runs() -> None:
    for wrong in (b"movej([1,2,3])", b"movej([0,0,0,0,0,0], t=3)", b"movel([0,0,0,0,0,0], v=0)"):
        [refused] = received(b"def p():\n  stopj(2)\n  " + wrong + b"\nend\n")
        assert isinstance(refused, Refused)
        assert refused.error.line == 3


def test_the_commands_of_the_client_library() -> None:
    lines = b"power on\npower off\nset robotmode run\nset unlock protective stop\nstop program\n"
    assert [Command(line.decode()) for line in lines.splitlines()] == received(lines)
    assert isinstance(received(b"power up\n")[0], Refused)


@given(
    st.lists(st.sampled_from([PROGRAM, SECONDARY, LINE, b"\r\n", b"x = 1\n", b"power on\n"]), max_size=5),
    st.lists(st.integers(0, 400)),
)
def test_it_does_not_matter_how_the_stream_is_cut(parts: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(parts)
    whole = shown(received(stream))
    reader = ScriptReader()
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert shown([one for a, b in itertools.pairwise(edges) for one in received(stream[a:b], reader)]) == whole


WORDS = st.sampled_from([*rb"def p(): sec s(): if x: end stopj(2) halt # \" ' ( )".split(b" "), b"\n"])


@given(st.one_of(st.binary(max_size=400), st.lists(WORDS, max_size=60).map(b" ".join)))
def test_any_bytes_give_programs_or_a_reason(data: bytes) -> None:
    for one in shown(received(data + b"\n")):
        assert one


@pytest.mark.parametrize(
    "body",
    [
        b"# %s\n" % (b"x" * 2000) * (MAX_PROGRAM_BYTES // 2000),
        b"sync()\n" * MAX_PROGRAM_LINES,
        b"\n" * MAX_PROGRAM_LINES,
    ],
    ids=["bytes", "lines", "empty lines"],
)
def test_a_program_that_is_too_large_is_refused_and_its_rest_passed_over(body: bytes) -> None:
    (_, words), after = shown(received(b"def p():\n" + body + b"  while True:\n end\n" + MOVE + b"end\n" + LINE))
    assert "more than" in words
    assert after == ("unnamed", ["stopl"])


def test_a_line_that_is_too_long_is_refused_in_any_piece() -> None:
    for text, line in ((b"stopj(2%s)\n", 1), (b"def p():\nstopj(2%s)\nend\n", 2)):
        stream = text % (b" " * MAX_LINE_BYTES) + LINE
        reader = ScriptReader()
        pieces = [stream[i : i + 700] for i in range(0, len(stream), 700)]
        refused, after = [one for piece in pieces for one in received(piece, reader)]
        assert isinstance(refused, Refused)
        assert refused.error.line == line
        assert shown([after]) == [("unnamed", ["stopl"])]


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
    assert parse_statement(text, 1).arguments == arguments


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
    moves = (
        Move((0, 1, 2, 3, 4, 5), is_pose=False, straight=False, speed=1, acceleration=1.4, blend_m=0.02, number=0),
        Move((0.1, 0.2, 0.3, 0, 0, 1), is_pose=True, straight=True, speed=0.25, acceleration=1.2, number=1),
    )
    assert received(control_script(path, offset=24)) == [ControlScript(24, moves)]
    assert received(control_script()) == [ControlScript(0, ())]
    for wrong in (control_script("\tmovej([1])\n"), control_script(offset=999)):
        [refused] = received(wrong)
        assert isinstance(refused, Refused)


@pytest.mark.parametrize("version", [(3, 15), (5, 12), (5, 25)])
def test_the_script_that_ur_rtde_uploads_is_recognised(version: tuple[int, int]) -> None:
    script_client = pytest.importorskip("script_client")
    text = "def rtde_control():\n" + script_client.ScriptClient("unused", *version).getScript() + "end\n"
    assert received(text.encode() + LINE)[0] == ControlScript(0, ())
    assert len(received(text.encode() + LINE)) == 2
