import os

import pytest

from crane.common.errors import OutputError
from crane.common.output import replacing


def test_file_appears_whole_at_the_end(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with replacing(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["result.txt"]


def test_failure_leaves_what_was_there(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(path) as part:
        part.write_text("half")
        1 / 0  # noqa: B018
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.txt"]


def test_permissions_follow_the_umask(tmp_path):
    with replacing(tmp_path / "result.txt") as part:
        part.write_text("new")
    (tmp_path / "plain.txt").write_text("new")
    modes = {path.stat().st_mode for path in tmp_path.iterdir()}
    assert len(modes) == 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing/result.txt", "there is no folder"),
        ("folder", "is a folder"),
        ("file/result.txt", "there is no folder"),
    ],
)
def test_bad_places(tmp_path, name, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=message), replacing(tmp_path / name) as part:
        part.write_text("x")


def test_operating_system_error_is_told(tmp_path):
    with (
        pytest.raises(OutputError, match="No space left on device"),
        replacing(tmp_path / "result.txt"),
    ):
        raise OSError(28, "No space left on device")
