"""Text files as loggers and spreadsheets of other countries write them: decimal commas, words above the names, other encodings."""

from pathlib import Path

import numpy as np
import pytest

from rtac_jax.measurement import Recording, RecordingError, csv_header

NAMES, UNITS = "t;i;x", "s;A;mm"
NUMBERS = [(f"{0.01 * n:.2f}", f"{0.1 * (n % 3):.1f}", f"{1.5 * n:.1f}") for n in range(10)]
ROWS = [";".join(row) for row in NUMBERS]
COMMAS = [row.replace(".", ",") for row in ROWS]
ABOVE = ["Messung am Prüfstand", "Logger 5;SN 123;"]


def read(path, **options):
    channels = {"current": "i", "cart_position": "x"}
    told = {"delimiter": ";", "time": "t", "units": {"cart_position": "mm"}, **options}
    return Recording.from_csv(path, channels=channels, kind="forced", **told)["run"]


@pytest.mark.parametrize(
    ("rows", "encoding"),
    [
        ([NAMES, *ROWS], "utf-8"),
        ([NAMES, *COMMAS], "utf-8"),
        ([*ABOVE, "", NAMES, *ROWS], "utf-8"),
        ([*ABOVE, NAMES, UNITS, *COMMAS], "cp1252"),
        (["Rate;100 Hz;", NAMES, *ROWS], "utf-8-sig"),
        (["Serial;12345;7", NAMES, *ROWS], "utf-8"),
    ],
    ids=[
        "plain",
        "decimal comma",
        "words above",
        "words above, units below, Latin letters",
        "a mark at the start",
        "as wide",
    ],
)
def test_what_a_logger_writes_is_read(tmp_path, rows, encoding):
    path = tmp_path / "run.csv"
    path.write_text("\n".join(rows), encoding=encoding)
    below = UNITS in rows
    assert csv_header(path, ";") == (["t [s]", "i [A]", "x [mm]"] if below else ["t", "i", "x"])
    found = read(path)
    if below:
        alone = read(path, units=None)
        np.testing.assert_array_equal(alone.outputs["cart_position"].values, found.outputs["cart_position"].values)
    assert found.sample_time == pytest.approx(0.01)
    np.testing.assert_allclose(found.outputs["cart_position"].values, 1.5e-3 * np.arange(10.0), rtol=1e-12)
    np.testing.assert_allclose(found.inputs["current"].values, 0.1 * (np.arange(10) % 3), rtol=1e-12)


@pytest.mark.parametrize("end", ["", ","])
def test_a_decimal_comma_between_quotes_separates_no_columns(tmp_path, end):
    """Nor is a mark at the end of the names a column, though the rows have none there."""
    path = tmp_path / "run.csv"
    quoted = [",".join(f'"{cell}"' for cell in row.split(";")) for row in COMMAS]
    path.write_text("\n".join([NAMES.replace(";", ",") + end, *quoted]))
    found = read(path, delimiter=",")
    np.testing.assert_allclose(found.outputs["cart_position"].values, 1.5e-3 * np.arange(10.0), rtol=1e-12)


def test_a_comma_that_separates_columns_is_no_decimal_comma(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("\n".join([NAMES.replace(";", ","), *(row.replace(";", ",") for row in ROWS)]))
    assert read(path, delimiter=",").samples == 10


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([NAMES, *ROWS[:5], *COMMAS[5:]], "a decimal point in row . and a decimal comma in row 7; write all of them with a point"),
        ([NAMES, *ROWS[:5], "0.05;1,234.5;3", *ROWS[6:]], "row 7, column 'i': '1,234.5' is not a number"),
        ([*ABOVE, NAMES, *ROWS[:5], "0.05;much;3", *ROWS[6:]], "row 9, column 'i': 'much' is not a number"),
        ([NAMES.replace("x", "y"), *ROWS], r"row 1: the column 'x' does not occur in the header \(t, i, y\)"),
        ([NAMES, "0.00;nothing;0.0", *ROWS[1:]], "row 2, column 'i': 'nothing' is not a number"),
        ([NAMES, "0.00;999;0.0", "0.01;1,001;1.5", "0.02;7;3.0"], "column 'i': the comma in row 3 may set off thousands"),
    ],
    ids=["both marks", "point and comma", "no number below", "another name", "no number in the first row", "thousands"],
)  # fmt: skip
def test_the_place_of_what_is_wrong_is_that_in_the_file(tmp_path, rows, message):
    path = tmp_path / "run.csv"
    path.write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(RecordingError, match=message):
        read(path)


def test_a_first_sample_is_no_unit(tmp_path):
    """Missing where all cells that are asked for are empty; of columns that nobody asks for nothing matters."""
    path = tmp_path / "run.csv"
    rows = [f"{NAMES};a;b", ";;;;", *(f"{0.01 * n:.2f};{n % 3};{n};run;ok" for n in range(1, 10))]
    path.write_text("\n".join(rows))
    found = Recording.from_csv(
        path,
        channels={"cart_position": "x"},
        kind="free",
        delimiter=";",
        sample_time=0.01,
        units={"cart_position": "mm"},
    )["run"]
    assert found.samples == 10
    assert np.isnan(found.outputs["cart_position"].values[0])


def test_columns_may_have_marks_of_their_own(tmp_path):
    """Times that a program wrote, and a voltage that another one did."""
    path = tmp_path / "run.csv"
    mixed = [f"{t};{i};{x}" for t, i, x in ((t, i.replace(".", ","), x) for t, i, x in NUMBERS)]
    path.write_text("\n".join([NAMES, *mixed]))
    np.testing.assert_allclose(read(path).inputs["current"].values, 0.1 * (np.arange(10) % 3), rtol=1e-12)


def test_what_is_no_text_is_refused_by_the_name_of_the_file(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("\n".join([NAMES, *ROWS]), encoding="utf-16")
    with pytest.raises(RecordingError, match=r"run.csv: .*not a readable text file .*zero bytes"):
        read(path)
    with pytest.raises(RecordingError, match=r"run.csv: .*not a readable text file"):
        csv_header(path, ";")


def test_a_file_without_names_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("60,0.0074,0\n61,0.0080,1\n62,0.0085,2\n")
    said = r"run.csv: row 1: holds numbers \(60, 0.0074, 0\) and no names; write a row"
    for column in ("60", "u"):
        with pytest.raises(RecordingError, match=said):
            Recording.from_csv(path, channels={"cart_position": column}, kind="free", sample_time=0.01)
    with pytest.raises(RecordingError, match=said):
        csv_header(path)


@pytest.mark.parametrize("above", ["position recording", "cart position against time"])
def test_words_above_the_names_are_no_names(tmp_path: Path, above: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(f"{above}\ntime,position\n" + "".join(f"{0.01 * k:.2f},{2e-2 * k:.3f}\n" for k in range(50)))
    found = Recording.from_csv(path, channels={"cart_position": "position"}, kind="free", sample_time=0.01)
    assert found.experiments[0].outputs["cart_position"].values[1] == 0.02
    assert csv_header(path) == ["time", "position"]


def test_a_number_above_the_names_is_not_taken_for_them(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("200.5\ntime,position\n0,1\n1,2\n")
    with pytest.raises(RecordingError, match="the column 'x' does not occur"):
        Recording.from_csv(path, channels={"cart_position": "x"}, kind="free", sample_time=0.01)


def test_columns_that_are_counted_have_names(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("0,1\n" + "".join(f"{0.01 * k},{0.02 * np.cos(0.1 * k)}\n" for k in range(100)))
    found = Recording.from_csv(path, channels={"cart_position": "1"}, kind="free", time="0")
    assert found.experiments[0].samples == 100


@pytest.mark.parametrize("delimiter", ["\t", "tab", "\\t"])
def test_names_between_spaces_over_columns_between_tabs_with_a_mark_at_the_end(tmp_path: Path, delimiter: str) -> None:
    path = tmp_path / "run.txt"
    path.write_text("t       y\n" + "".join(f"{0.01 * k:.2f}\t{0.02 * np.cos(0.1 * k):.6f}\t\n" for k in range(100)))
    assert csv_header(path, delimiter) == ["t", "y"]
    found = Recording.from_csv(
        path, channels={"cart_position": "y"}, kind="free", time="t", delimiter=delimiter
    ).experiments[0]
    assert found.outputs["cart_position"].values[0] == 0.02
    path.write_text("t\ty\n0\t1\t2\n")
    with pytest.raises(RecordingError, match="row 2: has 3 cells, but the header has 2"):
        Recording.from_csv(path, channels={"cart_position": "y"}, kind="free", time="t", delimiter=delimiter)
