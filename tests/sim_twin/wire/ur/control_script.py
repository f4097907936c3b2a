"""What ur_rtde uploads, shortened to what the controller looks at."""

from __future__ import annotations

_SCRIPT = """def rtde_control():
# HEADER_BEGIN
    global reg_offset_float = # float register offset
{offset}    global reg_offset_int = # int register offset
{offset}    def exec_move_path():
        textmsg("exec_move_path")
        # inject move path
{path}    end
# NODE_CONTROL_LOOP_BEGINS
        # RTDE Control script - Main loop #
# NODE_CONTROL_LOOP_ENDS
end
"""


def control_script(path: str = "", offset: int = 0) -> bytes:
    """The script with a path in it, and with the offset of its registers."""
    return _SCRIPT.format(path=path, offset=offset).encode()


CONTROL_SCRIPT = control_script()
