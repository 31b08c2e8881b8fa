"""The report: the shipped claims agree with the recorded rows, and whatever is wrong is refused by name."""
import pandas as pd
import pytest
from scipy.stats import t as student

from pdkit import cli, report
from pdkit.files import DATA
from pdkit.stats import wilson

TESTED = {"claim": "It works.", "section": "D.1", "tasks": "Door", "seeds": "0 1", "measured": "97 %", "interval": "95 to 99 % (Wilson)",
          "verdict": "reproduced", "command": "pdkit train decorated Door"}
UNTESTED = dict.fromkeys(report.COLUMNS, "") | {"claim": "It <b>might</b>, too.", "section": "F.3", "verdict": "untested",
                                                   "measured": "Nothing was run."}
ROW = {"task": "Door", "recipe": "lesson", "seed": 0, "base_success": 0.5, "decorated_success": 0.9,
       "command": "pdkit train decorated Door"}


@pytest.fixture
def results(tmp_path, monkeypatch):
    """data/results in a temporary folder, filled with what is right."""
    monkeypatch.setattr(report, "DATA", tmp_path)
    folder = tmp_path / "results"
    folder.mkdir()
    pd.DataFrame([TESTED, UNTESTED]).to_csv(folder / "claims.csv", index=False)
    pd.DataFrame([ROW]).to_csv(folder / "main.csv", index=False)
    pd.DataFrame([{"step": 1, "task": "Door", "recipe": "lesson", "seed": 0}]).to_csv(folder / "main_curves.csv", index=False)
    return folder


def call(results, capsys) -> tuple[int, str, str]:
    code = cli.main(["report", "--out", str(results / "page.html")])
    return code, *capsys.readouterr()


def test_the_report_prints_the_claims_and_writes_a_page(results, capsys):
    code, out, err = call(results, capsys)
    assert (code, err) == (0, "")
    assert "reproduced  D.1               It works." in out and "97 %; 95 to 99 % (Wilson)" in out and "Door, seeds 0 1" in out
    assert "Nothing was run." in out and ";" not in out[out.index("Nothing was run."):].splitlines()[0]
    assert "1 reproduced, 0 partly, 0 not, 1 untested; 1 rows in 1 recorded tables" in out
    html = (results / "page.html").read_text()
    assert "It works." in html and "It &lt;b&gt;might&lt;/b&gt;, too." in html
    assert "Nothing was run." in html and "Recorded: main" in html and "nan" not in html


def test_a_table_that_is_being_written_is_not_read(results, capsys):
    (results / "main_curves.csv.tmp-123.csv").write_text("half of a li")
    assert call(results, capsys)[0] == 0


@pytest.mark.parametrize("changes, said", [
    ({"verdict": "maybe"}, "has the verdict 'maybe'; known are reproduced, partly, not, untested."),
    ({"verdict": "untested"}, "is untested but has seeds, interval, command"),
    ({"measured": ""}, "is 'reproduced' but lacks measured."),
    ({"interval": " ", "seeds": "", "verdict": "not"}, "is 'not' but lacks seeds, interval."),
    ({"command": "", "verdict": "partly"}, "is 'partly' but lacks command."),
    ({"tasks": ""}, "lacks tasks."),
    ({"seeds": "five"}, "has the seeds 'five'"),
    ({"measured": "much better"}, "has no number in measured."),
    ({"interval": "narrow"}, "has no number in interval."),
    ({"command": "python x.py"}, "none of pdkit's"),
    ({"section": ""}, "lacks its section."),
    ({"claim": ""}, "lacks its sentence."),
    ({"claim": UNTESTED["claim"]}, "listed 2 times"),
])
def test_a_wrong_claim_is_named_and_no_page_written(results, capsys, changes, said):
    pd.DataFrame([TESTED | changes, UNTESTED]).to_csv(results / "claims.csv", index=False)
    code, out, err = call(results, capsys)
    assert code == 1 and said in err and len(err.strip().splitlines()) == 1
    assert out == "" and not (results / "page.html").exists()


@pytest.mark.parametrize("rows, said", [
    ([ROW | {"command": None}], "main.csv has a row without the command that makes it again (line 2); was the file cut off?"),
    ([ROW, ROW], "main.csv has 1 rows more than once"),
    ([ROW | {"decorated_success": 90.0}], "decorated_success that is no rate"),
    ([ROW | {"base_success": None}], "base_success that is no rate"),
    ([ROW, ROW | {"seed": 1}], "main_curves.csv has no curve of Door lesson 1."),
])
def test_a_broken_table_is_named(results, capsys, rows, said):
    pd.DataFrame(rows).to_csv(results / "main.csv", index=False)
    code, _, err = call(results, capsys)
    assert code == 1 and said in err and len(err.strip().splitlines()) == 1


def test_a_table_on_which_a_verdict_rests_is_missed(results, capsys):
    claim = TESTED | {"command": "pdkit sweep data/sweeps/calql.toml; pdkit nb 09"}
    pd.DataFrame([claim, UNTESTED]).to_csv(results / "claims.csv", index=False)
    (results.parent / "sweeps").mkdir()
    (results.parent / "sweeps" / "calql.toml").write_text('record = "calql"')
    code, _, err = call(results, capsys)
    assert (code, err) == (1, "calql.csv is missing, on which verdicts rest; `pdkit sweep data/sweeps/calql.toml` makes it.\n")
    pd.DataFrame([ROW]).to_csv(results / "calql.csv", index=False)
    assert call(results, capsys)[0] == 0


def test_a_table_with_other_keys_needs_only_its_commands(results, capsys):
    pd.DataFrame([{"updates": 100, "drift": 2.5, "command": "pdkit nb 06"}]).to_csv(results / "unlearning.csv", index=False)
    assert call(results, capsys)[0] == 0


@pytest.mark.parametrize("text, said", [("claim,section\na,b\n", "must have the columns"), ("", "not a readable CSV"),
                                        (None, "Cannot read")])
def test_a_missing_or_foreign_file_is_one_sentence(results, capsys, text, said):
    (results / "claims.csv").unlink()
    if text is not None:
        (results / "claims.csv").write_text(text)
    code, _, err = call(results, capsys)
    assert code == 2 and said in err and len(err.strip().splitlines()) == 1


def test_the_shipped_claims_and_tables_are_right(tmp_path, capsys):
    assert cli.main(["report", "--out", str(tmp_path / "report.html")]) == 0, capsys.readouterr().err
    claims = report.load_claims(DATA / "results" / "claims.csv")
    for section in ("Fig. 1", "C.1", "C.2", "D.1", "D.2", "D.3", "E.1", "E.2", "F.1", "F.2", "F.3", "F.4", "F.5.1", "F.5.2", "G.1", "G.2"):
        assert claims.section.str.split(r",\s*").apply(lambda names, s=section: s in names).any(), section


def test_the_readme_tells_how_many_claims_hold():
    claims = report.load_claims(DATA / "results" / "claims.csv")
    held = claims.verdict.value_counts()
    told = ", ".join(f"{held[verdict]} {verdict}" for verdict in ("reproduced", "partly", "not", "untested"))
    text = (DATA.parent / "README.md").read_text().replace("\n  ", " ")
    assert f"{held.sum()} claims of the paper: {told}," in text
    over_0 = claims.interval[claims.verdict == "not"].str.contains(r"-[\d.]+ to \+[\d.]+ points")
    assert f"""For {over_0.sum()} of the "not" the interval of what is judged includes 0""" in text


def test_the_claim_about_door_says_what_the_recorded_rows_say():
    claim = report.load_claims(DATA / "results" / "claims.csv").set_index("section").loc["Fig. 1"].iloc[0]
    table = pd.read_csv(DATA / "results" / "main_job.csv").query("task == 'Door' and recipe == 'lesson'")
    good = wilson(int((table.decorated_success >= 0.95).sum()), len(table))
    ends = table.decorated_success
    low, high = student.interval(0.95, len(ends) - 1, ends.mean(), ends.sem())  # a bootstrap of five values would be too narrow
    assert claim.seeds == " ".join(map(str, sorted(table.seed)))
    assert claim.measured.startswith(f"{good.successes} of {good.n} seeds reach 95 %")
    assert f"mean {100 * ends.mean():.1f} %" in claim.measured
    assert f"{100 * good.low:.0f} to {100 * good.high:.0f} % (Wilson" in claim.interval
    assert f"mean {100 * low:.1f} % to {100 * min(high, 1):.1f} %" in claim.interval
