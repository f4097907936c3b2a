import pytest

from robotcell.errors import ConfigError
from sim_twin.wire.exposure import check_exposure, is_loopback


@pytest.mark.parametrize(("host", "only_here"), [("127.0.0.2", True), ("localhost", True), ("0.0.0.0", False)])
def test_which_addresses_only_this_machine_reaches(host, only_here):
    assert is_loopback(host) is only_here


def test_others_reach_a_cell_only_where_that_is_asked_for():
    check_exposure("127.0.0.2", expose=False)
    check_exposure("0.0.0.0", expose=True)
    with pytest.raises(ConfigError, match="--expose"):
        check_exposure("0.0.0.0", expose=False)
