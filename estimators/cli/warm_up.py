"""`rtac warm-up`: the cache of compiled code, filled before it is needed."""

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.job import prepare, say
from estimators.cli.limits import numbers
from estimators.cli.refusals import NOT_POSSIBLE, WRONG_USE, answering, stop

if TYPE_CHECKING:
    from rtac_jax import RTAC
    from rtac_jax.measurement import Recording

_FEWEST = {"--experiments": 2, "--samples": 200}
_SAMPLE_TIME = 0.005  # [s]; compiled code does not depend on it
_NOISE = {"cart_position": 5e-6, "arm_velocity": 5e-2}  # as of the paper's sensors [m, rad/s]


def warm_up(
    experiments: Annotated[
        str, typer.Option(metavar="N,...", help="Numbers of experiments; up to 8 they are rounded up to 2, 4 or 8.")
    ] = "4,8",
    samples: Annotated[
        str,
        typer.Option(
            metavar="N,...", help="Samples of the longest experiment; code for so many serves fewer, down to half."
        ),
    ] = "1000,2000",
    hidden: Annotated[
        str, typer.Option(metavar="ID,...", help="Effects whose models are compiled beside the paper's model.")
    ] = "cubic_spring",
) -> None:
    """Compile what fits and diagnoses of usual sizes run, so that the first of yours begins at once."""
    with answering():
        sizes = [(e, s) for e in _counts("--experiments", experiments) for s in _counts("--samples", samples)]
        prepare()
        import jax

        from rtac_jax.effects import CATALOGUE

        effects = [name.strip() for name in hidden.split(",") if name.strip()]
        if unknown := [name for name in effects if name not in CATALOGUE]:
            stop(WRONG_USE, f"--hidden names {', '.join(unknown)}; choose among {', '.join(sorted(CATALOGUE))}.")
        kept = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue] - made when JAX starts
        if not kept:
            stop(
                NOT_POSSIBLE,
                "compiled code has no folder; let JAX_COMPILATION_CACHE_DIR name one that can be written to.",
            )
        folder = Path(kept)
        before = _megabytes(folder)
        rows = [f"{'experiments':>11s} {'samples':>8s} {'hidden':18s} {'fit':>8s} {'diagnosis':>10s}  verdict"]
        for count, length in sizes:
            for effect in effects or [None]:
                fit, diagnosis, verdict = _run(count, length, effect)
                rows.append(
                    f"{count:11d} {length:8d} {effect or 'nothing':18s} {fit:6.1f} s {diagnosis:8.1f} s  {verdict}"
                )
        after = _megabytes(folder)
        say(
            "\n".join(rows),
            f"{folder} holds {after:.0f} MB of compiled code, {after - before:.0f} MB of them new. Code that was not used for "
            "30 days goes by itself.",
        )


def _counts(option: str, text: str) -> list[int]:
    """Return the sizes of an option."""
    found = numbers(option, text)
    if any(number < _FEWEST[option] or number != int(number) for number in found):
        stop(WRONG_USE, f"{option} is {text!r}; give whole numbers of {_FEWEST[option]} or more between commas.")
    return [int(number) for number in found]


def _megabytes(folder: Path) -> float:
    """Return the size of the files in a folder; another process may remove some meanwhile."""
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total / 1e6


def _run(experiments: int, samples: int, effect: str | None) -> tuple[float, float, str]:
    """Fit and diagnose a recording of this size; return the seconds of both, and the verdict."""
    import estimators as est
    from rtac_jax import RTAC

    recording = _simulated(experiments, samples, effect)
    began = time.perf_counter()
    fit = est.output_error(RTAC.from_rig(recording), recording)
    fitted = time.perf_counter()
    found = est.diagnose(fit, recording)
    named = ", ".join(c.id for c in found.effects)
    return fitted - began, time.perf_counter() - fitted, f"{found.verdict} {named}".strip()


def _simulated(experiments: int, samples: int, effect: str | None) -> Any:
    """Return a recording of free decays and forced runs as the model of the paper's rig with an effect gives them."""
    import numpy as np

    import rtac_jax as rtac
    from estimators.core.initial_state import scales_of
    from rtac_jax.effects import CATALOGUE
    from rtac_jax.measurement import from_rest, multisine

    random, paper = np.random.default_rng(1), rtac.RTAC.paper()
    rig = {name: float(np.asarray(paper[name])) for name in ("total_mass", "arm_inertia")}

    def recorded(model: "RTAC") -> "Recording":
        made = []
        for n in range(experiments):
            forced = n >= experiments // 3
            wave = multisine(samples=samples, sample_time=_SAMPLE_TIME, rms=0.1, band=(1.0, 8.0), seed=n)
            current = from_rest(wave) if forced else None
            start = (0.0 if forced else 5e-3, 0.0, float(random.uniform(-3, 3)), 0.0 if forced else 20.0)
            seen = rtac.simulate_inputs(
                model, current=current, samples=samples, sample_time=_SAMPLE_TIME, start=start
            )  # fmt: skip
            outputs: dict[str, Any] = {
                c: np.asarray(getattr(seen, c)) + std * random.normal(size=samples) for c, std in _NOISE.items()
            }
            made.append(
                rtac.Experiment.of(
                    f"run_{n}", kind="forced" if forced else "free", sample_time=_SAMPLE_TIME, current=current,
                    initial_arm_angle=start[2], noise_std=_NOISE, **outputs,
                )
            )  # fmt: skip
        return rtac.Recording(tuple(made), rig=rig)

    if effect is None:
        return recorded(paper)
    scales = scales_of(paper, recorded(paper).experiments)
    return recorded(paper + CATALOGUE[effect].candidates(scales)[0])
