"""The version: one number for the distribution, both packages and the command line."""

import importlib.metadata
import importlib.resources

import pytest
from command_line import call

import estimators
import rtac_jax


def test_version_is_that_of_the_distribution():
    result = call("--version")
    assert result.exit_code == 0
    assert result.stdout == f"rtac-jax {importlib.metadata.version('rtac-jax')}\n"
    assert rtac_jax.__version__ == estimators.__version__ == importlib.metadata.version("rtac-jax")


@pytest.mark.parametrize("package", [rtac_jax, estimators], ids=lambda package: package.__name__)
def test_package_says_that_it_is_typed(package):
    assert importlib.resources.files(package).joinpath("py.typed").is_file()
