"""Files of models: the same bits come back, and whatever is wrong with a file is one sentence."""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np
import pytest
from users_effects import MagneticSpring

import estimators as est
import rtac_jax as rtac
from estimators.linear.homogeneity_test import Trend
from rtac_jax.effects import CATALOGUE, CubicSpring, FlexibleMode, Force, SplineForce
from rtac_jax.effects.formula_force import Term, formula_class
from rtac_jax.parameters import declarations
from rtac_jax.storage import _file
from rtac_jax.storage._decoding import MOVED, RENAMED, Decoder
from rtac_jax.storage._encoding import KIND

KEPT = Path(__file__).parents[2] / "data" / "model_version_1.h5"


def whole():
    """Every kind of thing that a model may hold."""
    learned = SplineForce.over("cart_position", (-0.01, 0.02), port="cart", amounts=np.arange(6) / 7)
    model = rtac.RTAC.paper() + CubicSpring(1 / 3) + FlexibleMode(0.1, 37.4, 0.03) + learned
    each = {"arm_viscous.positive": np.array([0.1, np.nextafter(0.1, 1), 3e-320])}
    return model.fix("total_mass").with_values(each).each_experiment("arm_viscous.positive")


def bits(model):
    return {name: np.asarray(model[name]).tobytes() for name in model.parameters}


@pytest.fixture
def file(tmp_path):
    whole().save(tmp_path / "model.h5")
    return tmp_path / "model.h5"


def test_a_model_comes_back_bit_for_bit(file):
    loaded, model = rtac.load(file), whole()
    assert bits(loaded) == bits(model)
    assert (loaded.ids, loaded.fixed, loaded.per_experiment) == (model.ids, model.fixed, model.per_experiment)
    assert str(loaded) == str(model)
    for name in ("shapes", "on", "variable", "first", "spacing", "used"):
        assert np.array_equal(getattr(loaded.effects[-1], name), getattr(model.effects[-1], name))


def test_every_effect_of_the_catalogue_comes_back(tmp_path):
    body = rtac.RTAC.paper().body
    for effect in CATALOGUE.values():
        shape = {n: 0.5 for n, d in declarations(effect).items() if d.null is None}
        model = rtac.RTAC(body, (effect.absent(**shape),))
        model.save(tmp_path / "one.h5")
        loaded = rtac.load(tmp_path / "one.h5")
        assert type(loaded.effects[0]) is effect
        assert bits(loaded) == bits(model)


def test_a_law_that_was_read_off_a_curve_comes_back(tmp_path):
    """No name leads to its class, which is made when it is read off."""
    terms = (Term("sine"), Term("power", 5))
    law = formula_class("cart", "cart_position", terms, 1e-4)(coefficient_1=-0.12, shape_1=500.0, coefficient_2=-2e9)
    friction = formula_class("arm", "arm_angle, against the motion", (Term("cosine", 3),), 1e-3)(coefficient_1=1e-4)
    assert (law.id, friction.id) == ("law_of_cart_position_sine_power5", "law_of_arm_angle_in_friction_cosine3")
    model = rtac.RTAC.paper() + law + friction
    model.save(tmp_path / "law.h5")
    loaded = rtac.load(tmp_path / "law.h5")
    assert bits(loaded) == bits(model)
    assert [type(effect) for effect in loaded.effects] == [type(effect) for effect in model.effects]


def test_a_file_of_version_1_is_read_for_ever():
    """It was written when the format was young; where a record has moved since, `_decoding.MOVED` says where to."""
    loaded = rtac.load(KEPT)
    assert loaded.ids == ("cart_viscous", "cart_coulomb", "cubic_spring", "arm_viscous", "spline_force")
    assert float(loaded["cubic_spring.stiffness"]) == 80060.25
    assert loaded.fixed == {"total_mass"}


def refusal(path, *words, **options):
    with pytest.raises(rtac.ResultFileError) as caught:
        rtac.load(path, **options)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert len(said.splitlines()) == 1
    for word in words:
        assert word in said
    return said


def test_damage_anywhere_is_seen(file):
    content = file.read_bytes()
    for place in [0, 3, 12, 14, 40, *range(600, len(content), len(content) // 40)]:
        damaged = bytearray(content)
        damaged[place] ^= 1
        file.write_bytes(damaged)
        refusal(file)
    for length in (0, 5, 511, 512, 700, len(content) - 1):
        file.write_bytes(content[:length])
        refusal(file)
    file.write_bytes(bytes(damaged[:-1]) + content[-1:])
    refusal(file, "does not agree with its checksum", "make the result again")


def test_another_version_is_named(file):
    content = file.read_bytes()
    file.write_bytes(content.replace(b"rtac-result 1 ", b"rtac-result 2 "))
    refusal(file, "is of version 2", "reads version 1", "use the rtac-jax that wrote it")


def test_other_files_are_refused(tmp_path, file):
    free = rtac.Experiment.of("a", kind="free", sample_time=0.01, cart_position=np.arange(20.0))
    rtac.Recording((free,)).save(tmp_path / "rig.h5")
    refusal(tmp_path / "rig.h5", "holds no model or result", "Recording.load")
    with pytest.raises(rtac.RecordingError, match="format is 'rtac-result', but 'rtac-measurement' was expected"):
        rtac.Recording.load(file)
    refusal(tmp_path, "cannot be read")
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        rtac.load(tmp_path / "none.h5")
    with pytest.raises(rtac.ResultFileError, match=r"let the name end in \.h5"):
        whole().save(tmp_path / "model.pkl")
    with pytest.raises(FileNotFoundError, match="no such folder"):
        whole().save(tmp_path / "none" / "model.h5")


def test_an_effect_of_the_users_own_is_named_and_asked_for(tmp_path):
    model = rtac.RTAC.paper() + MagneticSpring(1e7)
    model.save(tmp_path / "own.h5")
    refusal(tmp_path / "own.h5", "magnetic_spring of your own", "class MagneticSpring", "effects=[MagneticSpring]")
    loaded = rtac.load(tmp_path / "own.h5", effects=[MagneticSpring])
    assert type(loaded.effects[-1]) is MagneticSpring
    assert bits(loaded) == bits(model)

    class Other(Force):
        id: ClassVar[str] = "magnetic_spring"
        equation: ClassVar[str] = ""
        source: ClassVar[str] = ""
        port: ClassVar[str] = "cart"
        nature: ClassVar[str] = "conservative"
        force = MagneticSpring.force

    refusal(tmp_path / "own.h5", "a Other with stiffness, which it does not have here", effects=[Other])


def rewritten(file, change):
    """Change the record of a file and give it a right checksum, as another program might."""
    with h5py.File(file, "r") as h5:
        record = json.loads(h5["record"][()].tobytes())
        arrays = [np.asarray(h5["arrays"][str(i)][()]) for i in range(len(h5["arrays"]))]
    change(record)
    encoded = json.dumps(record)

    class Ready(_file.Encoder):
        def encode(self, value, place):
            self.arrays = arrays
            return json.loads(encoded)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_file, "Encoder", Ready)
        _file.save(None, file)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("rtac_jax._rtac.Gone", "does not have"),
        ("rtac_jax.gone.RTAC", "does not have"),
        ("os.system", "of the package os"),
        ("rtac_jax._rtac.jnp", "is no record of results"),
        ("rtac_jax._rtac.eqx", "is no record of results"),
        ("rtac_jax._rtac.declared_of", "is no record of results"),
        ("rtac_jax.measurement._recording.Path", "is no record of results"),
        ("rtac_jax", "does not have"),
    ],
)
def test_only_records_of_the_packages_are_made(file, path, words):
    rewritten(file, lambda record: record.update(type=path))
    refusal(file, words)


def test_a_field_or_kind_of_another_version_is_named(file):
    rewritten(file, lambda record: record["fields"].update(colour="red"))
    refusal(file, "a RTAC with colour, which it does not have here", "written by rtac-jax")
    rewritten(file, lambda record: record["fields"].update(colour={"is": "paint"}))
    refusal(file, "colour")
    rewritten(file, lambda record: (record["fields"].pop("colour"), record["fields"].pop("body")))
    refusal(file, "a RTAC that cannot be made here")
    rewritten(file, lambda record: record.update({"is": "_made"}))
    refusal(file, "holds a _made, which this version does not know")


def test_what_a_file_does_not_hold_is_named(tmp_path):
    with pytest.raises(rtac.ResultFileError, match=r"dict\['a'\]: is a function"):
        rtac.save({"a": whole}, tmp_path / "x.h5")
    with pytest.raises(rtac.ResultFileError, match="an array of object"):
        rtac.save({"a": np.array([None])}, tmp_path / "x.h5")
    assert not list(tmp_path.iterdir())


def test_numbers_of_every_kind_come_back(tmp_path):
    values = {
        "scalars": (1, 1.0, True, None, 1 + 2j, float("nan"), float("-inf"), np.float64(0.1), np.int32(3), np.bool_(True)),
        ("a", "b"): [frozenset({"y", "x"}), 2**70],
        "arrays": (
            np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.array([1 + 1j]), np.zeros((0, 3)), np.array(2.5),
            np.array([True, False]), np.linspace(0, 1, 5000), np.array([np.nan, -0.0]), np.arange(3, dtype=np.float32),
        ),
    }  # fmt: skip
    rtac.save(values, tmp_path / "x.h5")
    loaded = rtac.load(tmp_path / "x.h5")
    assert repr(loaded["scalars"]) == repr(values["scalars"])
    assert loaded[("a", "b")] == values[("a", "b")]
    for there, here in zip(loaded["arrays"], values["arrays"], strict=True):
        assert there.dtype == here.dtype
        assert there.shape == here.shape
        assert there.tobytes() == here.tobytes()
        assert there.strides == here.strides


@pytest.mark.parametrize(("old", "new"), MOVED.items())
def test_a_record_that_moved_is_where_files_of_before_look_for_it(old, new):
    module, _, name = new.rpartition(".")
    assert getattr(importlib.import_module(module), name).__module__ == module
    assert old != new


def test_a_field_that_was_renamed_is_read_by_its_old_name():
    """As a file of before names it; in Python the old name warns."""
    trend = Trend("angle", 0.2, 0.1, 0.75, 0.01)
    fields = {field.name: getattr(trend, field.name) for field in dataclasses.fields(trend)}
    fields["share"] = fields.pop("fraction")
    decoder = Decoder(np.zeros, ("estimators",), (), "")
    made = decoder.decode({KIND: "record", "type": f"{Trend.__module__}.Trend", "fields": fields})
    assert made == trend
    with pytest.warns(DeprecationWarning, match="Trend.share is called fraction now"):
        assert made.share == trend.fraction


@pytest.mark.parametrize(("record", "old", "new"), [(*key, new) for key, new in RENAMED.items()])
def test_the_old_name_of_a_field_is_no_field(record, old, new):
    found = getattr(est, record, Trend)
    names = {field.name for field in dataclasses.fields(found)}
    assert found.__name__ == record
    assert new in names
    assert old not in names
    assert isinstance(getattr(found, old), property)


@pytest.mark.parametrize("values", [{"spring_stiffness": 0.0}, {"arm_inertia": 7.7e-5, "eccentric_moment": 0.338}])
def test_a_model_is_loaded_with_whatever_a_fit_ended_at(tmp_path, values):
    """A slide has no spring, and a first model that lacks gravity may end at an inertia that no body of such a moment has."""
    model = rtac.RTAC.paper().with_values(values)
    model.save(tmp_path / "x.h5")
    found = rtac.load(tmp_path / "x.h5")
    assert {name: float(found[name]) for name in values} == values
    assert str(found) == str(model)
