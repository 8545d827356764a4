"""One explicit call that prepares JAX for estimation; importing the package changes nothing."""

import os
import tempfile
import warnings
from pathlib import Path

import jax

# Fuses a whole Runge-Kutta step into few loops, uses the machine's full vectors, and compiles a time loop as one function
# whatever its size: by default XLA does so only up to 1 kB, and else calls every kernel of every step. XLA ignores unknown
# names that begin with xla_ inside xla_backend_extra_options, so a JAX that drops them only loses speed. The others are LLVM's,
# which knows them since long: loops over the few states and parameters of a step are not unrolled, which takes two fifths of
# the time of compiling, and what is unrolled runs no faster.
_CPU_OPTIONS = ",".join(
    (
        "xla_cpu_use_multi_output_fusion=true",
        "xla_cpu_prefer_vector_width=512",
        "xla_cpu_small_while_loop_byte_threshold=1000000000",
        "-unroll-threshold=0",
        "-unroll-partial-threshold=0",
    )
)
_FLAG = "--xla_backend_extra_options="
NO_CACHE = "no compile cache"
_CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or "~/.cache/rtac-jax"


def configure(*, fast: bool = True, cache: str | Path | None = _CACHE, gpu: bool = False) -> str:
    """Prepare JAX: double precision, the processor, its compiler options for simulation, and a cache of compiled code.

    Call it once, before anything is computed. It may be called again.

    Args:
        fast: set the CPU compiler options. They must be in place before JAX starts its backend, and options that the
            user has put in `XLA_FLAGS` are kept.
        cache: folder for compiled code, so that the second run starts at once; None for no cache. By default
            ~/.cache/rtac-jax, or what the environment variable JAX_COMPILATION_CACHE_DIR names.
        gpu: leave the device to JAX, which takes a GPU where there is one: for batches of thousands of simulations. By
            default all is computed on the CPU, where a fit of a few experiments takes a sixth of the time. A platform
            named by JAX_PLATFORMS is kept whatever is said here.

    Returns:
        One sentence that says what was set and what could not be.

    Raises:
        RuntimeError: a platform is asked for, by JAX_PLATFORMS or `jax_platforms`, that this machine does not have.
    """
    jax.config.update("jax_enable_x64", True)
    said = ["float64 on"]
    if fast:
        said.append(_set_cpu_options())
    said.append(_choose_device(gpu))
    if cache is not None:
        folder = Path(cache).expanduser()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass  # a folder may be there and not take anything
        except OSError as error:
            # JAX may have taken the folder from the environment by itself, and would complain at every function it compiles.
            jax.config.update("jax_compilation_cache_dir", None)
            said.append(
                f"{NO_CACHE} in {folder} ({error.strerror}), so every run compiles anew; let JAX_COMPILATION_CACHE_DIR name a "
                "folder that can be written to"
            )
        else:
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
            said.append(f"compile cache in {folder}")
    require_platform()
    return "rtac-jax: " + "; ".join(said) + "."


def require_platform() -> None:
    """Refuse a platform that JAX is told to use and cannot; where none but the CPU is named, start nothing.

    Raises:
        RuntimeError: names the platform and what helps.
    """
    asked = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue] - made when JAX starts
    if not asked or asked == "cpu":  # which is there everywhere
        return
    try:
        jax.devices()
    except Exception as error:  # RuntimeError, or an AssertionError without a word where a driver is absent
        said = (str(error).splitlines() or ["there is no such device, or its driver or plugin is missing"])[0]
        said = said.partition(" (set JAX_PLATFORMS")[0].rstrip(".")
        raise RuntimeError(
            f"JAX_PLATFORMS is {asked!r}, and JAX cannot start ({said}); set JAX_PLATFORMS=cpu, or leave it unset."
        ) from None


def _choose_device(gpu: bool) -> str:
    asked = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue] - made when JAX starts
    if _backend_has_started():
        device = jax.default_backend().replace("cpu", "the CPU")
        late = not gpu and device != "the CPU" and not asked
        return f"computing on {device}" + ", because JAX had already started: call configure() first" * late
    if os.environ.get("JAX_PLATFORMS"):
        return f"computing on {asked}, which JAX_PLATFORMS names"
    if gpu:
        jax.config.update("jax_platforms", None)  # an earlier call may have set it
        return "computing where JAX chooses"
    if not asked:
        jax.config.update("jax_platforms", "cpu")
        asked = "the CPU"
    return f"computing on {asked}"


def _set_cpu_options() -> str:
    flags = os.environ.get("XLA_FLAGS", "")
    if _CPU_OPTIONS in flags:
        return "CPU options on"
    if _FLAG in flags:
        return "CPU options left as XLA_FLAGS sets them"
    if _backend_has_started():
        return "CPU options not set, because JAX had already started: call configure() first"
    os.environ["XLA_FLAGS"] = f"{flags} {_FLAG}{_CPU_OPTIONS}".strip()
    return "CPU options on"


def _backend_has_started() -> bool:
    from jax.extend.backend import backends  # deferred: its import is not free

    del backends
    from jax._src import xla_bridge  # there is no public question that does not itself start the backend

    return bool(getattr(xla_bridge, "_backends", {}))


def require_configured() -> None:
    """Refuse to estimate in single precision.

    Raises:
        RuntimeError: `configure()` was not called.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "Estimation needs double precision: add the line `rtac_jax.configure()` before the first use."
        )


_warned = False


def warn_single_precision() -> None:
    """Warn, once in a process, that what is computed is computed in single precision."""
    global _warned
    if jax.config.read("jax_enable_x64") or _warned:
        return
    _warned = True
    warnings.warn(
        "Simulating in single precision, to about six digits: add the line `rtac_jax.configure()` before the first use for "
        "double precision.",
        stacklevel=3,
    )
