"""Names and comments that a report must show as they are written, and that must not lead out of its folder."""

import csv
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser

import numpy as np
import pytest
from command_line import call, refused
from made_up_results import compared
from small_study import small

from estimators.cli import report_page
from estimators.cli.job import Job
from estimators.plots import plot_comparison, plot_recording, plot_residuals
from estimators.plots.style import shortened
from estimators.reporting.html import Shown, Table, write_figures, write_report
from estimators.reporting.report import comparison_rows
from estimators.reporting.tables import comparison_table
from estimators.study import Estimate
from estimators.validation.simulation_error import Comparison
from rtac_jax.measurement import Experiment, Recording, RecordingError, describe

TIME = 1e-2 * np.arange(60)
NAMES = (
    "<script>alert(1)",
    "\"quoted' & <b onclick=x()>",
    "$x_{$",
    r"$\frac{1$",
    "a | b `c`",
    "_hidden",
    "=1+1",
    "n" * 300,
    "Größe 測 😀",
    "..",
    "con",
    r"..\up",
)
COMMENT = '<img src=x onerror=alert(1)> $a_{$ | "\n\x1b[2J second'


def recording():
    def one(name):
        current = {"kind": "forced", "current": np.cos(9 * TIME)}
        return Experiment.of(name, sample_time=1e-2, cart_position=1e-3 * np.sin(9 * TIME), **current)

    return Recording(tuple(one(name) for name in NAMES), {"total_mass": 1.2}, rig_name=NAMES[1], comment=COMMENT)


class Page(HTMLParser):
    """What a browser makes of a page: its elements, their attributes, and the text between them."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.words = set(), set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.words.append(data)


TAGS = {"html", "head", "meta", "title", "style", "body", "h1", "h2", "section", "p", "div", "table", "caption", "thead", "tbody",
        "tr", "th", "td", "figure", "img", "figcaption"}  # fmt: skip
ATTRIBUTES = {"lang", "charset", "name", "content", "class", "alt", "src", "data-head"}


def harmless(path):
    page = Page(path.read_text())
    assert page.tags <= TAGS
    assert page.attributes <= ATTRIBUTES
    return page.words


# The first of them is the worst, which stands in the titles.
SETS = {"mathematics": NAMES[2:4] + NAMES[:1], "long": NAMES[7:9] + NAMES[4:6]}


@pytest.mark.parametrize(
    "names", [pytest.param(names, id=name, marks=[pytest.mark.slow] * (name == "long")) for name, names in SETS.items()]
)
def test_pictures_show_names_as_they_are_written(names, tmp_path):
    """No mathematics, no legend gone, no warning for a script that the font lacks; and valid XML."""
    made = Comparison((compared(names[0], 3.0, names=names), compared("last", 1.0, names=names)))
    figures = {
        "comparison": plot_comparison(made),
        "residuals": plot_residuals(made.models[0]),
        "recording": plot_recording(recording().select(names[:2])),
    }
    write_figures(tmp_path, figures)
    for path in tmp_path.glob("*.svg"):
        assert not [e.tag for e in ElementTree.parse(path).iter() if e.tag.endswith("script")]
    assert sorted(path.stem for path in tmp_path.glob("*.png")) == sorted(figures)


def test_a_report_shows_names_and_comments_and_runs_none_of_them(tmp_path):
    kept = recording()
    (tmp_path / "out").mkdir()
    work = Job(NAMES[0] + ".h5", kept, None, tmp_path / "out", None, 0.0)
    made = Comparison((compared(NAMES[0], 3.0, names=NAMES),))
    table = comparison_table(comparison_rows(made))
    report_page.write_report(
        work,
        f"Fit of {work.file}",
        {"recording": plot_recording(kept)},
        [(NAMES[1], [COMMENT, describe(kept), table]), ("Figures", [Shown(plot_recording(kept), NAMES[1])])],
    )
    words = harmless(tmp_path / "out" / "report.html")
    for name in NAMES:
        assert name in words, name
    assert any(COMMENT in text for text in words)
    found = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert found == {"out/report.html", "out/recording.png", "out/recording.svg"}


def test_what_a_terminal_shows_cannot_steer_it():
    said = describe(recording())
    assert "\x1b" not in said
    assert r"\x1b[2J second" in said
    with pytest.raises(RecordingError, match=r"\\x1b\[2J") as caught:
        recording().select(["\x1b[2J"])
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/b", ".", "", "a\0b", "a\nb", "\x1b[2J"])
def test_what_could_be_a_path_is_no_name(name):
    with pytest.raises(RecordingError, match="an experiment is named"):
        Experiment.of(name, kind="free", sample_time=1e-2, cart_position=np.sin(TIME))


def test_a_study_writes_into_its_folder_only(tmp_path):
    names = (NAMES[0], NAMES[2], NAMES[6], "../x")
    estimators = tuple(Estimate("least_squares", name=name, options={"cutoff": 20.0}) for name in names)
    small(repetitions=2, name="../../" + NAMES[0], question=COMMENT, estimate=estimators).save(tmp_path / "one.toml")
    out = tmp_path / "in" / "out"
    result = call("study", "run", tmp_path / "one.toml", "--out", out)
    assert result.exit_code == 0, result.output
    assert {path.name for path in tmp_path.iterdir()} == {"one.toml", "in"}
    assert [path.name for path in (tmp_path / "in").iterdir()] == ["out"]
    words = harmless(out / "report.html")
    assert all(estimate.name in words for estimate in estimators)
    with open(out / "summary.csv", newline="") as file:
        assert {row[0] for row in csv.reader(file)} == {"estimator", *(estimate.name for estimate in estimators)}
    for path in out.glob("*.svg"):
        ElementTree.parse(path)


@pytest.mark.parametrize("name", ["...toml", "..toml"])
def test_a_study_whose_name_is_a_folder_above_is_refused(tmp_path, name, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    small(repetitions=1).save(tmp_path / "here" / name)
    refused(call("study", "run", name), 2, "name one with --out")
    assert [path.name for path in tmp_path.iterdir()] == ["here"]
    assert [path.name for path in (tmp_path / "here").iterdir()] == [name]


def test_a_long_name_keeps_its_ends():
    assert shortened("short", 28) == "short"
    assert shortened("first" + "n" * 300 + "last", 28) == "first" + "n" * 13 + "…" + "n" * 5 + "last"


def test_a_table_keeps_its_columns():
    table = Table(("name", "value"), tuple((name, "1") for name in NAMES))
    assert len({len(line) for line in str(table).splitlines()}) <= 2


def test_a_page_of_nothing_but_names(tmp_path):
    write_report(
        tmp_path / "report.html", NAMES[1], [(name, [name, Table((name,), ((name,),), name)]) for name in NAMES]
    )
    words = harmless(tmp_path / "report.html")
    assert all(words.count(name) >= 3 for name in NAMES)
