"""Compiled programs that outlive the process: found again where nothing that determines them has changed, and only there."""

import dataclasses
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from rtac_jax import RTAC
from rtac_jax.effects.formula_force import FormulaForce, Term, formula_class
from rtac_jax.programs import Program, compiled_function, compiler, environment
from rtac_jax.programs import files as kept_files
from rtac_jax.programs.fingerprint import NoFingerprintError, Traced, fingerprint

FIT = """
import logging, sys
import jax
jax.config.update("jax_log_compiles", True)
said = []
class Kept(logging.Handler):
    def emit(self, record):
        said.append(record.getMessage())
for name in ("jax._src.dispatch", "jax._src.interpreters.pxla", "jax._src.compiler"):
    logging.getLogger(name).addHandler(Kept())
    logging.getLogger(name).propagate = False
import estimators as est, rtac_jax as rtac
from rtac_jax import virtual_rig
rtac.configure(cache=sys.argv[1])
recording = virtual_rig.record(virtual_rig.Rig(), virtual_rig.standard_plans(seed=1, duration=2.0, free=1, forced=2), seed=2)
fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
print([float(p.value).hex() for p in fit.parameters.values()], [float(p.std).hex() for p in fit.parameters.values()])
print(sum(line.startswith("Finished tracing") and "factor" in line for line in said))
"""


@pytest.mark.slow
def test_another_process_traces_nothing_again_and_finds_the_same_bits(tmp_path: Path) -> None:
    """Among it is code that calls LAPACK, which crashes where JAX has not looked for LAPACK."""
    runs = [
        subprocess.run([sys.executable, "-c", FIT, str(tmp_path)], capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    (first, traced), (second, traced_again) = (run.strip().splitlines() for run in runs)
    assert first == second
    assert int(traced) > 0
    assert int(traced_again) == 0


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Keep programs in a folder of the test, and those of this module as if it were of the package."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)  # JAX keeps nothing by itself
    reset_cache()
    # Another test of this process may have left a function of its own in the package.
    monkeypatch.setattr(kept_files, "patched", lambda: False)
    for module in (compiled_function, environment):
        monkeypatch.setattr(module, "PACKAGES", (*environment.PACKAGES, __name__.partition(".")[0]))
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)
    reset_cache()


TRACED: list[str] = []


def scaled(x, by):
    TRACED.append("scaled")
    return {"twice": by * x, "sum": jnp.sum(x)}


def factored(x, other):
    return jnp.linalg.qr(x)[1], other


def files(folder: Path) -> list[Path]:
    """Return the files of programs, and those of their code."""
    return sorted(file for file in folder.rglob(f"{kept_files.FOLDER}/*/*") if file.is_file())


def traced_by(function: Program, *given) -> int:
    """How often a call traces, in what stands for another process."""
    function.forget()
    TRACED.clear()
    function(*given)
    return len(TRACED)


def test_what_was_compiled_is_loaded_where_nothing_has_changed(kept, monkeypatch) -> None:
    function = Program(scaled)
    assert traced_by(function, jnp.ones(3), 2.0) == 1
    assert traced_by(function, jnp.ones(3), 2.0) == 0
    found = function(jnp.arange(3.0), 2.0)
    np.testing.assert_array_equal(found["twice"], [0.0, 2.0, 4.0])
    assert float(found["sum"]) == 3.0
    assert traced_by(function, jnp.ones(4), 2.0) == 1  # another shape
    assert traced_by(function, jnp.ones(3), 3.0) == 1  # another number that is no array
    assert traced_by(function, jnp.ones(3), 2) == 1  # of another type
    assert traced_by(function, jnp.ones(3, dtype=np.float32), 2.0) == 1


def test_code_is_found_by_what_was_traced_where_the_source_has_changed(kept, monkeypatch) -> None:
    function = Program(scaled)
    traced_by(function, jnp.ones(3), 2.0)
    before = files(kept)
    monkeypatch.setattr(environment, "_sources", lambda: "another source")
    assert traced_by(function, jnp.ones(3), 2.0) == 1
    assert len(files(kept)) == len(before) + 1  # no code
    for module in (environment, kept_files):
        monkeypatch.setattr(module, "machine", lambda: "another processor")
    assert traced_by(function, jnp.ones(3), 2.0) == 1
    assert len(files(kept)) == len(before) + 3


def unused(x, other):
    TRACED.append("unused")
    return 2 * x


def test_what_is_not_used_has_a_shape_too(kept) -> None:
    """Code is the same whatever its shape is, but it is called with arguments of one shape."""
    function = Program(unused)
    for length in (9, 7, 9):
        function.forget()
        np.testing.assert_array_equal(function(jnp.ones(3), jnp.ones(length)), 2.0)


def test_code_that_jax_had_in_its_cache_is_not_kept(kept) -> None:
    """It lacks parts when it is written again, and would fail where it is loaded."""
    function = Program(scaled)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    traced_by(function, jnp.ones(3), 2.0)
    assert len(files(kept)) == 2
    for file in files(kept):
        file.unlink()
    traced_by(function, jnp.ones(3), 2.0)
    assert files(kept) == []
    assert float(function(jnp.ones(3), 2.0)["sum"]) == 3.0


def test_a_damaged_program_is_compiled_again(kept) -> None:
    function = Program(scaled)
    traced_by(function, jnp.ones(3), 2.0)
    both = files(kept)
    assert len(both) == 2  # the program and its code
    for file in both:
        whole = file.read_bytes()
        for content in (
            b"",
            whole[:40],
            whole[:-1],
            *(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :] for at in (0, 50)),
        ):
            file.write_bytes(content)
            assert traced_by(function, jnp.ones(3), 2.0) == 1
            assert file.read_bytes() != content


def test_a_full_disk_costs_time_and_nothing_else(kept, monkeypatch) -> None:
    def full(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept_files, "replacing", full)
    function = Program(scaled)
    assert float(function(jnp.ones(3), 2.0)["sum"]) == 3.0
    assert files(kept) == []


def test_what_is_traced_itself_is_traced_through(kept) -> None:
    function = Program(scaled)
    slope = jax.grad(lambda x: jnp.sum(function(x, 3.0)["twice"]))(jnp.ones(2))
    np.testing.assert_array_equal(slope, [3.0, 3.0])
    assert jax.vmap(lambda x: function(x, 3.0)["sum"])(jnp.ones((4, 2))).shape == (4,)
    assert files(kept) == []


def test_a_result_that_is_not_made_of_arrays_alone_is_given_as_it_is(kept) -> None:
    assert Program(factored)(jnp.eye(2), "a word")[1] == "a word"
    assert files(kept) == []


def test_several_threads_compile_once(kept) -> None:
    def slow(x):
        TRACED.append("slow")
        time.sleep(0.2)
        return 2 * x

    function, found = Program(slow), []
    TRACED.clear()
    threads = [threading.Thread(target=lambda: found.append(function(jnp.ones(2)))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert len(TRACED) == 1


def test_what_was_prepared_for_shapes_is_not_compiled_again(kept) -> None:
    function = Program(scaled)
    TRACED.clear()
    function.prepare(jax.ShapeDtypeStruct((3,), np.float64), 2.0)
    assert len(TRACED) == 1
    assert float(function(jnp.ones(3), 2.0)["sum"]) == 3.0
    assert len(TRACED) == 1


def test_an_array_made_of_a_number_runs_what_another_of_its_type_does(kept) -> None:
    function = Program(scaled)
    TRACED.clear()
    weak, strong = jnp.asarray(2.0), jnp.asarray(np.float64(2.0))
    assert weak.weak_type, "or else nothing is asked here"
    assert not strong.weak_type
    for factor in (weak, strong):
        found = function(jnp.ones(3), factor)
        assert float(found["sum"]) == 3.0
        np.testing.assert_array_equal(found["twice"], [2.0, 2.0, 2.0])
    assert len(TRACED) == 1


def test_programs_of_older_versions_are_deleted_where_nobody_used_them_for_long(kept) -> None:
    old, recent = kept / kept_files.FOLDER / "old", kept / kept_files.FOLDER / "recent"
    code = kept / kept_files.FOLDER / "code" / "old"
    for folder in (old, recent, code.parent):
        folder.mkdir(parents=True)
    code.write_bytes(b"")
    os.utime(code, (time.time() - 40 * 24 * 3600,) * 2)
    os.utime(old, (time.time() - 40 * 24 * 3600,) * 2)
    traced_by(Program(scaled), jnp.ones(3), 2.0)
    assert not old.exists()
    assert not code.exists()
    assert recent.exists()


@dataclasses.dataclass(frozen=True)
class Own:
    """Stands for a user's own effect, whose source may change."""

    value: float


def test_a_fingerprint_tells_apart_what_tracing_tells_apart() -> None:
    known = ("rtac_jax",)
    same = fingerprint(RTAC.paper(), known)
    assert fingerprint(RTAC.paper(), known) == same
    assert fingerprint(RTAC.paper().fix("spring_stiffness"), known) != same
    values = [
        1,
        1.0,
        True,
        "1",
        None,
        (1,),
        [1],
        {"a": 1},
        {"b": 1},
        frozenset({1}),
        np.ones(1),
        np.zeros(1),
        np.ones(2),
    ]
    values += [Traced((1,), "float64"), Traced((1,), "int64"), Traced((2,), "float64")]
    values += [RTAC, fingerprint, jax.tree.structure((1, 2)), jax.tree.structure([1, 2]), jax.tree.structure((1, (2,)))]
    assert len({fingerprint(value, known) for value in values}) == len(values)
    assert fingerprint(frozenset("abc"), known) == fingerprint(frozenset("cab"), known)


UNSEEN = {"own": Own(1.0), "class": Own, "lambda": lambda: 1, "object": object(), "ufunc": np.sin, "path": Path}


@pytest.mark.parametrize("value", UNSEEN.values(), ids=UNSEEN)
def test_what_may_change_unseen_has_no_fingerprint(value) -> None:
    with pytest.raises(NoFingerprintError):
        fingerprint(value, ("rtac_jax",))


def test_a_function_that_took_the_place_of_another_has_no_fingerprint(monkeypatch) -> None:
    before = compiled_function.forget_programs
    monkeypatch.setattr(compiled_function, "forget_programs", lambda: None)
    with pytest.raises(NoFingerprintError):
        fingerprint(before, ("rtac_jax",))


def test_a_class_that_is_made_anew_in_each_process_is_known_by_what_it_is_made_of() -> None:
    def of(*terms: Term, slow: float = 1e-3) -> type[FormulaForce]:
        return formula_class("cart", "cart_position", terms, slow)

    made = [
        of(Term("power", 2)),
        of(Term("odd", 2)),
        of(Term("power", 2), Term("sign")),
        of(Term("power", 2), slow=2e-3),
    ]
    own = [fingerprint(RTAC.paper() + one(*np.ones(len(one.terms))), ("rtac_jax",)) for one in made]
    assert len(set(own)) == len(own)
    formula_class.cache_clear()  # as in another process
    again = of(Term("power", 2))
    assert again is not made[0]
    assert fingerprint(RTAC.paper() + again(1.0), ("rtac_jax",)) == own[0]
    with pytest.raises(NoFingerprintError):
        fingerprint(made[0], ("rtac_jax",))  # says what it is made of, but that gives another class now


PATCHED = """
import sys
import rtac_jax as rtac
from rtac_jax.programs import environment
from rtac_jax.programs import files as kept_files
rtac.configure(cache=sys.argv[1])
spring = rtac.effects.CATALOGUE["cubic_spring"]
before = spring.force
print(environment.patched(), kept_files.folder() is None)
spring.force = lambda self, motion, own: before(self, motion, own)
print(environment.patched(), kept_files.folder() is None)
spring.force = before
print(environment.patched(), kept_files.folder() is None)
"""


@pytest.mark.slow
def test_where_a_method_of_the_package_was_replaced_nothing_is_loaded_or_kept(tmp_path: Path) -> None:
    """A notebook may do so, and code of the method as it was would give its numbers without a word."""
    told = [sys.executable, "-c", PATCHED, str(tmp_path)]
    run = subprocess.run(told, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "False", "True", "True", "False", "False"]


def test_an_option_that_the_compiler_does_not_know_is_left_out(monkeypatch) -> None:
    monkeypatch.setattr(compiler, "OPTIONS", {"xla_cpu_no_such_thing": True})
    monkeypatch.setattr(compiler, "_unknown", set())
    lowered = jax.jit(lambda x: x + 1).lower(1.0)
    assert compiler.compile_lowered(lowered)(1.0) == 2.0
    assert compiler._unknown == {"xla_cpu_no_such_thing"}


def test_an_error_of_the_compiler_is_not_taken_for_an_unknown_option(monkeypatch) -> None:
    def out_of_memory(self, compiler_options) -> None:
        raise RuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr(jax.stages.Lowered, "compile", out_of_memory)
    with pytest.raises(RuntimeError, match="out of memory"):
        compiler.compile_lowered(jax.jit(lambda x: x + 1).lower(1.0))
