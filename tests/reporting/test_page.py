"""The page of a report: signals that can be zoomed, tables that a narrow page stacks, bullets, and what is escaped."""

import dataclasses
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from made_up_results import LEARNED, compared, diagnosis, improvement

from estimators.core.fit import Parameter
from estimators.plots.improvement import finding
from estimators.reporting.diagnosis_summary import of_diagnosis
from estimators.reporting.html import Bullets, Table, write_report
from estimators.reporting.trace_viewer import trace_viewer
from estimators.validation.simulation_error import Comparison
from rtac_jax.effects import CubicSpring

HOSTILE = '</script><img src=x onerror="alert(1)">'


def signals(markup):
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', markup, re.DOTALL)[1])


def test_the_viewer_holds_measured_and_simulated_samples_of_the_worst_first():
    comparison = Comparison((compared("base", 12.0), compared("+ mode", 0.2)))
    shown = signals(trace_viewer(comparison).markup)
    assert len(shown) == 4
    worst = comparison.models[0].worst(1)[0]
    assert shown[0]["name"].startswith(f"{worst.experiment}: {worst.channel.replace('_', ' ')}")
    assert [s["label"] for s in shown[0]["series"]] == ["measured", "base", "+ mode"]
    assert shown[0]["unit"] == ("mm" if worst.channel == "cart_position" else "rad/s")
    factor = 1e3 if worst.channel == "cart_position" else 1.0
    np.testing.assert_allclose(shown[0]["series"][1]["values"], factor * worst.simulated, rtol=1e-4, atol=1e-9)


def test_the_viewer_keeps_to_its_size():
    comparison = Comparison((compared("base", 12.0),))
    found = trace_viewer(comparison, most=2500)
    assert len(signals(found.markup)) == 2
    assert "The 2 of 4 with the largest errors" in found.markup


def test_names_cannot_leave_the_page_that_holds_them(tmp_path):
    comparison = Comparison((compared(HOSTILE, 2.0, names=(HOSTILE,), channels=("cart_position",)),))
    viewer = trace_viewer(comparison)
    assert signals(viewer.markup)[0]["series"][1]["label"] == HOSTILE
    sections = [
        (HOSTILE, [Bullets(HOSTILE, HOSTILE, HOSTILE), Table((HOSTILE, '"'), ((HOSTILE, "1"),)), viewer, viewer])
    ]
    write_report(tmp_path / "r.html", HOSTILE, sections)
    page = (tmp_path / "r.html").read_text()
    assert "<img" not in page
    assert page.count("querySelectorAll(") == 1, "the script stands in the page once"
    assert 'data-head="&quot;"' in page


def test_wide_tables_stack_on_a_narrow_page(tmp_path):
    narrow, wide = Table(("a", "b"), (("x", "1"),)), Table(tuple("abcdef"), (("x", *"12345"),))
    write_report(tmp_path / "r.html", "t", [("h", [narrow, wide])])
    page = (tmp_path / "r.html").read_text()
    assert page.count('<table class="stacks">') == 1
    assert "@media (max-width: 600px)" in page
    assert "attr(data-head)" in page
    for number, head in enumerate("bcdef", 1):
        assert f'data-head="{head}">{number}</td>' in page


def test_a_model_whose_simulation_is_far_off_is_not_to_be_used_as_it_is():
    """Although predictions show nothing that is missing."""
    found = improvement(1, "adequate", (30.0,))
    bullets = of_diagnosis(found, found.train, found.validation, file="rig.h5")
    assert bullets.next.startswith("Take the parameters from predictions")
    assert finding(found).startswith("No effect stands out, and yet the held-out error of")
    assert finding(improvement(1, "adequate", (1.0,))).startswith("Nothing is missing: the held-out error")
    missing = dataclasses.replace(diagnosis("missing"), additions=(CubicSpring(1.0),))
    both = (missing, diagnosis("adequate"))
    mended = dataclasses.replace(improvement(2, "missing", (90.0, 30.0)), diagnoses=both, diagnosed=(0, 1))
    bullets = of_diagnosis(mended, mended.train, mended.validation, file="rig.h5")
    assert bullets.next.startswith("Take the parameters from predictions")


@pytest.mark.parametrize(("verdict", "next_step"), [
    ("missing", "Use the model as far as"), ("adequate", "Use the model:"), ("ambiguous", "tells them apart"),
    ("unknown", "give an effect of your own"),
])  # fmt: skip
def test_bullets_say_what_was_found_how_sure_and_what_next(verdict, next_step):
    errors = (1.0,) if verdict == "adequate" else (30.0, 3.0)
    found = improvement(1 if verdict in ("adequate", "unknown") else 2, verdict, errors)
    bullets = of_diagnosis(found, found.train, found.validation, file="rig.h5")
    assert next_step in bullets.next
    if verdict in ("missing", "ambiguous"):
        assert "flexible_mode (mass 0.09 +- 0.001 kg)" in bullets.found
        assert "error over noise on experiments that no fit has seen: cart position" in bullets.sure.lower()
    if verdict == "ambiguous":
        assert (
            "these data cannot tell flexible_mode from cubic_spring, which may be it as well"
            in bullets.found.replace("But these", "these")
        )
        assert "confusable with cubic_spring" in bullets.sure
    known = {"flexible_mode.mass": Parameter(0.0912, 0.05, "kg")}
    advised = of_diagnosis(found, found.train, found.validation, file="rig.h5", estimates=known)
    if verdict == "missing":  # the deviation that the table below recommends
        assert "flexible_mode (mass 0.0912 +- 0.05 kg)" in advised.found
    alone = of_diagnosis(found.diagnoses[0], found.train, None, file="rig.h5")
    if verdict == "missing":
        assert alone.next.startswith("rtac improve rig.h5")


def test_what_was_named_and_not_added_is_not_said_to_be_added():
    found = dataclasses.replace(improvement(2, "missing"), added=(), verdict="unknown")
    assert found.diagnoses[0].effects
    said = of_diagnosis(found, found.train, found.validation, file="rig.h5").found
    assert "added on the way" not in said
    assert "flexible_mode (mass 0.09 +- 0.001 kg), does not serve held-out experiments and was not added" in said


def test_what_was_not_added_in_time_is_not_said_to_be_in_the_model():
    found = improvement(2, "missing", (30.0, 3.0))
    late = dataclasses.replace(found, added=(), not_added=("flexible_mode",), broken_off=True)
    bullets = of_diagnosis(late, late.train, late.validation, file="rig.h5")
    assert bullets.found.startswith("The model fails; missing, and not added before the time was over: flexible_mode")
    assert bullets.next.startswith("Give more time (--within)")


def test_a_mended_model_is_recommended_where_nothing_more_is_missing_and_not_where_it_fails():
    found = improvement(2, "missing", (30.0, 3.0))
    mended = dataclasses.replace(found, diagnoses=(found.diagnoses[0], diagnosis("adequate")), diagnosed=(0, 1))
    for one, said in ((found, "Use the model as far as its held-out error"), (mended, "Use the model with it")):
        assert of_diagnosis(one, one.train, one.validation, file="rig.h5").next.startswith(said)


def test_bullets_keep_a_learned_force_to_its_range():
    found = dataclasses.replace(improvement(2, "unknown"), learned=LEARNED)
    bullets = of_diagnosis(found, found.train, found.validation, file="rig.h5")
    assert "a learned force was added, which is no physical effect: on the cart against cart position" in bullets.found
    assert "error over noise on experiments that no fit has seen" in bullets.sure.lower()
    assert bullets.next.startswith("Use the model between -0.012 and 0.014 m of cart position only")


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node to run the script of the page")
def test_the_viewer_draws_zooms_and_shows_residuals(tmp_path):
    """In a page that is only as much of one as the script asks for."""
    viewer = trace_viewer(Comparison((compared("base", 12.0),)))
    data = json.dumps(json.dumps(signals(viewer.markup)))
    (tmp_path / "run.js").write_text(
        """
const node = name => ({name, children: [], attributes: {}, on: {}, clientWidth: 800, textContent: "",
  setAttribute(k, v) { this.attributes[k] = v; if (k === "value") this.value = v; },
  appendChild(c) { this.children.push(c); if (this.name === "select" && this.value === undefined) this.value = c.value; return c; },
  replaceChildren() { this.children = []; }, addEventListener(k, f) { this.on[k] = f; },
  getBoundingClientRect() { return {left: 0}; }, setPointerCapture() {}});
const box = node("figure");
box.querySelector = () => ({textContent: DATA});
globalThis.document = {querySelectorAll: () => [box], createElement: node, createElementNS: (_, name) => node(name)};
globalThis.addEventListener = () => {};
SCRIPT
const [bar, svg, legend] = box.children, [which, what, plus] = bar.children;
const state = () => ({paths: svg.children.filter(c => c.name === "path").map(c => c.attributes.d.length),
  ticks: svg.children.filter(c => c.attributes.class === "tick").map(c => c.textContent), legend: legend.children.length});
const states = [state()];
plus.onclick(); plus.onclick(); states.push(state());
document.activeElement = svg; svg.on.wheel({preventDefault() {}, deltaY: -1, clientX: 400}); states.push(state());
svg.ondblclick(); what.value = "residuals"; what.onchange(); states.push(state());
which.value = 1; which.onchange(); states.push(state());
console.log(JSON.stringify(states));
""".replace("DATA", data).replace("SCRIPT", viewer.script)
    )
    run = subprocess.run(["node", tmp_path / "run.js"], capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
    whole, nearer, nearest, residuals, other = json.loads(run.stdout)
    assert len(whole["paths"]) == whole["legend"] == 2
    assert min(whole["paths"]) > 1000
    assert "Time [s]" in whole["ticks"]
    assert whole["ticks"] != nearer["ticks"] != nearest["ticks"]
    assert len(residuals["paths"]) == residuals["legend"] == 1
    assert len(other["paths"]) == 1
