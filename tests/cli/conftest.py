"""The recording that commands are tried on."""

import pytest
from command_line import hidden_mode


@pytest.fixture(scope="module")
def recording():
    return hidden_mode()


@pytest.fixture(scope="module")
def file(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "rig & <co>.h5"
    recording.save(path)
    return path
