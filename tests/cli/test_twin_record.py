from typer.testing import CliRunner

from cli.main import app


def run(*arguments):
    return CliRunner().invoke(app, ["twin", "record", *map(str, arguments)])


def test_a_recording_is_written_and_its_size_told(tmp_path):
    out = tmp_path / "scene.db3"
    result = run("--out", out, "--seconds", 0.2, "--objects", 1, "--seed", 3)
    assert result.exit_code == 0
    assert f"{out}: 6 frames" in result.stdout.replace("\n", "")
    assert out.stat().st_size > 100_000


def test_a_file_that_exists_is_left_alone(tmp_path):
    out = tmp_path / "scene.db3"
    out.write_text("mine")
    result = run("--out", out)
    assert result.exit_code == 2
    assert "exists already" in result.stderr
    assert out.read_text() == "mine"
