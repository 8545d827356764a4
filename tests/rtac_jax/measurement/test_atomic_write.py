"""Writing to what is no file: a pipe is written to, and nothing takes its place."""

import os
import stat
import threading
from pathlib import Path

import pytest

from rtac_jax.measurement.atomic_write import replacing


def test_a_pipe_is_written_to_as_it_is(tmp_path: Path) -> None:
    """As /dev/stdout: a file had taken the place of /dev/full, where a report was asked for there."""
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    with replacing(pipe) as place:
        place.write_text("told")
    reader.join(timeout=10.0)
    assert read == ["told"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert list(tmp_path.iterdir()) == [pipe]


def test_a_link_goes_on_to_lead_to_the_file_that_is_replaced(tmp_path: Path) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("before")
    link.symlink_to(file)
    with replacing(link) as place:
        place.write_text("after")
    assert link.is_symlink()
    assert file.read_text() == "after"


def test_a_device_without_room_is_named(tmp_path: Path) -> None:
    full = tmp_path / "full"  # a link, so that the device itself is out of reach whatever is done to it
    full.symlink_to("/dev/full")
    if not Path("/dev/full").is_char_device():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(OSError, match=r"No space left on device.*full"), replacing(full) as place:
        place.write_text("told")
    assert Path("/dev/full").is_char_device()
