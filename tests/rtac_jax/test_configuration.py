"""What `configure` sets is set for a user as it is for these tests."""

import os
import subprocess
import sys

import jax
import pytest

import rtac_jax as rtac
from rtac_jax import configuration

OPTIONS = "--xla_backend_extra_options="


def test_a_fresh_process_compiles_with_the_options_of_these_tests() -> None:
    # conftest.py imports both packages first: were JAX's backend started by that, the options would come too late here.
    here = os.environ["XLA_FLAGS"].split()
    assert any(flag.startswith(OPTIONS) for flag in here)
    environment = os.environ | {"XLA_FLAGS": " ".join(flag for flag in here if not flag.startswith(OPTIONS))}
    code = "import os, rtac_jax; rtac_jax.configure(cache=None); print(os.environ['XLA_FLAGS'])"
    fresh = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert fresh.stdout.split() == here


def said_by(code: str, **variables: str) -> list[str]:
    """Return the lines that a fresh process prints, which no variable but these tells what to compute on."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"} | variables
    command = [sys.executable, "-c", f"import jax, rtac_jax as rtac\n{code}"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()


def test_all_is_computed_on_the_processor_unless_a_gpu_is_asked_for() -> None:
    code = """
for gpu in (False, True, False):
    print(rtac.configure(cache=None, gpu=gpu))
    print(jax.config.jax_platforms)
print(jax.default_backend())
print(rtac.configure(cache=None, gpu=True))
"""
    first, of_first, second, of_second, third, of_third, backend, late = said_by(code)
    assert "computing on the CPU" in first
    assert "computing where JAX chooses" in second
    assert (of_first, of_second, of_third) == ("cpu", "None", "cpu")
    assert third == first
    assert backend == "cpu"
    assert "computing on the CPU" in late


@pytest.mark.slow
def test_a_platform_that_the_user_names_is_kept() -> None:
    named = said_by("print(rtac.configure(cache=None, gpu=True), jax.config.jax_platforms)", JAX_PLATFORMS="cpu")
    assert "computing on cpu, which JAX_PLATFORMS names" in named[0]
    assert named[0].endswith(" cpu")


def test_a_gpu_that_was_taken_before_is_named(monkeypatch) -> None:
    monkeypatch.setattr(configuration.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(configuration, "_backend_has_started", lambda: True)
    jax_platforms = jax.config.jax_platforms
    jax.config.update("jax_platforms", None)
    try:
        said = rtac.configure(fast=False)
    finally:
        jax.config.update("jax_platforms", jax_platforms)
    assert "computing on gpu, because JAX had already started: call configure() first" in said
