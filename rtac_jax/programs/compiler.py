"""The compiler's options for programs."""

import jax

OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Which emitter XLA takes: the one of before writes the same kernels, as fast, in four fifths of the time."""
_unknown: set[str] = set()


def compile_lowered(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compile a lowered function with the options that this version of JAX knows."""
    options = {name: value for name, value in OPTIONS.items() if name not in _unknown}
    if jax.default_backend() != "cpu" or not options:
        return lowered.compile()
    try:
        return lowered.compile(compiler_options={**options})
    except RuntimeError as error:  # JAX has no class of its own for it
        unknown = {name for name in options if f"No such compile option: '{name}'" in str(error)}
        if not unknown:
            raise
        _unknown.update(unknown)
        return compile_lowered(lowered)
