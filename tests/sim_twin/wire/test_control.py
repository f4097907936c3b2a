import contextlib
import json
import socket

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.wire.control import ControlSocket, handle
from sim_twin.wire.control_client import ask
from tests.sim_twin.wire.conftest import HOST


@pytest.fixture
def control(served):
    with ControlSocket(served, HOST, 0) as socket_of_cell:
        yield socket_of_cell


def answer_to(endpoint, line):
    """What the socket says to a line, which may be anything."""
    host, _, port = endpoint.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as link, link.makefile("rw") as lines:
        lines.write((line if isinstance(line, str) else json.dumps(line)) + "\n")
        lines.flush()
        return json.loads(lines.readline())


def test_it_obeys(served, control):
    fault = {"device": "gripper", "channel": "modbus", "kind": "delayed", "value": 0.3}
    assert ask(control.endpoint, {"inject": fault}) == {"ok": True}
    answer = ask(control.endpoint, {"list": True})
    assert answer["active"] == [{**fault, "what": ""}]
    assert "modbus wrong unit" in answer["exist"]["gripper"]
    assert ask(control.endpoint, {"clear": True}) == {"ok": True}
    assert served.faults == ()
    assert ask(control.endpoint, {"state": True})["state"]["width_m"] == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("nonsense", "not a line of JSON"),
        ("[]", "inject"),
        ("{}", "inject"),
        ({"explode": True}, "inject"),
        ({"clear": False}, "inject"),
        ({"inject": 3}, "not a fault"),
        ({"inject": {"device": "gripper", "channel": "modbus"}}, "kind"),
        ({"inject": {"device": "oven", "channel": "modbus", "kind": "off"}}, "device"),
        ({"inject": {"device": "gripper", "channel": "modbus", "kind": "off", "colour": 1}}, "colour"),
        ({"inject": {"device": "gripper", "channel": "modbus", "kind": "slow"}}, "there are"),
    ],
)
def test_it_says_what_is_wrong(control, line, words):
    answer = answer_to(control.endpoint, line)
    assert not answer["ok"]
    assert words in answer["error"]


WORDS = st.sampled_from(
    [
        b'{"inject": ',
        b'{"clear": ',
        b'{"list": ',
        b"{",
        b"}",
        b"[",
        b"]",
        b"true",
        b'"device": "arm"',
        b'"kind": "off"',
        b"1e999",
    ]
)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=60), st.lists(WORDS, max_size=6).map(b"".join)))
def test_any_line_gets_an_answer(served, line):
    answer = handle(line, served)
    assert answer["ok"] or answer["error"]
    assert json.loads(json.dumps(answer)) == answer


def test_it_hangs_up_on_a_flood_and_lives_on(control):
    host, _, port = control.endpoint.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as link:
        link.sendall(b"x" * 20_000)
        with contextlib.suppress(ConnectionResetError):
            assert link.recv(1) == b""
    assert ask(control.endpoint, {"list": True})["ok"]


@pytest.mark.parametrize("line", ["[" * 9_000, '{"a":' * 1_900, '{"inject": ' + "[" * 5000 + "]" * 4000])
def test_json_that_is_nested_deeply_is_refused(control, line):
    answer = answer_to(control.endpoint, line)
    assert not answer["ok"]
    assert "JSON" in answer["error"]
    assert ask(control.endpoint, {"list": True})["ok"]


def test_a_crowd_of_connections_does_not_lock_it(control):
    host, _, port = control.endpoint.rpartition(":")
    with contextlib.ExitStack() as stack:
        crowd = [stack.enter_context(socket.create_connection((host, int(port)), timeout=5)) for _ in range(600)]
        assert ask(control.endpoint, {"list": True})["ok"]
        # One of the last is still there.
        crowd[-1].sendall(b'{"list": true}\n')
        assert crowd[-1].recv(1) == b"{"


def test_it_listens_on_this_machine_alone(served):
    with ControlSocket(served, "0.0.0.0", 0) as control:
        assert control.endpoint.startswith("127.0.0.1:")


def test_a_port_that_is_taken_is_named(served, control):
    with pytest.raises(ConfigError, match=control.endpoint):
        ControlSocket(served, HOST, int(control.endpoint.rpartition(":")[2]))


def test_the_client_says_what_is_wrong(control):
    with pytest.raises(ConfigError, match="no such request"):
        ask(control.endpoint, {"explode": True})
    with pytest.raises(ConfigError, match="host:port"):
        ask(HOST, {"list": True})
    with pytest.raises(ConnectionLost, match="--control-port"):
        ask(f"{HOST}:1", {"list": True})
