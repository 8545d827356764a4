"""A study's description: TOML there and back, its hash, and one sentence for what is wrong."""

import dataclasses
import math
import pickle
import tomllib

import pytest
from small_study import small

from estimators.study import Estimate, Excitation, Hidden, Noise, Plant, SpecError, StudySpec
from estimators.study.toml_writer import toml

WHOLE = StudySpec(
    name='with "quotes"',
    question="What?",
    repetitions=7,
    seed=3,
    keep=("estimate", "std"),
    plant=Plant(
        spread=0.1,
        values={"cubic_spring": [1e4, 5e4], "saturation": math.inf},
        hidden=(Hidden("nothing"), Hidden("arm_coulomb", {"arm_coulomb": 4e-4}, played="foh")),
    ),
    noise=Noise(encoder=True),
    excitation=(Excitation(name="a"), Excitation(name="b", kind="conditions", band=(1, 4))),
    estimate=(
        Estimate("output_error", "fit", {"starts": 1}),
        Estimate("diagnosis", options={"candidates": ["cogging"]}),
    ),
)


def test_a_study_comes_back_from_toml_with_the_same_hash():
    again = StudySpec.from_toml(WHOLE.to_toml())
    assert again == WHOLE
    assert again.digest == WHOLE.digest
    assert hash(again) == hash(WHOLE)
    assert pickle.loads(pickle.dumps(WHOLE)) == WHOLE


def test_what_toml_leaves_out_takes_its_default(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text('name = "a"\nrepetitions = 3\n[[estimate]]\nmethod = "weak_form"\n')
    spec = StudySpec.load(path)
    assert spec == StudySpec("a", 3, (Estimate("weak_form"),))
    spec.save(path)
    assert StudySpec.load(path) == spec


def test_the_hash_is_of_what_a_repetition_depends_on():
    spec = small()
    assert dataclasses.replace(spec, repetitions=99, name="other", question="?").digest == spec.digest
    for change in ({"seed": 6}, {"noise": Noise(force=1e-3)}, {"plant": Plant(spread=0.2)}, {"keep": ("estimate",)}):
        assert dataclasses.replace(spec, **change).digest != spec.digest
    assert small(noise=Noise(position=1)).digest == small(noise=Noise(position=1.0)).digest


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("repetition = 3", "repetition: there is no such key; use one of name, repetitions"),
        ("repetitions = 3.5", "repetitions: is 3.5, but a whole number is needed"),
        ("repetitions = true", "repetitions: is True, but a whole number is needed"),
        ("repetitions = 0", "repetitions: is 0; give at least 1"),
        ("seed = -1", "seed: is -1"),
        ('plant = {spread = "a"}', "plant.spread: is 'a', but a number is needed"),
        ("plant = {spread = 1.0}", "plant.spread: is 1.0; give a fraction"),
        ("plant = {vlaues = {}}", r"\[plant\] vlaues: there is no such key"),
        ("plant = {values = {cubic = 1}}", "plant.values.cubic: the virtual rig has no such field"),
        ("plant = {values = {cubic_spring = [2, 1]}}", "plant.values.cubic_spring: is .* give a number"),
        ("plant = {values = {total_mass = -1.0}}", "plant.values: Rig.total_mass"),
        ('plant = {truth = "rig"}', "plant.truth: is 'rig'; use one of 'virtual_rig', 'model'"),
        ('plant = {truth = "model", values = {mass = 1}}', "plant.values.mass: the model has no such parameter"),
        ('model = {effects = ["spring"]}', "model.effects: there is no effect 'spring'"),
        ("model = {free = [1]}", r"model.free\[0\]: is 1, but a string is needed"),
        ('excitation = {name = "a"}', "excitation: is a table, but a list is needed"),
        ("keep = 3", "keep: is 3, but a list is needed"),
        ('noise = {force = 1.0}\nplant = {truth = "model"}', "noise: random forces and coloured noise need"),
        ('estimate = [{method = "magic"}]', "method: is 'magic'; use one of 'least_squares'"),
        ("estimate = [{}]", "method: is missing"),
        ('estimate = [{method = "envelope"}]', "an envelope needs excitation.kind"),
        (
            'estimate = [{method = "output_error", options = {start = 1}}]',
            "options.start: output_error has no such option",
        ),
        ('estimate = [{method = "weak_form"}, {method = "weak_form"}]', "estimate: two have one name"),
        ("estimate = []", "estimate: is empty"),
        ("name = ", "this is not TOML"),
    ],
)
def test_one_sentence_says_what_is_wrong(tmp_path, change, words):
    lines = {"name": 'name = "a"', "repetitions": "repetitions = 3", "estimate": 'estimate = [{method = "weak_form"}]'}
    for line in change.splitlines():
        lines[line.split(" =")[0]] = line
    path = tmp_path / "study.toml"
    path.write_text("\n".join(lines.values()))
    with pytest.raises(SpecError, match=words) as told:
        StudySpec.load(path)
    assert str(told.value).startswith(f"{path}: ")
    assert len(str(told.value).splitlines()) == 1


def test_wrong_types_are_refused_in_python_too():
    with pytest.raises(SpecError, match=r"plant.hidden\[0\].values.cubic: the virtual rig has no such field"):
        Plant(hidden=(Hidden("cubic_spring", {"cubic": 1.0}),))
    with pytest.raises(SpecError, match=r"excitation.band"):
        Excitation(band=(4, 1))


def test_the_writer_keeps_what_toml_knows():
    table = {
        "text": 'a "b"\n\x7f\\',
        "odd key": 1,
        "numbers": [1e-9, -math.inf, 3],
        "flag": True,
        "nothing": None,
        "inline": {"a": 1.5, "b.c": "d"},
        "deep": {"x": {"y": [1, 2]}, "rows": [{"a": 1}, {"a": 2, "more": [{"z": []}]}]},
    }
    again = tomllib.loads(toml(table))
    del table["nothing"]
    assert again == table
    with pytest.raises(TypeError, match="TOML has no form"):
        toml({"a": 1j})
