"""What the machine lacks, and constants and channels without which nothing can be computed: one sentence each."""

import contextlib
import functools
import os
import re
import resource
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace

import jax
import numpy as np
import pytest
from command_line import call, refused
from small_experiments import forced, free, rest

import estimators as est
import rtac_jax
from estimators.cli.environment import say_once_that_the_cache_is_full
from estimators.reporting.html import write_json
from rtac_jax import RTAC
from rtac_jax.measurement import Recording, concerns

RIG = {"total_mass": 1.23, "arm_inertia": 9.5e-5}


def recording(**rig):
    return Recording((free(), forced(), rest()), {**RIG, **rig})


@pytest.fixture
def file(tmp_path):
    recording().save(tmp_path / "rig.h5")
    return tmp_path / "rig.h5"


@contextlib.contextmanager
def disk_of(size):
    """No file may become larger than so many bytes, which fails as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def run(*arguments, out=subprocess.PIPE, **environment):
    return subprocess.run(
        [sys.executable, "-m", "rtac_entry", *map(str, arguments)],
        stdout=out,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        env={**os.environ, **environment},
    )


@pytest.mark.parametrize(
    ("platform", "command"), [("nonsense", "fit"), pytest.param("cuda", "info", marks=pytest.mark.slow)]
)
def test_a_platform_that_is_not_there_is_named(file, platform, command):
    if platform == "cuda" and any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("this machine has one")
    done = run(command, file, JAX_PLATFORMS=platform)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert f"JAX_PLATFORMS is '{platform}', and JAX cannot start" in done.stderr
    assert "; set JAX_PLATFORMS=cpu" in done.stderr


@pytest.mark.slow
def test_a_platform_that_is_not_there_is_named_in_python_too():
    told = "import rtac_jax; rtac_jax.configure()"
    done = subprocess.run(
        [sys.executable, "-c", told],
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        env={**os.environ, "JAX_PLATFORMS": "nonsense"},
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("RuntimeError: JAX_PLATFORMS is 'nonsense', and JAX cannot start (")


def test_a_cache_that_cannot_be_written_is_said_and_done_without(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    (tmp_path / "file").touch()
    try:
        said = rtac_jax.configure(cache=tmp_path / "file" / "cache")
        assert jax.config.jax_compilation_cache_dir is None
    finally:
        rtac_jax.configure(cache=before)
    assert f"no compile cache in {tmp_path / 'file' / 'cache'} (Not a directory)" in said
    assert "let JAX_COMPILATION_CACHE_DIR name a folder that can be written to" in said


@pytest.mark.slow
def test_a_command_does_without_a_cache_too(tmp_path):
    done = run("fit", tmp_path / "none.h5", JAX_COMPILATION_CACHE_DIR="/dev/null")
    assert done.stderr.splitlines()[-1].endswith("there is no such file; check the path.")


@pytest.mark.parametrize("name", ["rig.h5", "rig.csv", "result.json"])
@pytest.mark.parametrize("size", [0, 2000])
def test_a_full_disk_is_named_and_the_old_file_stays(tmp_path, name, size):
    path = tmp_path / name
    path.write_text("old")
    content = {"numbers": list(range(3000))}
    write = functools.partial(write_json, content=content) if name == "result.json" else Recording((free(),)).save
    with disk_of(size), pytest.raises(OSError, match="File too large") as caught:
        write(path)
    assert caught.value.filename == str(path)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    assert path.read_text() == "old"


def test_a_full_disk_is_a_sentence_on_the_command_line(file, monkeypatch):
    def full(*_, **__):
        with disk_of(1000):
            write_json(file.parent / "x.json", {"numbers": list(range(3000))})

    monkeypatch.setattr(est, "least_squares", full)
    refused(call("fit", file), 2, "x.json: File too large; raise the limit on the size of files")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_no_room_for_what_is_said_is_a_sentence(file):
    with open("/dev/full", "w") as full:
        done = run("info", file, out=full)
    assert (done.returncode, done.stderr.splitlines()) == (
        2,
        ["rtac: the output: No space left on device; make room there, or name another place."],
    )


@pytest.mark.parametrize("option", ["--out", "--json"])
def test_a_name_that_is_too_long_is_refused_before_anything_is_computed(file, tmp_path, option, monkeypatch):
    monkeypatch.setattr(RTAC, "from_rig", lambda _: pytest.fail("computed"))
    refused(call("fit", file, option, tmp_path / ("x" * 300)), 2, "File name too long", "name another")
    refused(call("fit", tmp_path / ("x" * 300)), 2, "there is no such file")


def test_the_longest_name_there_is_can_be_written(tmp_path):
    write_json(tmp_path / f"{'x' * 250}.json", {})
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("value", [1e300, 1e-300])
@pytest.mark.parametrize(
    "name", ["total_mass", "arm_inertia", "spring_stiffness", "torque_constant", "eccentric_moment"]
)
def test_a_constant_that_no_rig_has_is_refused(tmp_path, name, value):
    said = re.escape(f"/rig: {name} is {value:g} ")
    with pytest.raises(ValueError, match=f"{said}.*, which no rig has; correct the value or its unit"):
        RTAC.from_rig(recording(**{name: value}))
    recording(**{name: value}).save(tmp_path / "odd.h5")
    refused(call("fit", tmp_path / "odd.h5"), 2, f"/rig: {name}")


def test_every_constant_that_no_rig_has_is_named():
    odd = (
        r"total_mass is 1e\+300 kg \(the paper's is 1\.23\) and arm_inertia is 1e-300 kg m\^2 \(.*\), which no rig has;"
    )
    with pytest.raises(ValueError, match=odd):
        RTAC.from_rig(recording(total_mass=1e300, arm_inertia=1e-300))


def test_rigs_of_other_sizes_are_taken():
    for scale in (1e-4, 1e6):
        model = RTAC.from_rig(recording(total_mass=1.23 * scale, arm_inertia=9.5e-5 * scale))
        assert float(model["total_mass"]) == pytest.approx(1.23 * scale)


def test_what_does_not_move_has_no_model():
    with pytest.raises(ValueError, match="rest records only; add an experiment in which the rig moves"):
        RTAC.from_rig(Recording((rest(),), RIG))
    still = Recording((replace(free(), arm="locked", cart="clamped"),), RIG)
    with pytest.raises(
        ValueError, match="arm and cart are both held in every experiment; add one in which either moves"
    ):
        RTAC.from_rig(still)


def test_a_recording_without_the_cart_position_says_so(tmp_path):
    bare = [replace(forced(), outputs={"arm_velocity": forced().outputs["arm_velocity"]}), rest()]
    assert any("cart_position was not measured" in said for said in concerns(Recording(tuple(bare), RIG)))
    assert not any("cart_position was not measured" in said for said in concerns(recording()))


def test_what_the_data_leave_free_without_the_cart_position_is_explained(tmp_path, monkeypatch):
    def free_friction(*_, **__):
        raise est.NotIdentifiableError("The data leave cart_viscous free.")

    bare = [replace(forced(), outputs={"arm_velocity": forced().outputs["arm_velocity"]}), rest()]
    Recording(tuple(bare), RIG).save(tmp_path / "bare.h5")
    monkeypatch.setattr(est, "output_error", free_friction)
    refused(
        call("compare", tmp_path / "bare.h5"),
        1,
        "leave cart_viscous free",
        "cart_position was not measured",
        "record it",
    )


def test_a_locked_cart_needs_no_position():
    held = replace(forced(cart="clamped"), outputs={"arm_velocity": forced().outputs["arm_velocity"]})
    assert not any("cart_position was not measured" in said for said in concerns(Recording((held, rest()), RIG)))
    assert np.isfinite(float(RTAC.from_rig(Recording((held,), RIG))["total_mass"]))


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("info", "--json"), "--json"),
        (("fit", "--json"), "--json"),
        (("fit", "--save"), "--save"),
        (("next-experiment", "--play"), "--play"),
    ],
)
@pytest.mark.parametrize("link", [False, True])
def test_no_result_takes_the_place_of_measurements(file, tmp_path, arguments, option, link):
    command, flag = arguments
    there = tmp_path / "other.h5"
    shutil.copy(file, there)
    if link:
        there = tmp_path / "link.h5"
        there.symlink_to("other.h5")
    before = there.read_bytes()
    refused(call(command, file, flag, there), 2, "holds a recording, which would be lost", f"for {option}")
    assert there.read_bytes() == before


@pytest.mark.parametrize("name", ["logger.csv", "logger.MAT", "logger.txt"])
def test_no_result_takes_the_place_of_what_a_logger_may_have_written(file, tmp_path, name):
    there = tmp_path / name
    there.write_text("t,q\n0,0.1\n")
    refused(call("info", file, "--json", there), 2, "may hold measurements, which would be lost", "for --json")
    assert there.read_text() == "t,q\n0,0.1\n"
    there.unlink()
    assert call("info", file, "--json", there).exit_code == 0


def test_a_recording_is_written_over_only_where_that_is_asked_for(file, tmp_path):
    there = tmp_path / "other.h5"
    shutil.copy(file, there)
    designed = ("--duration", "2", "--angles", "0")
    for arguments in (("import", file, there), ("design", there, *designed)):
        refused(call(*arguments), 2, "holds a recording, which would be lost", "--replace")
    assert there.read_bytes() == file.read_bytes()
    result = call("design", there, "--replace", *designed)
    assert result.exit_code == 0, result.output
    assert there.read_bytes() != file.read_bytes()
    assert call("design", there, *designed).exit_code == 0  # what was designed is made again at will
    assert call("import", file, tmp_path / "new.h5").exit_code == 0
    assert call("import", file, tmp_path / "new.h5", "--replace").exit_code == 0


@pytest.mark.slow
def test_where_there_is_no_home_nothing_but_the_cache_is_spoken_of(file):
    environment = {k: v for k, v in os.environ.items() if k not in ("MPLCONFIGDIR", "JAX_COMPILATION_CACHE_DIR")}
    done = subprocess.run(
        [sys.executable, "-m", "rtac_entry", "info", str(file)],
        capture_output=True,
        text=True,
        timeout=60,
        env=environment | {"HOME": "/proc/nope", "XDG_CONFIG_HOME": "/proc/nope", "XDG_CACHE_HOME": "/proc/nope"},
    )
    assert done.returncode == 0
    assert "atplotlib" not in done.stderr


def test_a_full_cache_is_said_once(capsys, monkeypatch):
    others = []
    monkeypatch.setattr(warnings, "showwarning", lambda message, *_, **__: others.append(str(message)))
    say_once_that_the_cache_is_full()
    full = "Error writing persistent compilation cache entry for 'jit_{}': OSError: [Errno 28] No space left on device"
    for message in (full.format("factor"), full.format("step"), "something else"):
        warnings.showwarning(UserWarning(message), UserWarning, "compiler.py", 833)
    said = capsys.readouterr().err
    assert said.count("rtac: compiled code cannot be kept (No space left on device), so every run compiles anew") == 1
    assert len(said.splitlines()) == 1
    assert others == ["something else"]


@pytest.mark.parametrize("command", ["fit", "improve", "diagnose", "compare"])
def test_of_rest_records_alone_every_command_says_the_same(command, tmp_path):
    Recording((rest(),), RIG).save(tmp_path / "rest.h5")
    said = call(command, tmp_path / "rest.h5")
    refused(said, said.exit_code, "rest records only; add an experiment in which the rig moves")
    assert said.exit_code > 0
