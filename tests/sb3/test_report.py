"""The report of a synthetic run: what the page has, what it says is missing, what is refused."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser

import cv2
import made_run
import numpy as np
import pytest
import yaml
from made_run import buffer_of, film
from regil_wrappers import Demonstration
from regil_wrappers.formats.fuzz import damaged

from regil_sb3.report import run_page
from regil_sb3.report.charts import Line, line_chart
from regil_sb3.report.episode_alignment import align
from regil_sb3.report.page import flat
from regil_sb3.report.run_contents import read_run
from regil_sb3.report.run_page import write_report
from regil_sb3.report.success_films import load_films, save_films
from regil_sb3.success_buffer import SuccessBuffer

EVIL = "</script><script>alert('x')</script>&\"'"


@pytest.fixture
def run(tmp_path):
    return made_run.run(tmp_path / "run", note=EVIL)


class _Page(HTMLParser):
    """Texts, tags and addresses of a page; raises no error itself, so nesting is checked here."""

    VOID = ("meta", "input", "br")
    LEAVES = ("rect", "line", "circle", "polyline", "image")

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.words, self.count = [], [], [], {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.count[tag] = self.count.get(tag, 0) + 1
        self.addresses += [v for k, v in attrs if k in ("src", "href", "action", "data", "srcset")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def _page(run):
    text = write_report(run).read_text("utf-8")
    return text, _Page(text)


def test_a_whole_run_is_one_page_with_everything(run):
    text, page = _page(run)
    assert write_report(run) == run / "report.html"
    assert [word for word in page.words if word.endswith(" %") and word.count(" ") == 1][:3] == [
        "95 %",
        "25 %",
        "30 %",
    ]
    for title in (
        "Success over steps",
        "Reward over steps",
        "Success buffer",
        "Episodes",
        "An evaluation episode beside the demonstration",
        "What the success buffer holds",
        "Configuration",
    ):
        assert f"<h2>{title}</h2>" in text
    assert text.count('class="yes"') == 19 + 5 + 6
    assert 'title="seed 1000019: failure"' in text
    assert "19 of 20<br>" in text
    assert "unseen episodes after 15,000 steps (30,000 frames)" in text
    assert "Missing from this page" not in text
    assert list(run.glob("*.tmp")) == []


def test_page_asks_the_network_for_nothing(run):
    text, page = _page(run)
    assert page.addresses
    assert all(address.startswith("data:image/") for address in page.addresses)
    assert "default-src 'none'" in text
    assert "url(" not in text
    assert "@import" not in text


def test_both_themes_define_every_colour(run):
    text, _ = _page(run)
    light, dark = re.findall(r":root \{(.*?)\}", text, re.DOTALL)
    used = set(re.findall(r"var\(--([a-z_]+)\)", text)) - {"c"}
    for theme in (light, dark):
        assert used | {"corrected_guide", *(f"m{i}" for i in range(6))} == set(
            re.findall(r"--([a-z_0-9]+):", theme)
        )


def test_everything_read_from_files_is_escaped(run):
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["env"] = EVIL
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    evaluation = json.loads((run / "evaluation.json").read_text())
    evaluation["seeds"] = [EVIL] * 20
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    film(40, 6, success=EVIL, control_rate=25).save(run / "episode.hdf5")
    text, page = _page(run)
    assert "alert('x')" not in text
    assert page.count["script"] == 3
    assert f"ReGIL: {EVIL}" in page.words


def test_films_are_whole_sprite_sheets(run):
    text, _ = _page(run)
    data, kept = (json.loads(d) for d in re.findall(r'class="player-data">(.*?)</script>', text))
    assert data["rate"] == 40
    assert [clip["length"] for clip in data["clips"]] == [30, 40]
    for clip, name in zip(data["clips"], ("demo", "episode"), strict=True):
        code = np.frombuffer(base64.b64decode(clip["sprite"].split(",")[1]), np.uint8)
        sheet = cv2.cvtColor(cv2.imdecode(code, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        frames = Demonstration.load(run / f"{name}.hdf5").frames
        for i, frame in enumerate(frames):
            y, x = divmod(i, clip["columns"])
            tile = sheet[36 * y : 36 * (y + 1), 36 * x : 36 * (x + 1)].astype(int)
            assert np.abs(tile - frame).mean() < 4
    # The episode moves at 3/4 of the demonstration's pace.
    assert data["ends"][0] <= 1
    assert data["ends"][-1] >= 27
    assert [path[-1] for path in data["paths"]] == [[t, j] for t, j in enumerate(data["ends"])]
    assert len(data["rewards"]) == 39
    assert [clip["length"] for clip in kept["clips"]] == [16] * 5


def test_pictures_of_the_successbuffer_of(tmp_path):
    save_films(buffer_of(60), tmp_path / "kept.npz")
    kept = load_films(tmp_path / "kept.npz")
    assert kept.lengths == list(range(20, 80))
    assert (len(kept.films), kept.shown[0], kept.shown[-1]) == (24, 0, 59)
    np.testing.assert_array_equal(kept.films[-1][[0, -1]], film(79, 0).frames[[0, -1]])
    save_films(SuccessBuffer(5), tmp_path / "none.npz")
    assert load_films(tmp_path / "none.npz").lengths == []
    states = SuccessBuffer(50)
    states.add(np.zeros((9, 3), np.float32), np.zeros((9, 2), np.float32))
    save_films(states, tmp_path / "states.npz")
    assert (load_films(tmp_path / "states.npz").lengths, kept.shown[:2]) == ([9], [0, 3])


def test_a_demonstration_without_actions_is_not_in_the_success_buffer(run):
    page = write_report(run).read_text()
    assert "the demonstration first, then from old to new" in page
    assert '"name": "the demo"' in page
    dataclasses.replace(film(30, 0), actions=None).save(run / "demo.hdf5")
    page = write_report(run).read_text()
    assert "steps in all, from old to new" in page
    assert '"name": "the demo"' not in page


def test_rewards_are_the_runs_own(run):
    demo = Demonstration.load(run / "demo.hdf5")
    wrapper = {"regil_wrappers.RetrievalRewardWrapper": {"reward": "progress", "register": True}}
    aligned = align(demo, demo, {"encoder": "pixels", "env_wrapper": [wrapper]})
    assert aligned.reward == "progress"
    assert aligned.rewards[-1] == 0  # an exact replay ends at the demonstration's end
    assert min(np.diff(aligned.rewards)) > -0.01
    assert aligned.rewards[0] < -0.8
    late = align(
        demo,
        demo,
        {"env_wrapper": ["x", {"y": None}, {"z.RetrievalRewardWrapper": {"reward": "ot"}}]},
    )
    assert len(late.rewards) == len(demo) - 1
    assert max(late.rewards) < 0


def test_alignment_is_the_retrievers(run):
    demo = Demonstration.load(run / "demo.hdf5")
    aligned = align(demo, demo, {"encoder": "pixels", "k": 3, "horizon": 4})
    assert aligned.ends == list(range(30))
    assert aligned.distances.shape == (30, 30)
    assert np.diag(aligned.distances).max() == 0
    assert all(t == j for path in aligned.paths for t, j in path)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["episode.hdf5"], "episode.hdf5 is not there"),
        (["demo.hdf5"], "demo.hdf5 is not there"),
        (["evaluation.json"], "evaluation.json is not there"),
        (["progress.csv"], "progress.csv is not there"),
        (["config.yaml"], "config.yaml is not there"),
        (["demo.hdf5", "episode.hdf5", "evaluation.json", "progress.csv"], "no training progress"),
        (["demo.hdf5", "episode.hdf5", "config.yaml", "progress.csv"], "no training progress"),
    ],
)
def test_what_is_missing_is_said(run, names, said):
    for name in names:
        (run / name).unlink()
    text, _ = _page(run)
    assert "Missing from this page" in text
    assert said in text


@pytest.mark.parametrize(
    "name",
    [
        *("config.yaml", "progress.csv", "evaluation.json", "demo.hdf5", "episode.hdf5"),
        *("success_buffer.npz", "calibration.json"),
    ],
)
@pytest.mark.parametrize("content", [b"", b"\x00\x89{[", b"[1, 2]", b'{"policy": 3, "seeds": 4'])
def test_a_broken_file_costs_its_part_of_the_page_only(run, name, content):
    (run / name).write_bytes(content)
    text, _ = _page(run)
    assert "Missing from this page" in text
    assert "<h2>Episodes</h2>" in text or name == "evaluation.json"


@pytest.mark.parametrize("name", ["config.yaml", "evaluation.json", "calibration.json"])
def test_a_file_nested_too_deeply_costs_its_part_of_the_page_only(run, name):
    (run / name).write_text("[" * 100_000)
    assert f"{name} cannot be read" in _page(run)[0]


LAUGHS = "a0: &a0 {b: 1}\n" + "".join(
    f"a{i}: &a{i} {{{', '.join(f'k{n}: *a{i - 1}' for n in range(9))}}}\n" for i in range(1, 12)
)


@pytest.mark.parametrize("text", [LAUGHS, "a: &a {b: *a}", "a: &a [*a]", "defaults: 5"])
def test_settings_that_hold_themselves_cost_their_part_of_the_page_only(run, text):
    (run / "config.yaml").write_text(text)
    assert "config.yaml cannot be read" in _page(run)[0]


def test_numbers_that_cannot_be_drawn_are_left_out(run):
    whole = (run / "progress.csv").read_text().splitlines()
    for number in ("1e308", "-1e308", "1e-323"):
        cells = ",".join([number] * whole[0].count(",")) + ",7000"
        (run / "progress.csv").write_text("\n".join([*whole, cells]) + "\n")
        assert "<h2>Success over steps</h2>" in _page(run)[0]
    for episodes in (4_000_000_000, 1e300, -1):
        result = {"success": 1.0, "episodes": episodes}
        (run / "evaluation.json").write_text(json.dumps({"policy": result}))
        assert "not evaluated: Policy" in _page(run)[0]


def test_damaged_films_are_left_out(run):
    path, rng = run / "success_buffer.npz", np.random.default_rng(0)
    content = path.read_bytes()
    others = [f for f in run.iterdir() if f.name not in ("config.yaml", path.name)]
    for other in others:
        other.unlink()
    left_out = 0
    for _ in range(400):
        path.write_bytes(damaged(content, rng, content))
        left_out += read_run(run).kept is None
    assert left_out > 100


def test_a_run_interrupted_while_it_wrote_a_line(run):
    whole = (run / "progress.csv").read_text()
    (run / "progress.csv").write_text(whole[: len(whole) - 40] + "\n7000,nan,inf,x,-,,,,,,9,9\n")
    text, _ = _page(run)
    assert "<h2>Success over steps</h2>" in text
    assert "nan" not in re.sub(r"base64,[^\"]*", "", text)


def test_results_of_another_shape_count_as_not_evaluated(run):
    (run / "evaluation.json").write_text('{"policy": 3, "guide": {"success": "x"}, "seeds": 4}')
    text, _ = _page(run)
    assert "not evaluated: Policy, Guided replay, BC alone" in text


def test_only_what_was_evaluated_is_compared(run):
    (run / "evaluation.json").write_text(json.dumps({"policy": {"success": 0.5, "episodes": 4}}))
    text, _ = _page(run)
    assert "2 of 4<br>" in text
    assert "not evaluated: Guided replay, BC alone" in text


def test_an_encoder_that_is_not_here_costs_the_alignment_only(run):
    (run / "config.yaml").write_text("encoder: no-such-encoder\n")
    text, _ = _page(run)
    assert "no-such-encoder" in text
    assert "distances and warping path" not in text
    assert "<h2>An evaluation episode beside the demonstration</h2>" in text


def test_out_is_where_the_page_goes(run, tmp_path):
    out = tmp_path / "new" / "page.html"
    assert write_report(str(run), str(out)) == out
    assert out.is_file()
    assert not (run / "report.html").exists()
    with pytest.raises(ValueError, match=r"^out '.*' is a folder"):
        write_report(run, tmp_path)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    (tmp_path / "report.html").write_text("mine")
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match="is not a run folder") as error:
            write_report(folder)
        assert "\n" not in str(error.value)
    assert (tmp_path / "report.html").read_text() == "mine"


def test_guided_stretches_are_joined():
    rows = [{"time/total_timesteps": s, "time/guided": g} for s, g in ((10, 1), (20, 1), (30, 0))]
    assert run_page._guided(rows) == [(0, 20)]
    rows.append({"time/total_timesteps": 40, "time/guided": 1})
    assert run_page._guided(rows) == [(0, 20), (30, 40)]


def test_nested_settings_become_one_table():
    settings = {"a": {"b": {"c": 1}, "empty": {}}, "wrap": [{"x": {"k": 5}}, "y"], "flat": [1, 2]}
    assert flat(settings) == [
        ("a.b.c", 1),
        ("a.empty", {}),
        ("wrap.0.x.k", 5),
        ("wrap.1", "y"),
        ("flat", [1, 2]),
    ]


@pytest.mark.parametrize("values", [[0.0], [5.0, 5.0], [-1e-9, 1e9], [-2.0, -1.0], [0.0, 0.0]])
def test_charts_draw_any_finite_values_inside_their_frame(values):
    svg = line_chart([Line("a", "policy", list(enumerate(values)))])
    numbers = re.findall(r'points="([^"]*)"', svg)
    for x, y in (pair.split(",") for points in numbers for pair in points.split()):
        assert 0 <= float(x) <= 480
        assert 0 <= float(y) <= 290


def test_a_chart_without_points_is_nothing():
    assert line_chart([Line("a", "policy", [])], [(0, 1)]) == ""
