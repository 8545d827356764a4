"""What `configure` sets is set for a user as it is for these tests."""

import os
import subprocess
import sys

OPTIONS = "--xla_backend_extra_options="


def test_a_fresh_process_compiles_with_the_options_of_these_tests() -> None:
    # conftest.py imports both packages first: were JAX's backend started by that, the options would come too late here.
    here = os.environ["XLA_FLAGS"].split()
    assert any(flag.startswith(OPTIONS) for flag in here)
    environment = os.environ | {"XLA_FLAGS": " ".join(flag for flag in here if not flag.startswith(OPTIONS))}
    code = "import os, rtac_jax; rtac_jax.configure(cache=None); print(os.environ['XLA_FLAGS'])"
    fresh = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert fresh.stdout.split() == here
