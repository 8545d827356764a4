"""Files of results: whole or not there, numbers that JSON can hold, and a page that shows what it is given."""

import json
import math

import pytest

from estimators.reporting.html import Table, write_json, write_report


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "x.json", {"a": [math.nan, math.inf, 1.5], "b": (1, True, None, "ä")})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": [None, None, 1.5], "b": [1, True, None, "ä"]}


def test_a_failed_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "x.json"
    write_json(target, {"a": 1})
    with pytest.raises(TypeError):
        write_json(target, {"a": object()})
    assert json.loads(target.read_text()) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["x.json"]


def test_a_report_escapes_what_it_is_given(tmp_path):
    table = Table(("<b>", "n"), (("a & b", "1.5"), ("", "-2")), "<caption>")
    write_report(tmp_path / "r.html", "<title> & more", [("<h>", ["<p>", table])])
    page = (tmp_path / "r.html").read_text()
    assert "&lt;title&gt; &amp; more" in page
    for raw in ("<b>", "<h>", "<p><p>", "<caption><caption>"):
        assert raw not in page
    assert '<td class="n" data-head="n">1.5</td>' in page
