"""`regil bench results`: one page of the tables that are kept, and one with their plots."""

from __future__ import annotations

import re

import made_run
import pytest

from regil_sb3.bench.page import figure, write
from regil_sb3.cli import main

TABLE = ["| H | success |", "|---|---|", "| 4 | 0.50 |", "| **mean** | 0.25 < 1 |"]
ROWS = [{"H": 4, "success": 0.5}]


@pytest.fixture
def bench(tmp_path):
    write(tmp_path / "bench", "sensitivity", {"episodes": 7}, TABLE, "On a machine & more", ROWS)
    return tmp_path / "bench"


def words(bench, page):
    return ["bench", "results", "--out", str(bench), "--page", str(page)]


def test_results_are_the_tables_that_are_kept(bench, tmp_path, capsys):
    page = tmp_path / "results.md"
    assert main(words(bench, page)) == 0
    assert capsys.readouterr().out == f"{page}: sensitivity; 9 not there yet\n"
    text = page.read_text()
    table = "\n".join(TABLE)
    command = "    regil bench sensitivity --episodes 7"
    assert f"## sensitivity\n\n{command}\n\n{table}\n\nOn a machine & more\n\n## Not" in text
    not_yet = ": not measured yet\n"
    assert f"* `regil bench success-buffer`{not_yet}* `regil bench ablations`{not_yet}" in text
    assert f"* `regil bench trajectories --runs RUN`{not_yet}" in text
    assert text.endswith(f"* `regil bench real-time`{not_yet}")
    shown = (tmp_path / "results.html").read_text()
    assert "<code>regil bench sensitivity --episodes 7</code>" in shown
    assert "<tr><td>mean</td><td>0.25 &lt; 1</td></tr>" in shown
    assert "On a machine &amp; more" in shown
    assert "<li>regil bench baselines: not measured yet</li>" in shown
    assert "<img" not in shown


def test_learning_tables_have_plots(bench, tmp_path):
    rows = []
    for method, solved in (("ReGIL", (19, 17)), ("RL", (3, 5))):
        for seed in (0, 1):
            folder = bench / f"metaworld-hammer-{method}-{seed}-15000"
            of = {"task": "hammer", "method": method, "seed": seed, "run": folder.name}
            rows += [{**of, "evaluated": "policy", "episode": episode} for episode in range(2)]
            env = "regil/metaworld-hammer-v0"
            made_run.run(folder, env, seed, solved[seed], films=False)
    rows.append({**rows[0], "run": "metaworld-hammer-ReGIL-2-15000"})
    rows.append({**rows[0], "method": "guide", "evaluated": "guide"})  # has no curve
    write(bench, "ablations", {}, TABLE, "there", rows)
    with figure(bench / "trajectories.png") as ((axis,),):
        axis.plot([0, 1], [0, 1])
    write(bench, "trajectories", {}, TABLE, "here", ROWS)
    assert main(words(bench, tmp_path / "results.md")) == 0
    what = "`regil bench ablations`: 20 of its 20 runs are not there\n"  # hammer is not its task
    assert what in (tmp_path / "results.md").read_text()
    shown = (tmp_path / "results.html").read_text()
    assert shown.count('src="data:image/png;base64,') == 1
    assert re.findall(r"<b>(\d+) %</b>", shown) == ["90", "20"]
    assert shown.count('class="spread"') == 2  # the IQM's interval, over steps
    assert re.search(r"<td>RL</td><td>0 % \(0 to 0 %\)", shown)  # none beats one of the first
    assert "<td>90 % (85 to 95, 2 runs)</td>" in shown
    assert "metaworld-hammer-ReGIL-2-15000, a run of ablations, is not there any more" in shown


def test_of_many_methods_each_is_drawn_with_its_own_changes(bench, tmp_path):
    methods = [
        of + change for of in ("ReGIL", "BC") for change in ("", *map("_{}".format, range(9)))
    ]
    rows = []
    for method in methods:
        folder = bench / f"metaworld-hammer-{method}-2-15000"
        made_run.run(folder, "regil/metaworld-hammer-v0", 2, 19, films=False)
        rows.append({"method": method, "run": folder.name, "evaluated": "policy"})
    write(bench, "tuning", {}, TABLE, "there", rows)
    assert main(words(bench, tmp_path / "results.md")) == 0
    shown = (tmp_path / "results.html").read_text()
    parts = shown.split("Success in unseen episodes, interquartile mean")[1:]
    assert [re.findall(r"<span>((?:ReGIL|BC)\w*)</span>", part) for part in parts] == [
        methods[:10],
        methods[10:],
    ]


def test_a_table_of_more_steps_stands_beside_its_own(bench, tmp_path):
    for called in ("ablations-60000", "ablations-7500", ""):
        rows = [{"task": "hammer", "method": "RL", "run": "gone", "evaluated": "policy"}]
        write(bench, "ablations", {}, TABLE, f"of {called}", rows, called)
    assert main(words(bench, tmp_path / "results.md")) == 0
    titles = re.findall(r"^## (.*)", (tmp_path / "results.md").read_text(), re.M)
    assert titles[:4] == ["sensitivity", "ablations", "ablations-7500", "ablations-60000"]


def test_latex_says_the_same(bench):
    write(
        bench, "success-buffer", {}, ["| a_b | c |", "|---|---|", "| **x** | 3 ± 1 % |"], "", ROWS
    )
    body = (bench / "success-buffer.tex").read_text().splitlines()[2:5]
    assert body == [r"a\_b & c \\", r"\midrule", r"\textbf{x} & 3 $\pm$ 1 \% \\"]


@pytest.mark.parametrize(
    ("page", "said"),
    [
        ("none/results.md", "there is no folder"),
        ("results.html", "its name must end in .md"),
    ],
)
def test_bad_options_get_one_line(bench, tmp_path, page, said, capsys):
    assert main(words(bench, tmp_path / page)) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert main(words(tmp_path, tmp_path / "results.md")) == 2
    assert "no table is there; make one: regil bench sensitivity" in capsys.readouterr().err
    (bench / "rewards.md").write_text("half a ta")
    assert main(words(bench, tmp_path / "results.md")) == 2
    assert "rewards.md is no table: remove it" in capsys.readouterr().err
    assert not (tmp_path / "results.md").exists()
