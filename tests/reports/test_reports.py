"""Reports: the answer first and right, figures that carry units and survive a black-and-white printer, one file."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.commands import Excite

from excite.cli import terminal
from excite.logs import profile as profiles
from excite.model import Model
from excite.reports import COLOURS, Picture, Table, charts, describe, design_figures, html, pages, save
from excite.simulation import Motion

RESULTS = Path(__file__).parents[2] / "results"
VERSIONS = {"excite": "1", "numpy": "2"}


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    figure = Figure(figsize=(6, 3))
    figure.subplots().plot([0, 1], [0, 1])
    save(figure, tmp_path / "design.png")
    return tmp_path / "design.png"


def test_answer_comes_first_then_figure_table_and_how(picture: Path) -> None:
    text = html.report_page(
        "Title",
        "The answer is 42.",
        [Picture(picture, "A line [m] over time [s].")],
        [Table("Numbers.", ("name", "value"), (("a", "1"), ("b", "2")), marked=(1,))],
        {"command": "excite design va12", "seed": "3"},
        ["A remark."],
    )
    order = [
        "The answer is 42.",
        "A remark.",
        "Figure 1. A line [m]",
        "Table 1. Numbers.",
        "<td>1</td>",
        "excite design",
    ]
    places = [text.rindex(words) for words in order]
    assert places == sorted(places)
    assert re.findall(r'(?:src|href)="(?!data:)[^"]*"', text) == []
    assert text.count('class="mark"') == 1
    with pytest.raises(ValueError, match="row 0 has 1 cells, not 2"):
        Table("t", ("a", "b"), (("1",),))


def test_names_from_files_cannot_break_the_page() -> None:
    text = html.report_page("<b>", "x < y & z", how={"logs": "<script>alert(1)</script>.csv"})
    assert "<script>alert" not in text
    assert "x &lt; y &amp; z" in text


def test_verify_answers_with_error_against_the_truth() -> None:
    """Error of a parameter: bias and spread together; 5 = |(3, 4)|."""

    def row(bias: float, spread: float, cover: float) -> dict[str, Any]:
        percent = {"bias_percent": bias, "std_percent": spread, "predicted_std_percent": 1.0}
        percent["rms_percent"] = float(np.hypot(bias, spread))
        return {"unit": "kg", "true": 10.0, "mean": 10.1, "coverage95": cover, **percent}

    rows = {"a": row(3, 4, 0.8), "b": row(0, 1, 1.0), "c": row(0.0, 2.0, 0.9)}
    summary = {
        "machine": "m",
        "runs": 7,
        "parameters": rows,
        "biased": ["a"],
        "failed": 0,
        "versions": VERSIONS,
    }
    described = describe("verify", summary)
    answer, (table,) = described.headline, described.tables
    assert "7 simulated" in answer
    assert "within 2 % of the truth" in answer
    assert "worst a, 5 %" in answer
    assert "held it in 90 % of cases" in answer
    assert described.remarks == ("Biased, the intervals do not hold: a.",)
    assert table.marked == (0,)


def test_a_narrow_terminal_shows_every_name_and_number(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It leaves out explanations and stacks headings rather than cut a cell."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    summary = json.loads((RESULTS / "R60_accuracy" / "verify" / "summary.json").read_text())
    shown = {}
    for width in (80, 200):
        monkeypatch.setenv("COLUMNS", str(width))
        terminal.show("verify", summary)
        shown[width] = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
        assert max(map(len, shown[width].splitlines())) <= width
        for name, row in summary["parameters"].items():
            assert re.search(rf"^ +{name} .* {row['mean']:.6g} ", shown[width], re.M)
    assert "mass, whole machine" in shown[200]
    assert "mass, whole machine" not in shown[80]


def test_design_answers_with_what_can_be_known() -> None:
    summary = json.loads((RESULTS / "R60_accuracy" / "design" / "summary.json").read_text())
    described = describe("design", summary)
    answer, tables = described.headline, described.tables
    assert "every parameter to 0.87 %" in answer
    assert "every limit is kept" in answer
    assert tables[0].rows[0][0] == "u20"
    described = describe("design", summary | {"max_violation": 0.02, "violations": {"power": 0.02}})
    answer, tables = described.headline, described.tables
    assert "limits broken: power by 2 % of the range" in answer
    assert tables[1].rows == (("power", "2.000 % of its range"),)


def test_a_design_for_cond_says_the_other_end_in_a_line() -> None:
    summary = json.loads((RESULTS / "R60_accuracy" / "design" / "summary.json").read_text()) | {"objective": "cond"}
    assert (
        "The other end, the drive of `--objective accuracy`, was not looked for." in describe("design", summary).remarks
    )
    end = {"cond_phi": 90.0, "worst_parameter": "u20", "worst_percent": 0.87, "median_percent": 0.3}
    both = {"most_accurate": {**end, "folder": "accurate"}, "lowest_cond": end | {"cond_phi": 17.0}}
    said = describe("design", summary | both | {"cond_slack_percent": 12.0})
    line = "u20 to 0.87 % or better at cond(Phi) 90; the folder accurate has it to drive."
    assert f"The other end, `--objective accuracy` from this drive: {line}" in said.remarks
    assert [row[0] for row in said.tables[0].rows] == [
        "lowest cond(Phi), --cond-slack 0",
        "this drive, the most accurate within 12 %",
        "for accuracy, --objective accuracy",
    ]


def test_compare_says_which_way() -> None:
    summary = json.loads((RESULTS / "compare_R60" / "summary.json").read_text())
    described = describe("compare", summary | {"ratio_equal_time": 6.8})
    (table,) = described.tables
    assert "6.8 times lower" in described.headline
    assert table.rows[table.marked[0]][0] == "designed"
    assert "3 times higher" in describe("compare", summary | {"ratio_equal_time": 1 / 3}).headline
    assert "No usual drive" in describe("compare", summary | {"ratio_equal_time": None}).headline


@pytest.mark.slow
def test_identify_reports_what_was_found(
    excite: Excite, straight: Model, straight_motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    profile, out = tmp_path / "profile.csv", tmp_path / "o"
    profiles.profile_of(straight, straight_motion).to_csv(profile, index=False)
    excite("simulate", "va12_straight", profile, "--noise", "off", "--out", tmp_path / "log.csv")
    code, _, _ = excite("identify", "va12_straight", tmp_path / "log.csv", "--method", "ols", "--out", out)
    assert code == 0
    text = (out / "report.html").read_text()
    summary = json.loads((out / "summary.json").read_text())
    assert f"<code>excite identify va12_straight {tmp_path / 'log.csv'} --method ols --out {out}</code>" in text
    for name, row in summary["parameters"].items():
        decimals = 1 - int(np.floor(np.log10(row["std"])))  # two digits of the standard deviation
        numbers = (f"{round(row[key], decimals):.{max(decimals, 0)}f}" for key in ("value", "std"))
        cells = (name, summary["meanings"][name], re.escape(row["unit"]), *numbers)
        assert re.search("".join(f"<td[^>]*>{cell}</td>" for cell in cells), text)
    assert summary["meanings"]["u10"] == "torque offset, front roll"
    assert (
        text.count('src="data:image/png;base64,') == 3
    )  # torques, shares of each uncertainty, correlation of the errors
    assert f"for {tmp_path / 'log.csv'}. Each torque is predicted from the motion that the log shows" in text
    code, _, _ = excite("identify", "va12_straight", tmp_path / "log.csv", "--method", "ols", "--out", out)
    assert code == 0  # a folder with a report in it is ours and may be replaced


@pytest.mark.slow
def test_what_a_method_errs_by_comes_first(excite: Excite, tmp_path: Path) -> None:
    """Least squares on the drive of lowest condition number: small deviations, a mass of a fifteenth."""
    profile = Path(__file__).parents[2] / "results" / "S40" / "design" / "profile.csv"
    excite("simulate", "va12_straight", profile, "--seed", 3, "--out", tmp_path / "log.csv")
    for method, words in (
        ("ols", "95 % intervals do not hold"),
        ("ols", "parameters by more than it says"),
        ("joint", "are identified to"),
    ):
        out = tmp_path / method
        code, _, _ = excite("identify", "va12_straight", tmp_path / "log.csv", "--method", method, "--out", out)
        assert code == 0
        assert words in " ".join((out / "report.html").read_text().split())
    summary = json.loads((tmp_path / "ols" / "summary.json").read_text())
    assert summary["parameters"]["M"]["bias"] == pytest.approx(-10_300, rel=0.05)
    assert any("far from the machine file's values" in note for note in summary["notes"])


def _figures(model: Model, motion: Motion) -> list[Figure]:
    problem = model.machine.problems[str(model.machine.problem)]
    sigma = dict(zip(model.base.names, np.linspace(0.1, 5, len(model.base.names)), strict=True))
    return [design_figures.design_figure(model, problem, motion, "t"), design_figures.sigma_figure(sigma, "t")]


def test_figures_have_units_and_line_styles_of_their_own(va12: Model, va12_motion: Motion) -> None:
    """In black and white only the style tells curves apart; an axis without a unit tells nothing."""
    checked = 0
    for figure in _figures(va12, va12_motion):
        for ax in figure.axes:
            curves = [line for line in ax.lines if not str(line.get_label()).startswith("_")]
            styles = [line._dash_pattern for line in curves]  # type: ignore[attr-defined]
            if len(curves) > 1:
                assert len({str(s) for s in styles}) == len(styles)
                checked += 1
            assert re.search(r"\[.+\]", ax.get_xlabel() + ax.get_ylabel()), ax.get_title()
    assert checked >= 4


def test_colours_differ_for_the_colour_blind() -> None:
    """Seen through protanopia and deuteranopia (Vienot, Brettel and Mollon, 1999) the first four still differ."""
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    blind = {
        "protan": np.array([[0, 2.02344, -2.52581], [0, 1, 0], [0, 0, 1]]),
        "deutan": np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]]),
    }
    rgb = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in COLOURS[:4]]) / 255.0
    for matrix in blind.values():
        seen = rgb**2.2 @ to_lms.T @ matrix.T @ np.linalg.inv(to_lms).T
        seen = np.clip(seen, 0, 1) ** (1 / 2.2)
        gaps = [np.linalg.norm(a - b) for k, a in enumerate(seen) for b in seen[k + 1 :]]
        assert min(gaps) > 0.12


def test_report_in_a_browser_fits_screen_and_paper(browser: Any, tmp_path: Path) -> None:
    source = RESULTS / "R60_accuracy" / "verify"
    summary = json.loads((source / "summary.json").read_text())
    (tmp_path / "verify.png").write_bytes((source / "verify.png").read_bytes())
    pages.write_report(tmp_path, "verify", summary)
    for size in ((1000, 800), (390, 844)):
        tab = browser.new_page(viewport={"width": size[0], "height": size[1]})
        said: list[str] = []
        tab.on("console", lambda message, said=said: said.append(message.text))
        tab.on("request", lambda r, said=said: said.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
        tab.goto((tmp_path / "report.html").as_uri())
        assert tab.evaluate("document.documentElement.scrollWidth") <= size[0]
        assert tab.evaluate("Array.from(document.images).every(i => i.complete && i.naturalWidth > 500)")
        top = tab.locator(".answer").bounding_box()
        assert top["y"] < 120
        paper = tab.pdf(prefer_css_page_size=True)
        assert 1 <= len(re.findall(rb"/Type\s*/Page\b", paper)) <= 3
        assert said == []
        tab.close()


def test_charts_keep_every_peak_and_gap() -> None:
    """Of a long log the extremes of every stretch stay, whatever is left out between them."""
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 60_000)).cumsum(axis=1)
    second[30_000:31_000] = np.nan
    kept = charts.thin_out([first, second], 2000)
    assert len(kept) < 2300
    for y in (first, second):
        for part in np.array_split(np.arange(60_000), 500):
            here = kept[(kept >= part[0]) & (kept <= part[-1])]
            if np.isfinite(y[part]).any():
                assert np.nanmax(y[here]) == np.nanmax(y[part])
                assert np.nanmin(y[here]) == np.nanmin(y[part])
            else:
                assert len(here)
    assert charts.thin_out([first], 60_000).tolist() == list(range(60_000))


def test_axes_without_anything_to_show_give_no_panel(caplog: pytest.LogCaptureFixture) -> None:
    """Hidden axes that fill up a figure, and axes with no more than a word, which stays in the picture."""
    figure = Figure()
    first, hidden, wordy = figure.subplots(3, 1, sharex=True)
    first.plot([0, 1], [2, 3])
    hidden.set_visible(False)
    wordy.set_xlabel("time [s]")
    shown = charts.explorable(figure)
    assert (len(shown.panels), shown.whole) == (1, False)
    wordy.set_visible(False)
    shown = charts.explorable(figure)
    assert (len(shown.panels), shown.whole) == (1, True)
    charts.documents({"log.png": shown.panels})
    assert "MISSING_RENDERERS" not in caplog.text


def test_a_report_zooms_sorts_and_copies(browser: Any, va12: Model, va12_motion: Motion, tmp_path: Path) -> None:
    """In a browser: linked charts with values under the pointer, sortable tables, and no network; on paper pictures."""
    problem = va12.machine.problems[str(va12.machine.problem)]
    figure = design_figures.design_figure(va12, problem, va12_motion, "t")
    shown = save(figure, tmp_path / "design.png")
    panels = shown.panels
    assert [p.y_label for p in panels] == ["torque [% of limit]", "speed [m/s]", "angle [rad]", "largest slip [-]"]
    assert panels[1].curves[0].y == pytest.approx(va12_motion.nu[:, 0])
    assert not shown.whole  # the path and the use of limits are in the picture alone
    chart = charts.documents({"design.png": panels})["design.png"]
    table = Table("T", ("name", "value"), (("a,b", "10"), ('c"', "9"), ("<i>", "-"), ("d", "< 1e-12")))
    picture = html.Picture(tmp_path / "design.png", "c", chart, shown.whole)
    text = html.report_page("t", "a", [picture], [table], remarks=["<script>alert(1)</script>"])
    assert len(text) - (tmp_path / "design.png").stat().st_size * 4 / 3 < 2e6
    (tmp_path / "report.html").write_text(text)
    tab = browser.new_page(viewport={"width": 1000, "height": 900})
    said: list[str] = []
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    tab.on("request", lambda r: said.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
    tab.goto((tmp_path / "report.html").as_uri())
    tab.locator(".zoom summary").click()  # the picture is shown once, its curves on request
    tab.wait_for_function("window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].is_idle")
    ranges = "Bokeh.documents[0].roots()[0].children.map(c => [c[0].x_range.start, c[0].x_range.end])"
    before = tab.evaluate(ranges)
    assert len(before) == 4
    tab.locator(".chart").evaluate("place => place.scrollIntoView()")
    box = tab.locator(".chart").bounding_box()
    tab.mouse.move(box["x"] + 300, box["y"] + 120)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 500, box["y"] + 150, steps=4)
    tab.mouse.up()
    tab.wait_for_timeout(200)
    after = tab.evaluate(ranges)
    assert all(x == after[0] for x in after)
    assert after[0][1] - after[0][0] < 0.5 * (before[0][1] - before[0][0])
    cells = "[...document.querySelectorAll('tbody td:first-child')].map(c => c.textContent)"
    tab.get_by_role("button", name="value").click()
    assert tab.evaluate(cells) == ["d", 'c"', "a,b", "<i>"]
    tab.evaluate("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
    tab.get_by_role("button", name="Copy as CSV").click()
    rows = list(csv.reader(io.StringIO(tab.evaluate("window.copied"))))
    assert rows[0] == ["name", "value"]
    assert sorted(rows[1:]) == sorted([list(row) for row in table.rows])
    tab.emulate_media(media="print")
    assert tab.evaluate("getComputedStyle(document.querySelector('.chart')).display") == "none"
    assert said == []
    tab.close()
